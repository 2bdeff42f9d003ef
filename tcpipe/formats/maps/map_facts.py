"""Facts of a map: its inputs, the results of its build, its summary, and layers as JSON values and CF attributes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, TypeAlias
from xml.etree.ElementTree import Element, fromstring

from tcpipe.arrays import Box
from tcpipe.formats.json_files import parse_typed, to_plain
from tcpipe.tables.findings import Findings, omit
from tcpipe.terrain.layers import (
    PAPER_LAYERS,
    ClassTable,
    Kind,
    Layer,
    TerrainClass,
    make_categorical_layer,
    make_continuous_layer,
    make_paper_layers,
)


@dataclass(frozen=True, slots=True)
class MapInputs:
    """Inputs of a map: the sha256 of each file of each role, and the CRS that the user gave."""

    files: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    crs: str | None = None
    categorical: tuple[str, ...] = omit(())
    ortho_bands: str | None = omit()


@dataclass(frozen=True, slots=True, kw_only=True)
class MapFacts:
    """Results of building a map, which the map stores in its attributes."""

    sources: Mapping[str, str]
    """Files by layer."""
    covered: Mapping[str, float]
    """Share of the grid's pixels with data, by layer."""
    height_min_m: float
    height_max_m: float
    class_share: Mapping[str, float]
    """Share of each terrain class among the pixels that have a class."""
    class_shares: Mapping[str, Mapping[str, float]] = omit({})
    """The same of the user's own layers."""
    findings: Findings = ()
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
    bounds_m: Box
    """West, south, east, north in the map's CRS."""
    layers: tuple[str, ...]
    overviews: tuple[int, ...]
    class_table: tuple[TerrainClass, ...]
    described: Mapping[str, Description] = omit({})
    """Descriptions of layers other than the paper's."""


@dataclass(frozen=True, slots=True, kw_only=True)
class InspectedMap(MapSummary):
    """Summary of a map."""

    kind: Literal["map"] = "map"
    path: str


_SHARES = 5  # classes that a line lists by their share, commonest first


def map_lines(summary: MapSummary) -> list[str]:
    """Return the georeference of a map and the content of each layer."""
    rows, cols, pixel_size_m = summary.rows, summary.cols, summary.pixel_size_m
    crs = summary.crs if len(summary.crs) < 20 else "a CRS of its own"
    lines = [
        f"{cols} x {rows} px of {pixel_size_m:g} m ({cols * pixel_size_m:.0f} x {rows * pixel_size_m:.0f} m) in {crs}"
    ]
    width = max(8, *(len(layer) for layer in summary.layers))
    for layer in summary.layers:
        line = f"{layer:{width}s} {_format_percent(summary.covered[layer]):>5s} covered, from {summary.sources[layer]}"
        lines.append(line + _format_detail(layer, summary))
    return lines


def _format_detail(layer: str, summary: MapSummary) -> str:
    if layer == "height":
        return f": {summary.height_min_m:.1f} to {summary.height_max_m:.1f} m"
    own = read_layers(summary.described, (), Path(summary.name)).get(layer)
    if own is not None and own.kind == "continuous" and own.stack != "greys":
        return f": {own.low:.6g} to {own.high:.6g}" + ("" if own.unit == "1" else f" {own.unit}")
    if layer == "terrain" or own is not None:
        classes = summary.class_share if layer == "terrain" else summary.class_shares[layer]
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


_VALUE_USAGES = ("5", "3")  # GDAL's GFU_MinMax, GFU_Min: the column of the value (or of the start of a range)
_UPPER_USAGE = "4"
_NAME_USAGE = "2"
_STRING_TYPE = "2"
_NAME_TITLES = ("class name", "classname", "class names", "class", "name", "label", "category", "terrain")


def read_value_names(vrt: str, band: int) -> dict[int, str]:
    """Return names by value of a band, from 1, by GDAL's VRT document of a raster; the attribute table has priority."""
    root = fromstring(vrt)  # noqa: S314  GDAL wrote it
    described = root.find(f"./VRTRasterBand[@band='{band}']")
    if described is None:
        return {}
    table = described.find("GDALRasterAttributeTable")
    categories = [(entry.text or "").strip() for entry in described.findall("./CategoryNames/Category")]
    names = {} if table is None else _read_table_names(table)
    return names or {value: name for value, name in enumerate(categories) if name}


def _read_table_names(table: Element) -> dict[int, str]:
    columns = [
        tuple((column.findtext(tag) or "").strip() for tag in ("Name", "Type", "Usage"))
        for column in table.findall("FieldDefn")
    ]
    titles = [" ".join(title.casefold().replace("_", " ").split()) for title, _, _ in columns]
    values = [n for usage in _VALUE_USAGES for n, column in enumerate(columns) if column[2] == usage]
    values += [n for n, title in enumerate(titles) if title == "value"]
    texts = [n for n, column in enumerate(columns) if column[1] == _STRING_TYPE]
    named = [n for n in texts if columns[n][2] == _NAME_USAGE]
    named += sorted((n for n in texts if titles[n] in _NAME_TITLES), key=lambda n: _NAME_TITLES.index(titles[n]))
    named += texts if len(texts) == 1 else []
    if not values or not named:
        return {}
    uppers = [n for n, column in enumerate(columns) if column[2] == _UPPER_USAGE]
    rows = [[(cell.text or "").strip() for cell in row.findall("F")] for row in table.findall("Row")]
    found = ((_parse_single_value(row, values[0], uppers), row[named[0]]) for row in rows if len(row) == len(columns))
    return {value: name for value, name in found if value is not None and name}


def _parse_single_value(row: Sequence[str], column: int, uppers: Sequence[int]) -> int | None:
    """Return the one integer that a row is about; None if it is about a range or a fraction."""
    try:
        value = float(row[column])
        upper = float(row[uppers[0]]) if uppers else value
    except ValueError:
        return None
    return int(value) if value == upper and value.is_integer() else None


Value: TypeAlias = str | int | float | Sequence[float | Sequence[float] | Mapping[str, str | int | bool]] | None
Description: TypeAlias = Mapping[str, Value]


@dataclass(frozen=True, slots=True)
class _LayerDescription:
    """Fields of a layer's description; the paper's layers need no description."""

    kind: Kind = "continuous"
    long_name: str = ""
    units: str = "1"
    actual_range: tuple[float, float] = (0.0, 1.0)
    classes: tuple[TerrainClass, ...] = ()
    dtype: Literal["uint8", "uint16", "float16", "float32"] = "float32"


def make_cf_flags(classes: ClassTable | None) -> dict[str, Value]:
    """Return the CF attributes of classes: their ids, and their names without spaces."""
    entries = () if classes is None else classes.classes
    names = " ".join(entry.name.replace(" ", "_") for entry in entries)
    return {"flag_values": [entry.id for entry in entries], "flag_meanings": names}


def make_cf_attributes(layer: Layer) -> dict[str, Value]:
    """Return the CF attributes of a layer of patches."""
    about: dict[str, Value] = {"long_name": layer.long_name, "units": layer.unit}
    if layer.kind == "categorical":
        return {**about, **make_cf_flags(layer.classes)}
    if layer.stack == "floats":
        return {**about, "actual_range": [layer.low, layer.high]}
    about |= {"scale_factor": layer.step, "add_offset": 0.0}
    return {**about, "missing_value": layer.nodata} if layer.kind == "relative" else about


def describe_layer(layer: Layer) -> Description:
    """Return a layer as JSON values, with kind and classes if the name alone does not determine them."""
    known = {"dtype": layer.stored.name, "nodata": layer.nodata, **make_cf_attributes(layer)}
    if layer.name in PAPER_LAYERS:
        return known
    table = () if layer.classes is None else layer.classes.classes
    return {**known, "kind": layer.kind, **({"classes": [to_plain(entry) for entry in table]} if table else {})}


def read_layers(found: Mapping[str, Description], classes: Sequence[TerrainClass], path: Path) -> dict[str, Layer]:
    """Return the layers that `describe_layer` wrote to ``path``, by name; ``classes`` are the terrain classes, if any."""
    layers: dict[str, Layer] = {}
    for name, description in found.items():
        about = parse_typed(description, _LayerDescription, path)
        if name in PAPER_LAYERS:
            known = make_paper_layers([name], ClassTable(tuple(classes))) if classes else PAPER_LAYERS
            layers[name] = replace(known[name], long_name=about.long_name or known[name].long_name)
        elif about.kind == "categorical":
            layers[name] = make_categorical_layer(name, ClassTable(about.classes))
        else:
            low, high = about.actual_range
            layers[name] = make_continuous_layer(name, unit=about.units, low=low, high=high)
    return layers
