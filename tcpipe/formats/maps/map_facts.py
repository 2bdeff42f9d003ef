"""What is known of a map: what it is made from, what building it found, and what it is as a whole."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from tcpipe.formats.layer_descriptions import Description
from tcpipe.tables.findings import LEFT_OUT, Finding
from tcpipe.terrain.classes import TerrainClass


@dataclass(frozen=True, slots=True)
class MapInputs:
    """What a map was made from: the sha256 of each file of each role, and the CRS that was asked for."""

    files: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    crs: str | None = None
    categorical: tuple[str, ...] = field(default=(), metadata=LEFT_OUT)
    ortho_bands: str | None = field(default=None, metadata=LEFT_OUT)


@dataclass(frozen=True, slots=True, kw_only=True)
class MapFacts:
    """What building a map found; a map keeps it in its attributes."""

    sources: Mapping[str, str]
    """Files by layer."""
    covered: Mapping[str, float]
    """Share of the grid's pixels with data, by layer."""
    height_min_m: float
    height_max_m: float
    class_share: Mapping[str, float]
    """Of terrain: share of each class among the pixels that have one."""
    class_shares: Mapping[str, Mapping[str, float]] = field(default_factory=dict, metadata=LEFT_OUT)
    """The same of the user's own layers."""
    findings: tuple[Finding, ...] = field(default=(), metadata=LEFT_OUT)
    """Maps of tcpipe 0.8 and earlier have none: they kept sentences."""
    classes_from: str
    """``file``, ``names`` of the terrain raster's values, ``store`` or ``default``."""
    inputs: MapInputs


@dataclass(frozen=True, slots=True, kw_only=True)
class MapSummary(MapFacts):
    """A map as a whole."""

    name: str
    crs: str
    rows: int
    cols: int
    pitch_m: float
    bounds_m: tuple[float, float, float, float]
    """West, south, east, north in the map's CRS."""
    layers: tuple[str, ...]
    overviews: tuple[int, ...]
    class_table: tuple[TerrainClass, ...]
    described: Mapping[str, Description] = field(default_factory=dict, metadata=LEFT_OUT)
    """What the names of layers other than the paper's do not tell."""
