"""Parameters of the estimator: prior and random walk of each.

Each parameter is an entry of the state. An unobservable parameter keeps its prior, and its uncertainty is part of the
uncertainty of the track. Noise of the sensors: `tcpipe.fusion.densities`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri

from tcpipe.arrays import Floats
from tcpipe.fusion import state
from tcpipe.fusion.densities import GaussMarkov, NoiseModel
from tcpipe.fusion.filter_kernel import FilterModel, Memory
from tcpipe.fusion.measurements import IMU, MAX_VARIANCE, VISUAL, WHEELS, InitialState, Measurements, Positions
from tcpipe.fusion.process import SLOPE_RAD, find_scale_stds, find_turn_scale_std, is_length_observable
from tcpipe.fusion.state import Error, Kind, Mode
from tcpipe.fusion.ticks import Ticks
from tcpipe.geometry.rotation import matrix_from_quat


@dataclass(frozen=True, slots=True)
class Parameter:
    """A parameter: index of its first error, number of errors, prior σ, and σ of the random walk in one second.

    A σ of 0 is set for each run; ``source`` says how.
    """

    name: str
    place: int
    count: int
    std: float
    walk: float
    unit: str
    source: str


PARAMETERS = (
    Parameter("gyroscope bias", Error.GYRO_BIAS, 3, 0.02, 0.0, "rad/s", "MEMS: 1°/s at turn-on; walk: `densities`"),
    Parameter("accelerometer bias", Error.ACCELEROMETER_BIAS, 3, 0.15, 3e-4, "m/s²", "MEMS: 15 mg, 1 mg in a run"),
    Parameter("antenna", Error.ARM, 3, 0.0, 0.0, "m", "stated or not: `Positions.lever_arm_std_m`"),
    Parameter("lag of fixes", Error.FIX_LAG, 1, 0.0, 1e-3, "s", "`Positions.lag_std_s`"),
    Parameter("wheel scale", Error.WHEEL_SCALE, 1, 0.0, 0.0, "1", "`process.find_scale_stds`; walk: `densities`"),
    Parameter("camera scale", Error.VISUAL_SCALE, 1, 0.0, 0.0, "1", "`process.find_scale_stds`; walk: `densities`"),
    Parameter("turn scale", Error.TURN_SCALE, 1, 0.0, 0.0, "1", "`process.find_turn_scale_std`"),
    Parameter(
        "turning centre", Error.TURNING_CENTRE, 1, 0.05, 0.0, "m", "skid-steered robots turn ahead of their middle"
    ),
    Parameter("mounting of the IMU", Error.MOUNT, 3, 0.0175, 0.0, "rad", "stated to a degree"),
    Parameter("mounting of the camera", Error.VISUAL_MOUNT, 2, 0.0175, 0.0, "rad", "stated to a degree"),
    Parameter("lag of wheels", Error.WHEEL_LAG, 1, 0.02, 1e-3, "s", "drivers stamp on arrival"),
    Parameter("lag of camera", Error.VISUAL_LAG, 1, 0.03, 1e-3, "s", "exposure and processing"),
    Parameter("mounting of the pose", Error.POSE_MOUNT, 3, 0.0, 0.0, "rad", "`Positions.mounting_std_rad`"),
    Parameter("frame of the pose", Error.POSE_FRAME, 3, 0.05, 2e-3, "rad", "level to 3°; drifts by 1° a minute"),
)
"""Parameters with a fixed prior; `make_priors` estimates scales of odometries and errors of fixes from the run."""
FIX_AXES = np.array([1.0, 1.0, 1.7])
"""Ratio of lasting errors of fixes east, north and up [1]: no satellite is below the antenna."""
_UNSEEN_SHARE = 0.25  # of the claimed variance [1]: errors that last hours (base, antenna, troposphere)
_MINUTE_S = 60.0


@dataclass(frozen=True, slots=True)
class Event:
    """Change of the error ``place`` at a tick by ``mean`` ± ``std``, or, if ``is_new``, a new draw from its prior."""

    tick: int
    place: int
    std: float = 0.0
    mean: float = 0.0
    is_new: bool = False


def make_priors(m: Measurements, noise: NoiseModel, ticks: Ticks) -> tuple[Floats, Floats, Floats]:
    """Return standard deviation, walk and correlation time of all errors, (45,): 0 if exact or without effect."""
    std, walk = np.zeros(state.N), np.zeros(state.N)
    has_imu = m.imu is not None
    inertial = bool((ticks.inputs.mode == Mode.INERTIAL).any())
    wanted = {
        "gyroscope bias": has_imu,
        "accelerometer bias": inertial,
        "lag of fixes": m.gnss is not None and m.has_tilt,
        "turning centre": has_imu,
        "mounting of the IMU": inertial,
        "mounting of the camera": m.visual is not None and bool(m.visual.measured.all()),
        "lag of wheels": inertial and m.wheels is not None,
        "lag of camera": inertial and m.visual is not None,
        "frame of the pose": m.has_attitude,
    }
    for parameter in PARAMETERS:
        if wanted.get(parameter.name, False):
            rows = slice(parameter.place, parameter.place + parameter.count)
            std[rows], walk[rows] = parameter.std, parameter.walk
    if m.imu is not None:
        walk[Error.GYRO_BIAS : Error.GYRO_BIAS + 3] = find_walk(noise.turns[IMU].correlated)
    scales = find_scale_stds(m, noise.horizontal)
    for role, place in ((WHEELS, Error.WHEEL_SCALE), (VISUAL, Error.VISUAL_SCALE)):
        if role in m.odometries() and scales[role]:
            # Within 100 s the mean of a varying scale changes as much as the scale varies.
            std[place], walk[place] = scales[role], np.sqrt(noise.odometries[role].correlated.variance / 100.0)
    time_s = np.full(state.N, np.inf)
    if m.odometries() and is_length_observable(m, noise.horizontal):
        # Only with fixes is the variation of a scale around its mean observable.
        slips = {WHEELS: Error.WHEEL_SLIP, VISUAL: Error.VISUAL_SLIP}
        varying = [(slips[role], noise.odometries[role].correlated) for role in m.odometries()]
        for error, process in (*varying, (Error.SHARED_SCALE, noise.shared_scale)):
            std[error], time_s[error] = np.sqrt(process.variance), process.time_s
    std[Error.TURN_SCALE] = find_turn_scale_std(m)
    # Wheels skid differently in each turn.
    walk[Error.TURN_SCALE] = 0.0 if has_imu else np.sqrt(2.0 / _MINUTE_S) * std[Error.TURN_SCALE]
    if m.gnss is not None:
        if wanted["lag of fixes"]:
            std[Error.FIX_LAG] = m.gnss.lag_std_s
        std[Error.ARM : Error.FIX_LAG] = np.where(_find_arm_axes(m), m.gnss.lever_arm_std_m, 0.0)
        std[Error.FIX_OFFSET : Error.FIX_OFFSET + 3] = _find_lasting_std_m(m.gnss, m, noise)
        std[Error.POSE_MOUNT : Error.POSE_MOUNT + 3] = m.gnss.mounting_std_rad if m.has_attitude else 0.0
        std[Error.FIX_ERROR : Error.FIX_ERROR + 3] = np.sqrt(ticks.fix_variance_m2[0])
    return std, walk, time_s


def _find_lasting_std_m(gnss: Positions, m: Measurements, noise: NoiseModel) -> Floats:
    """Return the standard deviation of the constant error of fixes in the section [m], shape (3,).

    It is the part of the claimed variance that the section does not show as noise, at least `_UNSEEN_SHARE` of it.
    Without measured tilt it includes the motion of the antenna by tilt. Without heights it includes that motion by
    slopes.
    """
    axes = [fix for fix in (noise.horizontal, noise.horizontal, noise.vertical) if fix is not None]
    observed, claimed = np.array([(fix.white + fix.correlated.variance, fix.claimed_m2) for fix in axes]).T
    variance = np.maximum(claimed - observed, _UNSEEN_SHARE * claimed * (claimed < MAX_VARIANCE))
    variance += np.where(_find_arm_axes(m), 0.0, np.square(gnss.lever_arm_std_m))
    if not m.has_tilt and (m.is_antenna_alone or not gnss.has_heights):
        variance[:2] += (SLOPE_RAD * gnss.lever_arm_m[2]) ** 2
    return np.asarray(np.sqrt(variance))


def _find_arm_axes(m: Measurements) -> tuple[bool, bool, bool]:
    """Return the axes along which the lever arm is observable by tilt; noise of a camera's roll mimics height."""
    return m.has_tilt, m.has_tilt, m.has_absolute_tilt


def find_walk(process: GaussMarkov) -> float:
    """Return the σ of the random walk in one second that reaches the σ of a Gauss-Markov process within a minute."""
    return float(np.sqrt(2.0 * process.variance * -np.expm1(-_MINUTE_S / process.time_s) / _MINUTE_S))


_BODY = (*range(Error.U, Error.GYRO_BIAS + 3), *range(Error.MOUNT, Error.MOUNT + 3))
_ANTENNA = (*range(Error.THETA, Error.THETA + 3), *_BODY, *range(Error.ARM, Error.FIX_LAG + 1))
_DEPENDS: Mapping[int, Sequence[int]] = {
    Kind.WHEELS: (*_BODY, Error.WHEEL_SCALE, Error.WHEEL_SLIP, Error.SHARED_SCALE, Error.WHEEL_LAG),
    Kind.SIDEWAYS: (*_BODY, Error.TURNING_CENTRE),
    Kind.VISUAL: (
        *_BODY,
        Error.VISUAL_SCALE,
        Error.VISUAL_SLIP,
        Error.SHARED_SCALE,
        Error.VISUAL_MOUNT,
        Error.VISUAL_MOUNT + 1,
        Error.VISUAL_LAG,
    ),
    Kind.STATIONARY: range(Error.U, Error.U + 3),
    Kind.STATIONARY_RATE: range(Error.GYRO_BIAS, Error.GYRO_BIAS + 3),
    Kind.LEVEL: range(3),
    Kind.DOPPLER: _ANTENNA,
    Kind.FIX: (*_ANTENNA, *range(Error.RHO, Error.RHO + 3), *range(Error.FIX_ERROR, Error.FIX_OFFSET + 3)),
    Kind.ATTITUDE: (
        *range(Error.THETA, Error.THETA + 3),
        *range(Error.GYRO_BIAS, Error.GYRO_BIAS + 3),
        Error.FIX_LAG,
        *range(Error.MOUNT, Error.MOUNT + 3),
        *range(Error.POSE_MOUNT, Error.POSE_FRAME + 3),
    ),
    state.KINDS: (*range(Error.GYRO_BIAS), Error.TURN_SCALE),
    state.KINDS + 1: (*range(state.MOVING), Error.TURN_SCALE),
}
"""Errors on which each kind of measurement depends; the last two: motion by odometry and by gyroscope."""


def make_model(
    m: Measurements,
    std: Floats,
    walk: Floats,
    events: Sequence[Event],
    *,
    period_s: float,
    gate_probability: float,
    time_s: Floats | None = None,
    possible: Sequence[int] = (),
) -> FilterModel:
    """Return the filter's model.

    ``possible``: errors that further events could change; with such errors there are no gate resets.
    """
    kept = np.ones(state.N) if time_s is None else np.exp(-period_s / time_s)
    involved = {event.place for event in events} | set(possible)
    active = np.array([e for e in range(state.N) if e < Error.GYRO_BIAS or std[e] or walk[e] or e in involved])
    position = {int(e): i for i, e in enumerate(active)}
    depends = np.zeros((state.KINDS + 2, active.size), np.int64)
    counts = np.zeros(state.KINDS + 2, np.int64)
    for row, errors in _DEPENDS.items():
        places = sorted(position[e] for e in errors if e in position)
        counts[row] = len(places)
        depends[row, : len(places)] = places
    gates = np.full(state.KINDS, np.inf)
    for kind in set(range(state.KINDS)) - {Kind.SIDEWAYS, Kind.LEVEL}:
        gates[kind] = chdtri(state.SIZES[kind], 1.0 - gate_probability)
    patience_s = np.full(state.KINDS, np.inf)
    if not possible:
        patience_s[[Kind.FIX, Kind.ATTITUDE]] = 1.0 if m.imu is None and m.visual is None else 5.0
    return FilterModel(
        active=active,
        depends=depends,
        counts=counts,
        kept=kept[active],
        noise=np.square(walk[active]) * period_s + np.square(std[active]) * (1.0 - kept[active] ** 2),
        gates=gates,
        patience_s=patience_s,
        mount=position.get(Error.MOUNT, -1),
        events=np.array([(e.tick, position[e.place], e.is_new) for e in events], np.int64).reshape(-1, 3),
        sizes=np.array([(std[e.place] if e.is_new else e.std) ** 2 for e in events], np.float64),
        shifts=np.array([e.mean for e in events], np.float64),
    )


def make_start(initial: InitialState, std: Floats, arm_m: Sequence[float]) -> Memory:
    """Return the state of all errors at the first tick."""
    x, P = np.zeros(state.NX), np.zeros((state.N, state.N))
    rotation = matrix_from_quat(initial.quat_xyzw)
    x[:9] = rotation.ravel()
    x[9:12] = initial.position_enu_m
    x[Error.U + 6 : Error.U + 9] = rotation.T @ initial.velocity_enu_mps
    np.fill_diagonal(P, std**2)
    if std[Error.GYRO_BIAS]:
        x[Error.GYRO_BIAS + 6 : Error.GYRO_BIAS + 9] = initial.gyro_bias_radps
        bias = range(Error.GYRO_BIAS, Error.GYRO_BIAS + 3)
        P[bias, bias] = initial.gyro_bias_std_radps**2
    x[Error.ARM + 6 : Error.ARM + 9] = arm_m
    level = np.diag(np.square([initial.tilt_std_rad, initial.tilt_std_rad, initial.yaw_std_rad]))
    P[0:3, 0:3] = rotation.T @ level @ rotation
    P[3:6, 3:6] = rotation.T @ np.diag(np.square(initial.position_std_m)) @ rotation
    P[6:9, 6:9] = np.eye(3) * initial.velocity_std_mps**2
    return Memory(x, P, np.zeros((state.KINDS, 2)))


def widen_start(start: Memory, std: Floats) -> Memory:
    """Return the start with the standard deviations ``std``, shape (45,), for the errors of fixes."""
    widened = start.copy()
    for place in range(Error.FIX_ERROR, Error.FIX_OFFSET + 3):
        widened.P[place, place] = std[place] ** 2
    # The start position comes from the first fixes: 5σ of their constant error.
    offset_m2 = np.square(5.0 * std[Error.FIX_OFFSET : Error.FIX_OFFSET + 3])
    widened.P[range(Error.RHO, Error.RHO + 3), range(Error.RHO, Error.RHO + 3)] += offset_m2
    return widened
