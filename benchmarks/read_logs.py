"""Reading a log into tables: CPU time against rosbags, rerun and the mere reading and decompressing of the chunks ("floor").

Run by hand: ``python benchmarks/read_logs.py [--quick | --minutes M] [--rerun PYTHON] [--huge GB] [--only PART]``. Logs
are made in a temporary directory; reads alternate in one process, the least of some times counts; what is read is
compared before anything is timed. ``--quick`` takes logs of one minute instead of ten: all is done in some two minutes
on an idle machine, but what is paid once a log weighs more. ``--rerun`` names the Python of an environment in which
rerun-sdk is installed; without it those lines say so. ``--huge`` adds the memory that reading a log of so many GB
takes, which needs as much room on the disk.
"""

import argparse
import contextlib
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pyarrow.parquet as pq
from made_logs import (
    NAVIGATION,
    RAGGED,
    RATES_HZ,
    STORES,
    by_time,
    camera,
    navigation,
    ragged,
    repeated,
    write_bag,
    write_db3,
    write_mcap,
)
from rosbags.highlevel import AnyReader

from tcpipe.formats.logs.log_file import open_log
from tcpipe.formats.logs.log_part import ByteSource, decompress
from tcpipe.formats.logs.mcap_file import McapPart
from tcpipe.pipeline.export import export

MINUTES, QUICK_MINUTES, REPEATS = 10.0, 1.0, 5
FIELDS = {topic: field for topic, _, _, field in RATES_HZ}
RERUN = """
import sys, time
from rerun.chunk import McapReader
for line in sys.stdin:
    path, topics = line.split()
    start, rows = time.process_time(), 0
    names = topics.split(",")
    reader = McapReader(path, decoders=["ros2msg", "ros2_reflection"], include_topic_regex=[f"^{name}$" for name in names])
    for chunk in reader.stream():
        rows += chunk.num_rows * (str(chunk.entity_path) in names)
    print(time.process_time() - start, rows, flush=True)
"""
MEMORY = """
import sys
from pathlib import Path
from tcpipe.formats.logs.log_file import open_log
import pyarrow.parquet, rosbags.typesys
import tcpipe.formats.logs.arrow_columns, tcpipe.formats.logs.bag_file, tcpipe.formats.logs.mcap_file
peak = lambda: int(Path("/proc/self/status").read_text().split("VmHWM:")[1].split()[0]) / 1024
before, rows, largest = peak(), 0, 0
with open_log(Path(sys.argv[1])) as log:
    for tables in log.batches(sys.argv[2].split(",")):
        rows += sum(table.num_rows for table in tables.values())
        largest = max(largest, sum(table.nbytes for table in tables.values()))
    assert not log.damage, log.damage
print(rows, peak() - before, largest / 2**20)
"""


def with_tcpipe(path: Path, topics: list[str]) -> int:
    with open_log(path) as log:
        return sum(table.num_rows for table in log.tables(topics).values())


def to_parquet(path: Path, topics: list[str]) -> None:
    with tempfile.TemporaryDirectory() as out:
        export(path, Path(out), topics=topics)


def rosbags_messages(path: Path, topics: list[str]) -> Iterator[tuple[str, int, object]]:
    with AnyReader([path], default_typestore=STORES["cdr"]) as reader:
        wanted = [connection for connection in reader.connections if connection.topic in topics]
        for connection, stamp, raw in reader.messages(wanted):
            yield connection.topic, stamp, reader.deserialize(raw, connection.msgtype)


def with_rosbags(path: Path, topics: list[str]) -> int:
    return sum(1 for _ in rosbags_messages(path, topics))


def floor(path: Path, _topics: list[str]) -> None:
    """Read every chunk of an .mcap and decompress it, as the reader does, and nothing else."""
    part, source = McapPart(path, path.name), ByteSource(path)
    for chunk in part._contents.chunks:  # noqa: SLF001
        data = source.read(chunk.data_offset, chunk.data_bytes)
        if chunk.compression:
            decompress(chunk.compression, data, chunk.uncompressed_bytes, checked=True)


def assert_equal_content(path: Path, topics: list[str]) -> None:
    """Compare log time and what varies in each message with what rosbags reads."""
    found: dict[str, list[tuple[int, object]]] = {topic: [] for topic in topics}
    for topic, stamp, message in rosbags_messages(path, topics):
        value: object = message
        for name in FIELDS[topic].split(".") if topic in FIELDS else ["status"]:
            value = getattr(value, name)
        found[topic].append((stamp, value if topic in FIELDS else [status.message for status in value]))
    with open_log(path) as log:
        for topic, table in log.tables(topics).items():
            rows = found[topic]
            assert table["log_time_ns"].to_pylist() == [stamp for stamp, _ in rows]
            if topic in FIELDS:
                assert table[FIELDS[topic]].to_pylist() == [value for _, value in rows]
            else:
                texts = [[status["message"] for status in row] for row in table["status"].to_pylist()]
                assert texts == [value for _, value in rows]
        assert log.damage == []


def assert_equal_tables(path: Path, other: Path | None = None) -> None:
    """Compare a log that is read twice, or with another log; and with its export where no other is given."""
    with open_log(path) as log, open_log(other or path) as again, tempfile.TemporaryDirectory() as out:
        tables = log.tables(NAVIGATION)
        assert tables == again.tables(NAVIGATION)
        if other is None:
            for topic in export(path, Path(out), topics=NAVIGATION).topics:
                assert pq.read_table(topic.path).equals(tables[topic.topic]), topic.topic


class Machine:
    """Let other processes run while something is timed, or with ``alone`` none (Linux; needs the privilege)."""

    def __init__(self) -> None:
        self.alone = False
        self.processes = [0]
        """This one, and peers that run on their own."""

    @contextlib.contextmanager
    def ours(self) -> Iterator[None]:
        """Run before everything else on the machine."""
        self._schedule(os.SCHED_FIFO, 1)
        try:
            yield
        finally:
            self._schedule(os.SCHED_OTHER, 0)

    def _schedule(self, policy: int, priority: int) -> None:
        for process in self.processes if self.alone else ():
            os.sched_setscheduler(process, policy, os.sched_param(priority))


MACHINE = Machine()


class Rerun:
    """rerun-sdk in its own environment."""

    def __init__(self, python: str | None) -> None:
        self.process = None
        if (
            python
            and subprocess.run([python, "-c", "import rerun.chunk"], check=False, capture_output=True).returncode == 0
        ):
            pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL, "text": True}
            self.process = subprocess.Popen([python, "-W", "ignore", "-c", RERUN], **pipes)
            MACHINE.processes.append(self.process.pid)

    def seconds(self, path: Path, topics: list[str], messages: int) -> float:
        """Have it read the topics; return the CPU seconds it took."""
        self.process.stdin.write(f"{path} {','.join(topics)}\n")
        self.process.stdin.flush()
        seconds, rows = self.process.stdout.readline().split()
        assert int(rows) >= messages, (rows, messages)
        return float(seconds)


def best(readers: dict[str, Callable[[], object]], clock: Callable[[], float] = time.process_time) -> dict[str, float]:
    """Call the readers in turn; return the least seconds each took (a reader that returns a float has measured itself)."""
    times: dict[str, list[float]] = {name: [] for name in readers}
    with MACHINE.ours():
        for _ in range(REPEATS):
            for name, read in readers.items():
                start = clock()
                found = read()
                times[name].append(found if isinstance(found, float) else clock() - start)
    return {name: min(found) for name, found in times.items()}


class Figures:
    """Prints each figure beside its target, and counts those that are reached."""

    def __init__(self) -> None:
        self.missed: list[str] = []
        self.count = 0

    def row(self, name: str, target: float | None, found: float, *, at_least: bool = False, note: str = "") -> None:
        """Print one; without a target for what it says beside the others."""
        reached = target is None or (found >= target if at_least else found <= target)
        wanted = "" if target is None else f"{'>=' if at_least else '<='} {target:g}"
        self.count += target is not None
        self.missed += [] if reached else [name.strip()]
        said = "" if target is None else "met" if reached else "MISSED"
        print(f"{name:66s} {wanted:>8s} {found:9.2f}  {said:7s} {note}".rstrip(), flush=True)


FIGURES = Figures()
row = FIGURES.row


def compare(
    name: str,
    path: Path,
    rerun: Rerun,
    times_rosbags: float | None,
    topics: list[str] = NAVIGATION,
    *,
    of_rerun: float | None = None,
) -> dict[str, float]:
    """Print the figures of one log against rosbags and, where it has a target, rerun."""
    assert_equal_content(path, topics)
    messages = with_tcpipe(path, topics)
    readers: dict[str, Callable[[], object]] = {
        "tcpipe": lambda: with_tcpipe(path, topics),
        "rosbags": lambda: with_rosbags(path, topics),
    }
    if path.suffix == ".mcap":
        readers["floor"] = lambda: floor(path, topics)
    if rerun.process and of_rerun:
        readers["rerun"] = lambda: rerun.seconds(path, topics, messages)
    seconds = best(readers)
    note = ", ".join(f"{reader} {found:.3f}" for reader, found in seconds.items()) + f" s, {messages} messages"
    row(
        f"{name}: times rosbags' speed", times_rosbags, seconds["rosbags"] / seconds["tcpipe"], at_least=True, note=note
    )
    if "rerun" in seconds:
        row("  of rerun's time", of_rerun, seconds["tcpipe"] / seconds["rerun"])
    elif of_rerun:
        print(
            f"{'  of rerun' + chr(39) + 's time':66s} {f'<= {of_rerun:g}':>8s}   (left out: --rerun names no Python with rerun-sdk)"
        )
    return seconds


def read_share(path: Path) -> float:
    """Return which share of a log's bytes is read from the disk, the page cache emptied of it."""
    descriptor = os.open(path, os.O_RDONLY)
    os.fsync(descriptor)
    os.posix_fadvise(descriptor, 0, 0, os.POSIX_FADV_DONTNEED)
    os.close(descriptor)

    def read_bytes() -> int:
        return int(Path("/proc/self/io").read_text().split("read_bytes: ")[1].split()[0])

    before = read_bytes()
    with_tcpipe(path, NAVIGATION)
    return (read_bytes() - before) / path.stat().st_size


def mcap_rows(directory: Path, minutes: float, rerun: Rerun) -> None:
    for compression, target in (("zstd", 15), ("lz4", 15), ("none", 16)):
        path = write_mcap(directory / "navigation.mcap", navigation(minutes), compression=compression)
        compare(
            f"MCAP {compression}, navigation only", path, rerun, target, of_rerun=0.8 if compression == "zstd" else None
        )
        if compression == "zstd":
            salvage(path)
        path.unlink()
    path = write_mcap(
        directory / "apart.mcap", by_time(navigation(minutes), camera(minutes)), compression="none", camera_apart=True
    )
    compare("MCAP none, camera in chunks of its own", path, rerun, 16)
    row("  share of the file that is read", 0.15, read_share(path))
    path.unlink()
    for compression, crcs, target in (("none", False, 16), ("none", True, None), ("lz4", True, 11)):
        path = write_mcap(
            directory / "camera.mcap", by_time(navigation(minutes), camera(minutes)), compression=compression, crcs=crcs
        )
        what = f"MCAP {compression}{'' if crcs else ' without CRC'}, camera in every chunk"
        compare(what, path, rerun, target)
        if not crcs:
            row("  share of the file that is read", 0.15, read_share(path))
        path.unlink()


def zstd_rows(directory: Path, minutes: float, rerun: Rerun) -> None:
    for crcs, target in ((True, 1.4), (False, 1.3)):
        path = write_mcap(
            directory / "camera.mcap", by_time(navigation(minutes), camera(minutes)), compression="zstd", crcs=crcs
        )
        what = f"zstd MCAP with camera{'' if crcs else ', without CRC'}"
        seconds = compare(what, path, rerun, None, of_rerun=0.75)
        row("  of the floor", target, seconds["tcpipe"] / seconds["floor"])
        if crcs:
            parquet(path, what)
            salvage(path)
        path.unlink()


def parquet(path: Path, name: str) -> None:
    assert_equal_tables(path)
    seconds = best({"floor": lambda: floor(path, []), "parquet": lambda: to_parquet(path, NAVIGATION)})
    row(f"{name} to Parquet: of the floor", 1.6, seconds["parquet"] / seconds["floor"])


def salvage(path: Path) -> None:
    """Compare the reading of a log with that of the same without its summary."""
    cut = path.with_name("cut.mcap")
    part = McapPart(path, path.name)
    last = max(part._contents.chunks, key=lambda chunk: chunk.offset)  # noqa: SLF001
    end = last.end + last.index_bytes
    with path.open("rb") as whole, cut.open("wb") as file:
        while (left := end - file.tell()) > 0:
            file.write(whole.read(min(left, 1 << 24)))
    assert_equal_tables(path, cut)
    seconds = best({"indexed": lambda: with_tcpipe(path, NAVIGATION), "salvage": lambda: with_tcpipe(cut, NAVIGATION)})
    row("  without summary (salvage): of the indexed read", 1.4, seconds["salvage"] / seconds["indexed"])
    cut.unlink()


def other_rows(directory: Path, minutes: float, rerun: Rerun) -> None:
    for compression, target in (("lz4", 15), ("none", 15), ("bz2", None)):
        path = write_bag(directory / "navigation.bag", navigation(minutes, "ros1"), compression=compression)
        compare(f".bag {compression}, navigation only", path, rerun, target)
        path.unlink()
    for compression, target in (("lz4", 8), ("none", 8)):
        messages = by_time(navigation(minutes, "ros1"), camera(minutes, "ros1"))
        path = write_bag(directory / "camera.bag", messages, compression=compression)
        compare(f".bag {compression}, camera in every chunk", path, rerun, target)
        path.unlink()
    path = write_db3(directory / "navigation", navigation(minutes))
    compare(".db3, navigation only", path, rerun, 2)
    path = write_db3(directory / "camera", by_time(navigation(minutes), camera(minutes)))
    compare(".db3 with camera", path, rerun, 2)
    path = write_mcap(directory / "ragged.mcap", ragged(20_000), compression="zstd")
    seconds = compare("ragged, high-entropy topic", path, rerun, None, [RAGGED])
    row("  of rosbags' time", 1.2, seconds["tcpipe"] / seconds["rosbags"])


def start_up() -> None:
    """Print the CPU time of ``tcpipe --help``, the Python interpreter's own included."""
    program = "import sys; from tcpipe.cli import cli; sys.argv = ['tcpipe', '--help']; cli()"
    found = []
    for _ in range(REPEATS):
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        with MACHINE.ours():
            subprocess.run([sys.executable, "-c", program], check=True, capture_output=True)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        found.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
    row("tcpipe --help: CPU ms", 80, 1000 * min(found))


def memory_rows(directory: Path, gigabytes: float) -> None:
    """Print the memory it takes to read a log of that size, made by repeating a minute, and the time to inspect it."""
    times = round(gigabytes * 1e9 / (1_550_000 * 60))
    minute = by_time(navigation(1), camera(1))
    path = write_mcap(directory / "huge.mcap", repeated(minute, 60, times), compression="lz4")
    size = path.stat().st_size / 1e9
    arguments = [sys.executable, "-c", MEMORY, str(path), ",".join(NAVIGATION)]
    done = subprocess.run(arguments, check=True, capture_output=True, text=True)
    rows, peak, largest = map(float, done.stdout.split())
    name = f"{size:.1f} GB MCAP: peak MB over imports and a row group"
    row(name, 120, peak - largest, note=f"peak {peak:.0f}, largest row group {largest:.0f}, {rows:.0f} messages")
    program = f"import sys; from tcpipe.cli import cli; sys.argv = ['tcpipe', 'inspect', {str(path)!r}]; cli()"
    inspect = [sys.executable, "-c", program]
    wall = best({"": lambda: subprocess.run(inspect, check=True, capture_output=True)}, time.perf_counter)
    row(f"tcpipe inspect of {size:.1f} GB: wall s", 1.0, wall[""])
    path.unlink()


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--minutes", type=float, default=MINUTES, help="length of the logs")
    parser.add_argument("--quick", action="store_const", dest="minutes", const=QUICK_MINUTES)
    parser.add_argument("--rerun", metavar="PYTHON")
    parser.add_argument("--huge", type=float, metavar="GB")
    parser.add_argument("--only", default="", metavar="PART", help="mcap, zstd, other, start or huge")
    parser.add_argument("--scratch", type=Path, metavar="DIR", help="where to make the logs")
    parser.add_argument("--alone", action="store_true", help="what is timed runs before everything else on the machine")
    given = parser.parse_args()
    MACHINE.alone = given.alone
    rerun = Rerun(given.rerun)
    with tempfile.TemporaryDirectory(dir=given.scratch) as scratch:
        directory = Path(scratch)
        parts: dict[str, Callable[[], None]] = {
            "mcap": lambda: mcap_rows(directory, given.minutes, rerun),
            "zstd": lambda: zstd_rows(directory, given.minutes, rerun),
            "other": lambda: other_rows(directory, given.minutes, rerun),
            "start": start_up,
        }
        if given.huge:
            parts["huge"] = lambda: memory_rows(directory, given.huge)
        print(f"{given.minutes:g} min of log, least CPU time of {REPEATS} alternating reads")
        print(f"{'figure':66s} {'target':>8s} {'found':>9s}")
        for name, run in parts.items():
            if given.only in name:
                run()
    print(
        f"{FIGURES.count - len(FIGURES.missed)} of {FIGURES.count} figures met; missed: {'; '.join(FIGURES.missed) or 'none'}"
    )


if __name__ == "__main__":
    main()
