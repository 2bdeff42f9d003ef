"""Reading logs of autopilots into columns: CPU time against their makers' readers, pyulog and pymavlink.

Run by hand: ``python benchmarks/autopilots.py [--minutes M] [LOG...]``. Without logs it writes a drive of so many
minutes in both formats. Reads alternate in one process and the least time of some counts; every column is decoded by
both. It ends with 1 where tcpipe takes more than its share: 0.8 of pyulog's time, 0.1 of pymavlink's.
"""

import argparse
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from autopilot_files import Drive, write_dataflash, write_ulog
from pymavlink.DFReader import DFReader_binary
from pyulog import ULog

from tcpipe.formats.logs.autopilot_log import read_autopilot_records
from tcpipe.formats.logs.log_file import find_autopilot

MOST_SHARE = {"ulog": 0.8, "dataflash": 0.1}
PEERS = {"ulog": "pyulog", "dataflash": "pymavlink"}
REPEATS = 3


def with_tcpipe(path: Path, kind: str) -> int:
    records = read_autopilot_records(path, kind)
    return sum(len(next(iter(of.read_columns(records.data).values()))) for of in records.messages.values())


def with_peer(path: Path, kind: str) -> int:
    if kind == "ulog":
        return sum(len(of.data["timestamp"]) for of in ULog(str(path)).data_list)
    log, count = DFReader_binary(str(path)), 0
    while (message := log.recv_msg()) is not None:
        count += message.get_type() not in ("FMT", "FILE") and len(message.to_dict()) > 0
    log.close()
    return count


def measure_log(path: Path) -> float:
    """Print the times of a log; return tcpipe's share of the peer's, of what it may take."""
    kind = find_autopilot(path)
    least = {with_tcpipe: float("inf"), with_peer: float("inf")}
    counts = {}
    for _ in range(REPEATS):
        for read, before in list(least.items()):
            begun = time.process_time()
            counts[read] = read(path, kind)
            least[read] = min(before, time.process_time() - begun)
    mine, theirs = least.values()
    size_mb = path.stat().st_size / 1e6
    print(
        f"{path.name}: {size_mb:.1f} MB, {counts[with_tcpipe]} of {counts[with_peer]} messages; tcpipe {mine:.3f} s, "
        f"{size_mb / mine:.0f} MB/s; {PEERS[kind]} {theirs:.3f} s: {mine / theirs:.3f} of its time (at most {MOST_SHARE[kind]})"
    )
    return mine / theirs / MOST_SHARE[kind]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("logs", nargs="*", type=Path, metavar="LOG")
    parser.add_argument("--minutes", type=float, default=20.0)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        logs = given.logs
        if not logs:
            drive = Drive(60.0 * given.minutes)
            logs = [write_ulog(Path(scratch, "drive.ulg"), drive), write_dataflash(Path(scratch, "drive.bin"), drive)]
        shares = [measure_log(path) for path in logs]
    sys.exit(int(max(shares) > 1.0))


if __name__ == "__main__":
    main()
