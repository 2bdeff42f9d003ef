"""What rolling resistance and grade alone explain of a run's power: a baseline beside each label, and the labels that it cannot explain.

On a slope that rises by tan(s) a robot of weight m g at horizontal speed v does the mechanical work

    m g v (c + tan(s))                                  (rolling resistance m g c cos(s), grade m g sin(s), along the surface)

a second. The drive needs 1 / efficiency of that, and gives back a share of it where it is negative (the slope drives the wheels)::

    P = P0 + N v g(c + tan(s)),   g(x) = x for x > 0, k x for x < 0

P0 is what the drive draws while the robot stands. N = m g / efficiency [N], c and k are fitted by Gauss-Newton steps with Huber's
weights (Huber 1964; k = 1.345), so that a minority of odd metres bends nothing. Terrain classes and turning are left to the residual.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

_FEWEST = 20  # segments to fit on
_LEAST_SLOPE = 0.02  # standard deviation of the rises: on flatter ground weight and rolling cannot be told apart
_FEWEST_DOWNHILL = 10  # segments that drive the robot: fewer tell no recovery
_STEPS = 50  # of Gauss-Newton at most
_HUBER = 1.345  # 95 % efficient for normal errors (Huber, Robust Statistics, 1981)
_NORMAL = 1.4826  # standard deviation over median absolute deviation of a normal variate
_OUTLIER = 4.0  # robust standard deviations
_FINEST = 0.02  # of the power: no such model is better
_PLAUSIBLE_RESISTANCE = (0.0, 1.5)  # coefficient of rolling resistance: tracks in deep sand stay below
_START = 0.15  # of that coefficient: a skid-steered robot on grass


@dataclass(frozen=True, slots=True)
class Physics:
    """The fit of a run.

    Attributes
    ----------
    standing_watt : P0 [W]; 0 where the robot never stood.
    drive_newton : N, weight over the drive's efficiency [N]; 0 where the slopes do not vary: then ``rolling_newton`` is all.
    rolling_newton : N c [N].
    recovered : k, share of downhill work that comes back; 0 where nothing was driven down steeply enough to tell.
    residual_watt : robust standard deviation of what is left [W], at least 2 % of the power.
    segments : how many segments it is fitted on.
    """

    standing_watt: float
    drive_newton: float
    rolling_newton: float
    recovered: float
    residual_watt: float
    segments: int

    @property
    def rolling_resistance(self) -> float | None:
        """The coefficient c, or None where the slopes do not vary."""
        return self.rolling_newton / self.drive_newton if self.drive_newton > 0 else None

    def power_watt(self, *, velocity_mps: Floats, rise: Floats) -> Floats:
        """Return the predicted power [W] at horizontal speeds [m/s] and rises tan(s), shape (M,)."""
        force = self.rolling_newton + self.drive_newton * rise
        return self.standing_watt + velocity_mps * np.where(force > 0, force, self.recovered * force)

    def is_outlier(self, residual_watt: Floats) -> NDArray[np.bool_]:
        """Return which residuals [W] are beyond four robust standard deviations; NaN is none."""
        found: NDArray[np.bool_] = np.abs(residual_watt) > _OUTLIER * self.residual_watt
        return found


def fit_physics(*, power_watt: Floats, velocity_mps: Floats, rise: Floats, standing_watt: float) -> Physics | None:
    """Fit rolling resistance and grade to a run's labels; None for fewer than 20 or where no such robot can be.

    Parameters
    ----------
    power_watt, velocity_mps, rise : labels [W], horizontal speeds [m/s] and tan of the slopes, shape (M,); rows with NaN are left out.
    standing_watt : power while standing [W]; 0 where unknown.
    """
    known = np.isfinite(power_watt + velocity_mps + rise)
    if known.sum() < _FEWEST:
        return None
    force = (power_watt[known] - standing_watt) / velocity_mps[known]
    slope = rise[known]
    flat = float(np.std(slope)) < _LEAST_SLOPE
    parameters = np.array([float(np.median(force)), 0.0, 0.0]) if flat else _fitted(force, slope)
    rolling, drive, recovered = parameters.tolist()
    low, high = _PLAUSIBLE_RESISTANCE
    if rolling <= 0 or drive < 0 or (drive > 0 and not low < rolling / drive < high):
        return None
    bare = Physics(standing_watt, drive, rolling, recovered, 0.0, int(known.sum()))
    off = power_watt[known] - bare.power_watt(velocity_mps=velocity_mps[known], rise=slope)
    spread = _NORMAL * float(np.median(np.abs(off - np.median(off))))
    spread = max(spread, _FINEST * float(np.median(np.abs(power_watt[known]))))
    return Physics(standing_watt, drive, rolling, recovered, spread, int(known.sum()))


def _fitted(force: Floats, rise: Floats) -> Floats:
    """Return (N c, N, k) by iteratively reweighted Gauss-Newton steps on the force P / v."""
    level = float(np.median(force))
    x = np.array([level, level / _START, 0.5])
    for _ in range(_STEPS):
        traction = x[0] + x[1] * rise
        driven = traction > 0
        gain = np.where(driven, 1.0, x[2])
        off = force - gain * traction
        scale = max(_NORMAL * float(np.median(np.abs(off))), 1e-9)
        weight = np.minimum(1.0, _HUBER * scale / np.maximum(np.abs(off), 1e-12))
        columns = [gain, gain * rise]
        if (~driven).sum() >= _FEWEST_DOWNHILL:
            columns.append(np.where(driven, 0.0, traction))
        design = np.column_stack(columns) * np.sqrt(weight)[:, None]
        step = np.linalg.lstsq(design, off * np.sqrt(weight), rcond=None)[0]
        x[: step.size] += step
        x[2] = min(max(x[2], 0.0), 1.0) if step.size == 3 else 0.0
        if np.abs(step[:2]).max() < 1e-9 * max(level, 1.0):
            break
    return x
