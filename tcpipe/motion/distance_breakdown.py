"""Distance breakdown of a track: the spans that are kept, and the reason of each interval that is masked.

The odometer is the horizontal length of the estimated track: Hermite arcs inside its sections, straight lines across
its gaps. A jump of the estimate is no driving: such a step counts by its speed. Each interval between two rows belongs
to one entry, so their sum is the odometer (docs/explanation/rulings.md, Marked, not deleted).

The catalogue of findings states how to avoid each large loss (``lost-...``).
"""

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tcpipe.arrays import Floats, Ints
from tcpipe.motion.row_sections import find_piece_spans, find_runs
from tcpipe.tables.bits import DropReason, flag_name
from tcpipe.tables.findings import Finding, Subject, make_finding, read_threshold


def find_kept_spans(dropped_by: NDArray[np.uint32], piece: Ints) -> Ints:
    """Return first and last row of every maximal run of kept rows inside one piece, shape (S, 2), two rows at least."""
    kept = find_runs(dropped_by == 0, piece)
    return kept[kept[:, 1] > kept[:, 0]]


def find_interval_reason(dropped_by: NDArray[np.uint32], piece: Ints) -> NDArray[np.uint32]:
    """Return one reason for each interval between rows, shape (N - 1,); 0 inside a kept section.

    A gap has the reason gap. Otherwise the reasons of both ends apply, and of several the first in the order of
    `DropReason`.
    """
    both = (dropped_by[:-1] | dropped_by[1:]).astype(np.int64)
    lowest = both & -both
    return np.where(piece[:-1] == piece[1:], lowest, int(DropReason.GAP)).astype(np.uint32)


JUMP_M = 1.0
"""Largest difference of a step from the distance by velocity [m]; a larger step is a jump of the estimate."""


def compute_unexplained_m(stamp_ns: Ints, position_m: Floats, velocity_mps: Floats, piece: Ints) -> Floats:
    """Return the horizontal difference of each step from the distance by velocity [m], (N - 1,); 0 across gaps.

    Parameters as in `compute_interval_length_m`.
    """
    step_s = np.diff(stamp_ns).astype(np.float64) * 1e-9
    explained = 0.5 * (velocity_mps[1:, :2] + velocity_mps[:-1, :2]) * step_s[:, None]
    difference = np.diff(position_m[:, :2], axis=0) - explained
    return np.where(piece[:-1] == piece[1:], np.hypot(difference[:, 0], difference[:, 1]), 0.0)


def compute_interval_length_m(stamp_ns: Ints, position_m: Floats, velocity_mps: Floats, piece: Ints) -> Floats:
    """Return the odometer's share of every interval between rows [m], shape (N - 1,).

    ``position_m`` [m] and ``velocity_mps`` [m/s] have shape (N, 3): east, north, up.
    """
    from tcpipe.geometry.polyline import fit_polyline  # noqa: PLC0415  numba loads only where a track is cut

    step = np.diff(position_m, axis=0)
    length: Floats = np.hypot(step[:, 0], step[:, 1])
    for first, last in find_piece_spans(piece):
        rows = slice(first, last + 1)
        length[first:last] = np.diff(fit_polyline(stamp_ns[rows], position_m[rows], velocity_mps[rows]).length_m)
    speed_mps = np.hypot(velocity_mps[:, 0], velocity_mps[:, 1])
    driven = 0.5 * (speed_mps[1:] + speed_mps[:-1]) * np.diff(stamp_ns).astype(np.float64) * 1e-9
    return np.where(compute_unexplained_m(stamp_ns, position_m, velocity_mps, piece) > JUMP_M, driven, length)


def compute_interval_duration_s(stamp_ns: Ints, epoch: Ints) -> Floats:
    """Return the duration of every interval between rows, [s], shape (N - 1,); 0 between clock epochs."""
    return np.where(np.diff(epoch) == 0, np.diff(stamp_ns) * 1e-9, 0.0)


def sum_by_reason(reason: NDArray[np.uint32], amount: Floats) -> dict[str, float]:
    """Return sums of an amount an interval (metres, seconds, joules) by name of every `DropReason` present."""
    return {flag_name(bit): float(amount[reason == int(bit)].sum()) for bit in DropReason}


KEPT = "kept"
"""Name of the entry for used metres."""
_MOST_LOSSES = 10
_WORTH_M = 0.05


def make_loss_code(reason: str) -> str:
    """Return the code of the finding on metres that were lost for a reason, as ``below_full_speed``."""
    return f"lost-{reason.replace('_', '-')}"


def find_losses(breakdown_m: Mapping[str, float], subject: Subject) -> list[Finding]:
    """Return findings on losses of over a twentieth of the distance [m], the largest first; none without motion."""
    total_m = sum(breakdown_m.values())
    if total_m < read_threshold("no-segments", "min_driven_m"):
        return []
    least_m = read_threshold("lost-gap", "min_lost_fraction") * total_m
    lost = sorted(breakdown_m.items(), key=lambda item: -item[1])
    return [
        make_finding(make_loss_code(reason), subject, lost_m=lost_m, lost_fraction=lost_m / total_m)
        for reason, lost_m in lost
        if reason != KEPT and lost_m > least_m
    ]


@dataclass(frozen=True, slots=True)
class StoreLoss:
    """Metres outside segments for one reason."""

    reason: str
    metres: float
    share: float
    """Fraction of all metres driven [1]."""
    runs: int
    """Number of runs with this loss."""


def find_largest_losses(ledgers_m: Iterable[Mapping[str, float]]) -> tuple[StoreLoss, ...]:
    """Return the ten largest losses of runs, by their distance breakdowns [m], the largest first."""
    metres, of_runs = Counter[str](), Counter[str]()
    for distance_by_reason_m in ledgers_m:
        metres.update(distance_by_reason_m)
        of_runs.update(reason for reason, lost_m in distance_by_reason_m.items() if lost_m >= _WORTH_M)
    total = sum(metres.values())
    lost = [(reason, lost_m) for reason, lost_m in metres.most_common() if reason != KEPT and of_runs[reason]]
    return tuple(StoreLoss(reason, lost_m, lost_m / total, of_runs[reason]) for reason, lost_m in lost[:_MOST_LOSSES])
