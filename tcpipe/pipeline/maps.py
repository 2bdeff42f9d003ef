"""Add a map to the store: rasters of one site on one common grid."""

import glob
import os
import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Literal

from tcpipe.errors import MapError, StoreError, UsageError, clean_lines
from tcpipe.formats.documents import State
from tcpipe.formats.finding_lines import format_findings
from tcpipe.formats.integrity import compute_checksum
from tcpipe.formats.maps.building import MoreLayers, OrthoBands, build_map
from tcpipe.formats.maps.geotiff import list_raster_files
from tcpipe.formats.maps.map_facts import MapInputs, MapSummary, map_lines
from tcpipe.formats.maps.map_files import open_map
from tcpipe.formats.maps.terrain_polygons import is_drawn
from tcpipe.formats.runs import StoredMap
from tcpipe.pipeline.calls import ADD_MAP, RunningCall, record_call
from tcpipe.pipeline.options import AddMapOptions, Files
from tcpipe.progress import logger
from tcpipe.report.pictures import draw_ortho, write_overview
from tcpipe.store import Store, check_map_name, open_store
from tcpipe.tables.levels import SAMPLES
from tcpipe.tables.options import as_function
from tcpipe.terrain.layers import ClassScheme, find_wrong_name

ROLES = ("height", "ortho", "terrain", "classes")
CLASSES = "classes"
"""Role of a class table; the role of a layer's own table is the name of the layer followed by this word."""


@dataclass(frozen=True, slots=True)
class AddedMap:
    """Result of adding a map; the command prints its ``str``."""

    path: str
    status: Literal["done", "unchanged"]
    map: MapSummary
    picture: str
    """A quick look at it: orthophoto or shaded relief, tinted by class, white where a layer has no data."""

    def __str__(self) -> str:
        """Return location and content of the map, as plain lines."""
        head = f"{self.path} (quick look: {PurePosixPath(self.picture).name})"
        if self.status == "unchanged":
            head += ": nothing to do: it is made from the same files and options"
        more = f"tcpipe inspect {shlex.quote(self.path)}"
        return clean_lines((head, *map_lines(self.map), *format_findings(self.map.findings, more=more)))


def run_add_map(options: AddMapOptions) -> AddedMap:
    """Put rasters on one common grid and add them to the store as a Zarr group, with a quick look beside it.

    A second call with the same files and options does nothing.

    Raises `MapError`, `StoreError`: a raster cannot be had or placed, the classes are not the store's, or the store
    cannot be written: the store is as it was.
    """
    opened = open_store(options.store, create=True)
    with record_call(opened, ADD_MAP, [options.name]) as call:
        return _add_map(call, options)


def _add_map(call: RunningCall, options: AddMapOptions) -> AddedMap:
    """Add a map to the store of a recorded call, unless it is there and was made from the same inputs."""
    name, layers, categorical = check_map_name(options.name), options.layer or {}, options.categorical or {}
    _refuse_layers(layers, categorical, ortho=bool(options.ortho), ortho_bands=options.ortho_bands)
    given = {role: getattr(options, role) for role in ROLES}
    tables = {f"{name} {CLASSES}": table for name, table in categorical.items() if table}
    files = _find_files({role: value for role, value in {**given, **layers, **tables}.items() if value})
    bands = None if options.ortho_bands == "grey" else options.ortho_bands
    if "height" not in files:
        raise UsageError(f"map {name}: no height raster; give --height FILE")
    store, state = call.store, call.state
    inputs = MapInputs(_compute_checksums(files), options.crs, tuple(sorted(categorical)), bands)
    more = MoreLayers(
        {name: files[name] for name in layers},
        {name: files[f"{name} {CLASSES}"][0] if table else None for name, table in categorical.items()},
        options.ortho_bands,
    )
    if name in state.maps and not options.force:
        return _find_unchanged(store, state, name, inputs)
    with store.new_map(name) as (path, put):
        build_map(
            path,
            name=name,
            height=files["height"],
            ortho=files.get("ortho", ()),
            terrain=files.get("terrain", ()),
            more=more,
            classes=files["classes"][0] if "classes" in files else None,
            agreed=_find_common_classes(store, state, name),
            crs=options.crs,
            inputs=inputs,
        )
        write_overview(path.with_suffix(".png"), draw_ortho(open_map(path)))
        before, state = state.maps.get(name), store.scan()
        if state.maps.get(name) != before:
            call.state = state
            return _find_unchanged(store, state, name, inputs)  # another process was faster
        call.begin()
        put(state)
    return _make_added(store, state.maps[name], "done")


add_map = as_function(AddMapOptions, run_add_map)
"""`tcpipe.add_map`: its keywords are the fields of `AddMapOptions`."""


def _refuse_layers(
    layers: Mapping[str, Files], categorical: Iterable[str], *, ortho: bool, ortho_bands: OrthoBands
) -> None:
    """Raise `UsageError` for invalid names, classes without a layer, and colours without orthophoto, in one error."""
    problems = [problem for name in layers if (problem := find_wrong_name(name, taken=SAMPLES.names()))]
    listed = ", ".join(layers) or "none is given"
    problems += [
        f"--categorical {name}: no layer of that name; --layer gives {listed}"
        for name in categorical
        if name not in layers
    ]
    if ortho_bands == "rgb" and not ortho:
        problems.append("--ortho-bands rgb: no orthophoto is given; add --ortho")
    if problems:
        raise UsageError(*problems)


def _make_added(store: Store, record: StoredMap, status: Literal["done", "unchanged"]) -> AddedMap:
    summary = open_map(*store.map_at(record)).summary()
    return AddedMap(store.place.where(record.zarr), status, summary, store.place.where(record.picture))


def _find_files(given: Mapping[str, Files]) -> dict[str, list[Path]]:
    """Return the files of every role: patterns become matching files by name; the last of equal files counts."""
    files: dict[str, list[Path]] = {}
    problems: list[str] = []
    for role, value in given.items():
        texts = [str(item) for item in ([value] if isinstance(value, str | Path) else value)]
        matches = [_match_files(text) for text in texts]
        problems += [_describe_no_file(text) for text, found in zip(texts, matches, strict=True) if not found]
        every = [Path(name) for found in matches for name in found]
        files[role] = list(reversed({path.absolute(): path for path in reversed(every)}.values()))
    if problems:
        raise UsageError(*problems)
    return files


def _match_files(text: str) -> list[str]:
    """Return the file of that name, or the files that match it, by name."""
    if os.path.lexists(text):
        return [] if Path(text).is_dir() else [text]
    return sorted(glob.glob(text, recursive=True))  # noqa: PTH207  a pattern may begin at the root


def _describe_no_file(text: str) -> str:
    """Return the reason why a text is not the name of a file."""
    if "://" in text or text.startswith("/vsi"):
        return f"{text}: is an address, expected a file on this machine: rio convert {text} local.tif"
    if Path(text).is_dir():
        return f"{text}: is a directory, expected its files: '{text.rstrip('/')}/*.tif'"
    return f"{text}: no file matches" if glob.has_magic(text) else f"{text}: there is no such file"


def _compute_checksums(files: Mapping[str, Sequence[Path]]) -> dict[str, dict[str, str]]:
    """Return a checksum for every file of every role, in their order; the order of options does not count."""
    checksums: dict[str, dict[str, str]] = {}
    problems: list[str] = []
    for role, paths in sorted(files.items()):
        try:
            plain = role.endswith(CLASSES) or (role == "terrain" and is_drawn(paths))
            parts = dict.fromkeys(part for path in paths for part in ([path] if plain else list_raster_files(path)))
            digests = [compute_checksum(part).sha256 for part in parts]
            folder = os.path.commonpath([path.absolute().parent for path in paths])
            checksums[role] = dict(zip((os.path.relpath(part, folder) for part in parts), digests, strict=True))
        except MapError as error:
            problems += error.problems
        except OSError as error:
            problems.append(f"{error.filename}: cannot be read ({error.strerror})")
    if problems:
        raise MapError(*problems)
    return checksums


def _find_unchanged(store: Store, state: State, name: str, inputs: MapInputs) -> AddedMap:
    """Return the existing map; `MapError` with the differences if it was made from other inputs."""
    try:
        stored = open_map(*store.map_at(state.maps[name]))
    except (MapError, StoreError) as error:
        raise MapError(*error.problems, f"map {name}: add it again with --force") from None
    before = stored.facts.inputs
    roles = dict.fromkeys([*ROLES, *before.files, *inputs.files])
    changes = [_describe_change(role, before.files.get(role, {}), inputs.files.get(role, {})) for role in roles]
    changes = [change for change in changes if change]
    for option in ("crs", "categorical", "ortho_bands"):
        now, then = (getattr(made_from, option) or "not given" for made_from in (inputs, before))
        if now != then:
            changes.append(f"--{option.replace('_', '-')} is {now}, was {then}")
    if changes:
        raise MapError(
            f"map {name}: is already in the store, made from other inputs: {'; '.join(changes)}; "
            "replace it with --force, or choose another name"
        )
    return _make_added(store, state.maps[name], "unchanged")


def _describe_change(role: str, before: Mapping[str, str], now: Mapping[str, str]) -> str:
    """Return the differences of a role's files (name to checksum); "" if their contents are equal."""
    if list(before.values()) == list(now.values()):
        return ""
    if sorted(before.values()) == sorted(now.values()):
        return f"the files of {role} come in another order"
    if not before or not now:
        option = f"--{role}" if role in ROLES else f"--layer {role}"
        return f"{option} was not given then, but is now" if now else f"{option} was given then, but is not now"
    names = [name for name in now if now[name] not in before.values()]
    return f"{role} has another content ({', '.join(names or before)})"


def _find_common_classes(store: Store, state: State, name: str) -> ClassScheme | None:
    """Return the classes of the store's other maps; None if none of them has classes named by a user or a raster."""
    for other, record in state.maps.items():
        if other == name:
            continue
        try:
            saved = open_map(*store.map_at(record))
        except (MapError, StoreError):
            logger.warning("map %s cannot be read; its classes are not compared", other)
            continue
        if saved.facts.classes_from == "file" or ("terrain" in saved.layers and saved.facts.classes_from != "default"):
            is_named = saved.facts.classes_from == "names"  # the values belong to that raster alone
            values = {entry.id: entry.id for entry in saved.classes.classes} if is_named else saved.id_by_value
            return ClassScheme(saved.classes, values)
    return None
