"""Figures of the campaign's cells, the verdict on each, and the page that shows them; docs/internals/tests.md says what they mean."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from campaign_drives import QUANTITIES, Outcome, bit_names
from campaign_faults import SETS, Cell
from campaign_map import NAME, MapResult

from tcpipe.tables.bits import Quality

OF_THE_DRIVE = (
    Quality.CURVED
    | Quality.POWER_MEAN_MISMATCH
    | Quality.BELOW_FULL_SPEED
    | Quality.NO_COMMAND
    | Quality.LOW_POWER_RATE
)
"""Bits that describe what was driven and recorded; all others doubt a label, and those are what is judged here."""
LABELS = ("T", "v", "w", "E")
BANDS = {1: (0.63, 0.73), 2: (0.93, 0.97)}
"""Shares wanted inside one and two deviations."""
_FEWEST = 20
_MOST_BEYOND = {"T": 0.08, "v": 0.08, "w": 0.08, "E": 0.08, "start": 0.10}
_MOST_DOUBT = 0.02
_FEWEST_KEPT = 0.80
_WIDEST = 1.5
_BLOCK = 20
_DRAWS = 1000


@dataclass(frozen=True)
class Result:
    """Result of one drive; ``oracle`` is the number of segments without the faulty sensors, if there are none with them."""

    seed: int
    outcome: Outcome
    oracle: int | None = None


@dataclass(frozen=True)
class Share:
    """A share, and the interval that holds it in 95 of 100 draws of blocks of neighbours."""

    value: float
    low: float
    high: float


@dataclass
class Figures:
    """Figures of a cell over its seeds; those by quantity are of the labels that no bit doubts."""

    cell: str
    seeds: int
    ladder: dict[str, float]
    """Metres truly driven, driven by the track, steady, labelled, undoubted, sampled."""
    rms: dict[str, float] = field(default_factory=dict)
    inside: dict[str, dict[int, Share]] = field(default_factory=dict)
    width: dict[str, float] = field(default_factory=dict)
    """Median standard deviation over RMS error, which includes the error that no sensor shows (`Fault.unseen_m`)."""
    doubted: float = float("nan")
    doubted_clean: float = 0.0
    """Figures of the same sensors without a fault."""
    kept_good: float = float("nan")
    """Share without any flag among the labels outside the fault's window whose errors are at most twice those of the clean log."""
    good: float = float("nan")
    """The share of labels outside of the window whose errors are within twice those of the clean log."""
    bits: dict[str, float] = field(default_factory=dict)
    refused: int = 0
    needlessly: int = 0
    """Refused although there are segments without the sensors at fault."""
    wheels: float = float("nan")
    """The track's length over the wheels' own."""
    said: list[str] = field(default_factory=list)
    traces: list[str] = field(default_factory=list)
    failures: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class _Pool:
    """All labels of some drives, one value a label; blocks of neighbours have a number each."""

    error: dict[str, np.ndarray]
    claimed: dict[str, np.ndarray]
    doubt: np.ndarray
    inside_window: np.ndarray
    placed: np.ndarray
    block: np.ndarray


def _no_doubt(cell: Cell) -> int:
    """Return the bits that doubt nothing here: without GNSS no place is claimed."""
    return int(OF_THE_DRIVE | (Quality.WEAK_GNSS if "gnss" in SETS[cell.sensors] else 0))


def _pool(results: Sequence[Result], window_s: tuple[float, float] | None, *, no_doubt: int) -> _Pool:
    def joined(parts: list[list[float]]) -> np.ndarray:
        return np.concatenate([np.asarray(part, float) for part in parts]) if parts else np.zeros(0)

    outcomes = [result.outcome for result in results]
    at_s, bits = joined([o.start_s for o in outcomes]), joined([o.bits for o in outcomes]).astype(np.int64)
    blocks = [(np.arange(len(o.bits)) // _BLOCK + 1000 * k).tolist() for k, o in enumerate(outcomes)]
    low, high = window_s or (np.inf, np.inf)
    return _Pool(
        {name: np.abs(joined([o.error[name] for o in outcomes])) for name in QUANTITIES},
        {name: joined([o.claimed[name] for o in outcomes]) for name in QUANTITIES},
        (bits & ~no_doubt) != 0,
        (at_s > low - 2.0) & (at_s < high + 1.0),
        joined([o.placed for o in outcomes]).astype(bool),
        joined(blocks),
    )


def figures_of(cell: Cell, results: Sequence[Result], clean: Sequence[Result]) -> Figures:
    """Return the figures of a cell; ``clean`` are the results of the same sensors at the same rate without a fault."""
    no_doubt, outcomes = _no_doubt(cell), [result.outcome for result in results]
    pool = _pool(results, cell.fault.window_s, no_doubt=no_doubt)
    sure = ~pool.doubt
    ladder = {
        "true": sum(o.true_m for o in outcomes),
        "driven": sum(o.driven_m for o in outcomes),
        "steady": sum(o.kept_m for o in outcomes),
        "labelled": float(pool.doubt.size),
        "undoubted": float(sure.sum()),
        "sampled": float((sure & pool.placed).sum()),
    }
    made = Figures(cell.name, len(results), ladder)
    if pool.doubt.size:
        made.doubted = float(pool.doubt.mean())
        counted = Counter(name for o in outcomes for bits in o.bits for name in bit_names(bits & ~no_doubt))
        made.bits = {name: count / pool.doubt.size for name, count in counted.items()}
        _measure(made, pool, sure, cell.fault.unseen_m)
        _yield(made, pool, _pool(clean, None, no_doubt=no_doubt))
    made.refused = sum(not o.bits for o in outcomes)
    made.needlessly = sum(r.oracle is None or r.oracle > 0 for r in results if not r.outcome.bits)
    lengths = [o.driven_m / o.wheels_m for o in outcomes if np.isfinite(o.wheels_m) and o.wheels_m > 1.0]
    made.wheels = float(np.mean(lengths)) if lengths else float("nan")
    made.said = [line for line, _ in Counter(blot_numbers(line) for o in outcomes for line in o.said).most_common(6)]
    made.traces = [o.trace for o in outcomes if o.trace]
    made.failures = _failures(made, cell, outcomes)
    return made


def map_figures(result: MapResult) -> Figures:
    """Return the figures of the map's cell: what was said, and the verdict."""
    said = [blot_numbers(line) for line in result.said]
    return Figures(NAME, 1, {}, refused=int(result.refused), said=said, failures=result.failures)


def _measure(made: Figures, pool: _Pool, sure: np.ndarray, unseen_m: float) -> None:
    for name in QUANTITIES:
        rows = sure & np.isfinite(pool.error[name]) & np.isfinite(pool.claimed[name])
        if rows.sum() < _FEWEST:
            continue
        error, claimed = pool.error[name][rows], pool.claimed[name][rows]
        made.rms[name] = float(np.sqrt(np.mean(error**2)))
        made.width[name] = float(np.median(claimed) / np.hypot(made.rms[name], unseen_m if name == "start" else 0.0))
        made.inside[name] = {k: _share(error <= k * claimed, pool.block[rows]) for k in BANDS}


def _share(hit: np.ndarray, block: np.ndarray) -> Share:
    """Return a share and its interval by drawing blocks with replacement, always the same draws."""
    _, of_block = np.unique(block, return_inverse=True)
    hits, sizes = np.bincount(of_block, hit), np.bincount(of_block)
    drawn = np.random.default_rng(0).integers(0, sizes.size, (_DRAWS, sizes.size))
    shares = hits[drawn].sum(axis=1) / sizes[drawn].sum(axis=1)
    return Share(float(hit.mean()), *(float(value) for value in np.quantile(shares, [0.025, 0.975])))


def _yield(made: Figures, pool: _Pool, clean: _Pool) -> None:
    good = ~pool.inside_window
    outside = int(good.sum())
    made.doubted_clean = float(clean.doubt.mean()) if clean.doubt.size else 0.0
    for name in QUANTITIES:
        known = clean.error[name][np.isfinite(clean.error[name])]
        if known.size:
            error = np.where(np.isfinite(pool.error[name]), pool.error[name], 0.0)
            good &= error <= 2.0 * np.sqrt(np.mean(known**2))
    made.good = float(good.sum() / outside) if outside else float("nan")
    made.kept_good = float((~pool.doubt[good]).mean()) if good.any() else float("nan")


def blot_numbers(line: str) -> str:
    """Return a finding with its numbers blotted out, so that seeds say the same."""
    return re.sub(r"[-+]?\d+(\.\d+)?", "#", line)


def _failures(made: Figures, cell: Cell, outcomes: Sequence[Outcome]) -> list[str]:
    found = ["traceback"] * bool(made.traces)
    if made.needlessly and not cell.fault.may_refuse:
        found.append(f"{made.needlessly} of {made.seeds} runs refused needlessly")
    for name, shares in made.inside.items():
        if (beyond := 1.0 - shares[2].value) > _MOST_BEYOND[name]:
            found.append(f"{name} {beyond:.0%} beyond 2 sigma")
    left_out = SETS[cell.sensors]
    if (
        scaled := "gnss" not in left_out
    ):  # else the odometry's scale is one error of a run: of three drives there are three
        found += [f"{name} sigma {w:.1f} RMS" for name, w in made.width.items() if w > _WIDEST]
    most_is_good, fewest_kept = made.good >= 0.5, _FEWEST_KEPT * (1.0 - made.doubted_clean)
    if cell.fault.calibrated and scaled and len(left_out) <= 1:
        found += _uncalibrated(made)
        if made.doubted > _MOST_DOUBT:
            found.append(f"{made.doubted:.0%} doubted")
    elif most_is_good and made.kept_good < fewest_kept:
        found.append(f"{made.kept_good:.0%} of good metres kept")
    harmed = bool(found) or made.refused > 0 or made.doubted > _MOST_DOUBT
    missing = [o for o in outcomes if not re.search(cell.fault.said, "\n".join(o.said).lower())]
    if harmed and missing:
        found.append(f"nothing said in {len(missing)} of {made.seeds}")
    return found


def _uncalibrated(made: Figures) -> list[str]:
    found = []
    for name in LABELS:
        for k, share in made.inside.get(name, {}).items():
            low, high = BANDS[k]
            if share.high < low or share.low > high:
                found.append(f"{name} {share.value:.0%} inside {k} sigma")
    return found


def row(made: Figures) -> str:
    """Return a line of figures: RMS errors, per cent inside one and two deviations, what is doubted and kept, the verdict."""
    cells = [
        f"{name} {made.rms[name]:.3g} {100 * shares[1].value:.0f}/{100 * shares[2].value:.0f}"
        for name, shares in made.inside.items()
    ]
    text = f"{made.cell:<52} {', '.join(cells) or 'no labels':<70}"
    return f"{text} doubted {made.doubted:4.0%} good {made.kept_good:4.0%} {'; '.join(made.failures) or 'ok'}"


_HEAD = (
    "cell",
    "T",
    "v",
    "w",
    "E",
    "start",
    "doubted",
    "good kept",
    "steady, labelled, undoubted, sampled",
    "verdict",
    "said",
)


def page(every: Sequence[Figures]) -> str:
    """Return the page in Markdown: a row a cell."""
    failed = [made for made in every if made.failures]
    lines = [
        "# Campaign",
        "",
        f"{len(every) - len(failed)} of {len(every)} cells are as they should be. By quantity: RMS error,",
        "median deviation over it, per cent inside one and two deviations, of labels that no bit doubts. Ladder: per cent of the",
        "true way, over all seeds.",
        "",
        f"| {' | '.join(_HEAD)} |",
        "|" + "---|" * len(_HEAD),
    ]
    return "\n".join([*lines, *(_line(made) for made in every), ""])


def _line(made: Figures) -> str:
    quantities = [_quantity(made, name) for name in QUANTITIES]
    true_m = made.ladder.get("true") or 1.0
    steps = ("steady", "labelled", "undoubted", "sampled") if made.ladder else ()
    ladder = ", ".join(f"{100 * made.ladder[name] / true_m:.0f}" for name in steps)
    bits = ", ".join(f"{name} {share:.0%}" for name, share in sorted(made.bits.items(), key=lambda item: -item[1])[:3])
    said = "<br>".join(line.replace("|", "/")[:160] for line in made.said)
    verdict = "; ".join(made.failures) or "ok"
    kept = "" if np.isnan(made.kept_good) else f"{made.kept_good:.0%}"
    cells = (made.cell, *quantities, bits, kept, ladder, verdict, said)
    return f"| {' | '.join(cells)} |"


def _quantity(made: Figures, name: str) -> str:
    if name not in made.inside:
        return ""
    inside = "/".join(f"{100 * share.value:.0f}" for share in made.inside[name].values())
    return f"{made.rms[name]:.3g} ({made.width[name]:.1f}) {inside}"
