"""The table of a path's pieces, and the files it is written to: CSV, Parquet or JSON by their ending."""

from __future__ import annotations

from pathlib import Path

import pyarrow as pa
from pyarrow import csv

from tcpipe.errors import UsageError
from tcpipe.formats.atomic import atomic_file
from tcpipe.formats.json_files import write_json
from tcpipe.formats.parquet import write_table
from tcpipe.planning.reasons import Reason
from tcpipe.tables.columns import Column, TableSchema

_F, _WGS84 = pa.float64(), "WGS84"

PIECES = TableSchema(
    "pieces",
    "path",
    "A path's pieces and what each costs, in order (tcpipe predict-path).",
    (
        Column("piece", pa.int64(), "", "Number of the piece, from 0."),
        Column("start_lon_deg", _F, "deg", "Longitude of its start.", _WGS84),
        Column("start_lat_deg", _F, "deg", "Latitude of its start.", _WGS84),
        Column("end_lon_deg", _F, "deg", "Longitude of its end.", _WGS84),
        Column("end_lat_deg", _F, "deg", "Latitude of its end.", _WGS84),
        Column("distance_m", _F, "m", "Length of the path before it, horizontal."),
        Column("chord_m", _F, "m", "Straight length, horizontal; the last piece is what remains."),
        Column("arc_length_m", _F, "m", "Length along the path, horizontal; what its cost is for."),
        Column("course_rad", _F, "rad", "Direction of its chord, counter-clockwise from true east.", "ENU"),
        Column("terrain_class", pa.uint8(), "", "Majority class under the chord; 0: none."),
        Column("terrain_name", pa.string(), "", "Name of that class."),
        Column("slope_rad", _F, "rad", "Slope along travel, uphill positive.", nullable=True),
        Column("cross_slope_rad", _F, "rad", "Slope across travel, positive when the left side is higher.", nullable=True),
        Column("power_watt", _F, "W", "Predicted mean power; null without a cost, as all that follows.", nullable=True),
        Column("velocity_mps", _F, "m/s", "Predicted ground velocity.", nullable=True),
        Column("duration_s", _F, "s", "Predicted time: arc length over velocity.", nullable=True),
        Column("duration_low_s", _F, "s", "Lower end of its 90 % interval.", nullable=True),
        Column("duration_high_s", _F, "s", "Upper end of its 90 % interval.", nullable=True),
        Column("turn_rad", _F, "rad", "Half of the change of course at either end: what it turns."),
        Column("turn_energy_joule", _F, "J", "What that costs beyond the turns of training; null without physics.", nullable=True),
        Column("energy_joule", _F, "J", "Predicted energy: power times time, and that of its turn.", nullable=True),
        Column("energy_low_joule", _F, "J", "Lower end of its 90 % interval.", nullable=True),
        Column("energy_high_joule", _F, "J", "Upper end of its 90 % interval.", nullable=True),
        Column("reasons", pa.uint16(), "bits", "Why it has no cost, or none to be trusted; 0: neither.", flags=Reason),
        Column("reason_names", pa.string(), "", "The same as words, separated by spaces."),
    ),
)  # fmt: skip

ENDINGS = (".csv", ".parquet", ".json")


def check_ending(path: Path) -> None:
    """Raise `UsageError` unless a table can be written to a file of this name."""
    if path.suffix.lower() not in ENDINGS:
        raise UsageError(f"{path}: wanted a name that ends in {', '.join(ENDINGS[:-1])} or {ENDINGS[-1]}")
    if path.is_dir():
        raise UsageError(f"{path}: is a directory, wanted a file")


def write_pieces(path: Path, table: pa.Table) -> None:
    """Write the table in the format of the file's ending, whole or not at all."""
    match path.suffix.lower():
        case ".parquet":
            write_table(table, path)
        case ".json":
            write_json(path, {"pieces": table.to_pylist()})
        case _:
            with atomic_file(path) as temporary:
                csv.write_csv(table, temporary)
