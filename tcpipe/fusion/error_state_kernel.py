"""Forward pass of the error-state unscented filter: events in their order, gates that refuse and reopen, the fixes' own error.

State and errors stand in `state_kernel`, the steps in `prediction_kernel` and `update_kernel`, the way back in
`smoother_kernel`.
"""

from __future__ import annotations

from math import sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tcpipe.compiled import compile_kernel
from tcpipe.fusion.prediction_kernel import predict
from tcpipe.fusion.state_kernel import (
    ACCEPTED,
    DECAY,
    GNSS_POSITION,
    GYRO_TURN,
    PREDICT,
    REFUSED,
    REOPENED,
    VISUAL_VELOCITY,
    WHEEL_VELOCITY,
    Matrix,
    N,
    Vector,
    allocate_workspace,
    copy_values,
    save_state,
)
from tcpipe.fusion.update_kernel import compute_innovation, compute_observation, correct

FIXED = 1e-10
"""A scale of no more variance is held."""
_FORGOTTEN_S = 300.0
_ANEW = 0.1
OFF_M = 0.5
"""What fixes that contradict the rest may be off by, at least."""
_KNOWN_M = 0.1
_MEAN_OF, SURELY, _WILD = 10, 2.5, 4.0


@compile_kernel
def _inflate_after_lockout(kind: int, P: Matrix, y: Vector, alone: bool) -> None:  # noqa: FBT001
    """Lift P after a lock-out so that the sensor can be heard again: the state may have jumped, or the sensor's scale."""
    if kind == GNSS_POSITION:
        P[2, 2] += 0.1**2
        if P[15, 15] > FIXED:
            P[15, 15] += 0.3**2
        for i in range(3):
            P[9 + i, 9 + i] += 0.3**2
            P[12 + i, 12 + i] += y[i] * y[i]
    else:
        scale = 15 if kind == WHEEL_VELOCITY else 16
        if P[scale, scale] > FIXED:
            P[scale, scale] += 0.1**2
        if alone:
            for i in range(3):
                P[9 + i, 9 + i] += y[0] * y[0] + y[1] * y[1] + y[2] * y[2]


@compile_kernel
def _reset_fix_error(x: Vector, P: Matrix, variance: Vector) -> None:
    """Forget the fixes' error: another one has taken its place."""
    for i in range(N, P.shape[0]):
        x[6 + i] = 0.0
        for j in range(P.shape[0]):
            P[i, j] = 0.0
            P[j, i] = 0.0
    for i in range(N, P.shape[0]):
        P[i, i] = variance[i - N]


@compile_kernel
def _has_drift(y: Vector, S: Matrix, gate: float, opened: Vector) -> bool:
    """Whether innovations lie on one side on average, each of them within the gate as it may be; the mean follows in ``opened[3:]``."""
    size = 0.0
    for a in range(3):
        normal = min(max(y[a] / sqrt(S[a, a]), -_WILD), _WILD)
        opened[3 + a] += (normal - opened[3 + a]) / _MEAN_OF
        size += opened[3 + a] * opened[3 + a]
    return (2 * _MEAN_OF - 1) * size > SURELY * gate


@compile_kernel
def _is_gone(x: Vector, P: Matrix) -> bool:
    """Whether the fixes' error is known well enough to say that it is none."""
    gone = True
    for i in range(N, N + 2):
        gone = gone and P[i, i] < _KNOWN_M**2 and x[6 + i] * x[6 + i] < P[i, i]
    return gone


@compile_kernel
def find_largest_drift(normal: Matrix) -> float:
    """Return the largest that `_has_drift` would see in normalised innovations, shape (F, 3)."""
    mean = np.zeros(3)
    most = 0.0
    for row in range(normal.shape[0]):
        size = 0.0
        for a in range(3):
            mean[a] += (min(max(normal[row, a], -_WILD), _WILD) - mean[a]) / _MEAN_OF
            size += mean[a] * mean[a]
        if row >= _MEAN_OF:
            most = max(most, (2 * _MEAN_OF - 1) * size)
    return most


@compile_kernel
def _decay_fix_error(x: Vector, P: Matrix, kept: float, noise: Vector, opened: Vector, dt: float) -> None:
    """Let the fixes' error fade: ``kept`` of it remains, ``noise`` is added; where a gate has reopened it may stay as large as that."""
    for i in range(N, P.shape[0]):
        x[6 + i] *= kept
        for j in range(P.shape[0]):
            P[i, j] *= kept
            P[j, i] *= kept
        opened[i - N] *= 1.0 - min(dt / _FORGOTTEN_S, 1.0) if kept > _ANEW else 0.0
        P[i, i] += noise[i - N] + opened[i - N] * max(1.0 - kept * kept, 0.0)


@compile_kernel
def filter_block(
    first: int,
    last: int,
    dt: Vector,
    kind: NDArray[np.int8],
    mode: NDArray[np.int8],
    q_v: Vector,
    z: Matrix,
    r: Matrix,
    turn_rate: Matrix,
    force: Matrix,
    turn_rate_now: Matrix,
    output: NDArray[np.int64],
    levers: Matrix,
    densities: Matrix,
    gates: Vector,
    lock_out: Matrix,
    kept_error: Vector,
    error_noise: Matrix,
    error_level: Matrix,
    x: Vector,
    P: Matrix,
    refused: Vector,
    silent: Vector,
    opened: Vector,
    keep: bool,  # noqa: FBT001
    store: Any,
    nis: Vector,
    innovation: Matrix,
    verdict: NDArray[np.int8],
    outputs: Matrix,
) -> float:
    """Filter events ``first`` to ``last``; return how often P had to be repaired.

    Parameters
    ----------
    dt : [s], time since the event before. kind, mode : as in `state_kernel`. q_v : noise of v since then, see `predict`.
    z, r : measurement and variances, shape (E, 3); unused entries are 0 and 1.
    turn_rate, force : mean angular velocity and specific force since the event before, shape (E, 3).
    turn_rate_now : angular velocity at the event, shape (E, 3).
    output : row of ``outputs`` that the event fills, or -1.
    levers : lever arm by kind, shape (9, 3). densities : process noise by mode, shape (4, 21), see `predict`.
    gates : threshold of the squared normalised innovation by kind; infinite where there is no gate.
    lock_out : by kind (9, 4): refusals in a row, and seconds since the last accepted one, after which the gate reopens; the seconds
        where no other sensor that tells velocity has been accepted for 2 s; 1 where the fixes' error is lifted, not the pose.
    kept_error, error_noise, error_level : what remains of the fixes' error since the event before, the variances added to it [m²],
        shape (E, 3), and those that it has in the long run, shape (E, 3).
    x, P, refused, silent, opened : state and memory at ``first``, of 17 errors or, with that of the fixes, of 20; refusals in a row and
        silence by kind; variance [m²] of what made the gate of fixes reopen, and their mean innovation. They become those after
        ``last - 1``.
    keep, store : with ``keep``, row e - first of the first three becomes F (12, 9), K' and H (2, 3, n), and (25,): 1 where time passed,
        what remains of s_w, 1 where something was measured and used, S⁻¹ y, S⁻¹, J, what remains of the fixes' error; the last gets P of
        each wanted stamp in turn.
    nis, innovation, verdict, outputs : filled for the events.
    """
    work, gain = allocate_workspace(P.shape[0])
    store_F, store_KH, store_y, store_P = store
    F = np.zeros((12 if keep else 0, 9))
    J = np.zeros((3, 3))
    wanted = 0
    for e in range(first, last):
        kept = kept_error[e]
        if P.shape[0] > N:
            _decay_fix_error(x, P, kept, error_noise[e], opened, dt[e])
        if dt[e] > 0.0:
            predict(x, P, densities[mode[e]], q_v[e], dt[e], turn_rate[e], force[e], mode[e], F, work)
            for k in range(silent.size):
                silent[k] += dt[e]
        k = kind[e]
        hears = False
        if k != PREDICT:
            # A scale of the turn rate is told by turns alone: beside a lever arm the rate's own noise would pass for one.
            bias = 1.0 if mode[e] >= GYRO_TURN else 0.0
            if k == GNSS_POSITION and opened[0] > 0.0 and _is_gone(x, P):
                kept = 0.0
                opened[:] = 0.0
                _reset_fix_error(x, P, error_level[e])
            value = compute_innovation(k, x, P, z[e], r[e], turn_rate_now[e], levers[k], bias, work, gain)
            hears = True
            verdict[e] = ACCEPTED
            for a in range(3):
                innovation[e, a] = gain[0][a]
            off_for_long = False
            if k == GNSS_POSITION and lock_out[k, 3] > 0.0 and opened[0] == 0.0:
                off_for_long = _has_drift(gain[0], gain[2], gates[k], opened)
            if off_for_long or not value <= gates[k]:
                hears = False
                verdict[e] = REFUSED
                refused[k] += 1.0
                alone = True
                for other in range(GNSS_POSITION, VISUAL_VELOCITY + 1):
                    alone = alone and (other == k or silent[other] > 2.0)
                long = silent[k] >= lock_out[k, 2 if alone else 1] or (k == GNSS_POSITION and opened[0] > 0.0)
                if refused[k] >= lock_out[k, 0] and long:
                    if lock_out[k, 3] > 0.0 and P.shape[0] > N:
                        kept = 0.0  # either the fixes are right again, or they err in another way
                        _reset_fix_error(x, P, error_level[e])
                        again = compute_innovation(k, x, P, z[e], r[e], turn_rate_now[e], levers[k], bias, work, gain)
                        for a in range(3):
                            opened[a] = max(gain[0][a] ** 2, OFF_M**2) if again > SURELY * gates[k] else 0.0
                            opened[3 + a] = 0.0
                        if again > SURELY * gates[k]:
                            _reset_fix_error(x, P, np.maximum(opened[:3], error_level[e]))
                    else:
                        _inflate_after_lockout(k, P, gain[0], alone)
                    again = compute_innovation(k, x, P, z[e], r[e], turn_rate_now[e], levers[k], bias, work, gain)
                    softer = max(again / gates[k], 1.0)
                    for a in range(3):
                        gain[2][a, a] = r[e, a] * softer * softer
                    compute_innovation(
                        k, x, P, z[e], np.diag(gain[2]).copy(), turn_rate_now[e], levers[k], bias, work, gain
                    )
                    hears = True
                    verdict[e] = REOPENED
            nis[e] = value
        row = e - first
        if keep:
            copy_values(F, store_F[row])
            store_y[row, 0] = 1.0 if dt[e] > 0.0 else 0.0
            store_y[row, 1] = 1.0 - dt[e] * densities[mode[e], DECAY]
            store_y[row, 2] = 1.0 if hears else 0.0
            store_y[row, 24] = kept
            if hears:
                y, Z, _, _, inverse = gain
                compute_observation(work[0], Z, store_KH[row, 1])
                for a in range(3):
                    store_y[row, 3 + a] = inverse[a, 0] * y[0] + inverse[a, 1] * y[1] + inverse[a, 2] * y[2]
                    for b in range(3):
                        store_y[row, 6 + 3 * a + b] = inverse[a, b]
        if hears:
            correct(x, P, work, gain, J)
            refused[k] = 0.0
            silent[k] = 0.0
            if keep:
                copy_values(work[1], store_KH[row, 0])
                for a in range(3):
                    for b in range(3):
                        store_y[row, 15 + 3 * a + b] = J[a, b]
        if keep and output[e] >= 0:
            copy_values(P, store_P[wanted])
            wanted += 1
        if output[e] >= 0:
            save_state(x, P, outputs[output[e]])
    repairs: float = work[8][0]
    return repairs
