"""A sensor that is not to be fused: the code of the finding that says why, and what would set it right."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from tcpipe.fusion.measurements import GNSS


@dataclass(frozen=True, slots=True)
class SensorExclusion:
    """A sensor that is not to be fused.

    Attributes
    ----------
    code : of the finding (`tcpipe.tables.catalogue`).
    names, numbers : of the finding; the name ``suspect`` is the other role that may be wrong instead.
    units : value of the recipe's ``imu_units`` that sets it right.
    turned_by : rotation (3, 3) from what the extrinsics in use make of the sensor to base_link.
    late_s : time offset of its stamps [s] that the recipe can correct.
    is_suspect_excludable : whether excluding the suspect instead sets it right.
    """

    role: str
    code: str
    names: Mapping[str, str] = field(default_factory=dict)
    numbers: Mapping[str, float] = field(default_factory=dict)
    units: str | None = None
    turned_by: NDArray[np.float64] | None = None
    late_s: float | None = None
    is_suspect_excludable: bool = False


def refuse_fixes(code: str, odometries: Collection[str], names: Mapping[str, str] | None = None) -> SensorExclusion:
    """Return the refusal of fixes that odometries contradict; a single odometry is suspect, whoever confirms how it turns."""
    if len(odometries) != 1:
        return SensorExclusion(GNSS, code, names or {})
    return SensorExclusion(GNSS, code, {**(names or {}), "suspect": next(iter(odometries))}, is_suspect_excludable=True)


def join_names(roles: Collection[str]) -> str:
    """Return several roles as one name of a finding."""
    return ", ".join(roles)
