"""Add a map to the store: rasters of one site on one common grid."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tcpipe.errors import MapError, StoreError
from tcpipe.formats.atomic import place_state
from tcpipe.formats.geotiff import raster_files
from tcpipe.formats.map_building import build_map
from tcpipe.formats.map_files import MapFile, open_map
from tcpipe.formats.map_text import map_text
from tcpipe.formats.seals import file_checksum, seal_of
from tcpipe.formats.terrain_polygons import SUFFIXES
from tcpipe.report.overview import quick_look, shows_map, write_quick_look
from tcpipe.store import Store, open_store
from tcpipe.terrain.classes import ClassScheme

logger = logging.getLogger("tcpipe")

_ROLES = ("height", "ortho", "terrain", "classes")


@dataclass(frozen=True, slots=True)
class AddedMap:
    """What became of a map; ``str`` of it is what the command prints."""

    path: Path
    status: str
    """``done`` or ``unchanged``."""
    map: Mapping[str, Any]
    """What the map is: `tcpipe.formats.map_files.MapFile.summary`."""
    picture: Path
    """A quick look at it: orthophoto or shaded relief, tinted by class, white where a layer has no data."""

    def __str__(self) -> str:
        """Return where the map is and what it holds, as plain lines."""
        head = f"{self.path} (quick look: {self.picture.name})"
        if self.status == "unchanged":
            head += ": nothing to do: it is made from the same files and options"
        return "\n".join((head, map_text(self.map), *(f"warning: {text}" for text in self.map["warnings"])))


def add_map(
    name: str,
    *,
    height: str | Path,
    ortho: str | Path | None = None,
    terrain: str | Path | None = None,
    classes: str | Path | None = None,
    crs: str | None = None,
    store: str | Path = "tcpipe-store",
    force: bool = False,
) -> AddedMap:
    """Put rasters on one common grid and add them to the store as ``maps/<name>.zarr``, with a quick look ``maps/<name>.png``.

    A second call with the same files and options does nothing.

    Parameters
    ----------
    height, ortho, terrain
        Rasters GDAL can read; they need not share grid, resolution or CRS. Terrain may also be GeoJSON polygons whose property ``class`` is
        a class name, value or id.
    classes
        CSV ``value,id,name,traversable`` or the same as TOML; None takes the store's, else the paper's seven classes. The first map with
        terrain or classes sets the store's table; the others must have the same.
    crs
        Projected, metric CRS of the map (``EPSG:n``); None takes the height raster's, or its UTM zone.
    force
        Replace a map of that name that is made from something else.

    Raises
    ------
    MapError, StoreError
        When a raster cannot be placed, the classes are not the store's, or the store cannot be written: the store is as it was.

    """
    house = open_store(store, create=True)
    path = house.map_path(name)
    given = {"height": height, "ortho": ortho, "terrain": terrain, "classes": classes}
    files = {role: Path(file) for role, file in given.items() if file is not None}
    inputs = _inputs(files, crs)
    before = place_state(path)
    if path.exists() and not force:
        return _unchanged(name, path, inputs)
    picture = path.with_suffix(".png")
    looks: list[tuple[Any, str]] = []
    try:
        build_map(
            path,
            name=name,
            height=files["height"],
            ortho=files.get("ortho"),
            terrain=files.get("terrain"),
            classes=files.get("classes"),
            agreed=_agreed(house, name),
            crs=crs,
            inputs=inputs,
            instead_of=before,
            look=lambda finished, half: looks.append((quick_look(finished), seal_of(half))),
        )
        write_quick_look(picture, *looks[0])
        return AddedMap(path, "done", open_map(path).summary(), picture)
    except OSError as error:
        raise StoreError(f"{path}: the map cannot be written ({error.strerror or error})") from None
    except StoreError:
        if force or place_state(path) == before:
            raise
        return _unchanged(name, path, inputs)  # another process was faster


def _unchanged(name: str, path: Path, inputs: Mapping[str, Any]) -> AddedMap:
    """Return the map that is there, its quick look drawn if there is none of it; `MapError` if it is made from something else."""
    found, picture = _same(name, path, inputs), path.with_suffix(".png")
    if not shows_map(picture, path):
        write_quick_look(picture, quick_look(found), seal_of(path))
    return AddedMap(path, "unchanged", found.summary(), picture)


def _inputs(files: Mapping[str, Path], crs: str | None) -> dict[str, Any]:
    """Return what a map is made from: a checksum for every file of every role, and the options."""
    checksums: dict[str, dict[str, str]] = {}
    problems: list[str] = []
    for role, path in files.items():
        try:
            drawn = role == "terrain" and path.suffix.lower() in SUFFIXES
            parts = [path] if role == "classes" or drawn else raster_files(path)
            checksums[role] = {part.name: file_checksum(part)[1] for part in parts}
        except MapError as error:
            problems += error.problems
        except OSError as error:
            problems.append(f"{path}: cannot be read ({error.strerror})")
    if problems:
        raise MapError(*problems)
    return {"files": checksums, "crs": crs}


def _same(name: str, path: Path, inputs: Mapping[str, Any]) -> MapFile:
    """Return the map that is there if it is made from the same; else `MapError` says what differs."""
    try:
        found = open_map(path)
    except MapError as error:
        raise MapError(*error.problems, f"map {name}: add it anew with --force") from None
    before = found.facts["inputs"]
    changes = [_change(role, before["files"].get(role, {}), inputs["files"].get(role, {})) for role in _ROLES]
    changes = [change for change in changes if change]
    if before["crs"] != inputs["crs"]:
        changes.append(f"--crs is {inputs['crs'] or 'not given'}, was {before['crs'] or 'not given'}")
    if changes:
        raise MapError(
            f"map {name}: is in the store already, made from something else: {'; '.join(changes)}; "
            "replace it with --force, or choose another name"
        )
    return found


def _change(role: str, before: Mapping[str, str], now: Mapping[str, str]) -> str:
    """Say how the files of a role, name to checksum, differ; nothing where their contents are the same."""
    if sorted(before.values()) == sorted(now.values()):
        return ""
    if not before or not now:
        return f"--{role} was not given then, but is now" if now else f"--{role} was given then, but is not now"
    names = [name for name in now if now[name] not in before.values()]
    return f"{role} has another content ({', '.join(names or before)})"


def _agreed(house: Store, name: str) -> ClassScheme | None:
    """Return the classes that the store's other maps share; None while none of them has any."""
    for other in house.maps():
        if other == name:
            continue
        try:
            found = open_map(house.map_path(other))
        except MapError:
            logger.warning("map %s cannot be read; its classes are not compared", other)
            continue
        if "terrain" in found.layers or found.facts["classes_from"] == "file":
            own = found.facts["classes_from"] == "names"  # those values are of that raster alone
            values = {entry.id: entry.id for entry in found.classes.classes} if own else found.id_by_value
            return ClassScheme(found.classes, values)
    return None
