"""Claims of the paper (section V) that the simulated site can refute, as ratios of errors.

The importance of height, class, several classes and slow ground is built into the site (docs/reference/simulation.md)
and is no claim.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.special import stdtrit

from tcpipe.experiment.networks import ALL_LAYERS, GRASS, HEIGHTS
from tcpipe.learning.baselines import CURVES, SPLITS, TREES, BaselineResult
from tcpipe.learning.metrics import Ratio

Verdict = Literal["held", "open", "NOT held", "not measured"]

CLAIMS = {
    ALL_LAYERS: "one net beats a net per class, all layers",
    HEIGHTS: "one net beats a net per class, heights alone",
    CURVES: "the net beats class and slope",
    TREES: "the net beats gradient boosting",
}
"""By the baseline; each is of E, on every split."""

_PAPER_RATIO = {HEIGHTS: (21.51 / 34.52, 26.63 / 32.92), GRASS: (21.51 / 51.39, 26.63 / 56.16)}
"""RMSE of E of the one network over that of another, on test and on unseen (the paper's table IV)."""

FEWEST_SEEDS = 5
"""Fewest trainings to decide a claim: a single training does not show how much trainings differ."""


@dataclass(frozen=True, slots=True)
class Claim:
    """One comparison on one split: the RMSE of E of the network over a baseline's, of the same samples."""

    says: str
    split: str
    ratio: Ratio
    """Its mean over trainings, with the 95 % interval over trainings and samples."""
    seeds: int
    between_seeds: float | None
    """Standard deviation of the ratio's logarithm between trainings; None of one."""
    in_the_paper: float | None
    verdict: Verdict
    """``held``: the whole 95 % interval is below 1; ``NOT held``: above; ``open``: it contains 1, or trainings or
    groups are too few."""

    def __str__(self) -> str:
        """Return the claim, its figure and its verdict as one line."""
        comparison = "" if self.in_the_paper is None else f" ({self.in_the_paper:.2f} in the paper)"
        trainings = (
            "one training"
            if self.between_seeds is None
            else f"{self.seeds} trainings, {100.0 * self.between_seeds:.0f} % apart (1σ)"
        )
        return f"{self.verdict}: {self.says}, {self.split}: RMSE of E {self.ratio} of its{comparison}; {trainings}"


def check_claims(runs: Sequence[Sequence[BaselineResult]]) -> list[Claim]:
    """Return every claim with its verdict over all trainings, each with its comparisons."""
    found = []
    for split in [split for split in SPLITS if any(row.split == split for row in runs[0])]:
        for baseline, says in CLAIMS.items():
            wanted = baseline, split, "E"
            rows = [row for run in runs for row in run if (row.baseline, row.split, row.quantity) == wanted]
            ratio, between = _combine_ratios(rows, len(runs))
            of_paper = _PAPER_RATIO[baseline][SPLITS.index(split)] if baseline in _PAPER_RATIO else None
            verdict = _find_verdict(ratio, len(runs))
            found.append(Claim(says, split, ratio, len(runs), between, of_paper, verdict))
    return found


def _combine_ratios(rows: Sequence[BaselineResult], seeds: int) -> tuple[Ratio, float | None]:
    """Return the mean ratio with its interval, and the standard deviation between trainings.

    The variance of the mean logarithm is that of the trainings, over their number, and that of the samples, which all
    trainings share: that of the bootstrap. Degrees of freedom are Welch and Satterthwaite's.
    """
    values = [row.rmse_ratio.value for row in rows if row.rmse_ratio.value is not None]
    if len(values) < seeds:
        return Ratio(None, None, None), None
    logs = np.log(values)
    mean = float(np.exp(logs.mean()))
    if seeds < 2:
        return Ratio(mean, None, None), None
    between = float(logs.std(ddof=1))
    groups = min(row.groups for row in rows)
    widths = [np.log(high / low) for row in rows if (low := row.rmse_ratio.low) and (high := row.rmse_ratio.high)]
    if len(widths) < seeds:
        return Ratio(mean, None, None), between
    parts = between**2 / seeds, float(np.mean(np.square(widths))) / (2.0 * float(stdtrit(groups - 1, 0.975))) ** 2
    freedom = sum(parts) ** 2 / max(parts[0] ** 2 / (seeds - 1) + parts[1] ** 2 / (groups - 1), 1e-300)
    half = float(stdtrit(max(freedom, 1.0), 0.975)) * float(np.sqrt(sum(parts)))
    return Ratio(mean, mean * float(np.exp(-half)), mean * float(np.exp(half))), between


def _find_verdict(ratio: Ratio, seeds: int) -> Verdict:
    if ratio.value is None:
        return "not measured"
    if ratio.low is None or ratio.high is None or seeds < FEWEST_SEEDS or ratio.low <= 1.0 <= ratio.high:
        return "open"
    return "held" if ratio.high < 1.0 else "NOT held"
