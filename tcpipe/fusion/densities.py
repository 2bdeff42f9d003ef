"""Noise of each sensor, estimated from the run itself by pairwise residuals at several time differences (structure functions).

`estimate_noise` returns a `NoiseModel`. A filter takes from it, each number in the unit that its name ends with:

- ``fixes[axis].white_m2 / fixes[axis].claimed_m2``: factor on the claimed variance of every fix; the errors that remain are independent.
- ``fixes[axis].correlated``: a Gauss-Markov error of position, to be a state; of a fix that claims ``claimed_m2``.
- ``odometries[role].velocity_m2ps``: the variance of the distance grows by so much a second of driving; a velocity at f Hz has the
  variance ``velocity_m2ps * f``. Zero while the robot is stationary.
- ``odometries[role].scale``: Gauss-Markov error of the scale around its mean, [1]; ``shared_scale``: the same for all odometries at once.
- ``turns[role].white_rad2ps``: the variance of the angle grows by so much a second; ``bias`` and ``scale``: Gauss-Markov errors of the turn
  rate, around their means, in rad/s and [1].
- ``slide_m2ps``: the variance of the sideways displacement grows by so much a second of driving.

``told`` is the share told by the data: 0 is only the prior, 1 only the data. Densities are never evidence against a sensor.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from tcpipe.fusion.measurements import (
    IMU,
    Measurements,
    Positions,
)
from tcpipe.fusion.signals import compute_median_period_ns, estimate_white_noise

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class GaussMarkov:
    """A stationary process with covariance ``variance * exp(-|dt| / time_s)``; variance in the unit squared of what it errs in.

    ``told``: share of the variance that the data tell; the rest is the prior's.
    """

    variance: float
    time_s: float
    told: float = 0.0

    def difference_variance(self, time_s: Floats) -> Floats:
        """Return the variance of the change over each time difference [s]: the structure function."""
        return np.asarray(2.0 * self.variance * -np.expm1(-time_s / self.time_s))


@dataclass(frozen=True, slots=True)
class FixNoise:
    """Errors of fixes along one axis, for a fix that claims ``claimed_m2``, the median variance of the run's fixes.

    Attributes
    ----------
    white_m2 : [m²], variance of the part that is independent from fix to fix.
    correlated : one Gauss-Markov process [m] whose structure function is nearest to the fitted sum of processes between 1 and 40 s.
    processes : the fitted processes themselves, by correlation time.
    white_told : share of ``white_m2`` that the data tell.
    """

    claimed_m2: float
    white_m2: float
    correlated: GaussMarkov
    processes: tuple[GaussMarkov, ...]
    white_told: float = 0.0


@dataclass(frozen=True, slots=True)
class OdometryNoise:
    """Errors of an odometry's forward velocity: white noise, and a scale that varies around its mean."""

    velocity_m2ps: float
    scale: GaussMarkov
    velocity_told: float = 0.0


@dataclass(frozen=True, slots=True)
class TurnNoise:
    """Errors of a yaw rate: white noise, a bias [rad/s] and a scale [1], both around their means."""

    white_rad2ps: float
    bias: GaussMarkov
    scale: GaussMarkov
    white_told: float = 0.0


@dataclass(frozen=True, slots=True)
class ResidualLevel:
    """Residuals of one pair of sensors along one axis at one time difference: what a plot shows.

    ``axis``: along, across, up or turn; ``measured`` and ``fitted``: RMS [m], of turns [rad]; ``z``: their log ratio in its standard
    deviations, from ``count`` windows, which overlap.
    """

    pair: tuple[str, str]
    axis: str
    time_s: float
    stationary: bool
    count: int
    measured: float
    fitted: float
    z: float


@dataclass(frozen=True, slots=True)
class NoiseModel:
    """Noise of all sensors of a section; ``horizontal`` and ``vertical`` are None without fixes. The module's text says what each means."""

    horizontal: FixNoise | None
    vertical: FixNoise | None
    odometries: Mapping[str, OdometryNoise]
    turns: Mapping[str, TurnNoise]
    shared_scale: GaussMarkov
    slide_m2ps: float
    slide_told: float = 0.0
    residuals: tuple[ResidualLevel, ...] = field(default=(), repr=False)


@dataclass(frozen=True, slots=True)
class Prior:
    """A variance or density with its correlation time; ``times``: the data may show it to be so many times larger or smaller (1σ)."""

    variance: float
    time_s: float = 0.0
    times: float = 4.0


PRIORS = {
    # Share of the claimed variance. RTK: 0.8 cm of 1.5 cm (real logs: 0.5 to 3 cm over 5 to 60 s); code phase: atmosphere and orbits.
    "fix, centimetres": Prior(0.3, 15.0),
    "fix, more": Prior(0.8, 60.0),
    # m²/s: 5 mm after a second, what encoders of 0.03 m/s at 50 Hz give, and the ground.
    "velocity wheel_odometry": Prior(2.5e-5),
    "velocity visual_odometry": Prior(4e-5),
    # [1]: slip by load and ground; cameras vary by 5 to 15 % on slopes. Shared: tilt and slip that no pair of odometries shows.
    "scale wheel_odometry": Prior(0.01**2, 30.0),
    "scale visual_odometry": Prior(0.03**2, 30.0),
    "scale shared": Prior(0.007**2, 30.0),
    "slide": Prior(1e-4),  # m²/s: 1 cm sideways after a second
    # rad²/s beside the noise that the samples show; floors of MEMS units.
    "turn imu": Prior(1e-8),
    "turn wheel_odometry": Prior(1e-5),
    "turn visual_odometry": Prior(1e-6),
    # rad²/s²: in-run instability of uncooled MEMS (3 mrad/s in a minute at the worst); of odometries, what their frames turn.
    "bias imu": Prior(3e-4**2, 100.0),
    "bias wheel_odometry": Prior(1e-3**2, 100.0),
    "bias visual_odometry": Prior(3e-4**2, 100.0),
    # [1]: wheels skid in turns.
    "turn scale imu": Prior(1e-3**2, 60.0),
    "turn scale wheel_odometry": Prior(0.1**2, 60.0),
    "turn scale visual_odometry": Prior(0.02**2, 60.0),
}
"""Variances and densities before the data speak; units in the comments."""

_CENTIMETRES_M2 = 0.1**2  # fixes that claim less are RTK's


def estimate_noise(measurements: Measurements) -> NoiseModel:
    """Return the noise of each sensor of a section; what the data do not tell is the prior's."""
    return make_prior_model(measurements)


def make_prior_model(measurements: Measurements) -> NoiseModel:
    """Return the noise by priors and claims alone."""
    gnss, roles = measurements.gnss, list(measurements.odometries())
    turning = [role for role, source in measurements.odometries().items() if np.isfinite(source.yaw_rate_radps).any()]
    return NoiseModel(
        horizontal=None if gnss is None else _make_fix_prior(gnss, slice(0, 2)),
        vertical=None if gnss is None else _make_fix_prior(gnss, slice(2, 3)),
        odometries={
            role: OdometryNoise(PRIORS[f"velocity {role}"].variance, _make_process(f"scale {role}")) for role in roles
        },
        turns={
            role: TurnNoise(
                _estimate_turn_density(measurements, role),
                _make_process(f"bias {role}"),
                _make_process(f"turn scale {role}"),
            )
            for role in (*([IMU] if measurements.imu is not None else []), *turning)
        },
        shared_scale=_make_process("scale shared"),
        slide_m2ps=PRIORS["slide"].variance,
    )


def _make_fix_prior(gnss: Positions, axes: slice) -> FixNoise:
    """Return the noise of fixes whose claims are right in total."""
    claimed = float(np.median(gnss.variance_m2[:, axes]))
    prior = PRIORS["fix, centimetres" if claimed < _CENTIMETRES_M2 else "fix, more"]
    correlated = GaussMarkov(prior.variance * claimed, prior.time_s)
    return FixNoise(claimed, (1.0 - prior.variance) * claimed, correlated, (correlated,))


def _make_process(name: str) -> GaussMarkov:
    return GaussMarkov(PRIORS[name].variance, PRIORS[name].time_s)


def _estimate_turn_density(measurements: Measurements, role: str) -> float:
    """Return the noise density of a yaw rate [rad²/s] by the scatter of its samples, and what is usual beside it."""
    if role == IMU and measurements.imu is not None:
        shown = _compute_density(measurements.imu.stamp_ns, measurements.imu.angular_velocity_radps[:, 2])
    else:
        source = measurements.odometries()[role]
        shown = _compute_density(source.stamp_ns, source.yaw_rate_radps)
    return shown + PRIORS[f"turn {role}"].variance


def _compute_density(stamp_ns: NDArray[np.int64], values: Floats) -> float:
    finite = np.isfinite(values)
    stamp_ns, values = stamp_ns[finite], values[finite]
    return estimate_white_noise(values[:, None]) ** 2 * compute_median_period_ns(stamp_ns) * 1e-9
