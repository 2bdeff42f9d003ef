"""What is known of a map: what it is made from, what building it found, and what it is as a whole."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from tcpipe.formats.layer_descriptions import Description, read_layers
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
    pixel_size_m: float
    bounds_m: tuple[float, float, float, float]
    """West, south, east, north in the map's CRS."""
    layers: tuple[str, ...]
    overviews: tuple[int, ...]
    class_table: tuple[TerrainClass, ...]
    described: Mapping[str, Description] = field(default_factory=dict, metadata=LEFT_OUT)
    """Descriptions of layers other than the paper's."""


_SHARES = 5
"""Classes that a line lists by their share, commonest first."""


def map_lines(of: MapSummary) -> list[str]:
    """Return where a map lies and what each layer holds."""
    rows, cols, pixel_size_m = of.rows, of.cols, of.pixel_size_m
    crs = of.crs if len(of.crs) < 20 else "a CRS of its own"
    lines = [
        f"{cols} x {rows} px of {pixel_size_m:g} m ({cols * pixel_size_m:.0f} x {rows * pixel_size_m:.0f} m) in {crs}"
    ]
    width = max(8, *(len(layer) for layer in of.layers))
    for layer in of.layers:
        line = f"{layer:{width}s} {_format_percent(of.covered[layer]):>5s} covered, from {of.sources[layer]}"
        lines.append(line + _format_detail(layer, of))
    return lines


def _format_detail(layer: str, of: MapSummary) -> str:
    if layer == "height":
        return f": {of.height_min_m:.1f} to {of.height_max_m:.1f} m"
    own = read_layers(of.described, (), Path(of.name)).get(layer)
    if own is not None and own.stack == "floats":
        return f": {own.low:.6g} to {own.high:.6g}" + ("" if own.unit == "1" else f" {own.unit}")
    if layer == "terrain" or own is not None:
        classes = of.class_share if layer == "terrain" else of.class_shares[layer]
        shares = sorted(classes.items(), key=lambda entry: (-entry[1], entry[0]))
        listed = [f"{_format_percent(share)} {name}" for name, share in shares[:_SHARES]]
        return ": " + ", ".join(listed) + (" …" if len(shares) > _SHARES else "")
    return ""


def _format_percent(share: float) -> str:
    """Return a share as per cent; never 0 % of something or 100 % of less than all."""
    percent = 100.0 * share
    if 0.0 < percent < 0.5:
        return "<1 %"
    return ">99 %" if 99.5 <= percent < 100.0 else f"{percent:.0f} %"
