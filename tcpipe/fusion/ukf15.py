"""The paper's forward filter (section IV-A): GNSS, wheels, IMU and visual odometry in an unscented Kalman filter.

Ticks, models of motion and sensors, and their noise are those of the default estimator (`ticks`, `state`,
`parameters`). filterpy does the scaled unscented transform (E. A. Wan and R. van der Merwe, 2000) of all errors at
once: the fifteen of pose, body velocity and biases of the IMU, and the parameters that are not known exactly. Each
state uses only measurements up to its tick: there is no smoothing and no search for changes. Noise and initial state
are estimated from the whole section.

The state of filterpy is the error of the estimate. It is zero between steps, so its angles need no wrapping.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter

from tcpipe.arrays import Floats, Ints
from tcpipe.fusion import state
from tcpipe.fusion.changes import Hypothesis
from tcpipe.fusion.error_state import make_tests, make_trajectory, prepare_section
from tcpipe.fusion.filter_kernel import RESET_REJECTIONS, RESET_SPEED_STD_MPS, FilterModel, GateVerdict, Memory
from tcpipe.fusion.measurements import DISPLACEMENT_LAGS_S, InitialState, Measurements, Trajectory
from tcpipe.fusion.smoother_kernel import STD_INTERVAL, Smoothed
from tcpipe.fusion.state import Error, Kind
from tcpipe.fusion.ticks import Pass, Ticks

_MAX_ANGLE_STD_RAD = 1.0  # sigma points are at √3 σ, and must not wrap around


def run_ukf15(m: Measurements, initial: InitialState, *, output_ns: Ints, gate_probability: float) -> Trajectory:
    """Return base_link's trajectory at ``output_ns`` by the paper's forward filter.

    Parameters
    ----------
    m, initial : one section of a run, and its state at the first measurement.
    output_ns : [ns], shape (N,), increasing multiples of the track's period.
    gate_probability : a measurement less likely than 1 minus this is rejected (χ² on its squared normalised
    innovation).
    """
    section = prepare_section(m, output_ns, gate_probability)
    initial = replace(initial, yaw_std_rad=min(initial.yaw_std_rad, _MAX_ANGLE_STD_RAD))
    forward, estimate = filter_forward(*section.prepare(section.make_start(initial)))
    found = make_trajectory(section, forward, estimate, output_ns, Hypothesis(()))
    # The estimate of a constant parameter still changes during a forward pass.
    parameters = {name: replace(learned, variation=()) for name, learned in found.facts.parameters.items()}
    return replace(found, facts=replace(found.facts, parameters=parameters))


def filter_forward(ticks: Ticks, model: FilterModel, start: Memory) -> tuple[Pass, Smoothed]:
    """Return the forward pass over all ticks, and its estimates, without variances of displacements (NaN).

    If the gate has rejected fixes or attitudes for as long as the default estimator allows, σ of pose and velocity is
    inflated, and the measurement is used.
    """
    size, period_s = ticks.stamp_ns.size, ticks.inputs.period_s
    ukf, tests = _Filter(ticks, model, start), make_tests(size)
    states, variances = np.zeros((size, state.NX)), np.zeros((size, 5))
    stds = np.zeros((-(-size // STD_INTERVAL), model.active.size))
    rejected: dict[int, list[int]] = {kind: [] for kind in range(state.KINDS)}
    for k in range(size):
        if k > 0:
            ukf.predict(k)
        for kind in np.flatnonzero(np.isfinite(ticks.inputs.value[k, :, 0])).tolist():
            verdict, innovation, nis = GateVerdict.ACCEPTED, *ukf.update(k, kind, model.gates[kind])
            if kind == Kind.FIX:
                tests.fix_innovation[k] = innovation
            if not nis <= model.gates[kind]:
                verdict, since = GateVerdict.REJECTED, rejected[kind]
                since.append(k)
                if len(since) >= RESET_REJECTIONS and (k - since[0]) * period_s >= model.patience_s[kind]:
                    verdict = GateVerdict.RESET
                    ukf.inflate(kind, innovation)
                    ukf.update(k, kind, np.inf)
            if verdict != GateVerdict.REJECTED:
                rejected[kind].clear()
            tests.nis[k, kind], tests.verdict[k, kind] = nis, verdict
        states[k], variances[k] = ukf.x, ukf.compute_variances()
        if k % STD_INTERVAL == 0:
            stds[k // STD_INTERVAL] = np.sqrt(np.diag(ukf.covariance))
    no_displacement_m2 = np.full((size, len(DISPLACEMENT_LAGS_S)), np.nan)
    return Pass(ticks, model, [], tests, start), Smoothed(states, variances, no_displacement_m2, stds)


class _Filter:
    """Estimate ``x``, shape (51,), and filterpy's filter of its active errors."""

    def __init__(self, ticks: Ticks, model: FilterModel, start: Memory) -> None:
        size = model.active.size
        # The points are at √3 σ for any number of errors, and match the fourth moment of a normal distribution.
        points = MerweScaledSigmaPoints(size, alpha=np.sqrt(3.0 / size), beta=2.0, kappa=0.0)
        self._ukf = UnscentedKalmanFilter(size, 1, ticks.inputs.period_s, None, None, points)
        self._ukf.P, self.x = _repair(start.P), start.x.copy()
        self._inputs, self._model = ticks.inputs, model
        self._is_fix_error = (model.active >= Error.FIX_ERROR) & (model.active < Error.FIX_ERROR + 3)

    @property
    def covariance(self) -> Floats:
        """Covariance of the active errors, shape (n, n)."""
        return np.asarray(self._ukf.P)

    def predict(self, k: int) -> None:
        """Propagate the estimate over the motion of tick k, with decay and random walk of parameters."""
        inputs, model, before = self._inputs, self._model, self.x
        decay, noise = model.kept.copy(), model.noise.copy()
        decay[self._is_fix_error] = inputs.fix_kept[k]
        noise[self._is_fix_error] += inputs.fix_noise[k, model.active[self._is_fix_error] - Error.FIX_ERROR]
        # Rotation, position and velocity are always active, and first.
        noise[Error.THETA : Error.THETA + 3] += inputs.noise[k, :3]
        noise[Error.U : Error.U + 3] += inputs.noise[k, 3:]
        motion = inputs.mode[k], inputs.period_s, inputs.turned[k], inputs.gained[k]
        moving = np.flatnonzero(model.active < state.MOVING)

        def move(x: Floats) -> Floats:
            moved = np.empty(state.NX)
            state.move_state(x, *motion, moved, np.empty(9))
            return moved

        def propagate(errors: Floats, _period_s: float) -> Floats:
            error = np.empty(state.MOVING)
            state.compute_moving_error(move(self._displace(before, errors)), self.x, error)
            propagated = errors * decay
            propagated[moving] = error[model.active[moving]]
            return propagated

        self.x = move(before)
        decays = decay != 1.0
        self.x[model.active[decays] + 6] *= decay[decays]
        self._ukf.Q = np.diag(noise)
        self._ukf.predict(fx=propagate)
        self._correct()

    def update(self, k: int, kind: int, gate: float) -> tuple[Floats, float]:
        """Apply one measurement of tick k unless the gate rejects it; return its innovation and NIS."""
        inputs, ukf, size, prior = self._inputs, self._ukf, state.SIZES[kind], self.covariance
        lever = inputs.attitude[k] if kind == Kind.ATTITUDE else inputs.levers[kind]
        acceleration = np.array([inputs.acceleration[k], 0.0, 0.0])
        circumstances = inputs.rate[k], inputs.has_gyro[k], acceleration, inputs.tau[k, kind], lever

        def measure(errors: Floats) -> Floats:
            measured = np.empty(3)
            state.predict_measurement(kind, self._displace(self.x, errors), *circumstances, measured)
            return measured[:size]

        ukf.sigmas_f = ukf.points_fn.sigma_points(ukf.x, ukf.P)  # filterpy would use the points before the last update
        ukf.update(inputs.value[k, kind, :size], np.diag(inputs.variance[k, kind, :size]), hx=measure)
        nis = float(ukf.y @ ukf.SI @ ukf.y)
        if not nis <= gate:
            ukf.x, ukf.P = np.zeros_like(ukf.x), prior
        else:
            self._correct()
        return ukf.y, nis

    def inflate(self, kind: int, innovation: Floats) -> None:
        """Inflate pose and velocity as `filter_ticks` does."""
        measured = Error.RHO if kind == Kind.FIX else Error.THETA
        added, angles = np.zeros(Error.GYRO_BIAS), range(Error.RHO)
        added[measured : measured + 3] = innovation @ innovation
        added[Error.U :] = RESET_SPEED_STD_MPS**2
        added[Error.THETA + 2] += _MAX_ANGLE_STD_RAD**2
        self._ukf.P[range(added.size), range(added.size)] += added
        self._ukf.P[angles, angles] = np.minimum(self._ukf.P[angles, angles], _MAX_ANGLE_STD_RAD**2)

    def compute_variances(self) -> Floats:
        """Return the variance of position east, north, up [m²], yaw [rad²] and forward velocity [m²/s²], shape (5,)."""
        x, P, yaw = self.x, self.covariance, np.zeros(self._model.active.size)
        yaw[[1, 2]] = np.array([x[7], x[8]]) / max(x[0] ** 2 + x[3] ** 2, 1e-6)  # of atan2(R10, R00) by rotation errors
        if self._model.mount >= 0:  # the robot's rotation error: that of the IMU plus that of its mounting
            yaw[self._model.mount : self._model.mount + 3] = yaw[:3]
        R, to_position = x[:9].reshape(3, 3), slice(Error.RHO, Error.RHO + 3)
        position = np.einsum("ij,jk,ik->i", R, P[to_position, to_position], R)
        return np.array([*position, yaw @ P @ yaw, P[Error.U, Error.U]])

    def _displace(self, x: Floats, errors: Floats) -> Floats:
        """Return a state displaced by active errors, shape (n,)."""
        all_errors, displaced = np.zeros(state.N), np.empty(state.NX)
        all_errors[self._model.active] = errors
        state.displace_state(x, all_errors, 1.0, displaced, np.empty(9))
        return displaced

    def _correct(self) -> None:
        """Add filterpy's error to the estimate, and rotate the axes of rotation and position errors accordingly."""
        ukf, turn = self._ukf, np.eye(self._model.active.size)
        # The right Jacobian of SO(3) to second order (Solà 2017, eq. 183).
        for first, share in ((Error.THETA, -0.5), (Error.RHO, -1.0)):
            block = np.empty(9)
            state.make_rotation(*(share * ukf.x[:3]), block)
            turn[first : first + 3, first : first + 3] = block.reshape(3, 3)
        self.x = self._displace(self.x, ukf.x)
        ukf.x, ukf.P = np.zeros_like(ukf.x), _repair(turn @ ukf.P @ turn.T)


def _repair(covariance: Floats) -> Floats:
    """Return a symmetric covariance; if rounding has made it invalid, only its variances."""
    symmetric = 0.5 * (covariance + covariance.T)
    try:
        np.linalg.cholesky(symmetric)
    except np.linalg.LinAlgError:
        return np.diag(np.maximum(np.diag(symmetric), 1e-18))
    return np.asarray(symmetric)
