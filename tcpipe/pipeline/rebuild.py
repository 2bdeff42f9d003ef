"""Build a dataset again from its own record, with logs and files that are found by their content, and compare the results."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TypeAlias

from tcpipe import __version__
from tcpipe.errors import DatasetError, LogError, TcpipeError, UsageError, clean_line
from tcpipe.execution import refuse_import_of_script
from tcpipe.formats.atomic import check_input_directory, check_output_directory, make_scratch_directory
from tcpipe.formats.bucket_directories import fetch_directory
from tcpipe.formats.dataset_card import DatasetCard, MapSource
from tcpipe.formats.dataset_files import CARD, read_card
from tcpipe.formats.dataset_inputs import DatasetInputs, RunInputs
from tcpipe.formats.file_checks import find_wrong_files
from tcpipe.formats.geojson import Feature, FeatureCollection
from tcpipe.formats.integrity import Checksum, compute_checksum
from tcpipe.formats.json_files import write_json
from tcpipe.formats.logs.log_joining import open_logs
from tcpipe.formats.logs.table_folders import Mappings, is_table, walk_folders
from tcpipe.formats.maps.map_facts import MapInputs
from tcpipe.formats.place import Place
from tcpipe.formats.recipe_toml import load_profiles, make_recipe_id
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
"""Order of adding maps: a class table of one map is that of all later ones."""


@dataclass(frozen=True, slots=True)
class Rebuilt:
    """Comparison of a dataset with what its record gives now; the command prints its ``str``."""

    dataset: str
    to: str | None
    """Directory of the rebuilt dataset; None if it was removed."""
    samples: int
    """Number of samples of the dataset."""
    differing: int
    """Number of them that were not rebuilt, or with other values, split or patch."""
    added: int
    """Number of rebuilt samples that the dataset does not have."""
    largest_in_std: float
    """Largest change of a label, in standard deviations of the dataset's label."""
    causes: tuple[str, ...]
    """Differences of the two records."""
    exit_code: int
    """0 if the datasets are identical, else 3."""

    def __str__(self) -> str:
        """Return one line."""
        if not self.exit_code:
            return f"identical: {self.samples} samples with their patches"
        new = f", {self.added} new" if self.added else ""
        causes = "; ".join(self.causes) or "not recorded (another processor or other library versions)"
        counts = f"{self.differing} of {self.samples} samples{new}, max |Δ|/σ {self.largest_in_std:.2g}"
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
        found = _find_content(card, directory, root, scratch)
        _ingest_logs(card.made_from, found, store, scratch, jobs)
        for source in sorted(card.maps, key=lambda each: _CLASS_SOURCES.index(str(each.classes_from))):
            run_add_map(_make_map_options(source, found, store, scratch))
        options = _make_build_options(card, found, scratch)
        kept = None if card.made_from.kept_split is None else directory
        run_build_dataset(replace(options, out=out, store=store, keep_split=kept, jobs=jobs))
        difference, rebuilt = diff(directory, out), read_card(out)
    causes = _list_causes(card, rebuilt) or difference.causes
    differing, added = difference.differing, difference.samples["only in b"]
    changes = (change.get("largest_in_std", 0.0) for change in difference.changes.values())
    code = 3 if differing or added or causes else 0
    to = None if place is None else str(place)
    return Rebuilt(str(dataset), to, card.samples, differing, added, max(changes, default=0.0), causes, code)


def _list_causes(card: DatasetCard, rebuilt: DatasetCard) -> tuple[str, ...]:
    """Return the differences of the records but for other segments, map files and the kept split, which follow from them."""
    before, now = card.made_from, rebuilt.made_from
    segments = {run_id: run.segments_sha256 for run_id, run in before.runs.items()}
    runs = {run_id: replace(run, segments_sha256=segments.get(run_id)) for run_id, run in now.runs.items()}
    given = replace(now, runs=runs, maps=before.maps, kept_split=before.kept_split)
    return list_causes(card, replace(rebuilt, made_from=given, inputs=given.digest))


@dataclass(frozen=True, slots=True)
class _Wanted:
    """A recorded file or log: its name, its content, and where it is used."""

    name: str
    content: Checksum
    """Size 0: not recorded."""
    use: str


def _find_content(card: DatasetCard, directory: Path, root: Path, scratch: Path) -> dict[str, Paths]:
    """Return everything that a card names, by its sha256; one `DatasetError` for all problems."""
    tables = card.recipe.tables
    sources = find_sources([root], as_one=False, staging=scratch / "staging", tables=tables).sources
    found, missing = _search(
        [*_list_logs(card.made_from.runs)], [each.paths for each in sources], partial(_hash_log, tables), root
    )
    wanted = [*_list_files(card)]
    endings = {Path(each.name).suffix.lower() for each in wanted}
    paths = (Path(folder, name).absolute() for folder, _, names in walk_folders(root) for name in names)
    files, more = _search(wanted, [(path,) for path in paths if path.suffix.lower() in endings], _hash_file, root)
    problems = (
        *find_wrong_files(Place(directory), card.checksums),
        *_find_unusable(card, directory / CARD),
        *missing,
        *more,
    )
    if problems:
        raise DatasetError(*problems)
    return found | files


def _find_unusable(card: DatasetCard, where: Path) -> Iterator[str]:
    """Yield a line for each recorded value that cannot be used."""
    robots, has_classes = (
        load_profiles(card.recipe).robots,
        any(each.classes_from in ("names", "file") for each in card.maps),
    )
    for run_id, run in card.made_from.runs.items():
        if run.robot not in robots:
            yield f"{where}: run {run_id}: robot {run.robot!r} is neither in the recipe nor known to this version"
        elif card.tcpipe_version == __version__ and (own := make_recipe_id(card.recipe, run.robot)) != run.recipe_id:
            yield f"{where}: run {run_id}: ingested with recipe {run.recipe_id}, but the recorded one is {own}"
        if run.message_definitions:
            yield f"{where}: run {run_id}: ingested with --msgdef; a record does not contain message definitions"
    for source in card.maps:
        if source.inputs is None or not source.inputs.main_files:
            yield f"{where}: map {source.name}: its files are not recorded; add the map and build the dataset again"
        elif source.classes_from == "store" and not has_classes:
            yield f"{where}: map {source.name}: its classes come from another map, which is not recorded"


def _list_logs(runs: Mapping[str, RunInputs]) -> Iterator[_Wanted]:
    for run_id, run in runs.items():
        for name, part in zip(run.logs, run.parts or (Checksum(run.size_bytes, run.sha256),), strict=False):
            yield _Wanted(name, part, f"run {run_id}")


def _list_files(card: DatasetCard) -> Iterator[_Wanted]:
    for source in card.maps:
        for role, files in ({} if source.inputs is None else source.inputs.files).items():
            for name, sha256 in files.items():
                yield _Wanted(Path(name).name, Checksum(0, sha256), f"{role} of map {source.name}")
    for table in card.covariates:
        yield _Wanted(table.name, table.checksum, "covariates")
    for excluded in card.exclusions:
        yield _Wanted(excluded.name, excluded.checksum, "excluded samples")


def _search(
    wanted: Sequence[_Wanted], candidates: Sequence[Paths], read: Callable[[Paths, set[int]], str], root: Path
) -> tuple[dict[str, Paths], list[str]]:
    """Return candidates by sha256, and a line for each content that none has; those with a recorded name are read first."""
    found, problems, names = dict[str, Paths](), list[str](), {each.name for each in wanted}
    sizes, left = {each.content.size_bytes for each in wanted}, {each.content.sha256 for each in wanted}
    for paths in sorted(candidates, key=lambda paths: names.isdisjoint(path.name for path in paths)):
        if left and (sha256 := read(paths, sizes)) in left:
            found[sha256] = paths
            left.remove(sha256)
    others = [path for paths in candidates if paths not in found.values() for path in paths]
    for each in wanted:
        if each.content.sha256 in left:
            altered = ", ".join(str(path) for path in others if path.name == each.name)
            what = f"{altered}: altered: not the content" if altered else f"{root}: does not contain {each.name}"
            problems.append(f"{what} that the dataset records for {each.use} (sha256 {each.content.sha256[:12]}…)")
    return found, problems


def _hash_log(tables: Mappings, paths: Paths, sizes: set[int]) -> str:
    """Return the hash of a log of one of the sizes; "" for another size, or a log that cannot be read."""
    with suppress(TcpipeError, OSError), open_logs(paths, tables=tables) as log:
        return log.sha256() if {0, log.size_bytes} & sizes else ""
    return ""


def _hash_file(paths: Paths, sizes: set[int]) -> str:
    with suppress(OSError):
        return compute_checksum(paths[0]).sha256 if {0, paths[0].stat().st_size} & sizes else ""
    return ""


def _link(path: Path, target: Path) -> Path:
    """Return a path that is a link to the target, in new folders."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.symlink_to(target.absolute())
    return path


def _ingest_logs(inputs: DatasetInputs, found: Mapping[str, Paths], store: Path, scratch: Path, jobs: int) -> None:
    """Ingest every log under its recorded name; `LogError` if one fails."""
    calls, problems = dict[tuple[str | None, str], list[Path]](), list[str]()
    for run_id, run in inputs.runs.items():
        paths = _name_log(run_id, run, found, scratch / "logs" / run_id)
        calls.setdefault((run.robot_requested, run_id if run.parts else ""), []).extend(paths)
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


def _name_log(run_id: str, run: RunInputs, found: Mapping[str, Paths], folder: Path) -> Iterable[Path]:
    """Return a log's paths if they give the recorded names, so that files beside it are found, else links that do."""
    logs, stem = [found[part.sha256] for part in run.parts] or [found[run.sha256]], run_id.rpartition("-")[0]
    if not run.parts and LogSource(logs[0], ()).stem == stem and tuple(path.name for path in logs[0]) == run.logs:
        yield from logs[0]
        return
    names = iter(run.logs)
    for number, paths in enumerate(logs):  # parts are joined in the order of their paths
        for path, name in zip(paths, names, strict=False):
            above = stem.removesuffix(f"_{Path(name).stem}") if is_table(name) else "log"
            yield _link(folder / f"{number:04d}" / above / name, path)


def _make_map_options(source: MapSource, found: Mapping[str, Paths], store: Path, scratch: Path) -> AddMapOptions:
    """Return the options that add a map as its card records it; all of its files are linked under their names."""
    inputs, folder = source.inputs or MapInputs(), scratch / "maps" / source.name
    for role, files in inputs.files.items():
        for name, sha256 in files.items():
            _link(folder / role / name, *found[sha256])
    given = {role: [folder / role / name for name in names] for role, names in inputs.main_files.items()}
    rasters = {role: given[role] for role in ROLES if role in given}
    return AddMapOptions(
        source.name,
        **{**rasters, "classes": rasters["classes"][0]} if "classes" in rasters else rasters,
        layers={name: given[name] for name in source.layers if name in given and name not in ROLES},
        categorical={name: given.get(f"{name} {CLASSES}", [None])[0] for name in inputs.categorical},
        ortho_bands="rgb" if inputs.ortho_bands else "grey",
        crs=inputs.crs,
        store=store,
    )


def _make_build_options(card: DatasetCard, found: Mapping[str, Paths], scratch: Path) -> BuildDatasetOptions:
    """Return the options that build a dataset as its card records it, but for an earlier split."""
    inputs, region = card.made_from, card.split.region
    if region is not None:
        features = (Feature({"split": kind}, polygon) for kind, polygon in region.items())
        write_json(scratch / "region.geojson", FeatureCollection(tuple(features)))
    folder = scratch / "files"
    return BuildDatasetOptions(
        split=None if region is None else scratch / "region.geojson",
        map_name=inputs.map_names,
        robot=next(iter(inputs.robots), None),
        tags=inputs.tags,
        recipe=inputs.recipe,
        file_format="parquet" if inputs.file_format == "parquet" else "zarr",
        covariates=[_link(folder / each.name, *found[each.checksum.sha256]) for each in card.covariates],
        exclude=[_link(folder / each.name, *found[each.checksum.sha256]) for each in card.exclusions],
        reason=[each.reason for each in card.exclusions],
    )
