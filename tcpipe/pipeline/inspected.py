"""What `tcpipe inspect` says of a map and of a dataset: all that they say of themselves. It takes longer to load than a log to inspect."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from tcpipe.formats.dataset_card import DatasetCard
from tcpipe.formats.maps.map_facts import MapSummary


@dataclass(frozen=True, slots=True, kw_only=True)
class InspectedMap(MapSummary):
    """What a map is."""

    kind: Literal["map"] = "map"
    path: str


@dataclass(frozen=True, slots=True, kw_only=True)
class InspectedDataset(DatasetCard):
    """What a dataset is: its card."""

    kind: Literal["dataset"] = "dataset"
    path: str
