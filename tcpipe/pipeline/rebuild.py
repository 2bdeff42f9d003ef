"""Build a dataset again from its own record, with logs and files that are found by their content, and compare the results."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TypeAlias

from tcpipe import __version__
from tcpipe.errors import DatasetError, LogError, TcpipeError, UsageError, clean_line
from tcpipe.execution import refuse_import_of_script
from tcpipe.formats.atomic import check_input_directory, check_output_directory, make_scratch_directory
from tcpipe.formats.dataset_card import DatasetCard, DatasetInputs, MapSource, RunInputs
from tcpipe.formats.dataset_files import CARD, read_card
from tcpipe.formats.geojson import Feature, FeatureCollection
from tcpipe.formats.integrity import Checksum, compute_checksum
from tcpipe.formats.json_files import write_json
from tcpipe.formats.logs.log_joining import open_logs
from tcpipe.formats.logs.table_folders import Mappings, is_table, walk_folders
from tcpipe.formats.maps.map_facts import MapInputs
from tcpipe.formats.place import Place, find_wrong_files
from tcpipe.formats.published_outputs import fetch_directory
from tcpipe.formats.recipe_toml import make_recipe_id
from tcpipe.pipeline.dataset.build import run_build_dataset
from tcpipe.pipeline.diff import diff, list_causes
from tcpipe.pipeline.ingest import run_ingest
from tcpipe.pipeline.ingest_run import tag_log
from tcpipe.pipeline.log_sources import LogSource, find_sources
from tcpipe.pipeline.maps import CLASSES, ROLES, run_add_map
from tcpipe.pipeline.options import AddMapOptions, BuildDatasetOptions, IngestOptions
from tcpipe.store import open_store

Paths: TypeAlias = tuple[Path, ...]
"""A file, or the files and folders of one log."""

_CLASS_SOURCES = ("default", "names", "file", "store")
"""Order in which maps are added, by the source of their classes: later maps use the class table of earlier ones."""


@dataclass(frozen=True, slots=True)
class Rebuilt:
    """Comparison of a dataset with the one that its record gives now; the command prints its ``str``."""

    samples: int
    """Number of samples of the dataset."""
    differing: int
    """Number of samples that were not rebuilt, are new, or have other values, another split or another patch."""
    largest_in_std: float
    """Largest change of a label, in standard deviations of that label in the dataset."""
    causes: tuple[str, ...]
    """Differences between the two records."""
    is_identical: bool

    def __str__(self) -> str:
        """Return one line."""
        if self.is_identical:
            return f"identical: {self.samples} samples"
        causes = "; ".join(self.causes) or "not recorded (another processor or other library versions)"
        counts = f"{self.differing} of {self.samples} samples, max |Δ|/σ {self.largest_in_std:.2g}"
        return clean_line(f"changed: {counts}; cause: {causes}")


def rebuild(dataset: str | Path, *, logs: str | Path, to: str | Path | None = None, jobs: int = 1) -> Rebuilt:
    """Ingest the logs, add the maps and build the dataset again as its card records, and compare both datasets.

    ``logs`` is a folder; logs, rasters, tables and lists below it are found by their content. ``to`` is a new folder for the rebuilt
    dataset; None removes it.

    Raises `DatasetError` with a line for each file that is missing or altered and each recorded value that cannot be used, `UsageError`, or
    the error of a step; nothing is written then.
    """
    refuse_import_of_script(jobs)
    root, place = check_input_directory(logs), None if to is None else check_output_directory(to)
    if place is not None and place.exists() and any(place.iterdir()):
        raise UsageError(f"{place}: contains files; give a new folder (--to)")
    directory = fetch_directory(dataset)
    card = read_card(directory)
    if card.without_coordinates:
        what = "is without coordinates: its card names no logs, maps and region"
        raise DatasetError(f"{dataset}: {what}; rebuild the dataset with coordinates that it was made from")
    with make_scratch_directory() as scratch:
        store, out = scratch / "store", scratch / "dataset" if place is None else place
        found = _find_content(card, directory, root, scratch / "staging")
        _ingest_logs(card.made_from, found, store, scratch / "logs", jobs)
        for source in sorted(card.maps, key=lambda each: _CLASS_SOURCES.index(str(each.classes_from))):
            run_add_map(replace(_make_map_options(source, found, scratch / "maps" / source.name), store=store))
        options = replace(_make_build_options(card, found, scratch / "files"), out=out, store=store, jobs=jobs)
        run_build_dataset(options if card.made_from.kept_split is None else replace(options, keep_split=directory))
        difference, rebuilt = diff(directory, out), read_card(out)
    causes = _list_causes(card, rebuilt)
    changes = (change.get("largest_in_std", 0.0) for change in difference.changes.values())
    is_identical = not (difference.differing or causes)
    return Rebuilt(card.samples, difference.differing, max(changes, default=0.0), causes, is_identical)


def _list_causes(card: DatasetCard, rebuilt: DatasetCard) -> tuple[str, ...]:
    """Return the differences of two records; other segments and files of maps count only if nothing else differs."""
    before, now = card.made_from, replace(rebuilt.made_from, kept_split=card.made_from.kept_split)
    segments = {run_id: run.segments_sha256 for run_id, run in before.runs.items()}
    runs = {run_id: replace(run, segments_sha256=segments.get(run_id)) for run_id, run in now.runs.items()}
    records = (replace(now, runs=runs, maps=before.maps), now)
    cards = (replace(rebuilt, made_from=record, inputs=record.digest) for record in records)
    return next(filter(None, (list_causes(card, each) for each in cards)), ())


def _find_content(card: DatasetCard, directory: Path, root: Path, staging: Path) -> dict[str, Paths]:
    """Return the logs and files that a card names, by their sha256; one `DatasetError` for all problems."""
    problems = [*find_wrong_files(Place(directory), card.checksums), *_find_unusable(card, directory / CARD)]
    tables, recorded = card.recipe.tables, list(_list_files(card))
    logs = find_sources([root], as_one=False, staging=staging, tables=tables).sources
    endings = {Path(each.name).suffix.lower() for each in recorded}
    paths = (Path(folder, name).absolute() for folder, _, names in walk_folders(root) for name in names)
    files = [(path,) for path in paths if path.suffix.lower() in endings]
    found, missing = _search(
        list(_list_logs(card.made_from.runs)), [log.paths for log in logs], partial(_hash_log, tables)
    )
    found_files, missing_files = _search(recorded, files, _hash_file)
    problems += (f"{root}: {line}" for line in (*missing, *missing_files))
    if problems:
        raise DatasetError(*problems)
    return found | found_files


def _find_unusable(card: DatasetCard, where: Path) -> Iterator[str]:
    """Yield a line for each recorded value that cannot be used; another version may give a recipe another id."""
    for run_id, run in card.made_from.runs.items():
        own = make_recipe_id(card.recipe, run.robot)
        if card.tcpipe_version == __version__ and own != run.recipe_id:
            yield f"{where}: run {run_id} was ingested with recipe {run.recipe_id}, but the recorded recipe is {own}"
        if run.message_definitions:
            yield f"{where}: run {run_id} was ingested with --msgdef, and message definitions are not recorded"
    for source in card.maps:
        if source.inputs is None or not source.inputs.main_files:
            yield f"{where}: files of map {source.name} are not recorded; add it again and build the dataset again"
        elif source.classes_from == "store" and not any(each.classes_from in ("names", "file") for each in card.maps):
            yield f"{where}: map {source.name} has the classes of a map that is not recorded; add it again with --classes"


@dataclass(frozen=True, slots=True)
class _Wanted:
    """A recorded log or file: its name, its content (size 0: not recorded), and where it is used."""

    name: str
    content: Checksum
    use: str


def _list_logs(runs: Mapping[str, RunInputs]) -> Iterator[_Wanted]:
    for run_id, run in runs.items():
        for name, part in zip(run.logs, run.parts or (Checksum(run.size_bytes, run.sha256),), strict=False):
            yield _Wanted(name, part, f"log of run {run_id}")


def _list_files(card: DatasetCard) -> Iterator[_Wanted]:
    for source in card.maps:
        for role, files in ({} if source.inputs is None else source.inputs.files).items():
            for name, sha256 in files.items():
                yield _Wanted(Path(name).name, Checksum(0, sha256), f"{role} of map {source.name}")
    yield from (_Wanted(table.name, table.checksum, "table of covariates") for table in card.covariates)
    yield from (_Wanted(ids.name, ids.checksum, "list of excluded samples") for ids in card.exclusions)


def _search(
    wanted: Sequence[_Wanted], candidates: Sequence[Paths], read: Callable[[Paths, set[int]], str]
) -> tuple[dict[str, Paths], list[str]]:
    """Return candidates by sha256, of which those with a recorded name are read first, and a line for each missing content."""
    names, sizes = {each.name for each in wanted}, {each.content.size_bytes for each in wanted}
    found, left = dict[str, Paths](), {each.content.sha256: each for each in wanted}
    for paths in sorted(candidates, key=lambda paths: names.isdisjoint(path.name for path in paths)):
        sha256 = read(paths, sizes) if left else ""
        if left.pop(sha256, None) is not None:
            found[sha256] = paths
    others = [path for paths in candidates if paths not in found.values() for path in paths]
    lines = list[str]()
    for sha256, each in left.items():
        altered = ", ".join(str(path) for path in others if path.name == each.name)
        what, remedy = (
            (f"{altered} was altered", "restore it") if altered else (f"{each.name} is missing", "copy it there")
        )
        lines.append(f"{what}: expected the {each.use} with sha256 {sha256[:12]}…; {remedy}")
    return found, lines


def _hash_log(tables: Mappings, paths: Paths, sizes: set[int]) -> str:
    """Return the sha256 of a log; "" if it has none of the sizes or cannot be read."""
    with suppress(TcpipeError, OSError), open_logs(paths, tables=tables) as log:
        return log.sha256() if {0, log.size_bytes} & sizes else ""
    return ""


def _hash_file(paths: Paths, sizes: set[int]) -> str:
    with suppress(OSError):
        return compute_checksum(paths[0]).sha256 if {0, paths[0].stat().st_size} & sizes else ""
    return ""


def _link(path: Path, found: Paths) -> Path:
    """Return a path that is a link to a found file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.symlink_to(found[0])
    return path


def _ingest_logs(inputs: DatasetInputs, found: Mapping[str, Paths], store: Path, folder: Path, jobs: int) -> None:
    """Ingest the logs as they were ingested before; `LogError` if one fails."""
    calls, problems = dict[tuple[str | None, str], list[Path]](), list[str]()
    for run_id, run in inputs.runs.items():
        key = (run.robot_requested, run_id if run.parts else "")
        calls.setdefault(key, []).extend(_name_log(run_id, run, found, folder / run_id))
    for (robot, joined), paths in calls.items():
        options = IngestOptions(paths, store=store, recipe=inputs.recipe, robot=robot, as_one=bool(joined), jobs=jobs)
        failed = (result for result in run_ingest(options).results if result.run is None)
        problems += (line for result in failed for line in result.problems or (f"{result.log}: {result.status}",))
    if problems:
        raise LogError(*problems)
    opened = open_store(store)
    state = opened.scan()
    for run in inputs.runs.values():
        tag_log(opened, state, run.sha256, run.tags)


def _name_log(run_id: str, run: RunInputs, found: Mapping[str, Paths], folder: Path) -> list[Path]:
    """Return paths with the recorded names, parts in order: the log's own, beside which earlier parts are found, or links."""
    parts, stem = [found[part.sha256] for part in run.parts] or [found[run.sha256]], run_id.rpartition("-")[0]
    if not run.parts and LogSource(parts[0], ()).stem == stem and tuple(path.name for path in parts[0]) == run.logs:
        return list(parts[0])
    above = stem.removesuffix(f"_{Path(run.logs[0]).stem}") if is_table(run.logs[0]) else "log"
    places = [(folder / f"{number:04d}" / above, path) for number, paths in enumerate(parts) for path in paths]
    return [_link(place / name, (path,)) for name, (place, path) in zip(run.logs, places, strict=False)]


def _make_map_options(source: MapSource, found: Mapping[str, Paths], folder: Path) -> AddMapOptions:
    """Return the options that add a map as its card records it, with links of the recorded names to its files."""
    inputs = source.inputs or MapInputs()
    for role, files in inputs.files.items():
        for name, sha256 in files.items():
            _link(folder / role / name, found[sha256])
    given = {role: [folder / role / name for name in names] for role, names in inputs.main_files.items()}
    return AddMapOptions(
        source.name,
        height=given["height"],
        ortho=given.get("ortho"),
        terrain=given.get("terrain"),
        classes=given["classes"][0] if "classes" in given else None,
        layers={name: given[name] for name in source.layers if name in given and name not in ROLES},
        categorical={name: given.get(f"{name} {CLASSES}", [None])[0] for name in inputs.categorical},
        ortho_bands="rgb" if inputs.ortho_bands else "grey",
        crs=inputs.crs,
    )


def _make_build_options(card: DatasetCard, found: Mapping[str, Paths], folder: Path) -> BuildDatasetOptions:
    """Return the options that build a dataset as its card records it, but for a kept split."""
    inputs, region, split = card.made_from, card.split.region, folder / "region.geojson"
    if region is not None:
        features = (Feature({"split": kind}, polygon) for kind, polygon in region.items())
        write_json(split, FeatureCollection(tuple(features)))
    return BuildDatasetOptions(
        split=None if region is None else split,
        map_name=inputs.map_names,
        robot=next(iter(inputs.robots), None),
        tags=inputs.tags,
        recipe=inputs.recipe,
        labels=inputs.labels,
        without_patches=inputs.without_patches,
        file_format="parquet" if inputs.file_format == "parquet" else "zarr",
        covariates=[_link(folder / "covariates" / each.name, found[each.checksum.sha256]) for each in card.covariates],
        exclude=[_link(folder / "exclude" / each.name, found[each.checksum.sha256]) for each in card.exclusions],
        reason=[each.reason for each in card.exclusions],
    )
