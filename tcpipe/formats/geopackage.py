"""GeoPackages with the styles in which QGIS shows their layers: the one home of pyogrio (extra ``gis``)."""

from __future__ import annotations

import sqlite3
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Literal

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
    """Write a GeoPackage, whole or not at all.

    Raises
    ------
    UsageError : pyogrio is not installed, or ``path`` is there and holds something else than such layers.
    """
    ogr = _import_pyogrio()
    if path.exists() and not _is_of(ogr, path, {layer.name for layer in layers}):
        raise UsageError(f"{path}: is there, and no GeoPackage of tcpipe; give another name")
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
