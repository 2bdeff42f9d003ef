"""Claims of the paper (section V) that the simulated site can refute, as ratios of errors.

The importance of height, class, several classes and slow ground is built into the site (docs/reference/simulation.md) and is no claim.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from tcpipe.learning import paper_tables as paper
from tcpipe.learning.baselines import CURVES, OURS, PER_CLASS, TREES
from tcpipe.learning.evaluation_facts import SPLITS, BaselineResult, Evaluation
from tcpipe.learning.metrics import Ratio

Verdict = Literal["held", "open", "NOT held", "not measured"]

CLAIMS = {
    PER_CLASS: "one net beats a net per class",
    CURVES["spline"]: "the net beats class and slope",
    TREES: "the net beats gradient boosting",
}
"""By the baseline; each is of E, on every split."""


@dataclass(frozen=True, slots=True)
class Claim:
    """One comparison on one split: the RMSE of E of the network over a baseline's, of the same samples."""

    says: str
    split: str
    ratio: Ratio
    in_the_paper: float | None
    verdict: Verdict
    """``held``: the whole 95 % interval lies below 1; ``NOT held``: above; ``open``: it holds 1, or there are too few groups for one."""

    def __str__(self) -> str:
        """Return the claim, its figure and its verdict as one line."""
        told = "" if self.in_the_paper is None else f" ({self.in_the_paper:.2f} in the paper)"
        return f"{self.verdict}: {self.says}, {self.split}: RMSE of E {self.ratio} of its{told}"


def check_claims(runs: Sequence[Evaluation]) -> list[Claim]:
    """Return every claim with its verdict over all trainings (one evaluation a seed): mean ratios with the widest interval."""
    found = []
    for split in runs[0].splits:
        for baseline, says in CLAIMS.items():
            ratio = _combine_ratios([_compute_ratio(run, baseline, split) for run in runs])
            found.append(Claim(says, split, ratio, _read_paper_value(baseline, split), _find_verdict(ratio)))
    return found


def _compute_ratio(run: Evaluation, baseline: str, split: str) -> Ratio:
    rows: tuple[BaselineResult, ...] = (*run.networks, *run.baselines)
    mine = (row.rmse_ratio for row in rows if (row.baseline, row.split, row.quantity) == (baseline, split, "E"))
    return next(mine, Ratio(None, None, None))


def _combine_ratios(ratios: Sequence[Ratio]) -> Ratio:
    values, lows, highs = ([getattr(ratio, end) for ratio in ratios] for end in ("value", "low", "high"))
    if None in values:
        return Ratio(None, None, None)
    mean = float(np.exp(np.mean(np.log(values))))
    return Ratio(mean, None, None) if None in lows else Ratio(mean, min(lows), max(highs))


def _find_verdict(ratio: Ratio) -> Verdict:
    if ratio.value is None:
        return "not measured"
    if ratio.low is None or ratio.high is None or ratio.low <= 1.0 <= ratio.high:
        return "open"
    return "held" if ratio.high < 1.0 else "NOT held"


def _read_paper_value(baseline: str, split: str) -> float | None:
    """Return the same ratio of the paper's table IV."""
    at = SPLITS.index(split)
    return paper.ENERGY[OURS][at][0] / paper.ENERGY[baseline][at][0] if baseline in paper.ENERGY else None
