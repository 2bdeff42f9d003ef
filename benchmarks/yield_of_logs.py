"""Print the yield of real logs, from the distance driven to the metres that become samples.

    python benchmarks/yield_of_logs.py LOG... [--robot NAME]

There is no truth: the distance by the wheels is printed next to that of the track, then the messages of ingest.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import numpy as np
from campaign_drives import said_of, wheels_m
from campaign_figures import OF_THE_DRIVE

from tcpipe.errors import TcpipeError
from tcpipe.formats.logs.log_file import open_log
from tcpipe.formats.recipe_toml import load_shipped_profiles
from tcpipe.pipeline.ingest_run import run_stages
from tcpipe.recipe import Recipe
from tcpipe.stages.read import read_run
from tcpipe.tables.columns import to_floats, to_numbers

HEAD = ("wheels", "driven", "steady", "labelled", "with power", "undoubted", "sampled")


@dataclass(frozen=True)
class Ladder:
    """Metres by step, in the order of `HEAD`, and what was said."""

    steps_m: tuple[float, ...]
    said: tuple[str, ...]


def ladder(path: Path, robot: str | None) -> Ladder:
    """Run the stages of ingest over a log; an error becomes what was said."""
    recipe = Recipe()
    try:
        with open_log(path) as log:
            streams = read_run(log, recipe.read, robot=robot, known=load_shipped_profiles())
        _, _, labelled = run_stages(streams, recipe.ingest, run_id="run")
    except TcpipeError as error:
        return Ladder((np.nan, *[0.0] * (len(HEAD) - 1)), (*error.problems, *said_of(error.findings)))
    table, distance_by_reason_m = labelled.table, labelled.distance_by_reason_m
    power = np.isfinite(to_floats(table, "energy_joule"))
    sure = (to_numbers(table["quality"]).astype(np.int64) & ~int(OF_THE_DRIVE)) == 0
    placed = np.isfinite(to_floats(table, "start_lon_deg"))
    placed &= to_floats(table, "position_std_m") <= recipe.sample.max_position_std_m
    arc_m = to_floats(table, "arc_length_m")
    chosen = (np.ones_like(power), power, sure, sure & placed)
    steps_m = (wheels_m(streams), sum(distance_by_reason_m.values()), distance_by_reason_m.get("kept", 0.0))
    return Ladder(
        (*steps_m, *(float(arc_m[rows].sum()) for rows in chosen)), tuple(said_of(labelled.info.report.findings))
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("logs", nargs="+", type=Path)
    parser.add_argument("--robot", help="profile of all of them; found from the log without")
    given = parser.parse_args()
    print(f"{'metres':<24}" + "".join(f"{name:>12}" for name in HEAD))
    for path in given.logs:
        found = ladder(path, given.robot)
        print(f"{path.name:<24}" + "".join(f"{step:12.1f}" for step in found.steps_m))
        print("\n".join(f"    {line}" for line in found.said))


if __name__ == "__main__":
    main()
