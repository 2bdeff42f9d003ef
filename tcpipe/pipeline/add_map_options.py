"""The options of ``tcpipe add-map`` and `tcpipe.add_map`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import Literal, TypeAlias

from tcpipe.tables.options import STORE, Option, option, required

Files: TypeAlias = "str | Path | Sequence[str | Path]"
"""A file, a pattern of files such as ``dem/*.tif`` (its files by name), or several of both: tiles of one grid, the last on top."""


def _raster(about: str) -> Option:
    return Option(about, (), "several", "FILE", repeatable=True)


@dataclass(frozen=True, slots=True)
class AddMapOptions:
    """Which rasters become a map of a store; they need not share grid, resolution or CRS."""

    name: str = required(Option(is_argument=True))
    _: KW_ONLY
    height: Files = required(_raster("Height raster, metres."))
    ortho: Files | None = option(None, _raster("Orthophoto, grey or RGB."))
    terrain: Files | None = option(
        None, _raster("Terrain classes: one integer band, or GeoJSON polygons with a property 'class'.")
    )
    """The property is a class name, value or id."""
    classes: str | Path | None = option(
        None, Option("Class table: CSV with value,id,name,traversable, or TOML.", (), "input_file", "FILE")
    )
    """None takes the store's, else the paper's seven classes. The first map with terrain or classes sets the store's table."""
    layers: Mapping[str, Files] | None = option(
        None,
        Option(
            "Another raster of one band, as layer NAME; repeatable.",
            ("--layer",),
            "layers",
            "NAME=FILE",
        ),
    )
    categorical: Mapping[str, str | Path | None] | None = option(
        None,
        Option(
            "Layer NAME contains classes: named by FILE, like --classes, or by the raster itself.",
            (),
            "class_tables",
            "NAME[=FILE]",
        ),
    )
    """None: as the raster names its values."""
    ortho_bands: Literal["grey", "rgb"] = option(
        "grey", Option("rgb also keeps red, green and blue as layers.", (), ("grey", "rgb"))
    )
    crs: str | None = option(
        None, Option("Projected, metric CRS of the map (default: the height's, or its UTM zone).", metavar="EPSG:n")
    )
    force: bool = option(False, Option("Replace a map of this name that has other inputs."))
    store: str | Path = option("tcpipe-store", STORE)
