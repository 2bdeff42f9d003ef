"""Judge the estimator on public logs by fixes that are withheld from it.

    python benchmarks/withheld.py [LOGS] [--only NAME] [--log LOG ...]

For each log `tcpipe audit` withholds fixes in windows of 10, 30 and 60 s; see `tcpipe/pipeline/audit.py`. One row a log
shows the fixes: windows, median error, 95 % error and σ [m], and the share of errors inside 1σ and 2σ. Pooled figures
follow, one value a second of every window, and the mean of the logs' shares: wanted are 92 % of withheld fixes inside
2σ. Logs without fixes show the length of the track over that of their own odometry: wanted is 1 to within 2 %. Husky
logs are audited again without GNSS, and without GNSS and IMU.

A hash of a log's name puts half of the logs aside (``held out``): their figures are printed apart, and nothing may be
tuned on them.

LOGS, or the environment's TCPIPE_PUBLIC_LOGS, is a directory with files of public repositories, of which none belongs
here:

- ``husky/*.bag``: kaasmandje/ResearchMethods2023, branch Original-data
- ``evo/nav2_turtlebot.mcap``: MichaelGrupp/evo, test/data
- ``gps_nav_ws/bag_0.db3``, ``bag2_0.db3``: drewbot02341/gps_nav_ws, bag and bag2
- ``fomo/``: norlab-ulaval/fomo-sdk, gt.txt and odom.csv of examples/data/2025-10-14/red_2025-10-14-11-41
- ``giow/``: i2Nav-WHU/GIOW-release, GNSS_data.txt and odometer_speed.txt of data
- ``librsf/``: TUC-ProAut/libRSF, Corridor, Lecture_Hall and Indoor_UWB of datasets, each _GT.txt and _Input.txt
- ``fau/``: dylans019/CAP6415_F25_project-…,
EnergyConsumptionPredictionFiles/data/test_dataset/test_gps_20251118_162921.csv

TCPIPE_TEST_DATA names the directory with ``robot_localization/`` and ``warthog_grass_a/``. A log that is not there is
named and skipped.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import shutil
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from tcpipe.errors import TcpipeError
from tcpipe.formats.recipe_toml import load_recipe
from tcpipe.pipeline.audit import (
    Comparison,
    WithheldComparisons,
    compare_withheld,
    read_audited,
    score_comparisons,
)

HUSKY = 'wheel_odometry = ["odometry/filtered"]\n'
HUSKY_VARIANTS = {"": "", ", no GNSS": "gnss = []\n", ", no GNSS, no IMU": "gnss = []\nimu = []\n"}
FOMO = """
[fuse]
gnss_default_std_m = 0.02
[read]
pose_crs = "EPSG:2949"
[tables.pose]
file = "gt.txt"
columns = { x = "tx", y = "ty", z = "tz" }
[tables.wheel_odometry]
file = "odom.csv"
columns = { linear_x = "tlx", angular_z = "taz" }
"""
FAU = """
[tables.gnss]
file = "test_gps_20251118_162921.csv"
stamp = "timestamp (ns)"
columns = { latitude = "latitude (deg)", longitude = "longitude (deg)", altitude = "alt_msl (m)" }
"""
GIOW = """
[tables.gnss]
file = "GNSS_data.txt"
stamp_unit = "s"
columns = { latitude = "column_2", longitude = "column_3", altitude = "column_4", east_std = "column_6", north_std = "column_5" }
[tables.wheel_odometry]
file = "odometry.csv"
stamp_unit = "s"
columns = { linear_x = "v" }
"""
LIBRSF = """
[tables.pose]
file = "pose.csv"
stamp_unit = "s"
columns = { x = "x", y = "y" }
[tables.wheel_odometry]
file = "odometry.csv"
stamp_unit = "s"
columns = { linear_x = "v", angular_z = "w" }
"""
TEST1 = """
[read.extrinsics]
imu = { xyz_m = [0.0, -0.3, 0.52], rpy_rad = [1.5707963, 0.0, -1.5707963] }
"""


@dataclass(frozen=True)
class Case:
    """A log and how it is read."""

    name: str
    path: Path
    recipe: str = ""
    convert: Callable[[Path, Path], None] | None = None
    """Function that writes the tables of a log without a log file into a directory."""

    @property
    def half(self) -> str:
        """Whether it may be tuned on; all variants of a log are in one half."""
        is_held_out = hashlib.sha256(self.name.partition(",")[0].encode()).digest()[0] % 2
        return "held out" if is_held_out else "open"


def convert_giow(path: Path, out: Path) -> None:
    """Write the mean speed of both wheels, and the fixes as they are."""
    shutil.copy(path / "GNSS_data.txt", out)
    stamp, left, right = np.loadtxt(path / "odometer_speed.txt").T
    _write(out / "odometry.csv", "stamp,v", stamp, (left + right) / 2.0)


def convert_librsf(path: Path, out: Path) -> None:
    """Write odometry, of wheels or of the body, and positions: a line there has a type before its numbers."""
    rows = [line.split() for line in path.read_text().splitlines()]
    odometry = np.array([row[1:7] for row in rows if row[0] in {"odom2", "odom2diff"}], float)
    stamp, v, w = odometry[:, 0], odometry[:, 1], odometry[:, 3]
    if any(row[0] == "odom2diff" for row in rows):  # right, left, sideways, track width
        v, w = odometry[:, 1:3].mean(axis=1), (odometry[:, 1] - odometry[:, 2]) / odometry[:, 4]
    truth = path.with_name(path.name.replace("_Input", "_GT")).read_text().splitlines()
    _write(out / "odometry.csv", "stamp,v,w", stamp, v, w)
    _write(
        out / "pose.csv",
        "stamp,x,y",
        *np.array([line.split()[1:4] for line in truth if line.startswith("point2")], float).T,
    )


def _write(path: Path, header: str, *columns: np.ndarray) -> None:
    np.savetxt(path, np.column_stack(columns), "%.6f", delimiter=",", header=header, comments="")


def list_cases(logs: Path, data: Path) -> Iterator[Case]:
    """Yield every log; a directory stands for all logs in it."""
    husky = sorted((logs / "husky").glob("*.bag")) or [logs / "husky" / "*.bag"]
    for variant, topics in HUSKY_VARIANTS.items():
        yield from (Case(f"husky/{path.stem}{variant}", path, f"[read.topics]\n{HUSKY}{topics}") for path in husky)
    yield Case("evo/nav2_turtlebot", logs / "evo" / "nav2_turtlebot.mcap")
    yield Case(
        "evo/nav2_turtlebot, AMCL", logs / "evo" / "nav2_turtlebot.mcap", '[read.topics]\npose = ["/amcl_pose"]\n'
    )
    for name in ("bag_0", "bag2_0"):
        yield Case(f"gps_nav_ws/{name}", logs / "gps_nav_ws" / f"{name}.db3")
    yield Case("fomo/red_2025-10-14-11-41", logs / "fomo", FOMO)
    yield Case("giow/experiment 2", logs / "giow", GIOW, convert_giow)
    for name in ("Corridor", "Lecture_Hall", "Indoor_UWB"):
        yield Case(f"librsf/{name}", logs / "librsf" / f"{name}_Input.txt", LIBRSF, convert_librsf)
    yield Case("fau/test_gps_20251118_162921", logs / "fau", FAU)
    for name, recipe in (("test1", TEST1), ("test2", ""), ("test1_2014", "")):
        yield Case(f"robot_localization/{name}", data / "robot_localization" / f"{name}.bag", recipe)
    yield Case("warthog_grass_a", data / "warthog_grass_a" / "run.mcap")


@dataclass
class Half:
    """Results of the logs of one half."""

    comparisons: dict[float, list[Comparison]] = field(default_factory=lambda: defaultdict(list))
    ratios: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    cpu_s: float = 0.0
    failed: int = 0


def audit(case: Case, directory: Path) -> WithheldComparisons:
    (directory / "recipe.toml").write_text(case.recipe)
    log = case.path
    if case.convert is not None:
        log = directory / "tables"
        shutil.rmtree(log, ignore_errors=True)
        log.mkdir()
        case.convert(case.path, log)
    streams, config = read_audited(log, load_recipe(directory / "recipe.toml"))
    return compare_withheld(streams, config, run_id=case.name)


def row_of(comparisons: list[Comparison]) -> str:
    of = score_comparisons(comparisons)
    return (
        f"{of.windows:4d}  {of.median_error_m:7.3f} {of.p95_error_m:7.3f} {of.median_std_m:7.3f}  "
        f"{of.within_1_sigma:4.0%} {of.within_2_sigma:4.0%}"
    )


def print_log(case: Case, found: WithheldComparisons, cpu_s: float) -> None:
    fixes = [f"| {of.window_s:.0f} s {row_of([of])} " for of in found.comparisons]
    ratios = [f"| track/{role} {ratio:.4f} " for role, ratio in found.length_ratios.items()]
    skipped = "" if fixes or ratios else "| " + "; ".join(found.skipped)
    print(f"{case.name:<44} {case.half:<8} {cpu_s:6.1f} s {''.join([*fixes, *ratios])}{skipped}", flush=True)


def print_pooled(name: str, half: Half) -> None:
    print(f"\n{name}: {half.cpu_s:.1f} CPU-s, {half.failed} logs failed")
    print(f"{'':34} logs windows  error    95 %   sigma   <1s  <2s  <2s, mean of logs")
    kinds = {f"gnss {window_s:.0f} s": comparisons for window_s, comparisons in sorted(half.comparisons.items())}
    if fixes := [of for comparisons in kinds.values() for of in comparisons]:
        kinds["all fixes"] = fixes
    for kind, comparisons in kinds.items():
        of = score_comparisons(comparisons)
        by_log = np.mean([score_comparisons([each]).within_2_sigma for each in comparisons])
        print(f"{kind:<34} {len(comparisons):4d} {row_of(comparisons)}  {by_log:4.0%}  {of.calibration}")
    for variant, values in sorted(half.ratios.items()):
        within = np.mean(np.abs(np.array(values) - 1.0) < 0.02)
        low, high = min(values), max(values)
        print(
            f"{variant:<44} {len(values):3d} logs, median {np.median(values):.4f}, {low:.4f} to {high:.4f}, {within:.0%} within 2 %"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("logs", nargs="?", type=Path, default=Path(os.environ.get("TCPIPE_PUBLIC_LOGS", "public-logs")))
    parser.add_argument("--only", default="", help="cases whose name contains this")
    parser.add_argument("--log", type=Path, action="append", help="audit this log instead; repeatable")
    given = parser.parse_args()
    data = Path(os.environ.get("TCPIPE_TEST_DATA", Path(__file__).parents[2] / "shared" / "data"))
    cases = [Case(str(log), log) for log in given.log] if given.log else list_cases(given.logs, data)
    halves = {"open": Half(), "held out": Half()}
    print(f"{'log':<44} {'half':<8} {'CPU':>8} | fixes withheld for: windows, error, 95 %, sigma [m], <1s, <2s")
    with tempfile.TemporaryDirectory() as directory:
        for case in (case for case in cases if given.only in case.name):
            if not case.path.exists():
                print(f"{case.name:<44} not there: {case.path}")
                continue
            half, begun_s = halves[case.half], time.process_time()
            try:
                found = audit(case, Path(directory))
            except TcpipeError as error:
                half.failed += 1
                print(f"{case.name:<44} {case.half:<8} fails: {error.problems[0][:150]}", flush=True)
                continue
            cpu_s = time.process_time() - begun_s
            half.cpu_s += cpu_s
            for of in found.comparisons:
                half.comparisons[of.window_s].append(of)
            source, _, variant = case.name.partition(",")
            for role, ratio in found.length_ratios.items():
                half.ratios[f"track/{role}, {source.partition('/')[0]}{variant}"].append(ratio)
            print_log(case, found, cpu_s)
    for name, half in halves.items():
        print_pooled(name, half)


if __name__ == "__main__":
    main()
