"""Whether what is removed of a drive depends on the ground: metres in use by class or slope, and where the share stands out.

A dataset whose mud metres are mostly dropped shows the easy mud. So the share in use of every group of metres is held against that of all
of them. Neighbouring metres share their fate, so that a share is known no better than as many independent draws as there are stretches.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tcpipe.tables.catalogue import read_threshold

_STRETCH_M = 5.0
_BIAS = "selection-bias"


@dataclass(frozen=True, slots=True)
class Group:
    """Metres of one class or range of slopes: driven, in use, and removed by reason (those of zero left out) [m]."""

    name: str
    driven_m: float
    used_m: float
    removed_m: Mapping[str, float]
    used_share: float


def sum_lengths_m(
    group: NDArray[np.int64], reason: NDArray[np.int64], length_m: NDArray[np.float64], *, shape: tuple[int, int]
) -> NDArray[np.float64]:
    """Return the metres of every group and reason, ``shape``; group, reason and length [m] of every piece of a drive, shape (N,)."""
    cells = np.bincount(group * shape[1] + reason, weights=length_m, minlength=shape[0] * shape[1])
    return cells.astype(np.float64).reshape(shape)


def list_groups(tally: NDArray[np.float64], names: Sequence[str], reasons: Sequence[str]) -> tuple[Group, ...]:
    """Return the groups that were driven at all, in order; ``tally`` is of `sum_lengths_m`, reason 0 is being in use."""
    return tuple(
        Group(
            name,
            float(row.sum()),
            float(row[0]),
            {reasons[i]: float(row[i]) for i in range(1, len(reasons)) if row[i] > 0},
            float(row[0]) / float(row.sum()),
        )
        for name, row in zip(names, tally, strict=True)
        if row.sum() > 0
    )


def find_uneven_groups(groups: Sequence[Group]) -> list[Group]:
    """Return the groups whose share in use differs from that of all others by more than the catalogue's ``selection-bias`` and than chance.

    Chance: so many standard deviations of a share over stretches of 5 m.
    """
    least_m, sigmas = read_threshold(_BIAS, "min_driven_m"), read_threshold(_BIAS, "min_sigmas")
    apart = read_threshold(_BIAS, "min_difference_fraction")
    driven_m, used_m = sum(g.driven_m for g in groups), sum(g.used_m for g in groups)
    found = []
    for group in groups:
        rest_m = driven_m - group.driven_m
        if min(group.driven_m, rest_m) < least_m:
            continue
        others = (used_m - group.used_m) / rest_m
        variance = used_m / driven_m * (1 - used_m / driven_m) * _STRETCH_M * (1 / group.driven_m + 1 / rest_m)
        if abs(group.used_share - others) > max(apart, sigmas * float(np.sqrt(variance))):
            found.append(group)
    return found


def find_main_reason(group: Group) -> str:
    """Return the reason that removed most of a group, ``""`` where nothing was removed."""
    return max(group.removed_m, key=lambda name: group.removed_m[name], default="")
