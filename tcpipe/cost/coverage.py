"""Share of labels or drives inside their prediction intervals, and whether the intervals are too narrow or wide."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.special import betaincinv, stdtrit

from tcpipe.arrays import GenericArray, Mask
from tcpipe.cost.prediction_errors import COVERAGE
from tcpipe.tables.findings import Finding, Subject, make_finding, read_threshold

_TAIL = 0.025


@dataclass(frozen=True, slots=True)
class Coverage:
    """Share of labels inside their 90 % intervals, with its own 95 % interval; None of too few runs."""

    fraction: float
    low: float | None
    high: float | None
    runs: int
    samples: int

    def __str__(self) -> str:
        """Return the share in percent with its interval."""
        if self.low is None or self.high is None:
            return f"{100.0 * self.fraction:.1f} % ({self.runs} runs are too few for an interval)"
        interval = f"95 % CI {100.0 * self.low:.1f} to {100.0 * self.high:.1f}"
        return f"{100.0 * self.fraction:.1f} % ({interval}, {self.runs} runs)"


_FEWEST_RUNS = 5  # runs without which a coverage has no interval: two or three do not show how runs differ


def measure_coverage(is_inside: Mask, runs: GenericArray) -> Coverage:
    """Return the share of samples that are inside, and its binomial interval, clustered by run.

    Errors of one run are correlated, so that its samples count as fewer: as many as the variance between runs shows,
    less for the few degrees of freedom of that variance (Korn and Graubard, Survey Methodology 24, 1998); then the
    interval of Clopper and Pearson.
    """
    _, at = np.unique(runs, return_inverse=True)
    share, samples, groups = float(is_inside.mean()), len(is_inside), int(at.max()) + 1
    if groups < _FEWEST_RUNS:
        return Coverage(share, None, None, groups, samples)
    counted = float(groups)  # where all or none are inside, the variance is not observable
    if 0.0 < share < 1.0:
        variance = groups / (groups - 1.0) * float((np.bincount(at, weights=is_inside - share) ** 2).sum()) / samples**2
        counted = min(share * (1.0 - share) * samples / (samples - 1.0) / max(variance, 1e-300), samples)
        counted *= (float(stdtrit(samples - 1, 1.0 - _TAIL)) / float(stdtrit(groups - 1, 1.0 - _TAIL))) ** 2
    inside = share * counted
    low = float(betaincinv(inside, counted - inside + 1.0, _TAIL)) if inside > 0.0 else 0.0
    high = float(betaincinv(inside + 1.0, counted - inside, 1.0 - _TAIL)) if inside < counted else 1.0
    return Coverage(share, low, high, groups, samples)


def find_miscalibration(found: Coverage, quantity: str, subject: Subject) -> Iterator[Finding]:
    """Yield that intervals of ``time`` or ``energy`` are too narrow or too wide, if there are enough runs."""
    if found.low is None or found.high is None:
        return
    if found.high < COVERAGE and found.fraction < read_threshold(f"{quantity}-overconfident", "min_coverage_fraction"):
        yield make_finding(f"{quantity}-overconfident", subject, coverage_fraction=found.fraction)
    if found.low > COVERAGE and found.fraction > read_threshold("underconfident", "max_coverage_fraction"):
        names = {"quantity": quantity}
        yield make_finding("underconfident", subject, names=names, coverage_fraction=found.fraction)
