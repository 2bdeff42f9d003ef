"""Make the tables of `fau.toml` from the files of FAU's drive: ``python pipelines/fau_tables.py CLONE OUT``.

Power is published in watts alone, and a rail is a voltage and a current: it is written as so many amperes at 1 V. Fixes carry a quality
and no deviation: an RTK fixed solution (4) counts as 0.02 m, a float one (5) as 0.3 m, all others as 0.8 m.
"""

import csv
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

FILES = (
    Path("EnergyConsumptionPredictionFiles/data/test_dataset/test_gps_20251118_162921.csv"),
    Path("Results/test_run_predictions.csv"),
)
STD_M = {"4": 0.02, "5": 0.3}
OTHER_STD_M = 0.8
STAMP, POWER = "timestamp (ns)", "Power (w)"
PLACE = {"lat": "latitude (deg)", "lon": "longitude (deg)", "alt": "alt_msl (m)"}
INERTIAL = {f"{short}{axis}": f"{name}_{axis} ({unit})" for short, name, unit, axes in (
    ("w", "Angular_Velocity", "rad/s", "xyz"), ("a", "Linear_Acceleration", "m/s²", "xyz"), ("q", "Orientation", "Quaternion", "xyzw")
) for axis in axes}  # fmt: skip


def rows(path: Path) -> Iterator[Mapping[str, str]]:
    """Yield the rows of a CSV file by column."""
    with path.open(encoding="utf-8") as file:
        yield from csv.DictReader(file)


def write(path: Path, head: Sequence[str], lines: Iterator[Sequence[object]]) -> None:
    """Write a CSV file."""
    with path.open("w", encoding="utf-8", newline="") as file:
        csv.writer(file).writerows([head, *lines])


def main(clone: Path, out: Path) -> None:
    """Write gnss.csv, power.csv and imu.csv."""
    fixes, seconds = (clone / file for file in FILES)
    out.mkdir(parents=True, exist_ok=True)
    std_m = ((row, STD_M.get(row["fix_quality"], OTHER_STD_M)) for row in rows(fixes))
    places = ([row[STAMP], *(row[name] for name in PLACE.values()), std] for row, std in std_m)
    write(out / "gnss.csv", ["stamp_ns", *PLACE, "std"], places)
    write(out / "power.csv", ["stamp_ns", "volt", "amp"], ([row[STAMP], 1, row[POWER]] for row in rows(seconds)))
    inertial = ([row[STAMP], *(row[name] for name in INERTIAL.values())] for row in rows(seconds))
    write(out / "imu.csv", ["stamp_ns", *INERTIAL], inertial)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
