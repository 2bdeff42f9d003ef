"""Finished ingestions as they lie in a store: their documents and tables, each proved when it is read."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path, PurePosixPath

import pyarrow as pa

from tcpipe.errors import StoreError
from tcpipe.formats.index_files import RunFacts
from tcpipe.formats.numbered import digest_of, name_of, numbers, read_as_at
from tcpipe.formats.parquet import highest, lowest, read_table, write_table
from tcpipe.formats.place import DirectoryPlace, Entry, Place
from tcpipe.formats.recipe_toml import read_key
from tcpipe.formats.run_documents import Manifest, ManifestHead
from tcpipe.formats.seals import Checksum, file_checksum, file_checksums, wrong_checksum
from tcpipe.tables.levels import LABELLED_SEGMENTS, GatedTrack
from tcpipe.tables.verdicts import judge_again


@dataclass(frozen=True, slots=True)
class Listed:
    """What lies in the directory of a run: its files by name there, and the last numbers of its documents."""

    runs: Place
    run_id: str
    files: Mapping[str, Entry]
    numbers: Mapping[str, int]

    def manifests(self) -> list[tuple[str, int]]:
        """Return each recipe with the number of its last manifest."""
        parted = ((stem.partition("/"), number) for stem, number in self.numbers.items())
        return sorted((recipe, number) for (recipe, _, stem), number in parted if stem == "manifest")


@dataclass(frozen=True, slots=True)
class RunDirectory:
    """One finished ingestion: a run under one recipe."""

    run_id: str
    recipe_id: str
    place: Place
    """``runs/<run_id>/<recipe_id>``."""
    facts: RunFacts
    """What the index has of it: enough to choose by."""
    files_state: str
    """Tells its segments and track from files that were written since."""

    @property
    def manifest(self) -> Manifest:
        """The whole manifest, with the run's tags as they are now; `StoreError` if it is not as it was written."""
        return replace(_manifest(self.place, self.facts.state), tags=self.facts.tags)

    @property
    def streams_key(self) -> str:
        """Names the read settings of the streams that it was made from, as ``run.json`` has it while these are there."""
        told = self.manifest
        key = read_key(told.recipe, told.robot_requested, definitions=told.message_definitions)
        return f"{key}-{told.tcpipe_version}"

    @property
    def where(self) -> str:
        """Path or URL of its place."""
        return self.place.where()

    def checksum(self, name: str) -> Checksum:
        """Return what the manifest has of ``track.parquet`` and such."""
        return self.manifest.checksums[self._name(name)]

    def file(self, name: str) -> Path:
        """Return ``track.parquet`` and such on this machine, proved; `StoreError` if it is not as it was written."""
        return local_file(self.place, self._name(name), self.checksum(name))

    def table(self, name: str, columns: Sequence[str] | None = None) -> pa.Table:
        """Read ``track``, ``segments`` or ``rejections``, or some of its columns; `StoreError` if it is not as it was written."""
        columns = None if columns is None else list(columns)
        return read_table(self.file(f"{name}.parquet"), columns).replace_schema_metadata(None)

    def prove(self, *names: str) -> None:
        """Compare files with what the manifest has of them; `StoreError` names the first that is not as it was written."""
        for name in names:
            self.file(name)

    def segments(self) -> pa.Table:
        """Read the labelled segments (schema LABELLED_SEGMENTS; columns that an earlier data model lacks are null)."""
        return LABELLED_SEGMENTS.completed(self.table("segments"))

    def track(self) -> GatedTrack:
        """Read the gated track as a checked level."""
        return GatedTrack(self.table("track"), self.manifest.info)

    def rejections(self) -> pa.Table:
        """Read the measurements that the filter refused (schema REJECTIONS)."""
        return self.table("rejections")

    def _name(self, name: str) -> str:
        found = next((of for of in self.manifest.checksums if PurePosixPath(of).name == name), None)
        if found is None:
            raise StoreError(f"{self.where}: its manifest lists no {name}; ingest the log again")
        return found


@dataclass(frozen=True, slots=True)
class Ingestions:
    """What a store, or one of its runs, holds of finished ingestions."""

    finished: tuple[RunDirectory, ...]
    """Those of this data-model version, by run and recipe."""
    outdated: Mapping[str, ManifestHead]
    """By run, of those that are finished in other data-model versions only: the last."""
    damaged: Mapping[tuple[str, str], str]
    """By run and recipe ("" of the whole run): what is not as it was written, or is gone."""
    superseded: Mapping[str, str] = field(default_factory=dict)
    """Runs whose log was completed or repaired, which are in none of the others, and the run that took their place."""
    rows: Mapping[tuple[str, str], RunFacts] = field(default_factory=dict)
    """Of the index, by run and recipe: of all that are finished, those of superseded runs too."""
    lost: Mapping[tuple[str, str], RunFacts] = field(default_factory=dict)
    """What the index has of those that are damaged or gone: it keeps them, so that nobody takes what is left for all."""
    unfinished: tuple[str, ...] = ()
    """Runs without a manifest that the index does not know: on their way, of a killed call, or not copied whole."""
    stale: bool = False
    """Whether the index has to be written again."""


def with_lost(
    found: Ingestions, known: Mapping[tuple[str, str], RunFacts], run_ids: Iterable[str], *, runs: Place, index: Place
) -> Ingestions:
    """Return what there is of all runs with what the index knows and the listing lacks, as damaged.

    What `prune` removes is not missed: it is superseded, or of a recipe beside another.

    Parameters
    ----------
    found : what was listed.
    known : the rows of the index, read before.
    run_ids : the runs of which anything is there.
    runs, index : where both lie.
    """
    damaged, names = dict(found.damaged), set(run_ids)
    there = {
        *(run.run_id for run in found.finished),
        *(name for name, _ in damaged),
        *found.outdated,
        *found.superseded,
    }
    gone = sorted({name for name, _ in known if name not in there})
    absent = [name for name in gone if name not in names]
    few = f"{', '.join(absent[:3])}{f' and {len(absent) - 3} more' if len(absent) > 3 else ''}"
    what = f"{len(absent)} run{'s are' if len(absent) > 1 else ' is'} gone that the index knows: {few}"
    why = f"copy the store again, or ingest the logs again; if you removed them, remove {index.where()} too"
    for name in gone:
        bare = f"{runs.where(name)}: its manifest-<n>.json is gone; ingest the log again"
        damaged[name, ""] = bare if name in names else f"{runs.where()}: {what}; {why}"
    lost = {key: row for key, row in known.items() if key in damaged or key[0] in gone}
    return replace(found, damaged=damaged, lost=lost, unfinished=tuple(sorted(names - there - set(gone))))


def refuse_lost(of: Listed, recipe_id: str, row: RunFacts | None) -> None:
    """Raise `StoreError` where a document is gone that the index has seen, and an earlier one would hold.

    A copy's files may have other times: what is gone is told by numbers alone.
    """
    if row is None:
        return
    seen = f"{recipe_id}/{row.state} {'' if row.log is None else row.log.state}"
    for stem, number in numbers(state.rsplit("-", 2)[0] for state in seen.split()).items():
        if number > of.numbers.get(stem, 0):
            where = of.runs.where(f"{of.run_id}/{name_of(stem, number)}")
            raise StoreError(f"{where}: is gone; ingest the log again")


@lru_cache(maxsize=64)
def _manifest(place: Place, state: str) -> Manifest:
    """Return the manifest whose file is in this state, which begins with its name; judged by this version's catalogue."""
    manifest = read_as_at(place, state.rsplit("-", 2)[0], Manifest)
    return replace(manifest, verdict=judge_again(manifest.verdict, manifest.info.report.findings))


def with_span(row: RunFacts, place: Place, manifest: Manifest) -> RunFacts:
    """Return a row with when its segments begin and end, from the statistics of their file; without where it has none."""
    name = row.segments_file.removeprefix(f"runs/{row.run_id}/{row.recipe_id}/")
    with suppress(StoreError):
        if row.segments:
            path = place.local(name, manifest.checksums[name])
            return replace(row, start_ns=lowest(path, "start_ns"), end_ns=highest(path, "end_ns"))
    return row


@contextmanager
def told_of(where: str, directory: Path) -> Iterator[None]:
    """Tell what goes wrong in a working directory of the place for which it is."""
    try:
        yield
    except StoreError as error:
        raise StoreError(*(problem.replace(str(directory), where) for problem in error.problems)) from error.__cause__


def put_tables(place: Place, tables: Mapping[str, pa.Table], *, folder: str = "") -> dict[str, Checksum]:
    """Put tables as Parquet into a directory named after their content; return the files."""
    with place.workshop() as directory:
        with told_of(place.where(folder), directory):
            for name, table in tables.items():
                write_table(table, directory / f"{name}.parquet")
        checksums = file_checksums(directory)
        prefix = f"{folder}{digest_of(checksums)}"
        place.put_files(prefix, directory)
    return below(prefix, checksums)


def below(prefix: str, checksums: Mapping[str, Checksum]) -> dict[str, Checksum]:
    """Return checksums by the names that their files have where ``prefix`` lies."""
    return {f"{prefix}/{name}": of for name, of in checksums.items()}


def local_file(place: Place, name: str, wanted: Checksum) -> Path:
    """Return a file on this machine, proved; `StoreError` if it is not as it was written."""
    path = place.local(name, wanted)
    wrong = wrong_checksum(place.where(name), file_checksum(path) if path.is_file() else None, wanted)
    if wrong and not isinstance(place, DirectoryPlace):  # the copy in the cache; a new one is proved when it is made
        path.unlink(missing_ok=True)
        return place.local(name, wanted)
    if wrong:
        raise StoreError(f"{wrong}; 'tcpipe verify {place.where()}' tells what else is not as it was written")
    return path
