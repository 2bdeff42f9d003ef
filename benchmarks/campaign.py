"""Whether labels are right or know that they are not: every set of sensors, every rate, every fault, compared with the truth.

    python benchmarks/campaign.py --out DIR                          # all cells, three seeds each; goes on where it was ended
    python benchmarks/campaign.py --out DIR --cells "wrong fix|float" --seeds 1
    python benchmarks/campaign.py --out DIR --cells ": clean" --seeds 10    # calibration
    python benchmarks/campaign.py --list

A cell is a set of sensors at a rate of GNSS under a fault (`campaign_faults.py`); its drives last four minutes on
hills. What each gave is kept under DIR/cells and not made again: give another DIR for another state of the program.
DIR/campaign.md and DIR/campaign.json hold the figures of all cells that are there, and the verdict on each:
docs/internals/tests.md says what they mean.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

from campaign_drives import FIRST_SEED, Outcome, outcome_of, simulated
from campaign_faults import Cell, cells
from campaign_figures import Result, figures_of, map_figures, page, row
from campaign_map import NAME as MAP
from campaign_map import MapResult, map_in_feet

LENGTH_M, QUICK_LENGTH_M = 170.0, 120.0


def made(cell: Cell, seed: int, *, length_m: float) -> Result:
    """Run a cell; where it gives no segment, also without the sensors at fault, as one would who knows them."""
    drive = simulated(cell.fault.route, seed, length_m)
    found = outcome_of(drive, cell.fitted, cell.fault)
    oracle = None
    if not found.bits and cell.fault.at_fault:
        knowing = replace(cell, without=frozenset(cell.fault.at_fault))
        oracle = len(outcome_of(drive, knowing.fitted, cell.fault).bits)
    return Result(seed, found, oracle)


def kept(out: Path, cell: Cell, seed: int, *, length_m: float) -> Result:
    """Return what is on disk of a cell, made where it is not."""
    path = _place(out, cell.name, f"{seed}_{length_m:g}")
    if path.exists():
        known = json.loads(path.read_text())
        return Result(known["seed"], Outcome(**known["outcome"]), known["oracle"])
    result = made(cell, seed, length_m=length_m)
    _keep(path, asdict(result))
    return result


def kept_map(out: Path) -> MapResult:
    """Return the result of the map's cell, made where it is not on disk."""
    path = _place(out, MAP, "1")
    if path.exists():
        return MapResult(**json.loads(path.read_text()))
    result = map_in_feet()
    _keep(path, asdict(result))
    return result


def _place(out: Path, cell: str, name: str) -> Path:
    return out / "cells" / re.sub(r"[^\w.]+", "_", cell) / f"{name}.json"


def _keep(path: Path, result: dict[str, object]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    half = path.with_suffix(".half")
    half.write_text(json.dumps(result))
    half.rename(path)


def chosen(pattern: str) -> list[Cell]:
    """Return the cells whose name holds the pattern."""
    return [cell for cell in cells() if re.search(pattern, cell.name)]


def results(out: Path, wanted: Sequence[Cell], seeds: range, *, length_m: float) -> dict[str, list[Result]]:
    """Return the results of cells, and of the clean cell of each set and rate."""
    clean = next(cells()).fault
    every = {cell.name: cell for cell in wanted}
    every |= {base.name: base for cell in wanted if (base := replace(cell, fault=clean)).name not in every}
    found = {}
    for number, (name, cell) in enumerate(every.items(), 1):
        begun_s = time.process_time()
        found[name] = [kept(out, cell, seed, length_m=length_m) for seed in seeds]
        spent_s = time.process_time() - begun_s
        if spent_s > 0.5:
            print(f"{number}/{len(every)} {name}: {spent_s:.1f} s of CPU", file=sys.stderr, flush=True)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, help="where results are kept and the page is written")
    parser.add_argument("--cells", default="", metavar="PATTERN", help="a regular expression that names of cells hold")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--first-seed", type=int, default=FIRST_SEED)
    parser.add_argument("--quick", action="store_true", help="shorter drives, one seed")
    parser.add_argument("--list", action="store_true", help="only name the cells")
    given = parser.parse_args()
    wanted = chosen(given.cells)
    names = [*(cell.name for cell in wanted), *[MAP] * bool(re.search(given.cells, MAP))]
    if given.list or given.out is None or not names:
        print("\n".join(names) or f"no cell is called {given.cells!r}; --list names them")
        sys.exit(0 if given.list else 2)
    seeds = range(given.first_seed, given.first_seed + (1 if given.quick else given.seeds))
    found = results(given.out, wanted, seeds, length_m=QUICK_LENGTH_M if given.quick else LENGTH_M)
    clean = next(cells()).fault
    figures = [figures_of(cell, found[cell.name], found[replace(cell, fault=clean).name]) for cell in wanted]
    if MAP in names:
        figures.append(map_figures(kept_map(given.out)))
    (given.out / "campaign.json").write_text(json.dumps([asdict(figure) for figure in figures], indent=1))
    (given.out / "campaign.md").write_text(page(figures))
    print("\n".join(row(figure) for figure in figures))
    failed = sum(bool(figure.failures) for figure in figures)
    print(f"{len(figures) - failed} of {len(figures)} cells are as they should be; see {given.out / 'campaign.md'}")


if __name__ == "__main__":
    main()
