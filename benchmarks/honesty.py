"""Whether labels are as wrong as they claim: the truth gate, on drives and families of errors that the estimator does not contain.

    python benchmarks/honesty.py --gate --out A.json [--cache DIR]      # the gate: two seeds of each of its cells
    python benchmarks/honesty.py --first-seed 8001 --seeds 10           # the verdict: all cells, on drives that nothing was tuned on
    python benchmarks/honesty.py --cells "outage|: clean" --seeds 1     # any cells, by a regular expression
    python benchmarks/honesty.py --compare A.json B.json                # two estimators on the same drives
    python benchmarks/honesty.py --read A.json                          # the table again
    python benchmarks/honesty.py --list                                 # all cells; those beyond the gate are indented

A cell (`honesty_cells.py`) is a set of sensors under a fault; its drives last about four minutes. ``--cache`` keeps
what the sensors recorded, so that another estimator, or another simulator, is judged on the same drives. Of the labels
that no bit doubts a row shows

    labels, per cent of T, v, w, E inside 1 and 2 sigma; per cent of start points inside DRMS and 1.73 DRMS (63 and 95
    are wanted); own: the same of T and E without the part of sigma that is common to a drive; c: the common error over
    its sigma, the largest; median sigma over RMS error of T; per cent of good labels lost: of the labels that are good
    on the same drive without the fault, those that are doubted or not there, though they are as good here; RMS errors
    of the track: position [mm], forward velocity [mm/s], yaw [deg]; the track's length over the wheels' own; whether
    the finding is named; which other sensors are blamed; CPU [s] a drive.

Verdicts follow the limits that `LIMITS` holds.
"""

from __future__ import annotations

import argparse
import json
import pickle
import re
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))

from campaign_drives import QUANTITIES, RING, TRACK, Drive, MemoryLog, Outcome, judge_log, log_of, simulated
from campaign_faults import SETS
from campaign_figures import LABELS, OF_THE_DRIVE, blot_numbers
from honesty_cells import HonestCell, honest_cells

from tcpipe.tables.bits import Quality

FIRST_SEED = 7001
LENGTH_M = 210.0
LIMITS = {
    "inside 2 sigma": 0.92,
    "starts inside 95 %": 0.90,
    "lost": 0.15,
    "sigma over RMS": 1.2,
    "gap": 0.080,
    "gap inside": 0.92,
    "common": 3.0,
}
CLEAN = {1: (0.60, 0.76), 2: (0.91, 0.98)}
"""Shares wanted of the labels of a set of sensors without a fault."""
LENGTHS = {"plain": 0.002, "valley": 0.005, "slow": 0.005}
"""By how much the track by wheels alone may differ from their own length."""
_POWER = ("w", "E")
"""Labels that a current sensor makes."""
_SAME_S = 0.6
"""Labels of two estimates that start within this are of the same ground."""
_FEWEST = 20
_ROLES = {"gnss": "gnss", "wheels": "wheel_odometry", "visual": "visual_odometry", "imu": "imu"}
Key = tuple[str, int]
"""Name of a cell, seed."""


# Drives and their outcomes


def kept_drive(cell: HonestCell, seed: int, length_m: float, cache: Path | None) -> tuple[Drive, MemoryLog]:
    """Return a drive and what was recorded of it; from the cache what is there."""
    if cache is None:
        drive = simulated(cell.fault.route, seed, length_m)
        return drive, log_of(drive, cell.fitted(drive), cell.fault)
    place = cache / re.sub(r"[^\w.+-]+", "_", cell.name) / f"{seed}_{length_m:g}.pickle"
    of_drive = cache / f"{cell.fault.route.replace(' ', '_')}_{seed}_{length_m:g}.pickle"
    if not of_drive.exists():
        _keep(of_drive, simulated(cell.fault.route, seed, length_m))
    drive = pickle.loads(of_drive.read_bytes())  # noqa: S301  written by this program
    if not place.exists():
        _keep(place, log_of(drive, cell.fitted(drive), cell.fault))
    return drive, pickle.loads(place.read_bytes())  # noqa: S301  likewise


def _keep(path: Path, value: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    half = path.with_suffix(".half")
    half.write_bytes(pickle.dumps(value))
    half.rename(path)


def judge(cells: Sequence[HonestCell], seeds: Iterable[int], length_m: float, cache: Path | None) -> dict[Key, Outcome]:
    """Return the outcomes of cells, and of the drives without a fault that they are compared with."""
    every = {cell.name: cell for of in cells for cell in (of.base, of)}
    outcomes: dict[Key, Outcome] = {}
    for number, cell in enumerate(every.values(), 1):
        for seed in seeds:
            drive, log = kept_drive(cell, seed, length_m, cache)
            if not outcomes:
                judge_log(drive, log, cell.fault)  # kernels are compiled before time is measured
            outcomes[cell.name, seed] = judge_log(drive, log, cell.fault)
        print(f"{number}/{len(every)} {cell.name}", file=sys.stderr, flush=True)
    return outcomes


# Figures


@dataclass(frozen=True)
class Labels:
    """The labels of a drive as arrays, with the bits that doubt them."""

    start_s: np.ndarray
    error: Mapping[str, np.ndarray]
    claimed: Mapping[str, np.ndarray]
    common: Mapping[str, np.ndarray]
    """The part of ``claimed`` that is one error of the whole drive."""
    value: Mapping[str, np.ndarray]
    sure: np.ndarray
    placed: np.ndarray
    """Which sure labels also have a sure place: `weak_gnss` doubts the place alone."""

    def are_sure(self, name: str) -> np.ndarray:
        """Return which labels no bit doubts a quantity of."""
        return self.placed if name == "start" else self.sure

    def split(self, name: str) -> tuple[np.ndarray, float]:
        """Return absolute errors over standard deviations without what is common, of sure labels, and the common error over its own.

        A current sensor has two common errors: a gain errs by a share of each label, an offset by the same power in all
        of them.
        """
        error, claimed, common = (of[name][self.sure] for of in (self.error, self.claimed, self.common))
        known = np.isfinite(error) & np.isfinite(claimed)
        error, common = error[known], common[known]
        own = np.sqrt(np.maximum(claimed[known] ** 2 - common**2, 1e-12))
        shared = float(np.sum(common * error / own**2) / (1.0 + np.sum((common / own) ** 2)))
        alike = [common]
        if name in _POWER:
            alike = [
                self.value[name][self.sure][known],
                self.value["T"][self.sure][known] if name == "E" else np.ones(error.size),
            ]
        if not common.any() or error.size <= len(alike):
            return np.abs(error) / own, shared
        shapes = np.column_stack(alike) / own[:, None]
        left = error / own - shapes @ np.linalg.lstsq(shapes, error / own)[0]
        return np.abs(left) * np.sqrt(error.size / (error.size - len(alike))), shared

    @property
    def ratio(self) -> dict[str, np.ndarray]:
        """Absolute errors over standard deviations."""
        return {name: np.abs(self.error[name]) / self.claimed[name] for name in self.error}

    def match(self, other: Labels) -> tuple[np.ndarray, np.ndarray]:
        """Return for each label the other's that is nearest in time, and whether it is of the same ground."""
        if not other.start_s.size:
            return np.zeros(self.start_s.size, int), np.zeros(self.start_s.size, bool)
        nearest = np.argmin(np.abs(self.start_s[:, None] - other.start_s), axis=1)
        return nearest, np.abs(other.start_s[nearest] - self.start_s) < _SAME_S


def labels_of(outcome: Outcome, sensors: str) -> Labels:
    """Return the labels; without GNSS no place is claimed."""
    bits = np.asarray(outcome.bits, np.int64)
    error, claimed = (
        {name: np.asarray(of[name], float) for name in QUANTITIES} for of in (outcome.error, outcome.claimed)
    )
    common, value = (
        {name: np.asarray(of.get(name, np.zeros(bits.size)), float) for name in QUANTITIES}
        for of in (outcome.common, outcome.value)
    )
    sure = (bits & ~int(OF_THE_DRIVE | Quality.WEAK_GNSS)) == 0
    placed = sure & (("gnss" in SETS[sensors]) | ((bits & int(Quality.WEAK_GNSS)) == 0))
    return Labels(np.asarray(outcome.start_s, float), error, claimed, common, value, sure, placed)


@dataclass
class Figures:
    """Figures of a row, over the seeds of a cell."""

    cell: str
    clean: bool
    ratio: dict[str, np.ndarray]
    """Error over standard deviation of the labels that no bit doubts, by quantity."""
    own: dict[str, np.ndarray]
    """The same without what is common to a drive."""
    common: dict[str, float]
    """The largest common error of a drive over its standard deviation."""
    width: float
    good: int
    lost: int
    track: dict[str, float]
    length: float
    named: float
    """Share of the drives whose findings hold what the fault is to be called; NaN where nothing has to be said."""
    blamed: list[str]
    cpu_s: float
    traces: int
    misses: list[str]

    def inside(self, name: str, within: float, *, own: bool = False) -> float:
        """Return the share of labels inside so many standard deviations."""
        ratio = (self.own if own else self.ratio)[name]
        return float(np.mean(ratio <= within)) if ratio.size >= _FEWEST else float("nan")


def figures_of(cell: HonestCell, outcomes: Sequence[Outcome], bases: Sequence[Outcome]) -> Figures:
    """Return the figures of a cell from its drives and the same drives without the fault."""
    labels = [labels_of(of, cell.sensors) for of in outcomes]
    losses = [_losses(of, labels_of(base, cell.sensors)) for of, base in zip(labels, bases, strict=True)]
    ratio = {name: _joined([of.ratio[name][of.are_sure(name)] for of in labels]) for name in QUANTITIES}
    split = {name: [of.split(name) for of in labels] for name in LABELS}
    error = _joined([of.error["T"][of.sure] for of in labels])
    claimed = _joined([of.claimed["T"][of.sure] for of in labels])
    known = np.isfinite(error)
    lengths = [of.driven_m / of.wheels_m for of in outcomes if of.driven_m and np.isfinite(of.wheels_m)]
    at_fault = {_ROLES.get(role, role) for role in cell.fault.at_fault}
    said = [_names(cell.fault.said, of, base) for of, base in zip(outcomes, bases, strict=True)]
    figures = Figures(
        cell.name, cell.fault.calibrated,
        {name: values[np.isfinite(values)] for name, values in ratio.items()},
        {name: _joined([own for own, _ in of]) for name, of in split.items()},
        {name: max(abs(shared) for _, shared in of) for name, of in split.items()},
        float(np.median(claimed[known]) / np.sqrt(np.mean(error[known] ** 2))) if known.sum() >= _FEWEST else float("nan"),
        sum(good for good, _ in losses), sum(lost for _, lost in losses),
        {name: _pooled(name, [of.track.get(name, np.nan) for of in outcomes]) for name in TRACK},
        float(np.mean(lengths)) if lengths else float("nan"),
        float(np.mean(said)) if cell.fault.said else float("nan"),
        sorted({name for of in outcomes for name in of.blamed} - at_fault),
        float(np.mean([of.cpu_s for of in outcomes])), sum(bool(of.trace) for of in outcomes), [],
    )  # fmt: skip
    figures.misses = list(_misses(figures, cell))
    return figures


def _names(pattern: str, outcome: Outcome, base: Outcome) -> bool:
    """Return whether a finding holds the pattern that is not made without the fault as well, whatever its numbers."""
    without = {blot_numbers(line) for line in base.said}
    return bool(re.search(pattern, "\n".join(line for line in outcome.said if blot_numbers(line) not in without)))


def _losses(labels: Labels, base: Labels) -> tuple[int, int]:
    """Return how many labels are as good here as without the fault, and how many of these are doubted or not there."""
    nearest, matched = base.match(labels)
    was_good, is_good = base.sure.copy(), matched.copy()
    for name in LABELS:
        was_good &= ~(base.ratio[name] > 2.0)
        if labels.start_s.size:
            is_good &= ~(np.abs(labels.error[name][nearest]) > 2.0 * base.claimed[name])
    doubted = ~labels.sure[nearest] if labels.start_s.size else np.ones(matched.size, bool)
    good = was_good & (is_good | ~matched)
    return int(good.sum()), int((good & (~matched | doubted)).sum())


def _misses(figures: Figures, cell: HonestCell) -> Iterator[str]:
    if figures.traces:
        yield f"{figures.traces} tracebacks"
    yield from _uncovered(figures, exactly=figures.clean and "gnss" not in SETS[cell.sensors])
    if cell.sensors == "wheels alone" and abs(figures.length - 1.0) > (limit := LENGTHS[cell.fault.route]):
        yield f"length {figures.length - 1.0:+.2%}, limit {limit:.1%}"
    if "outage" in figures.cell and "jump" not in figures.cell and figures.track["gap_xy_m"] > LIMITS["gap"]:
        yield f"gap {1e3 * figures.track['gap_xy_m']:.0f} mm"
    if figures.track["gap_inside"] < LIMITS["gap inside"]:
        yield f"gap {figures.track['gap_inside']:.0%} inside"
    if figures.lost > LIMITS["lost"] * figures.good:
        yield f"{figures.lost / figures.good:.0%} lost"
    if figures.named < 1.0:
        yield f"named in {figures.named:.0%}"


def _uncovered(figures: Figures, *, exactly: bool) -> Iterator[str]:
    """Yield where coverage is too small; of clean drives with GNSS, whose own part is judged, also where it is too large."""
    bands = CLEAN if exactly else {2: (LIMITS["inside 2 sigma"], 1.0)}
    for name, (within, (low, high)) in product(LABELS, bands.items()):
        share = figures.inside(name, within, own=exactly)
        if share < low or share > high:
            yield f"{name} {share:.0%} in {within}σ"
    for name, sigmas in figures.common.items() if figures.clean else ():
        if sigmas > LIMITS["common"]:
            yield f"{name} {sigmas:.1f} common σ"
    if figures.inside("start", RING) < LIMITS["starts inside 95 %"]:
        yield f"start {figures.inside('start', RING):.0%}"
    if exactly and figures.width > LIMITS["sigma over RMS"]:
        yield f"σ {figures.width:.2f} RMS"


def _joined(parts: Sequence[np.ndarray]) -> np.ndarray:
    return np.concatenate(parts) if parts else np.zeros(0)


def _pooled(name: str, values: Sequence[float]) -> float:
    """Return the RMS over the drives that have a value; of a share the mean."""
    known = np.asarray(values)[np.isfinite(values)]
    power = 1 if name == "gap_inside" else 2
    return float(np.mean(known**power) ** (1 / power)) if known.size else float("nan")


# Pages

HEAD = (
    f"{'cell':<50} {'labels':>6} {'T':>6} {'v':>6} {'w':>6} {'E':>6} {'start':>6} {'own T':>6} {'own E':>6} "
    f"{'c T':>3} {'c E':>3} {'σ/RMS':>5} {'lost':>4} "
    f"{'xy mm':>6} {'mm/s':>5} {'yaw °':>6} {'length':>6} {'named':>5} {'CPU s':>5}"
)


def _number(value: float, form: str, factor: float = 1.0) -> str:
    return format(value * factor, form) if np.isfinite(value) else "–".rjust(int(re.findall(r"\d+", form)[0]))


def _shares(figures: Figures, name: str, second: float = 2.0, *, own: bool = False) -> str:
    one, two = (figures.inside(name, within, own=own) for within in (1.0, second))
    return f"{100 * one:.0f}/{100 * two:.0f}".rjust(6) if np.isfinite(two) else "–".rjust(6)


def row(of: Figures) -> str:
    """Return a line of figures and what it misses."""
    lost = of.lost / of.good if of.good else float("nan")
    figures = (
        f"{of.ratio['T'].size:6d}", *(_shares(of, name) for name in LABELS), _shares(of, "start", RING),
        *(_shares(of, name, own=True) for name in ("T", "E")), f"{of.common['T']:3.1f} {of.common['E']:3.1f}", _number(of.width, "5.2f"),
        _number(lost, "4.0f", 100), _number(of.track["xy_m"], "6.1f", 1e3), _number(of.track["velocity_mps"], "5.1f", 1e3),
        _number(of.track["yaw_rad"], "6.3f", 180 / np.pi), _number(of.length, "6.4f"), _number(of.named, "5.0f", 100), f"{of.cpu_s:5.1f}",
    )  # fmt: skip
    blamed = f" blamed: {', '.join(of.blamed)}" if of.blamed else ""
    if np.isfinite(of.track["gap_xy_m"]):
        blamed = f" gap: {1e3 * of.track['gap_xy_m']:.0f} mm, {of.track['gap_inside']:.0%} inside{blamed}"
    return f"{of.cell:<50} {' '.join(figures)}  {'; '.join(of.misses) or 'ok'}{blamed}"


def summary(every: Sequence[Figures]) -> list[str]:
    """Return the lines over all cells."""
    clean = [of for of in every if of.clean and ": clean" in of.cell and np.isfinite(of.inside("start", 1.0))]
    lines = []
    if clean:
        pooled = {
            name: np.concatenate([(of.own if name in LABELS else of.ratio)[name] for of in clean])
            for name in QUANTITIES
        }
        inside = {
            name: [100 * np.mean(of <= k) for k in (1.0, RING if name == "start" else 2.0)]
            for name, of in pooled.items()
        }
        shares = ", ".join(f"{name} {one:.0f}/{two:.0f}" for name, (one, two) in inside.items())
        lines.append(
            f"clean, pooled over {len(clean)} sets with GNSS: {shares} (wanted 63 to 73 / 93 to 97; start 58 to 68 / 92 to 97)"
        )
    faulty = [of for of in every if not of.clean]
    good, named = sum(of.good for of in faulty), [of.named for of in faulty if np.isfinite(of.named)]
    if good:
        lines.append(f"good labels lost in all: {sum(of.lost for of in faulty) / good:.1%} (wanted 5 %)")
    if named:
        lines.append(f"named: {np.mean(named):.0%} of the drives of {len(named)} cells (wanted 90 %)")
    met = sum(not of.misses for of in every)
    return [*lines, f"{met} of {len(every)} cells meet all limits"]


def compare(first: Mapping[Key, Outcome], second: Mapping[Key, Outcome]) -> Iterator[str]:
    """Yield how far the second's errors are from the first's, over the first's deviations, where both have labels; a line a drive."""
    yield f"{'cell':<50} {'seed':>5} {'both':>5} {'median |Δ|/σ, max':>18} {'1σ/2σ of T, then E':>24} {'start':>13}"
    for (cell, seed), outcome in first.items():
        if (cell, seed) not in second:
            continue
        labels = [labels_of(of, cell.split(": ")[0]) for of in (outcome, second[cell, seed])]
        nearest, matched = labels[0].match(labels[1])
        change = [
            np.abs(labels[1].error[name][nearest[matched]] - labels[0].error[name][matched]) / labels[0].claimed[name][matched]
            for name in LABELS
        ]  # fmt: skip
        moved = np.concatenate(change)
        moved = moved[np.isfinite(moved)]
        medians = f"{np.median(moved):8.2f} {moved.max():8.1f}" if moved.size else f"{'–':>8} {'–':>8}"
        yield f"{cell:<50} {seed:5d} {matched.sum():5d} {medians}  " + "  ".join(
            " → ".join(_of_sure(of, name, (1.0, RING if name == "start" else 2.0)) for of in labels)
            for name in ("T", "E", "start")
        )


def _of_sure(labels: Labels, name: str, within: tuple[float, float]) -> str:
    ratio = labels.ratio[name][labels.are_sure(name)]
    ratio = ratio[np.isfinite(ratio)]
    return "/".join(f"{100 * np.mean(ratio <= k):.0f}" for k in within) if ratio.size else "–"


# Files


def write(path: Path, outcomes: Mapping[Key, Outcome]) -> None:
    """Write outcomes as JSON."""
    runs = [{"cell": cell, "seed": seed, "outcome": asdict(of)} for (cell, seed), of in outcomes.items()]
    path.write_text(json.dumps({"runs": runs}))


def read(path: Path) -> dict[Key, Outcome]:
    """Return the outcomes of a file that this program wrote."""
    return {(run["cell"], run["seed"]): Outcome(**run["outcome"]) for run in json.loads(path.read_text())["runs"]}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--gate", action="store_true", help="the cells of the gate, two seeds")
    parser.add_argument("--cells", default="", metavar="PATTERN", help="a regular expression that names of cells hold")
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--first-seed", type=int, default=FIRST_SEED)
    parser.add_argument("--length", type=float, default=LENGTH_M, help="about how far to drive [m]")
    parser.add_argument("--out", type=Path, help="a JSON file of all outcomes")
    parser.add_argument("--cache", type=Path, help="a directory in which drives are kept")
    parser.add_argument("--compare", type=Path, nargs=2, metavar=("A", "B"))
    parser.add_argument("--read", type=Path, metavar="A", help="print the table of a file, run nothing")
    parser.add_argument("--list", action="store_true", help="only name the cells")
    given = parser.parse_args()
    if given.compare:
        print("\n".join(compare(*(read(path) for path in given.compare))))
        return
    cells = [cell for cell in honest_cells() if re.search(given.cells, cell.name) and not (given.gate and cell.wide)]
    if given.list or not cells:
        print(
            "\n".join("  " * cell.wide + cell.name for cell in cells)
            or f"no cell is called {given.cells!r}; --list names them"
        )
        sys.exit(0 if given.list else 2)
    seeds: Sequence[int] = range(given.first_seed, given.first_seed + given.seeds)
    outcomes = read(given.read) if given.read else judge(cells, seeds, given.length, given.cache)
    if given.read:
        seeds = sorted({seed for _, seed in outcomes})
    if given.out:
        write(given.out, outcomes)
    every = [
        figures_of(cell, *([outcomes[of.name, seed] for seed in seeds] for of in (cell, cell.base)))
        for cell in cells
        if all((cell.name, seed) in outcomes for seed in seeds)
    ]
    print("\n".join([HEAD, *map(row, every), *summary(every)]))
    print(
        f"{len(outcomes)} drives, {sum(of.cpu_s for of in outcomes.values()) / 60:.1f} CPU minutes of fusion and labels"
    )


if __name__ == "__main__":
    main()
