"""Nights on a store of 10,000 runs: what it costs to ingest nothing, to tell where everything stands, to choose a dataset's runs, to prune.

::

    python benchmarks/many_runs.py DIRECTORY [RUNS]
    python benchmarks/many_runs.py DIRECTORY RUNS new      one new log alone, with the memory that it takes

Logs and runs are copies of one short drive under other names, hashes and times, laid out as ingestion would have; documents have its size.
10,000 take one CPU minute, 100,000 eleven and 8 GB.
"""

import hashlib
import os
import re
import resource
import shutil
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from tcpipe.formats.commits import Entries
from tcpipe.formats.integrity import compute_checksum
from tcpipe.formats.logs.writing import write_mcap
from tcpipe.formats.stored_runs import RunDirectory
from tcpipe.pipeline.calls import open_log
from tcpipe.pipeline.dataset.inputs import remove_duplicates
from tcpipe.pipeline.dataset.runs import SelectedRuns, choose_runs
from tcpipe.pipeline.ingest import ingest
from tcpipe.pipeline.log_sources import LogSource, find_sources
from tcpipe.pipeline.options import IngestOptions
from tcpipe.pipeline.prune import prune
from tcpipe.pipeline.status import find_status
from tcpipe.recipe import Recipe
from tcpipe.store import Store, open_store

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from wheel_drives import wheel_drive

T = TypeVar("T")

DAY_NS = 86_400 * 10**9
SEAL = re.compile(r'(?m)^  "document_sha256": "([0-9a-f]{64})"(,?)\n')


def many_runs(directory: Path, count: int) -> tuple[Path, Store]:
    """Return a folder of so many logs and a store that has them all."""
    logs, store = directory / f"logs-{count}", Store(directory / f"store-{count}")
    if Path(store.root).exists():
        return logs, store
    write_mcap(directory / "one.mcap", wheel_drive())
    ingest([directory / "one.mcap"], store=directory / "one", recipe=Recipe())
    (run,) = Store(directory / "one").runs()
    logs.mkdir(parents=True)
    for number in range(count):
        (logs / f"drive_{number:05d}.mcap").write_bytes(b"%08d" % number)
    open_store(store.root, create=True)
    log, sources = open_log(store), find_sources([logs], as_one=False, staging=Path()).sources
    segments = run.table("segments")
    for start in range(0, count, 100):
        made = [
            _copy(run, segments, store, source, start + at) for at, source in enumerate(sources[start : start + 100])
        ]
        log.commit(
            "ingested",
            Entries(runs=tuple(of for each in made for of in each.runs), seen=tuple(of.seen[0] for of in made)),
        )
    return logs, store


def _copy(run: RunDirectory, segments: pa.Table, store: Store, source: LogSource, number: int) -> Entries:
    sha256 = hashlib.sha256(str(number).encode()).hexdigest()
    run_id = f"{source.stem}-{sha256[:8]}"
    there = run.file("segments.parquet").parent
    place = Path(store.root) / "runs" / run_id / run.recipe_id / there.name
    place.mkdir(parents=True)
    for name in ("track", "rejections"):
        _link(there / f"{name}.parquet", place / f"{name}.parquet")
    for stream in there.parents[1].glob("streams/*/*.parquet"):
        linked = place.parents[1] / stream.relative_to(there.parents[1])
        linked.parent.mkdir(parents=True, exist_ok=True)
        _link(stream, linked)
    for name in ("start_ns", "end_ns"):
        at, column = segments.schema.get_field_index(name), pc.add(segments.column(name), number * DAY_NS)
        segments = segments.set_column(at, segments.schema.field(name), column)
    pq.write_table(segments, place / "segments.parquet")
    new, old = compute_checksum(place / "segments.parquet"), run.checksum("segments.parquet")
    log = run.facts.log.source
    names = {run.run_id: run_id, log.sha256: sha256, log.paths[0]: source.origins[0], old.sha256: new.sha256}
    names |= {f'"size_bytes": {old.size_bytes}': f'"size_bytes": {new.size_bytes}'}
    for document in (Path(run.recipe_id, "manifest-1.json"), Path("run-1.json")):
        (place.parents[1] / document).write_text(_renamed((there.parents[1] / document).read_text(), names))
    return Entries(runs=tuple(store.read_rows(run_id).values()), seen=(source.sighting(sha256),))


def _link(file: Path, link: Path) -> None:
    try:
        os.link(file, link)
    except OSError:  # a file system allows only so many links to a file
        new = shutil.copyfile(file, file.with_suffix(".new"))
        new.replace(file)
        os.link(file, link)


def _renamed(text: str, names: dict[str, str]) -> str:
    for old, new in names.items():
        text = text.replace(old, new)
    bare = hashlib.sha256(SEAL.sub("", text).encode()).hexdigest()
    return SEAL.sub(lambda found: f'  "document_sha256": "{bare}"{found[2]}\n', text)


def timed(what: str, act: Callable[[], T]) -> T:
    wall, cpu = time.perf_counter(), time.process_time()
    found = act()
    print(f"{what:<32} {time.perf_counter() - wall:6.2f} s wall, {time.process_time() - cpu:6.2f} s CPU", flush=True)
    return found


def once(store: Store, chosen: SelectedRuns) -> int:
    return len(remove_duplicates(store, chosen.runs, chosen.logs).runs)


def ingest_new_logs(directory: Path, count: int) -> None:
    """Ingest a new log into an empty store, twice, as the first one loads libraries, and into the store of many runs."""
    logs, store = many_runs(directory, count)
    stores = {"into an empty store, first": None, "into an empty store, again": None, "one new log": store.root}
    for what, root in stores.items():
        new = directory / f"new-{time.time_ns()}.mcap"
        write_mcap(new, wheel_drive(seed=time.time_ns() % 2**31))
        given, where = [new] if root is None else [logs, new], root or new.with_suffix("")
        summary = timed(what, lambda given=given, where=where: ingest(given, store=where, recipe=Recipe()))
        assert [result.status for result in summary.results].count("done") == 1
        print(f"largest memory: {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MB", flush=True)


def main() -> None:
    directory, count = Path(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 10_000
    if sys.argv[3:] == ["new"]:
        ingest_new_logs(directory, count)
        return
    directory.mkdir(parents=True, exist_ok=True)
    logs, store = timed("synthesise", lambda: many_runs(directory, count))
    timed("read the log", store.state)
    for again in ("first", "again"):
        summary = timed(f"nothing to ingest, {again}", lambda: ingest([logs], store=store.root, recipe=Recipe()))
        assert {result.status for result in summary.results} == {"unchanged"}
        found = timed(
            f"status, {again}",
            lambda: find_status(IngestOptions([logs], store=store.root, recipe=Recipe(), min_age_s=600.0)),
        )
        assert found.counts == {"done": count}, found.counts
        chosen = timed(f"choice of runs, {again}", lambda: choose_runs(store, Recipe(), robot=None, tags={}))
        assert timed(f"each drive once, {again}", lambda chosen=chosen: once(store, chosen)) >= count
        assert not timed(
            f"prune --dry-run, {again}", lambda: prune(store=store.root, recipe=Recipe(), dry_run=True)
        ).removed


if __name__ == "__main__":
    main()
