"""Errors of adapted models on the rest of drives, after their first metres are known."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from tcpipe.cost.adaptation import MeasuredRun, adapt, predict
from tcpipe.cost.prediction_errors import QuantityErrors


@dataclass(frozen=True, slots=True)
class AdaptedErrors:
    """Errors of one quantity on the rest of runs, after the first ``metres`` of each are known."""

    quantity: str
    metres: float
    runs: int
    samples: int
    rmse: float
    coverage_percent: float
    """Of single metres, by 90 % intervals."""
    total_error_percent: float
    """Mean absolute error of the sums over the rests of runs."""
    totals_inside: int
    """Runs whose sum is inside its 90 % interval."""

    def __str__(self) -> str:
        """Return them as one line."""
        unit, digits = ("s", 3) if self.quantity == "duration" else ("J", 1)
        return (
            f"{self.quantity} after {self.metres:g} m: RMSE {self.rmse:.{digits}f} {unit}, 90 % intervals cover "
            f"{self.coverage_percent:.1f} % of {self.samples} metres; sums off by {self.total_error_percent:.1f} %, "
            f"{self.totals_inside} of {self.runs} inside"
        )


_LEAST_REST = 10
"""Metres that are left to predict, at least, of a run."""


def compare_adaptations(
    errors: Mapping[str, QuantityErrors], runs: Sequence[MeasuredRun], known_m: Sequence[float]
) -> Iterator[AdaptedErrors]:
    """Yield errors on the rest of each run after so many metres of it are known.

    The rest begins after the most metres, so that all rows are of the same metres; a run too short for some ``known_m`` is in none.
    """
    for quantity, error in errors.items():
        parts = [(run.metres[quantity], np.cumsum(run.metres[quantity].length_m)) for run in runs]
        parts = [(metres, ends_m) for metres, ends_m in parts if (ends_m > max(known_m)).sum() >= _LEAST_REST]
        for metres_m in sorted(known_m) if parts else ():
            found = [
                (rest, adapt(error, known, rest) if len(known.predicted) else predict(error, rest))
                for metres, ends_m in parts
                for known, rest in [(metres.take(ends_m <= metres_m), metres.take(ends_m > max(known_m)))]
            ]
            off = np.concatenate([said.value - rest.measured for rest, said in found])
            inside = [(said.low <= rest.measured) & (rest.measured <= said.high) for rest, said in found]
            sums = np.array([rest.measured.sum() for rest, _ in found])
            middle, low, high = np.array([[said.total.middle, *said.total.interval] for _, said in found]).T
            yield AdaptedErrors(
                quantity=quantity, metres=metres_m, runs=len(found), samples=len(off),
                rmse=float(np.sqrt(np.mean(off**2))), coverage_percent=100.0 * float(np.concatenate(inside).mean()),
                total_error_percent=100.0 * float(np.mean(np.abs(middle / sums - 1.0))),
                totals_inside=int(((low <= sums) & (sums <= high)).sum()),
            )  # fmt: skip
