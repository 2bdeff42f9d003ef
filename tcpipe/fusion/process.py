"""Process noise of the filters: noise densities, most of them estimated from the sensors themselves.

White noise of standard deviation s at f Hz has the density s²/f. Only the density of the velocity's noise changes along
the drive. With an accelerometer, it is the accelerometer's noise, which vibration multiplies while the robot moves.
Without an accelerometer, the filter keeps the body velocity constant, and the density follows the measured change of
forward velocity.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from tcpipe.arrays import Floats, Ints
from tcpipe.fusion.densities import PRIORS, NoiseModel, SensorNoise
from tcpipe.fusion.measurements import IMU, VISUAL, WHEELS, BodyVelocities, Measurements, Positions
from tcpipe.fusion.signals import (
    MAX_ACCELERATION_MPS2,
    compute_median_period_ns,
    compute_slopes,
    is_covered,
    remove_xy_spikes,
)
from tcpipe.fusion.state import Mode
from tcpipe.robust import estimate_robust_std

SCALE_STD: Mapping[str, float] = {
    WHEELS: 0.12,  # slip of a skid-steered robot on grass
    VISUAL: 0.05,  # stereo calibration
}
"""By odometry, prior σ of its scale [1]."""
_TURN_SCALE_STD: Mapping[str, float] = {
    IMU: 0.01,  # MEMS gyroscopes, by their datasheets: 1 to 3 %
    WHEELS: 0.2,  # skidding wheels
    VISUAL: 0.03,  # camera
}
"""By source, prior σ of the scale of its turn rate [1]."""
SLOPE_RAD = 0.1  # slope of unknown ground [rad], 1σ
UNSEEN_TURN_RADPS = 0.07  # roll and pitch rate on uneven ground [rad/s], 1σ
GROUND = 2e-3  # density of the change of slope under a robot [rad²/m]: 2.6° over a metre
_ACCELERATION_LASTS_S = 0.05  # correlation time of acceleration [s]: one row of the track
_MIN_DENSITY = 1e-4  # least density of velocity [m²/s³]: 1 cm/s in a second, forward and aside
_UNKNOWN_DENSITY = 0.3  # density of velocity that no sensor measures [m²/s³]


def find_turn_scale_std(measurements: Measurements) -> float:
    """Return the prior σ of the turn rate's scale: of the gyroscope, else of an odometry; else 0.

    Without fixes the scale is unobservable, and stays 1.
    """
    if measurements.gnss is None:
        return 0.0
    if measurements.imu is not None:
        return _TURN_SCALE_STD[IMU]
    roles = list(measurements.turning_odometries())
    return _TURN_SCALE_STD[roles[-1]] if roles else 0.0


def is_length_observable(m: Measurements, fixes: SensorNoise | None) -> bool:
    """Return whether fixes determine the scale of odometry twice as well as its prior, by the distance that they span.

    Otherwise errors of an accelerometer would act as a scale. White noise of many fixes averages out.
    """
    if m.gnss is None or fixes is None or m.gnss.stamp_ns.size < 2:
        return False
    span_m = float(np.linalg.norm(np.ptp(m.gnss.position_enu_m[:, :2], axis=0)))
    lasting_m2 = fixes.correlated.variance + fixes.white / m.gnss.stamp_ns.size
    return float(np.sqrt(2.0 * lasting_m2)) < 0.5 * find_best_scale_std(m) * max(span_m, 1e-3)


def find_best_scale_std(m: Measurements) -> float:
    """Return the smallest prior σ of the scales of odometries."""
    return SCALE_STD[WHEELS if m.visual is None else VISUAL]


def find_scale_stds(measurements: Measurements, fixes: SensorNoise | None) -> Mapping[str, float]:
    """Return the prior σ of the scales of odometries by role; 0 if a scale is unobservable, so that it stays 1.

    Only fixes make a scale observable: within a minute, integrated acceleration has the errors of tilt and bias.
    Without fixes the camera is the reference, or the wheels if there is no camera.
    """
    if is_length_observable(measurements, fixes):
        return SCALE_STD
    return {WHEELS: 0.0 if measurements.visual is None else SCALE_STD[WHEELS], VISUAL: 0.0}


def make_motion_noise(  # noqa: PLR0917
    m: Measurements, noise: NoiseModel, stamp_ns: Ints, mode: NDArray[np.int8], rate_radps: Floats, period_s: float
) -> Floats:
    """Return the variance added by motion over the tick before each stamp: rotation [rad²], velocity [m²/s²]; (K, 6).

    ``mode`` and ``rate_radps`` belong to the tick; see `tcpipe.fusion.state.move_state`.
    """
    density = np.zeros((stamp_ns.size, 6))
    by_gyro = mode >= Mode.GYRO_TURN
    if m.imu is not None:
        density[by_gyro, :3] = noise.turns[IMU].white
    metres_per_s = _compute_speed(m, stamp_ns[~by_gyro])
    density[~by_gyro, :3] = _make_turn_density(m, noise, mode[~by_gyro], rate_radps[~by_gyro], metres_per_s)
    inertial = mode == Mode.INERTIAL
    if m.imu is not None and inertial.any():
        noise_mps2 = m.imu.accelerometer_noise_mps2
        of_samples = np.full(m.imu.stamp_ns.size, m.imu.accelerometer_std_mps2) if noise_mps2 is None else noise_mps2
        of_samples = np.square(of_samples) * 1e-9 * compute_median_period_ns(m.imu.stamp_ns) + 1e-6
        density[inertial, 3:] = np.interp(stamp_ns[inertial], m.imu.stamp_ns, of_samples)[:, None]
    if not inertial.all():
        density[~inertial, 3:] = _compute_odometry_density(m, stamp_ns[~inertial])[:, None]
        density[~inertial, 4:] *= not m.odometries()
        density[~inertial, 4:] += _estimate_slide_density(m.visual)
    return density * period_s


def _compute_speed(m: Measurements, at_ns: Ints) -> Floats:
    """Return the approximate speed of the robot [m/s]; 1 if only fixes measure it."""
    source = m.first_odometry
    if source is None:
        return np.ones(at_ns.size)
    return np.abs(np.interp(at_ns, source.stamp_ns, source.velocity_mps[:, 0]))


def _make_turn_density(
    m: Measurements, noise: NoiseModel, mode: NDArray[np.int8], rate_radps: Floats, speed_mps: Floats
) -> Floats:
    """Return the noise density of turns that no gyroscope measures [rad²/s], shape (K, 3).

    The error of the scale of an odometry's turn rate has a constant part, and a part by `PRIORS` that lasts for a
    second.
    """
    density = np.full((mode.size, 3), 5e-7)  # at least a tenth of a degree in a second
    ground = np.full(mode.size, 0.0 if m.is_antenna_alone else GROUND)
    if not noise.turns and m.odometries():  # only the course over ground measures turns
        density[:, 2] = 5e-3  # 4° in a second
    for role in noise.turns.keys() - {IMU}:
        rows = mode == (Mode.VISUAL_TURN if role == VISUAL else Mode.FLAT_TURN)
        is_spatial = m.odometries()[role].turn_rate_radps is not None
        density[rows, 0 if is_spatial else 2 :] = noise.turns[role].white
        ground[rows] *= not is_spatial
        density[rows] += PRIORS[f"{role} turn scale"].variance * np.square(rate_radps[rows])
    density[:, :2] += (ground * speed_mps)[:, None]
    return density


def _compute_odometry_density(m: Measurements, at_ns: Ints) -> Floats:
    """Return the noise density without accelerometer: squared acceleration around a stamp times its duration.

    If two odometries differ, the smaller density is right: wheels that slip in soft ground measure large accelerations.
    """
    sources = [source for source in m.odometries().values() if source.stamp_ns.size > 2]
    found = np.full(at_ns.size, np.nan)
    for source in sources:
        covered = is_covered(source.stamp_ns, at_ns, at_ns)
        slope = compute_slopes(source.stamp_ns, source.velocity_mps[:, 0], 0.6)  # window [s]
        found[covered] = np.fmin(found[covered], np.interp(at_ns[covered], source.stamp_ns, np.abs(slope)))
    unseen = np.full(at_ns.size, _UNKNOWN_DENSITY) if sources else _compute_receiver_density(m, at_ns)
    return np.where(np.isnan(found), unseen, _MIN_DENSITY + _ACCELERATION_LASTS_S * found**2)


def _compute_receiver_density(m: Measurements, at_ns: Ints) -> Floats:
    """Return the noise density without odometry: squared acceleration of a receiver times its duration.

    An acceleration between slow fixes lasts from one fix to the next. If fixes are too noisy for a velocity, its change
    is unknown.
    """
    source, least = m.doppler or m.gnss, 0.0
    if source is None or source.stamp_ns.size < 5:
        return np.full(at_ns.size, _UNKNOWN_DENSITY)
    period_s = 1e-9 * compute_median_period_ns(source.stamp_ns)
    if isinstance(source, Positions):
        std, order = float(np.sqrt(np.median(source.variance_m2[:, :2]))), 2
        velocity_std_mps = np.sqrt(12.0 / 5.0) * std / max(1.0, 5.0 * period_s)  # five fixes, at least one second
        least = _UNKNOWN_DENSITY * min(1.0, (velocity_std_mps / 0.5) ** 2)  # worse fixes do not resolve its change
        places = remove_xy_spikes(source.position_enu_m)
        axes = [places.real, places.imag]
    else:
        std, order = float(np.sqrt(np.median(source.variance_m2ps2[:, :2]))), 1
        axes = [source.velocity_enu_mps[:, 0], source.velocity_enu_mps[:, 1]]
    # The slope of a line through the samples of a window has σ = √12 times their noise / √(samples) / window. The
    # window is chosen for 0.15 m/s², 1σ: half of the change that masks detect.
    window_s = max(3.0 * period_s, (12.0 ** (order / 2.0) * std * period_s**0.5 / 0.15) ** (1.0 / (order + 0.5)))
    for _ in range(order):
        axes = [compute_slopes(source.stamp_ns, axis, window_s) for axis in axes]
    acceleration = np.minimum(np.hypot(*axes), MAX_ACCELERATION_MPS2)
    # The acceleration changes by 0.07 m/s², 1σ, between two measurements, and lasts for 0.2 s.
    density = np.maximum(max(0.2, period_s) * (0.07**2 + acceleration**2), least)
    return np.interp(at_ns, source.stamp_ns, density)


def _estimate_slide_density(visual: BodyVelocities | None) -> float:
    """Return the density of sideways and upward velocity [m²/s³] from visual odometry, or a default without it."""
    if visual is None or visual.stamp_ns.size < 3:
        return 4e-4
    slopes = [compute_slopes(visual.stamp_ns, visual.velocity_mps[:, axis], 1.0) for axis in (1, 2)]  # window [s]
    return max(_MIN_DENSITY, _ACCELERATION_LASTS_S * estimate_robust_std(np.array(slopes)) ** 2)
