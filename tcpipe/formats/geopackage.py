"""GeoPackages, and the styles (QML) in which QGIS shows their layers and rasters: the one home of pyogrio (extra ``gis``)."""

from __future__ import annotations

import sqlite3
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from types import ModuleType
from typing import Literal
from xml.sax.saxutils import quoteattr

import pyarrow as pa

from tcpipe.errors import UsageError
from tcpipe.formats.atomic import write_atomic_file

_ANY_DAY = "1970-01-01T00:00:00.000Z"
"""When everything in a file was written: the same is the same by bytes."""
_STYLES = """
CREATE TABLE layer_styles (id INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, f_table_catalog TEXT(256), f_table_schema TEXT(256),
f_table_name TEXT(256), f_geometry_column TEXT(256), styleName TEXT(30), styleQML TEXT, styleSLD TEXT, useAsDefault BOOLEAN,
description TEXT, owner TEXT(30), ui TEXT(30), update_time DATETIME)
"""
_INSTALL = "needs pyogrio: pip install 'tcpipe[gis]'"


@dataclass(frozen=True, slots=True)
class VectorLayer:
    """A layer: columns, of which numbers, truth values and texts are kept, a geometry (WKB) a row, and styles, the first of which rules."""

    name: str
    kind: Literal["LineString", "Polygon", "MultiPolygon"]
    crs: str
    table: pa.Table
    wkb: Sequence[bytes]
    styles: Mapping[str, str]
    """QML by the style's name."""


def write_geopackage(path: Path, layers: Sequence[VectorLayer]) -> None:
    """Write a GeoPackage, whole or not at all."""
    ogr = _import_pyogrio()
    if path.exists() and not _is_of(ogr, path, {layer.name for layer in layers}):
        raise UsageError(f"{path}: exists and is not a GeoPackage of tcpipe; give another name")
    ogr.set_gdal_config_options({"OGR_CURRENT_DATE": _ANY_DAY})
    with write_atomic_file(path) as temporary:
        made = temporary.with_name("layers.gpkg")
        for layer in layers:
            told = layer.table.select([of.name for of in layer.table.schema if _is_plain(of.type)])
            told = told.append_column("geom", pa.array(layer.wkb, pa.binary())).replace_schema_metadata(None)
            how = {"geometry_name": "geom", "geometry_type": layer.kind, "crs": layer.crs, "driver": "GPKG"}
            ogr.write_arrow(told, made, layer=layer.name, **how)
        with closing(sqlite3.connect(made)) as base, base:
            _add_styles(base, layers)
        made.replace(temporary)


def _add_styles(base: sqlite3.Connection, layers: Sequence[VectorLayer]) -> None:
    base.execute(_STYLES)
    base.execute(
        "INSERT INTO gpkg_contents (table_name, data_type, identifier, last_change) "
        "VALUES ('layer_styles', 'attributes', 'layer_styles', ?)",
        (_ANY_DAY,),
    )
    style = (
        "INSERT INTO layer_styles (f_table_catalog, f_table_schema, f_table_name, f_geometry_column, styleName, styleQML, styleSLD, "
        "useAsDefault, description, owner, ui, update_time) VALUES ('', '', ?, 'geom', ?, ?, '', ?, '', 'tcpipe', NULL, ?)"
    )
    for layer in layers:
        for number, (name, qml) in enumerate(layer.styles.items()):
            base.execute(style, (layer.name, name, qml, number == 0, _ANY_DAY))


def _is_plain(of: pa.DataType) -> bool:
    kinds = pa.types.is_integer, pa.types.is_floating, pa.types.is_boolean, pa.types.is_string
    return any(is_of(of) for is_of in kinds)


def _is_of(ogr: ModuleType, path: Path, names: set[str]) -> bool:
    try:
        found = {str(name) for name in ogr.list_layers(path)[:, 0]}
    except (ogr.errors.DataSourceError, OSError):
        return False
    return found <= {*names, "layer_styles"}


def _import_pyogrio() -> ModuleType:
    try:
        import pyogrio  # noqa: PLC0415  an extra
    except ImportError:
        raise UsageError(f"a GeoPackage {_INSTALL}") from None
    return pyogrio  # type: ignore[no-any-return]


VIRIDIS = ("#440154", "#3b528b", "#21918c", "#5ec962", "#fde725")
"""From the least to the greatest, told apart by every eye and in grey."""

Shape = Literal["line", "fill"]
_HEAD = "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>\n<qgis version=\"3.22.0\">\n"


def make_classes_style(attribute: str, colours: Mapping[str, str], shape: Shape) -> str:
    """Return the style of a vector layer that has a colour for each value of a column."""
    values = [
        f'<category render="true" symbol="{at}" value={quoteattr(of)} label={quoteattr(of)}/>'
        for at, of in enumerate(colours)
    ]
    return _make_vector_style(
        f'type="categorizedSymbol" attr={quoteattr(attribute)}', "categories", values, list(colours.values()), shape
    )


def make_ranges_style(attribute: str, edges: Sequence[float], shape: Shape) -> str:
    """Return the style of a vector layer that has a colour for each range of a column; six edges bound the five ranges."""
    ranges = [
        f'<range render="true" symbol="{at}" lower="{low!r}" upper="{high!r}" label="{low:.4g} - {high:.4g}"/>'
        for at, (low, high) in enumerate(pairwise(edges))
    ]
    return _make_vector_style(f'type="graduatedSymbol" attr={quoteattr(attribute)}', "ranges", ranges, VIRIDIS, shape)


def make_raster_style(band: int, low: float, high: float) -> str:
    """Return the style of a raster whose band, counted from 1, is coloured from the least value to the greatest."""
    step = (high - low) / (len(VIRIDIS) - 1)
    stops = [(low + at * step, colour) for at, colour in enumerate(VIRIDIS)]
    items = "".join(f'<item alpha="255" color="{colour}" value="{at!r}" label="{at:.4g}"/>' for at, colour in stops)
    shader = f'colorRampType="INTERPOLATED" classificationMode="1" minimumValue="{low!r}" maximumValue="{high!r}"'
    bounds = f'classificationMin="{low!r}" classificationMax="{high!r}"'
    return (
        f'{_HEAD}<pipe><rasterrenderer type="singlebandpseudocolor" band="{band}" opacity="1" {bounds}>'
        f"<rastershader><colorrampshader {shader}>{items}</colorrampshader></rastershader></rasterrenderer></pipe>\n</qgis>\n"
    )


def _make_vector_style(renderer: str, groups: str, entries: Sequence[str], colours: Sequence[str], shape: Shape) -> str:
    symbols = "".join(_make_symbol(at, colour, shape) for at, colour in enumerate(colours))
    told = f"<{groups}>{''.join(entries)}</{groups}><symbols>{symbols}</symbols>"
    return f'{_HEAD}<renderer-v2 {renderer} symbollevels="0" forceraster="0">{told}</renderer-v2>\n</qgis>\n'


def _make_symbol(name: int, colour: str, shape: Shape) -> str:
    rgb = ",".join(str(int(colour[at : at + 2], 16)) for at in (1, 3, 5))
    line = {"line_color": f"{rgb},255", "line_width": "0.8", "line_style": "solid"}
    fill = {
        "color": f"{rgb},60",
        "style": "solid",
        "outline_color": f"{rgb},255",
        "outline_width": "0.3",
        "outline_style": "solid",
    }
    kind, wanted = ("SimpleLine", line) if shape == "line" else ("SimpleFill", fill)
    options = "".join(f'<Option type="QString" name="{key}" value="{value}"/>' for key, value in wanted.items())
    layer = f'<layer class="{kind}" pass="0" locked="0" enabled="1"><Option type="Map">{options}</Option></layer>'
    return f'<symbol type="{shape}" name="{name}" alpha="1" clip_to_extent="1">{layer}</symbol>'
