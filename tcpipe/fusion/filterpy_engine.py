"""The paper's forward filter run through filterpy 2.0.0: the same model, slowly, as reference (``engine = "filterpy"``).

Model and measurements are written here a second time, in plain numpy and independent of the kernel, so that agreement means
something. Two defects of filterpy are worked around: ``update`` reuses the sigma points of the last ``predict``, so they are
drawn anew from (x, P) before each update; angles are averaged and subtracted on the circle by functions handed to it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter
from numpy.typing import NDArray

from tcpipe.fusion import ukf15_kernel as kernel
from tcpipe.fusion.ukf15_kernel import ACCEPTED, RECOVERED, REJECTED, Events, FilterState, Outputs, Sources
from tcpipe.geometry.rotation import wrap_to_pi

_ANGLE_ENTRIES = (kernel.ROLL, kernel.PITCH, kernel.YAW)
_Array = NDArray[np.float64]


class _Measurement(NamedTuple):
    """One event: kind of source, its entries, lever arm, measurement and variance."""

    kind: int
    entries: NDArray[np.int64]
    lever_m: _Array
    z: _Array
    variance: _Array


def _make_measurement(events: Events, sources: Sources, e: int) -> _Measurement:
    s = int(events.source[e])
    entries = sources.entries[s, : sources.width[s]]
    here = slice(int(events.at[e]), int(events.at[e]) + entries.size)
    return _Measurement(int(sources.kind[s]), entries, sources.lever_m[s], events.z[here], events.variance[here])


def _make_circular_functions(
    angles: tuple[int, ...],
) -> tuple[Callable[[_Array, _Array], _Array], Callable[[_Array, _Array], _Array]]:
    """Return the mean of sigma points and the difference of two vectors whose entries ``angles`` lie on a circle."""
    on_circle = list(angles)

    def mean(points: _Array, weights: _Array) -> _Array:
        found = weights @ points
        found[on_circle] = np.arctan2(weights @ np.sin(points[:, on_circle]), weights @ np.cos(points[:, on_circle]))
        return found

    def difference(a: _Array, b: _Array) -> _Array:
        found = np.subtract(a, b)
        found[on_circle] = wrap_to_pi(found[on_circle])
        return found

    return mean, difference


def map_from_body(roll_rad: float, pitch_rad: float, yaw_rad: float) -> _Array:
    """Return Rz(yaw)·Ry(pitch)·Rx(roll), shape (3, 3)."""
    sr, cr, sp, cp = math.sin(roll_rad), math.cos(roll_rad), math.sin(pitch_rad), math.cos(pitch_rad)
    sy, cy = math.sin(yaw_rad), math.cos(yaw_rad)
    about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    about_z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    return np.asarray(about_z @ about_y @ about_x)


def process(x: _Array, dt: float) -> _Array:
    """Return the state after ``dt`` [s] of constant body acceleration and angular velocity, shape (15,)."""
    roll, pitch, yaw = x[kernel.ANGLES]
    euler_rates = np.array(
        [
            [1.0, math.sin(roll) * math.tan(pitch), math.cos(roll) * math.tan(pitch)],
            [0.0, math.cos(roll), -math.sin(roll)],
            [0.0, math.sin(roll) / math.cos(pitch), math.cos(roll) / math.cos(pitch)],
        ]
    )
    moved = x.copy()
    moved[kernel.POSITION] += map_from_body(roll, pitch, yaw) @ (
        x[kernel.VELOCITY] * dt + 0.5 * x[kernel.ACCELERATION] * dt**2
    )
    moved[kernel.ANGLES] += euler_rates @ x[kernel.TURN] * dt
    moved[kernel.VELOCITY] += x[kernel.ACCELERATION] * dt
    return moved


def observe(x: _Array, kind: int, entries: NDArray[np.int64], lever_m: _Array) -> _Array:
    """Return what a source of this kind shows in state ``x``, shape (m,)."""
    velocity = x[kernel.VELOCITY] + np.cross(x[kernel.TURN], lever_m)
    if kind == kernel.SELECT:
        seen = x
    elif kind == kernel.ANTENNA:
        seen = x[kernel.POSITION] + map_from_body(*x[kernel.ANGLES]) @ lever_m
    elif kind == kernel.SENSOR_VELOCITY:
        seen = velocity
    else:
        up = map_from_body(*x[kernel.ANGLES]).T @ np.array([0.0, 0.0, kernel.GRAVITY_MPS2])
        seen = x[kernel.ACCELERATION] + np.cross(x[kernel.TURN], velocity) + up
    return np.asarray(seen[entries])


def _make_filter(belief: FilterState) -> UnscentedKalmanFilter:
    points = MerweScaledSigmaPoints(kernel.STATES, alpha=1.0, beta=2.0, kappa=0.0)
    mean, difference = _make_circular_functions(_ANGLE_ENTRIES)
    ukf = UnscentedKalmanFilter(
        dim_x=kernel.STATES,
        dim_z=1,
        dt=0.0,
        hx=observe,
        fx=process,
        points=points,
        x_mean_fn=mean,
        residual_x=difference,
    )
    ukf.x, ukf.P = belief.x[: kernel.STATES].copy(), belief.P[:, : kernel.STATES].copy()
    return ukf


def _advance(ukf: UnscentedKalmanFilter, q: _Array, dt: float) -> None:
    steps = max(1, math.ceil(dt / kernel.MAX_STEP_S - 1e-9)) if dt > 0.0 else 0
    for _ in range(steps):
        ukf.Q = np.diag(q) * (dt / steps)
        ukf.predict(dt=dt / steps)
        ukf.x[kernel.ANGLES] = wrap_to_pi(ukf.x[kernel.ANGLES])


def _update(ukf: UnscentedKalmanFilter, measured: _Measurement, gate: float) -> float:
    """Fuse one measurement unless its normalised innovation squared, which is returned, exceeds the gate."""
    kind, entries, lever_m, z, variance = measured
    ukf.sigmas_f = ukf.points_fn.sigma_points(ukf.x, ukf.P)
    angles = tuple(k for k, state in enumerate(entries) if kind == kernel.SELECT and state in _ANGLE_ENTRIES)
    ukf.z_mean, ukf.residual_z = _make_circular_functions(angles)
    before = ukf.x.copy(), ukf.P.copy()
    ukf.update(z, R=np.diag(variance), kind=kind, entries=entries, lever_m=lever_m)
    nis = float(ukf.y @ np.linalg.solve(ukf.S, ukf.y))
    if not nis <= gate:
        ukf.x, ukf.P = before
    ukf.x[kernel.ANGLES] = wrap_to_pi(ukf.x[kernel.ANGLES])
    return nis


def _open_up(ukf: UnscentedKalmanFilter, measured: _Measurement) -> None:
    innovation = measured.z - observe(ukf.x, measured.kind, measured.entries, measured.lever_m)
    for at, entry in enumerate(measured.entries):
        state = kernel.find_observed_state(measured.kind, entry)
        if state in _ANGLE_ENTRIES:
            innovation[at] = min(abs(float(wrap_to_pi(innovation[at]))), kernel.MAX_OPENED_RAD)
        ukf.P[state, state] += innovation[at] ** 2
        if state == kernel.X:
            ukf.P[kernel.YAW, kernel.YAW] += kernel.MAX_OPENED_RAD**2


def run(belief: FilterState, q: NDArray[np.float64], events: Events, sources: Sources, outputs: Outputs) -> None:
    """Filter forward as `tcpipe.fusion.ukf15_kernel.run` does; a covariance that is not positive definite raises here."""
    ukf = _make_filter(belief)
    refused, clock_s, e = belief.refused, float(belief.clock_s[0]), 0
    for k, output_s in enumerate(outputs.time_s.tolist()):
        while e < events.time_s.size and events.time_s[e] <= output_s:
            now_s, s = float(events.time_s[e]), int(events.source[e])
            _advance(ukf, q, now_s - clock_s)
            clock_s = max(clock_s, now_s)
            measured = _make_measurement(events, sources, e)
            outputs.nis[e] = nis = _update(ukf, measured, float(sources.gate[s]))
            accepted = nis <= sources.gate[s]
            outputs.outcome[e] = ACCEPTED if accepted else REJECTED
            refused[s, 1] = refused[s, 1] if refused[s, 0] else now_s
            refused[s, 0] = 0.0 if accepted else refused[s, 0] + 1.0
            if kernel.is_locked_out(*refused[s], now_s):
                _open_up(ukf, measured)
                _update(ukf, measured, math.inf)
                outputs.outcome[e], refused[s, 0] = RECOVERED, 0.0
            e += 1
        _advance(ukf, q, output_s - clock_s)
        clock_s = max(clock_s, output_s)
        outputs.x[k], outputs.variance[k] = ukf.x, np.diag(ukf.P)
    belief.x[: kernel.STATES], belief.P[:, : kernel.STATES], belief.clock_s[0] = ukf.x, ukf.P, clock_s
