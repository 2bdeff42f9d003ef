"""Nights on a store of 10,000 runs: CPU time and memory of whole commands, with the index of the store and without it.

::

    python benchmarks/many_runs.py DIRECTORY [RUNS] [COMMAND...]     commands: status, ingest, new, build-dataset (default: all)

Runs are synthetic: four segments on a small map, with the findings, sensors and topics of one short drive, so that
documents have its size. Logs are files of eight bytes under the names, sizes and times that the store has seen. 10,000
take two CPU minutes, 100,000 need 12 GB.
"""

import hashlib
import os
import shutil
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from tcpipe.formats.atomic import make_unique_name
from tcpipe.formats.documents import BLOBS, INDEX, State, make_key
from tcpipe.formats.integrity import compute_checksum
from tcpipe.formats.logs.writing import write_mcap
from tcpipe.formats.runs import LogOrigin, LogSnapshot, Run, find_lineage
from tcpipe.formats.stored_runs import StoredRun
from tcpipe.pipeline.calls import INGEST, record_call
from tcpipe.pipeline.ingest import CallOptions, ingest
from tcpipe.pipeline.log_sources import LogSource, list_log_sources
from tcpipe.pipeline.problems import forget_tables
from tcpipe.recipe import Recipe
from tcpipe.store import Store, open_store

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from synthetic_store import add_run, add_world, driven, lanes, segments
from wheel_drives import wheel_drive

DAY_NS = 86_400 * 10**9
FIRST_NS = 10**18
STEM = "drive_"
SHARED = ("findings", "sensors", "topics", "notes", "distance_by_reason_m", "physics")
"""Parts of the ingested drive that a synthetic run keeps."""
LIMITS = {"status": (1.2, None), "ingest": (None, None), "new": (2.2, 300), "build-dataset": (2.5, 300)}
"""CPU time [s] and memory [MB] of a command with 10,000 runs, where the index is there."""


def make_many_runs(directory: Path, count: int) -> tuple[Path, Path]:
    """Return a folder of so many logs and a store that has them all."""
    logs, root = directory / f"logs-{count}", directory / f"store-{count}"
    if root.exists():
        return logs, root
    os.fsync = lambda _: None  # type: ignore[assignment]  all of it can be made again
    write_mcap(directory / "one.mcap", wheel_drive())
    ingest([directory / "one.mcap"], store=directory / "one", recipe=Recipe())
    (one,) = Store(directory / "one").runs()
    logs.mkdir(parents=True)
    for number in range(count):
        (logs / f"{STEM}{number:06d}.mcap").write_bytes(b"%08d" % number)
    store = open_store(root, create=True)
    add_world(store)
    with record_call(store, INGEST, [str(logs.absolute())], CallOptions()) as call:
        call.begin()
        first = _add_first(store, one.manifest)
        call.state, table = store.scan(), first.table("segments")
        for source in list_log_sources([logs.absolute()], as_one=False, staging=Path()).sources:
            _add_copy(store, call.state, first, table, source)
        forget_tables(store, call.state, first.facts)
    return logs, root


def _add_first(store: Store, run: Run) -> StoredRun:
    """Add a run of a drive straight ahead, with all that the run of a real log has beside its segments."""
    table = segments("first", *lanes(0.0, -2.0, 2.0), start_ns=FIRST_NS)
    shared = {name: getattr(run, name) for name in SHARED}
    add_run(store, "first", table, track=driven(table), facts=run.info.report.facts, recording=run.recording, **shared)
    (first,) = store.runs()
    return first


def _add_copy(store: Store, state: State, first: StoredRun, table: pa.Table, source: LogSource) -> None:
    number = int(source.stem.removeprefix(STEM))
    sha256 = hashlib.sha256(str(number).encode()).hexdigest()
    run_id, offset_ns, blob = f"{source.stem}-{sha256[:8]}", number * DAY_NS, make_unique_name()
    changed = {name: pc.add(table.column(name), offset_ns) for name in ("start_ns", "end_ns")}
    changed["run_id"] = pa.array([run_id] * table.num_rows)
    changed["segment_id"] = pa.array([f"{run_id}-{stamp}" for stamp in changed["start_ns"].to_pylist()])
    for name, column in changed.items():
        at = table.schema.get_field_index(name)
        table = table.set_column(at, table.schema.field(at), column)
    folder = Path(store.root) / BLOBS / blob
    folder.mkdir()
    for name in ("track", "rejections"):
        _link(first.file(f"{name}.parquet"), folder / f"{name}.parquet")
    pq.write_table(table, folder / "segments.parquet")
    manifest, checksum = first.manifest, compute_checksum(folder / "segments.parquet")
    assert manifest.recording is not None
    run = replace(
        manifest,
        run_id=run_id,
        info=replace(manifest.info, run_id=run_id),
        log=LogOrigin(source.origins, sha256, source.size_bytes),
        recording=replace(manifest.recording, first_ns=FIRST_NS + offset_ns, last_ns=FIRST_NS + offset_ns + 10**10),
        start_ns=FIRST_NS + offset_ns,
        end_ns=FIRST_NS + offset_ns + 10**10,
        blob=blob,
        streams_blob=blob,
        tables={**manifest.tables, "segments.parquet": checksum},
    )
    store.put_run(state, run)
    store.put(state, "seen", make_key(find_lineage(source.origins)), LogSnapshot(source.origins, source.files, sha256))


def _link(file: Path, link: Path) -> None:
    try:
        os.link(file, link)
    except OSError:  # a file system allows only so many links to a file
        new = shutil.copyfile(file, file.with_suffix(".new"))
        new.replace(file)
        os.link(file, link)


MEASURE = """
import resource, subprocess, sys
code = subprocess.run([sys.executable, "-m", "tcpipe", *sys.argv[1:]], check=False).returncode
used = resource.getrusage(resource.RUSAGE_CHILDREN)
print(used.ru_utime + used.ru_stime, used.ru_maxrss / 1024, code)
"""
"""Runs a command from a small process: the memory of the process that starts a command counts as its own."""


def run_command(what: str, *words: str | Path, cwd: Path, codes: tuple[int, ...] = (0,)) -> tuple[float, float]:
    """Run a whole command and print its wall time, CPU time and memory; return the CPU time [s] and the memory [MB]."""
    begin = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-c", MEASURE, *map(str, words)], cwd=cwd, capture_output=True, text=True, check=True
    )
    wall_s, *said = time.perf_counter() - begin, *done.stdout.splitlines()
    cpu_s, memory_mb, code = map(float, said[-1].split())
    print(f"{what:<24} {wall_s:6.2f} s wall, {cpu_s:6.2f} s CPU, {memory_mb:5.0f} MB", flush=True)
    assert code in codes, done.stdout + done.stderr
    return cpu_s, memory_mb


def measure(what: str, directory: Path, logs: Path, root: Path) -> list[str]:
    """Measure a command twice with the index and once without it; return what is above its limits."""
    store = ["--store", root]
    new = directory / f"new-{root.name}"
    words: dict[str, list[str | Path]] = {
        "status": ["status", root],
        "ingest": ["ingest", logs, *store, "--quiet"],
        "new": ["ingest", logs, new, *store, "--quiet"],
        "build-dataset": ["build-dataset", directory / f"dataset-{root.name}", *store, "--robot", "husky"],
    }
    figures = []
    for how in ("first", "warm", "warm", "cold"):
        if how == "cold":
            (root / INDEX).unlink(missing_ok=True)
        if what == "new":
            new.mkdir(exist_ok=True)
            seed = time.time_ns() % 2**31
            write_mcap(new / f"{seed}.mcap", wheel_drive(seed=seed, start_ns=time.time_ns()))
        codes = (0, 3) if what == "build-dataset" else (0,)
        figures.append(run_command(f"{what}, {how}", *words[what], cwd=directory, codes=codes))
    limits = [(of, limit) for of, limit in zip(np.min(figures[1:3], axis=0), LIMITS[what], strict=True) if limit]
    return [f"{what}: {found:.3g}, expected {limit:g}" for found, limit in limits if found > limit]


def main() -> None:
    directory, count = Path(sys.argv[1]).absolute(), int(sys.argv[2]) if len(sys.argv) > 2 else 10_000
    directory.mkdir(parents=True, exist_ok=True)
    begin_s = time.process_time()
    logs, root = make_many_runs(directory, count)
    print(f"{'synthesise':<24} {time.process_time() - begin_s:22.2f} s CPU", flush=True)
    wrong = [line for what in sys.argv[3:] or [*LIMITS] for line in measure(what, directory, logs, root)]
    if count == 10_000 and wrong:
        sys.exit("\n".join(wrong))


if __name__ == "__main__":
    main()
