"""The paper's forward filter (section IV-A: GNSS, wheel odometry, IMU and visual odometry through one unscented Kalman filter).

State, in this order: position x y z [m] in the ENU plane; roll, pitch, yaw [rad]; body velocity [m/s]; body angular velocity
[rad/s]; body acceleration, which is the derivative of the body velocity [m/s²]. The process holds angular velocity and
acceleration constant, as in robot_localization (T. Moore and D. Stouch, A Generalized Extended Kalman Filter Implementation for the
Robot Operating System, 2014). What each sensor shows:

* GNSS: the position of its antenna, whose lever arm turns with the attitude.
* IMU: roll and pitch of its own attitude filter where it has one (its yaw may be magnetic or offset and is not used), angular
  velocity less the bias found at rest, and specific force, which is acceleration, the turning of the velocity, and gravity.
* Wheels: forward velocity; their yaw rate, which skids on turning, only where there is no gyroscope.
* Visual odometry: velocity of the camera, and yaw rate.
* The ground: sideways and vertical body velocity are about zero.

What no sensor shows is held near zero by a weak prior, since a random walk that nothing observes would grow until the sigma points
go round the circle. Estimates use the past only; the smoother is `tcpipe.fusion.error_state`.

filterpy 2.0.0 does the scaled unscented transform (E. A. Wan and R. van der Merwe, 2000) with alpha = 1, kappa = 0, beta = 2, so that
the points lie at sqrt(15) deviations and no weight is negative.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from heapq import merge
from itertools import count, repeat

import numpy as np
from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter
from numpy.typing import NDArray

from tcpipe.fusion.measurements import (
    DISPLACEMENT_LAGS_S,
    GNSS,
    IMU,
    VISUAL,
    WHEELS,
    BodyVelocities,
    InertialMeasurements,
    InitialState,
    Measurements,
    Rejections,
    Trajectory,
)
from tcpipe.fusion.signals import find_chi_square_threshold, is_covered
from tcpipe.fusion.state import GRAVITY_MPS2
from tcpipe.geometry.rotation import invert, quat_from_rpy, rotate, rpy_from_quat, wrap_to_pi
from tcpipe.tables.facts import StretchFacts

STATES = 15
"""Length of the state."""
X, Y, Z, ROLL, PITCH, YAW, VX, VY, VZ, WX, WY, WZ, AX, AY, AZ = range(STATES)
"""Place of each entry in the state: position, angles, velocity, angular velocity, acceleration."""
POSITION, ANGLES, VELOCITY, TURN, ACCELERATION = (slice(first, first + 3) for first in (X, ROLL, VX, WX, AX))

NOT_RUN, ACCEPTED, REJECTED, RECOVERED = range(4)
"""Outcome of a measurement: not reached; fused; rejected by the gate; fused outside the gate after its states were opened up."""

PROCESS_VARIANCE = np.array([1e-4] * 3 + [1e-4] * 3 + [1e-2] * 3 + [1.0] * 3 + [2.0] * 3)
"""Variance that each state gains in a second, shape (15,): angular velocity changes by 1 rad/s, acceleration by 1.4 m/s², in a second
of rough ground; the small rest stands for gyroscope bias and for what constant acceleration leaves out."""

TILT_STD_RAD = 0.05
"""Roll and pitch of an IMU's own attitude filter: their error lasts for seconds, so that each one of many says little [rad]."""

SCALE_STD = 0.03
"""Wheels slip and a camera's scale is off by some per cent, for seconds on end: what odometry says in one second shares this error, so
that its many messages are worth a few. Without it the filter trusts slipping wheels against the GNSS and is wrong in outages."""

SKID_STD = 0.2
"""Likewise of the yaw rate of wheels that skid when they turn."""

MAX_STEP_S = 0.1
"""Longer predictions are divided, so that an angle's deviation stays far below pi [s]."""

MAX_OPENED_RAD = 0.5
"""No angle is opened up further than this: sigma points must not go round the circle [rad]."""

_LOCKOUT_S, _LOCKOUT_COUNT = 5.0, 5
_GROUND = "ground"
_PRIOR = "prior"
_GROUND_PERIOD_NS = 50_000_000
_LEVEL_PERIOD_NS = 1_000_000_000
_CALM_STD = dict(zip(range(WX, STATES), (0.05, 0.05, 1.0, 1.0, 1.0, 1.0), strict=True))
"""Of angular velocity [rad/s] and acceleration [m/s²] that no sensor shows."""
_LEVEL_STD_RAD = 0.15

_Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class SensorRows:
    """A sensor, or a constraint, as the filter takes it.

    Attributes
    ----------
    role : whose measurements these are; constraints have roles of their own and are in no table.
    entries : the states that are measured: position, velocity and acceleration where the sensor sits, the others of base_link.
    stamp_ns : [ns], shape (N,), increasing.
    z, variance : shape (N, m), finite.
    lever_arm_m : [m], position of the sensor in base_link.
    is_specific_force : the acceleration is what an accelerometer feels, with gravity and the turning of the velocity.
    """

    role: str
    entries: tuple[int, ...]
    stamp_ns: NDArray[np.int64]
    z: _Array
    variance: _Array
    lever_arm_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    is_specific_force: bool = False


@dataclass(frozen=True, slots=True)
class ForwardResult:
    """Result of the filter.

    ``x`` and ``variance`` are states and variances at the wanted stamps, (K, 15); ``nis`` and ``outcome``, by source, the normalised
    innovation squared and what became of each measurement.
    """

    x: _Array
    variance: _Array
    nis: list[_Array]
    outcome: list[NDArray[np.int8]]


def run_ukf15(
    measurements: Measurements, initial: InitialState, *, output_ns: NDArray[np.int64], gate_probability: float
) -> Trajectory:
    """Return base_link's trajectory at ``output_ns`` by the paper's forward filter; each state uses the measurements up to its stamp.

    Parameters
    ----------
    measurements, initial : one section of a run, and its state at the first measurement.
    output_ns : [ns], shape (K,), increasing.
    gate_probability : a measurement less likely than this is rejected (χ² on its normalised innovation squared).
    """
    sources = collect_sources(measurements, initial, end_ns=int(output_ns[-1]))
    gates = [_find_gate(source, gate_probability) for source in sources]
    x, P = _make_initial_state(initial)
    start_ns = min(int(source.stamp_ns[0]) for source in sources if source.stamp_ns.size)
    found = filter_forward(sources, gates, x=x, P=P, q=PROCESS_VARIANCE, start_ns=start_ns, output_ns=output_ns)
    quat = quat_from_rpy(*found.x[:, ANGLES].T)
    std = np.sqrt(found.variance)
    return Trajectory(
        stamp_ns=output_ns,
        position_enu_m=found.x[:, POSITION],
        quat_xyzw=quat,
        velocity_enu_mps=rotate(quat, found.x[:, VELOCITY]),
        angular_velocity_radps=found.x[:, TURN],
        position_std_m=std[:, POSITION],
        yaw_std_rad=std[:, YAW],
        forward_velocity_std_mps=std[:, VX],
        rejections=_make_rejections(sources, gates, found),
        displacement_std_m=np.full((output_ns.size, len(DISPLACEMENT_LAGS_S)), np.nan),
        facts=_make_facts(sources, found),
    )


def filter_forward(
    sources: Sequence[SensorRows],
    gates: Sequence[float],
    *,
    x: _Array,
    P: _Array,
    q: _Array,
    start_ns: int,
    output_ns: NDArray[np.int64],
) -> ForwardResult:
    """Run the 15-state filter over any sources.

    When a gate has rejected every measurement of a source for 5 s (and five of them), the estimate is wrong: the variance of the states
    that the source measures is inflated by the innovation, the measurement is fused, and its outcome is `RECOVERED`.

    Parameters
    ----------
    sources : the measurements; of those with one stamp, the earlier source comes first.
    gates : per source, the largest normalised innovation squared that is fused.
    x, P : state, shape (15,), and covariance, shape (15, 15), at ``start_ns`` [ns]; nothing may be older.
    q : variance that each state gains in a second, shape (15,).
    output_ns : [ns], shape (K,), increasing.
    """
    ukf, clock_ns = _Filter(x, P), start_ns
    states, variances = np.empty((2, output_ns.size, STATES))
    nis = [np.full(source.stamp_ns.size, np.nan) for source in sources]
    outcome = [np.full(source.stamp_ns.size, NOT_RUN, np.int8) for source in sources]
    rejected_since_ns: list[list[int]] = [[] for _ in sources]
    for stamp_ns, series, row in _iterate_events([*(source.stamp_ns for source in sources), output_ns]):
        ukf.advance(q, (stamp_ns - clock_ns) * 1e-9)
        clock_ns = stamp_ns
        if series == len(sources):
            states[row], variances[row] = ukf.x, np.diag(ukf.P)
            if row == output_ns.size - 1:
                break
            continue
        source, rejected = sources[series], rejected_since_ns[series]
        nis[series][row] = ukf.fuse(source, row, gates[series])
        outcome[series][row] = ACCEPTED
        if nis[series][row] <= gates[series]:
            rejected.clear()
            continue
        outcome[series][row] = REJECTED
        rejected.append(stamp_ns)
        if len(rejected) >= _LOCKOUT_COUNT and stamp_ns - rejected[0] >= _LOCKOUT_S * 1e9:
            ukf.open_up(source, row)
            ukf.fuse(source, row, math.inf)
            outcome[series][row] = RECOVERED
            rejected.clear()
    return ForwardResult(states, variances, nis, outcome)


def _iterate_events(stamps_ns: Sequence[NDArray[np.int64]]) -> Iterator[tuple[int, int, int]]:
    """Yield stamp [ns], series and row in order of time; of one stamp, the earlier series first."""
    return merge(*(zip(map(int, stamps), repeat(series), count()) for series, stamps in enumerate(stamps_ns)))


def predict_states(x: _Array, dt: float) -> _Array:
    """Return states, shape (M, 15), after ``dt`` [s] of constant body acceleration and angular velocity."""
    roll, pitch, _ = angles = x[:, ANGLES].T
    wx, wy, wz = x[:, TURN].T
    about_up = np.sin(roll) * wy + np.cos(roll) * wz
    moved = x.copy()
    moved[:, POSITION] += rotate(quat_from_rpy(*angles), dt * x[:, VELOCITY] + 0.5 * dt**2 * x[:, ACCELERATION])
    moved[:, ROLL] += dt * (wx + np.tan(pitch) * about_up)
    moved[:, PITCH] += dt * (np.cos(roll) * wy - np.sin(roll) * wz)
    moved[:, YAW] += dt * about_up / np.cos(pitch)
    moved[:, VELOCITY] += dt * x[:, ACCELERATION]
    return moved


def predict_measurements(x: _Array, source: SensorRows) -> _Array:
    """Return what a source would measure in states, shape (M, 15): shape (M, m)."""
    if not source.is_specific_force and not any(source.lever_arm_m):
        return x[:, source.entries]
    shown, turn = x.copy(), x[:, TURN]
    shown[:, VELOCITY] += np.cross(turn, source.lever_arm_m)
    if X in source.entries:
        shown[:, POSITION] += rotate(quat_from_rpy(*x[:, ANGLES].T), source.lever_arm_m)
    if source.is_specific_force:
        up = rotate(invert(quat_from_rpy(*x[:, ANGLES].T)), (0.0, 0.0, GRAVITY_MPS2))
        shown[:, ACCELERATION] += np.cross(turn, shown[:, VELOCITY]) + up
    return shown[:, source.entries]


class _Filter(UnscentedKalmanFilter):  # type: ignore[misc]  # filterpy has no annotations
    """filterpy's filter, with what it lacks: angles on a circle, a covariance kept positive definite, all sigma points at once.

    filterpy takes a function of one sigma point; 31 calls for each measurement would take five times as long.
    """

    def __init__(self, x: _Array, P: _Array) -> None:
        points = MerweScaledSigmaPoints(STATES, alpha=1.0, beta=2.0, kappa=0.0)
        mean, difference = _make_circular_functions((ROLL, PITCH, YAW))
        super().__init__(STATES, 1, 0.0, None, None, points, x_mean_fn=mean, residual_x=difference)
        self.x, self.P = x.copy(), P.copy()

    def advance(self, q: _Array, dt: float) -> None:
        """Predict over ``dt`` [s] in equal steps of at most 0.1 s."""
        steps = math.ceil(dt / MAX_STEP_S - 1e-9) if dt > 0.0 else 0
        for _ in range(steps):
            self.Q = np.diag(q * (dt / steps))
            self.predict(dt / steps, _transform)
            self.x[ANGLES] = wrap_to_pi(self.x[ANGLES])

    def fuse(self, source: SensorRows, row: int, gate: float) -> float:
        """Fuse one measurement unless its normalised innovation squared, which is returned, exceeds the gate."""
        self.sigmas_f = self._draw_points()  # filterpy would use those of the last prediction
        shown = iter(predict_measurements(self.sigmas_f, source))
        on_circle = tuple(k for k, entry in enumerate(source.entries) if ROLL <= entry <= YAW)
        self.z_mean, self.residual_z = _make_circular_functions(on_circle)
        x, P = self.x, self.P
        self.update(source.z[row], np.diag(source.variance[row]), _transform, lambda _: next(shown))
        nis = float(self.y @ self.SI @ self.y)
        if not nis <= gate:
            self.x, self.P = x, P
        self.x[ANGLES] = wrap_to_pi(self.x[ANGLES])
        return nis

    def open_up(self, source: SensorRows, row: int) -> None:
        """Add the squared innovation to the variance of the states that a source shows; positions open the yaw, which leads them astray."""
        innovation = source.z[row] - predict_measurements(self.x[None], source)[0]
        for entry, y in zip(source.entries, innovation, strict=True):
            self.P[entry, entry] += (min(abs(float(wrap_to_pi(y))), MAX_OPENED_RAD) if ROLL <= entry <= YAW else y) ** 2
            if entry == X:
                self.P[YAW, YAW] += MAX_OPENED_RAD**2

    def _draw_points(self) -> _Array:
        """Return sigma points; where rounding has made the covariance useless, keep its variances alone."""
        try:
            return np.asarray(self.points_fn.sigma_points(self.x, self.P))
        except np.linalg.LinAlgError:
            self.P = np.diag(np.maximum(np.abs(np.diag(self.P)), 1e-12))
            return np.asarray(self.points_fn.sigma_points(self.x, self.P))

    def compute_process_sigmas(self, dt: float, _fx: None = None) -> None:
        """As filterpy calls it."""
        self.sigmas_f = predict_states(self._draw_points(), dt)

    def cross_variance(self, x: _Array, z: _Array, sigmas_f: _Array, sigmas_h: _Array) -> _Array:
        """As filterpy calls it."""
        return np.asarray(self.residual_x(sigmas_f, x).T * self.Wc @ self.residual_z(sigmas_h, z))


def _transform(  # noqa: PLR0917  filterpy gives positional arguments
    sigmas: _Array,
    Wm: _Array,
    Wc: _Array,
    noise: _Array,
    mean: Callable[..., _Array],
    difference: Callable[..., _Array],
) -> tuple[_Array, _Array]:
    """Return mean and covariance of sigma points, as filterpy calls it."""
    centre = mean(sigmas, Wm)
    deviations = difference(sigmas, centre)
    return centre, deviations.T * Wc @ deviations + noise


@cache
def _make_circular_functions(
    angles: tuple[int, ...],
) -> tuple[Callable[[_Array, _Array], _Array], Callable[[_Array, _Array], _Array]]:
    """Return the mean of sigma points and the difference of vectors whose entries ``angles`` lie on a circle."""
    on_circle = list(angles)

    def mean(points: _Array, weights: _Array) -> _Array:
        found = weights @ points
        found[on_circle] = np.arctan2(weights @ np.sin(points[:, on_circle]), weights @ np.cos(points[:, on_circle]))
        return found

    def difference(a: _Array, b: _Array) -> _Array:
        found = np.subtract(a, b)
        found[..., on_circle] = wrap_to_pi(found[..., on_circle])
        return found

    return (mean, difference) if angles else (lambda points, weights: weights @ points, np.subtract)


def collect_sources(measurements: Measurements, initial: InitialState, *, end_ns: int) -> list[SensorRows]:
    """Return what the filter fuses of a section: its sensors, the ground, and priors for unobservable states; constraints up to ``end_ns``.

    Measurements of one stamp are fused in this order.
    """
    imu = measurements.imu
    sensors = (
        _make_imu_sources(measurements, initial)
        + _make_velocity_sources(WHEELS, measurements.wheels, imu)
        + _make_velocity_sources(VISUAL, measurements.visual)
        + _make_gnss_sources(measurements)
    )
    start_ns = min(int(source.stamp_ns[0]) for source in sensors if source.stamp_ns.size)
    std = measurements.nonholonomic_std_mps
    ground = _make_zero_source(_GROUND, {VY: std, VZ: std}, start_ns, end_ns, _GROUND_PERIOD_NS)
    priors = _make_priors(sensors, start_ns, end_ns)
    if imu is not None:  # in its gaps the filter must not go on turning and accelerating as it did before them
        priors += _select_in_gaps(
            imu, _make_priors([source for source in sensors if source.role != IMU], start_ns, end_ns)
        )
    return [*sensors, ground, *priors]


def _make_imu_sources(measurements: Measurements, initial: InitialState) -> list[SensorRows]:
    imu = measurements.imu
    if imu is None:
        return []
    turn = imu.angular_velocity_radps - initial.gyro_bias_radps
    variance = np.broadcast_to(imu.gyro_std_radps**2, turn.shape)
    sources = [SensorRows(IMU, (WX, WY, WZ), imu.stamp_ns, turn, variance)]
    if imu.accelerometer_usable:
        variance = np.broadcast_to(imu.accelerometer_std_mps2**2, turn.shape)
        force = imu.specific_force_mps2
        sources.append(
            SensorRows(IMU, (AX, AY, AZ), imu.stamp_ns, force, variance, imu.lever_arm_m, is_specific_force=True)
        )
    known = np.isfinite(imu.quat_xyzw).all(axis=1)
    if known.any():
        tilt = rpy_from_quat(imu.quat_xyzw[known])[:, :2]
        variance = np.broadcast_to(TILT_STD_RAD**2, tilt.shape)
        sources.append(SensorRows(IMU, (ROLL, PITCH), imu.stamp_ns[known], tilt, variance))
    return sources


def _make_velocity_sources(
    role: str, odometry: BodyVelocities | None, imu: InertialMeasurements | None = None
) -> list[SensorRows]:
    """One source for each combination of entries that the odometry gives; its yaw rate only where that ``imu`` gives none."""
    if odometry is None:
        return []
    lever = odometry.lever_arm_m
    known = np.isfinite(odometry.velocity_mps)
    per_second = 1e9 / float(np.median(np.diff(odometry.stamp_ns))) if odometry.stamp_ns.size > 1 else 1.0
    every_variance = odometry.variance_m2ps2 + per_second * np.square(SCALE_STD * odometry.velocity_mps)
    sources = []
    for pattern in np.unique(known, axis=0):
        rows, columns = (known == pattern).all(axis=1), np.flatnonzero(pattern)
        if columns.size:
            z, variance = odometry.velocity_mps[rows][:, columns], every_variance[rows][:, columns]
            entries = tuple(int(VX + column) for column in columns)
            sources.append(SensorRows(role, entries, odometry.stamp_ns[rows], z, variance, lever))
    rows = np.isfinite(odometry.yaw_rate_radps)
    if imu is not None:
        rows &= ~is_covered(imu.stamp_ns, odometry.stamp_ns, odometry.stamp_ns)
    if rows.any():
        z = odometry.yaw_rate_radps[rows, None]
        scale_std = SKID_STD if role == WHEELS else SCALE_STD
        variance = odometry.yaw_rate_var[rows, None] + per_second * np.square(scale_std * z)
        sources.append(SensorRows(role, (WZ,), odometry.stamp_ns[rows], z, variance))
    return sources


def _make_gnss_sources(measurements: Measurements) -> list[SensorRows]:
    gnss = measurements.gnss
    if gnss is None:
        return []
    return [SensorRows(GNSS, (X, Y, Z), gnss.stamp_ns, gnss.position_enu_m, gnss.variance_m2, gnss.lever_arm_m)]


def _make_zero_source(role: str, stds: Mapping[int, float], start_ns: int, end_ns: int, period_ns: int) -> SensorRows:
    """Return states that are zero to within their standard deviations, said again and again."""
    stamps = np.arange(start_ns + period_ns, end_ns + 1, period_ns, dtype=np.int64)
    z = np.zeros((stamps.size, len(stds)))
    return SensorRows(role, tuple(stds), stamps, z, z + np.square(list(stds.values())))


def _make_priors(sensors: Sequence[SensorRows], start_ns: int, end_ns: int) -> list[SensorRows]:
    shown = {entry for source in sensors for entry in source.entries}
    calm = {state: std for state, std in _CALM_STD.items() if state not in shown}
    level = {} if shown & {ROLL, AX} else dict.fromkeys((ROLL, PITCH), _LEVEL_STD_RAD)
    return [
        _make_zero_source(_PRIOR, stds, start_ns, end_ns, period_ns)
        for stds, period_ns in ((calm, _GROUND_PERIOD_NS), (level, _LEVEL_PERIOD_NS))
        if stds
    ]


def _select_in_gaps(imu: InertialMeasurements, sources: Sequence[SensorRows]) -> list[SensorRows]:
    """Return the rows of sources that lie in gaps of an IMU; without any, none."""
    found = []
    for source in sources:
        rows = ~is_covered(imu.stamp_ns, source.stamp_ns, source.stamp_ns)
        if rows.any():
            inside = {name: getattr(source, name)[rows] for name in ("stamp_ns", "z", "variance")}
            found.append(replace(source, **inside))
    return found


def _find_gate(source: SensorRows, probability: float) -> float:
    if source.role in {_GROUND, _PRIOR}:
        return math.inf
    return find_chi_square_threshold(len(source.entries), probability)


def _make_initial_state(initial: InitialState) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    x, std = np.zeros(STATES), np.empty(STATES)
    x[POSITION], std[POSITION] = initial.position_enu_m, initial.position_std_m
    x[ANGLES] = rpy_from_quat(initial.quat_xyzw)
    attitude_std = (initial.tilt_std_rad, initial.tilt_std_rad, initial.yaw_std_rad)
    std[ANGLES] = np.minimum(attitude_std, MAX_OPENED_RAD)  # sigma points lie at sqrt(15) deviations
    x[VELOCITY] = rotate(invert(initial.quat_xyzw), initial.velocity_enu_mps)
    std[VELOCITY], std[TURN], std[ACCELERATION] = initial.velocity_std_mps, 0.1, 0.5
    return x, np.diag(std**2)


def _make_rejections(sources: Sequence[SensorRows], gates: Sequence[float], found: ForwardResult) -> Rejections:
    refused = [outcome == REJECTED for outcome in found.outcome]
    counts = [int(rows.sum()) for rows in refused]
    stamp_ns = np.concatenate([source.stamp_ns[rows] for source, rows in zip(sources, refused, strict=True)])
    order = np.argsort(stamp_ns, kind="stable")
    role = np.repeat([source.role for source in sources], counts)[order]
    nis = np.concatenate([nis[rows] for nis, rows in zip(found.nis, refused, strict=True)])[order]
    return Rejections(stamp_ns[order], role, np.full(role.size, "gate"), nis, np.repeat(gates, counts)[order])


def _make_facts(sources: Sequence[SensorRows], found: ForwardResult) -> StretchFacts:
    measurements, rejected, nis_mean = {}, {}, dict[str, float | None]()
    for role in (GNSS, IMU, WHEELS, VISUAL):
        mine = [at for at, source in enumerate(sources) if source.role == role]
        if not mine:
            continue
        outcome = np.concatenate([found.outcome[at] for at in mine])
        freedom = np.concatenate([np.full(found.nis[at].size, len(sources[at].entries)) for at in mine])
        accepted = outcome == ACCEPTED
        nis = np.concatenate([found.nis[at] for at in mine])
        measurements[role] = int((outcome != NOT_RUN).sum())
        rejected[role] = int((outcome == REJECTED).sum())
        nis_mean[role] = float(nis[accepted].sum() / freedom[accepted].sum()) if accepted.any() else None
    return StretchFacts(nis_mean, measurements, rejected)
