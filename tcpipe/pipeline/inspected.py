"""Results of `tcpipe inspect` for maps and datasets; apart from those for logs, because these imports take long."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from tcpipe.formats.dataset_card import DatasetCard
from tcpipe.formats.maps.map_facts import MapSummary


@dataclass(frozen=True, slots=True, kw_only=True)
class InspectedMap(MapSummary):
    """Summary of a map."""

    kind: Literal["map"] = "map"
    path: str


@dataclass(frozen=True, slots=True, kw_only=True)
class InspectedDataset(DatasetCard):
    """Card of a dataset."""

    kind: Literal["dataset"] = "dataset"
    path: str
