"""Measure the CPU time to read an hour of tables at 50 Hz, as a ratio to polars reading the same columns, without imports.

python benchmarks/tables.py [HOURS]
"""

import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import polars as pl

from tcpipe.formats.logs.table_log import open_tables
from tcpipe.recipe import TableMapping

RATE_HZ = 50.0
START_US = 1_760_456_485_000_000
TABLES = {
    "imu": {
        f"{what}_{axis}": f"{short}{axis}"
        for what, short in (("angular_velocity", "w"), ("linear_acceleration", "a"))
        for axis in "xyz"
    },
    "wheel_odometry": {"linear_x": "v", "angular_z": "w"},
    "pose": {axis: axis for axis in "xyz"},
    "power": {"voltage": "volt", "current": "amp"},
}


def written(folder: Path, hours: float) -> dict[str, TableMapping]:
    rng = np.random.default_rng(1)
    rows = round(hours * 3600 * RATE_HZ)
    stamps = START_US + np.round(np.arange(rows) * 1e6 / RATE_HZ).astype(np.int64)
    for role, columns in TABLES.items():
        values = {name: np.round(rng.normal(size=rows), 6) for name in columns.values()}
        pl.DataFrame({"t": stamps, **values, "spare": np.zeros(rows)}).write_csv(folder / f"{role}.csv")
    return {role: TableMapping(f"{role}.csv", columns=columns) for role, columns in TABLES.items()}


def by_polars(folder: Path, mappings: dict[str, TableMapping]) -> int:
    return sum(
        pl.scan_csv(folder / of.file).select("t", *of.columns.values()).collect().height for of in mappings.values()
    )


def by_tcpipe(folder: Path, mappings: dict[str, TableMapping]) -> int:
    log = open_tables(folder, mappings)
    return sum(table.num_rows for table in log.tables(list(log.topics)).values())


def cpu_s(read, *given) -> tuple[float, int]:
    times = []
    for _ in range(5):
        before = time.process_time()
        rows = read(*given)
        times.append(time.process_time() - before)
    return float(np.median(times)), rows


def main() -> None:
    hours = float(sys.argv[1]) if len(sys.argv) > 1 else 1.0
    with tempfile.TemporaryDirectory() as place:
        mappings = written(Path(place), hours)
        size = sum((Path(place) / of.file).stat().st_size for of in mappings.values())
        theirs, rows = cpu_s(by_polars, Path(place), mappings)
        ours, same = cpu_s(by_tcpipe, Path(place), mappings)
    assert rows == same
    print(f"{hours:g} h at {RATE_HZ:g} Hz: {len(TABLES)} tables, {rows} rows, {size / 1e6:.0f} MB")
    print(f"polars {theirs:.3f} s, tcpipe {ours:.3f} s of CPU: {ours / theirs:.2f} times")


if __name__ == "__main__":
    main()
