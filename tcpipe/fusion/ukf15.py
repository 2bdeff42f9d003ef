"""The paper's forward filter (section IV-A: GNSS, wheel odometry, IMU and visual odometry through one unscented Kalman filter).

Fifteen states as in robot_localization, moved by `tcpipe.fusion.ukf15_kernel` or, for comparison, by
`tcpipe.fusion.filterpy_engine`. What each sensor shows:

* GNSS: the position of its antenna, whose lever arm turns with the attitude.
* IMU: roll and pitch of its own attitude filter where it has one (its yaw may be magnetic or offset and is not used), angular
  velocity less the bias found at rest, and specific force, which is acceleration, the turning of the velocity, and gravity.
* Wheels: forward velocity; their yaw rate, which skids on turning, only where there is no gyroscope.
* Visual odometry: velocity of the camera, and yaw rate.
* The ground: sideways and vertical body velocity are about zero.

What no sensor shows is held near zero by a weak prior, since a random walk that nothing observes would grow until the sigma points
go round the circle. Estimates use the past only; the smoother is `tcpipe.fusion.error_state`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from tcpipe.fusion import ukf15_kernel as kernel
from tcpipe.fusion.measurements import (
    GNSS,
    IMU,
    VISUAL,
    WHEELS,
    BodyVelocities,
    InertialMeasurements,
    InitialState,
    Measurements,
)
from tcpipe.fusion.signals import find_chi_square_threshold, is_covered
from tcpipe.fusion.trajectory import DISPLACEMENT_LAGS_S, Rejections, Trajectory
from tcpipe.fusion.ukf15_kernel import ACCEPTED, NOT_RUN, RECOVERED, REJECTED, Events, FilterState, Outputs, Sources
from tcpipe.geometry.rotation import invert, quat_from_rpy, rotate, rpy_from_quat
from tcpipe.tables.facts import StretchFacts

_PLACE, _TURNING, _ACCELERATING = (
    tuple(range(kernel.STATES)[of]) for of in (kernel.POSITION, kernel.TURN, kernel.ACCELERATION)
)
"""Entries of the state, as a source names what it measures."""

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

_BLOCK = 4096  # outputs filtered at a time: bounds the memory of a long run
_GROUND = "ground"
_PRIOR = "prior"
_GROUND_PERIOD_NS = 50_000_000
_LEVEL_PERIOD_NS = 1_000_000_000
_CALM_STD_RADPS, _CALM_STD_MPS2, _LEVEL_STD_RAD = (0.05, 0.05, 1.0), 1.0, 0.15


@dataclass(frozen=True, slots=True)
class SensorRows:
    """A sensor, or a constraint, as the filter takes it.

    Attributes
    ----------
    role : whose measurements these are; constraints have roles of their own and are in no table.
    kind : `SELECT`, `ANTENNA`, `SPECIFIC_FORCE` or `SENSOR_VELOCITY` of `tcpipe.fusion.ukf15_kernel`.
    entries : which states (`SELECT`), or which of the sensor's three entries, are measured; at most six.
    stamp_ns : [ns], shape (N,), increasing.
    z, variance : shape (N, m), finite.
    lever_arm_m : [m], position of the sensor in base_link.
    """

    role: str
    kind: int
    entries: tuple[int, ...]
    stamp_ns: NDArray[np.int64]
    z: NDArray[np.float64]
    variance: NDArray[np.float64]
    lever_arm_m: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class ForwardResult:
    """Result of the filter.

    ``x`` and ``variance`` are states and variances at the wanted stamps, (K, 15); ``final`` the last state, (15,), and covariance, (15,
    15); ``nis`` and ``outcome``, by source, the normalised innovation squared and what became of each measurement.
    """

    x: NDArray[np.float64]
    variance: NDArray[np.float64]
    final: tuple[NDArray[np.float64], NDArray[np.float64]]
    nis: list[NDArray[np.float64]]
    outcome: list[NDArray[np.int8]]


def run_ukf15(
    measurements: Measurements,
    initial: InitialState,
    *,
    output_ns: NDArray[np.int64],
    gate_probability: float,
    engine: Literal["compiled", "filterpy"],
) -> Trajectory:
    """Return base_link's trajectory at ``output_ns`` by the paper's forward filter; each state uses the measurements up to its stamp.

    Parameters
    ----------
    measurements, initial : one section of a run, and its state at the first measurement.
    output_ns : [ns], shape (K,), increasing.
    gate_probability : a measurement less likely than this is rejected (χ² on its normalised innovation squared).
    engine : ``compiled`` or ``filterpy``.
    """
    sources = collect_sources(measurements, initial, end_ns=int(output_ns[-1]))
    gates = [_find_gate(source, gate_probability) for source in sources]
    x, P = _make_initial_state(initial)
    start_ns = min(int(source.stamp_ns[0]) for source in sources if source.stamp_ns.size)
    found = filter_forward(
        sources, gates, x=x, P=P, q=PROCESS_VARIANCE, start_ns=start_ns, output_ns=output_ns, engine=engine
    )
    quat = quat_from_rpy(*found.x[:, kernel.ANGLES].T)
    std = np.sqrt(found.variance)
    return Trajectory(
        stamp_ns=output_ns,
        position_enu_m=found.x[:, kernel.POSITION],
        quat_xyzw=quat,
        velocity_enu_mps=rotate(quat, found.x[:, kernel.VELOCITY]),
        angular_velocity_radps=found.x[:, kernel.TURN],
        position_std_m=std[:, kernel.POSITION],
        yaw_std_rad=std[:, kernel.YAW],
        forward_velocity_std_mps=std[:, kernel.VX],
        rejections=_make_rejections(sources, gates, found),
        displacement_std_m=np.full((output_ns.size, len(DISPLACEMENT_LAGS_S)), np.nan),
        facts=_make_facts(sources, found),
    )


def filter_forward(
    sources: Sequence[SensorRows],
    gates: Sequence[float],
    *,
    x: NDArray[np.float64],
    P: NDArray[np.float64],
    q: NDArray[np.float64],
    start_ns: int,
    output_ns: NDArray[np.int64],
    engine: Literal["compiled", "filterpy"] = "compiled",
) -> ForwardResult:
    """Run the 15-state filter over any sources.

    Parameters
    ----------
    sources : the measurements; of those with one stamp, the earlier source comes first.
    gates : per source, the largest normalised innovation squared that is fused.
    x, P : state, shape (15,), and covariance, shape (15, 15), at ``start_ns`` [ns]; nothing may be older.
    q : variance that each state gains in a second, shape (15,).
    output_ns : [ns], shape (K,), increasing.
    engine : ``compiled`` or ``filterpy``.
    """
    belief = FilterState(
        np.zeros(kernel.ROW), np.zeros((kernel.STATES, kernel.ROW)), np.zeros(1), np.zeros((len(sources), 2))
    )
    belief.x[: kernel.STATES], belief.P[:, : kernel.STATES] = x, P
    states, variances = np.empty((output_ns.size, kernel.STATES)), np.empty((output_ns.size, kernel.STATES))
    nis = [np.full(source.stamp_ns.size, np.nan) for source in sources]
    outcome = [np.full(source.stamp_ns.size, NOT_RUN, np.int8) for source in sources]
    packed = _pack_sources(sources, gates)
    run = _run_of(engine)
    reached = [0] * len(sources)
    for first in range(0, output_ns.size, _BLOCK):
        block = slice(first, first + _BLOCK)
        until = [int(np.searchsorted(s.stamp_ns, output_ns[block][-1], side="right")) for s in sources]
        rows = [slice(begin, end) for begin, end in zip(reached, until, strict=True)]
        events, order = _sort_events(sources, rows, start_ns)
        times_s = np.asarray((output_ns[block] - start_ns) * 1e-9, np.float64)
        outputs = Outputs(times_s, states[block], variances[block], np.empty(order.size), np.empty(order.size, np.int8))
        run(belief, np.asarray(q, np.float64), events, packed, outputs)
        cuts = np.cumsum([s.stop - s.start for s in rows])[:-1]
        for written, all_of in ((outputs.nis, nis), (outputs.outcome, outcome)):
            by_source = np.empty_like(written)
            by_source[order] = written
            for at, part in enumerate(np.split(by_source, cuts)):
                all_of[at][rows[at]] = part
        reached = until
    return ForwardResult(states, variances, (belief.x[: kernel.STATES], belief.P[:, : kernel.STATES]), nis, outcome)


def _run_of(engine: Literal["compiled", "filterpy"]) -> Callable[..., None]:
    if engine == "compiled":
        compiled: Callable[..., None] = kernel.run
        return compiled
    from tcpipe.fusion import filterpy_engine  # noqa: PLC0415  it takes more than a second to load

    return filterpy_engine.run


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
    ground = _make_zero_source(_GROUND, {kernel.VY: std, kernel.VZ: std}, start_ns, end_ns, _GROUND_PERIOD_NS)
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
    sources = [SensorRows(IMU, kernel.SELECT, _TURNING, imu.stamp_ns, turn, variance)]
    if imu.accelerometer_usable:
        variance = np.broadcast_to(imu.accelerometer_std_mps2**2, turn.shape)
        force = imu.specific_force_mps2
        sources.append(
            SensorRows(IMU, kernel.SPECIFIC_FORCE, (0, 1, 2), imu.stamp_ns, force, variance, imu.lever_arm_m)
        )
    known = np.isfinite(imu.quat_xyzw).all(axis=1)
    if known.any():
        tilt = rpy_from_quat(imu.quat_xyzw[known])[:, :2]
        variance = np.broadcast_to(TILT_STD_RAD**2, tilt.shape)
        sources.append(SensorRows(IMU, kernel.SELECT, (kernel.ROLL, kernel.PITCH), imu.stamp_ns[known], tilt, variance))
    return sources


def _make_velocity_sources(
    role: str, odometry: BodyVelocities | None, imu: InertialMeasurements | None = None
) -> list[SensorRows]:
    """One source for each combination of entries that the odometry gives; its yaw rate only where that ``imu`` gives none."""
    if odometry is None:
        return []
    lever = odometry.lever_arm_m
    kind = kernel.SENSOR_VELOCITY if any(lever) else kernel.SELECT
    first = 0 if any(lever) else kernel.VX
    known = np.isfinite(odometry.velocity_mps)
    per_second = 1e9 / float(np.median(np.diff(odometry.stamp_ns))) if odometry.stamp_ns.size > 1 else 1.0
    every_variance = odometry.variance_m2ps2 + per_second * np.square(SCALE_STD * odometry.velocity_mps)
    sources = []
    for pattern in np.unique(known, axis=0):
        rows, columns = (known == pattern).all(axis=1), np.flatnonzero(pattern)
        if columns.size:
            z, variance = odometry.velocity_mps[rows][:, columns], every_variance[rows][:, columns]
            entries = tuple(int(first + column) for column in columns)
            sources.append(SensorRows(role, kind, entries, odometry.stamp_ns[rows], z, variance, lever))
    rows = np.isfinite(odometry.yaw_rate_radps)
    if imu is not None:
        rows &= ~is_covered(imu.stamp_ns, odometry.stamp_ns, odometry.stamp_ns)
    if rows.any():
        z = odometry.yaw_rate_radps[rows, None]
        scale_std = SKID_STD if role == WHEELS else SCALE_STD
        variance = odometry.yaw_rate_var[rows, None] + per_second * np.square(scale_std * z)
        sources.append(SensorRows(role, kernel.SELECT, (kernel.WZ,), odometry.stamp_ns[rows], z, variance))
    return sources


def _make_gnss_sources(measurements: Measurements) -> list[SensorRows]:
    gnss = measurements.gnss
    if gnss is None:
        return []
    kind = kernel.ANTENNA if any(gnss.lever_arm_m) else kernel.SELECT
    return [SensorRows(GNSS, kind, _PLACE, gnss.stamp_ns, gnss.position_enu_m, gnss.variance_m2, gnss.lever_arm_m)]


def _make_zero_source(role: str, stds: Mapping[int, float], start_ns: int, end_ns: int, period_ns: int) -> SensorRows:
    """Return states that are zero to within their standard deviations, said again and again."""
    stamps = np.arange(start_ns + period_ns, end_ns + 1, period_ns, dtype=np.int64)
    z = np.zeros((stamps.size, len(stds)))
    return SensorRows(role, kernel.SELECT, tuple(stds), stamps, z, z + np.square(list(stds.values())))


def _make_priors(sensors: Sequence[SensorRows], start_ns: int, end_ns: int) -> list[SensorRows]:
    selected = {entry for source in sensors if source.kind == kernel.SELECT for entry in source.entries}
    force = any(source.kind == kernel.SPECIFIC_FORCE for source in sensors)
    calm = {state: std for state, std in zip(_TURNING, _CALM_STD_RADPS, strict=True) if state not in selected}
    calm |= {} if force else dict.fromkeys(_ACCELERATING, _CALM_STD_MPS2)
    level = {} if force or kernel.ROLL in selected else dict.fromkeys((kernel.ROLL, kernel.PITCH), _LEVEL_STD_RAD)
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
    x, std = np.zeros(kernel.STATES), np.empty(kernel.STATES)
    x[kernel.POSITION], std[kernel.POSITION] = initial.position_enu_m, initial.position_std_m
    x[kernel.ANGLES] = rpy_from_quat(initial.quat_xyzw)
    attitude_std = (initial.tilt_std_rad, initial.tilt_std_rad, initial.yaw_std_rad)
    std[kernel.ANGLES] = np.minimum(attitude_std, kernel.MAX_OPENED_RAD)  # sigma points lie at sqrt(15) deviations
    x[kernel.VELOCITY] = rotate(invert(initial.quat_xyzw), initial.velocity_enu_mps)
    std[kernel.VELOCITY], std[kernel.TURN], std[kernel.ACCELERATION] = initial.velocity_std_mps, 0.1, 0.5
    return x, np.diag(std**2)


def _sort_events(
    sources: Sequence[SensorRows], rows: Sequence[slice], start_ns: int
) -> tuple[Events, NDArray[np.int64]]:
    """Return these rows in order of time, and for each which one it was of those of the sources end to end."""
    stamp_ns = np.concatenate([source.stamp_ns[of] for source, of in zip(sources, rows, strict=True)])
    which = np.repeat(np.arange(len(sources), dtype=np.int8), [of.stop - of.start for of in rows])
    width = np.array([len(source.entries) for source in sources])[which]
    order = np.argsort(stamp_ns, kind="stable")
    return Events(
        time_s=np.asarray((stamp_ns[order] - start_ns) * 1e-9, np.float64),
        source=which[order],
        at=(np.cumsum(width) - width)[order],
        z=np.concatenate([source.z[of].ravel() for source, of in zip(sources, rows, strict=True)]),
        variance=np.concatenate([source.variance[of].ravel() for source, of in zip(sources, rows, strict=True)]),
    ), order


def _pack_sources(sources: Sequence[SensorRows], gates: Sequence[float]) -> Sources:
    entries = np.zeros((len(sources), 6), np.int64)
    for row, source in zip(entries, sources, strict=True):
        row[: len(source.entries)] = source.entries
    return Sources(
        kind=np.array([source.kind for source in sources], np.int64),
        width=np.array([len(source.entries) for source in sources], np.int64),
        entries=entries,
        lever_m=np.array([source.lever_arm_m for source in sources], np.float64),
        gate=np.array(gates, np.float64),
    )


def _make_rejections(sources: Sequence[SensorRows], gates: Sequence[float], found: ForwardResult) -> Rejections:
    refused = [outcome == REJECTED for outcome in found.outcome]
    count = [int(rows.sum()) for rows in refused]
    stamp_ns = np.concatenate([source.stamp_ns[rows] for source, rows in zip(sources, refused, strict=True)])
    order = np.argsort(stamp_ns, kind="stable")
    role = np.repeat([source.role for source in sources], count)[order]
    nis = np.concatenate([nis[rows] for nis, rows in zip(found.nis, refused, strict=True)])[order]
    return Rejections(stamp_ns[order], role, np.full(role.size, "gate"), nis, np.repeat(gates, count)[order])


def _make_facts(sources: Sequence[SensorRows], found: ForwardResult) -> StretchFacts:
    measurements, rejected, recovered, nis_mean = {}, {}, {}, dict[str, float | None]()
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
        recovered[role] = int((outcome == RECOVERED).sum())
        nis_mean[role] = float(nis[accepted].sum() / freedom[accepted].sum()) if accepted.any() else None
    return StretchFacts(nis_mean, measurements, rejected, recovered=recovered)
