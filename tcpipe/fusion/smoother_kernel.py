"""Backward pass of the error-state filter: the smoother.

This is the smoother of Bryson and Frazier in the form of Bierman. It inverts no covariance, so parameters may be known
exactly. Steps back in time over each update (gain K, innovation y of covariance S; G rotates the axes of the error with
the correction) and over each motion F::

    l ← G' l, Λ ← G' Λ G    l ← (I - K H)' l - H' S⁻¹ y,  Λ ← (I - K H)' Λ (I - K H) + H' S⁻¹ H    l ← F' l, Λ ← F' Λ F
    x_s = x - P l    P_s = P - P Λ P    cov(d_j, d_k) = P_j (product of all transitions from j to k)' (I - Λ_k P_k),  j
    < k

At each tick the adjoint gives the log evidence of an event. Restricted to the errors that the event changes, with
S = diag(σ) of the change::

    B = I + S Λ S    z = chol(B)⁻¹ S l    log evidence = |z|² / 2 - log |B| / 2    change = -S B⁻¹ S l

References: G. J. Bierman, "Fixed interval smoothing with discrete measurements", International Journal of Control 18
(1), 1973; P. de Jong, J. Penzer, "Diagnosing shocks in time series", Journal of the American Statistical Association 93
(442), 1998.
"""

from __future__ import annotations

from math import log, sqrt
from typing import Any, NamedTuple

import numpy as np

from tcpipe.compiled import compile_kernel
from tcpipe.fusion.filter_kernel import FilterModel, Indices, Steps, TickInputs, factorize, turn_rows
from tcpipe.fusion.state import KINDS, SIZES, Error, Matrix, Mode, N, Vector, displace_state


class Candidates(NamedTuple):
    """Possible events, and the best tick of each.

    Attributes
    ----------
    indices, stds, sizes : by event, indices in `Model.active` of the errors that it changes, standard deviations of the
        change, (C, 9), and number of these errors, (C,).
    earliest : first tick of an event.
    best : by event, the largest log evidence of all ticks, its tick, the change, and its standard deviation, (C, 20);
    to be filled.
    """

    indices: Indices
    stds: Matrix
    sizes: Indices
    earliest: int
    best: Matrix


class Smoothed(NamedTuple):
    """Smoothed estimate by tick.

    Attributes
    ----------
    states : x, (K, 51).
    variances : of the position east, north, up [m²], yaw [rad²] and forward velocity [m²/s²], (K, 5).
    displacement_m2 : variance of the horizontal displacement, along its direction, from a tick to the tick one lag
        later [m²], (K, l); NaN except at every `DISPLACEMENT_INTERVAL_TICKS`-th tick.
    stds : standard deviation of every active error, every `STD_INTERVAL` ticks, (K / STD_INTERVAL, n).
    """

    states: Matrix
    variances: Matrix
    displacement_m2: Matrix
    stds: Matrix


DISPLACEMENT_INTERVAL_TICKS, STD_INTERVAL = 10, 100
LARGEST_EVENT = 9  # largest number of errors that an event changes


class Adjoint(NamedTuple):
    """State of the smoother, which runs back in time.

    Attributes
    ----------
    information : Λ, (n, n).
    rows : l, and for each of Q later ticks the columns of I - Λ P of its position east and north, (1 + 2 Q,
    n).
    ticks : indices of these Q ticks, (Q,); -1: none. Every `DISPLACEMENT_INTERVAL_TICKS`-th tick up to the longest lag.
    ends : positions east and north at these ticks, and their smoothed covariance (ee, en, nn), (Q, 5).
    """

    information: Matrix
    rows: Matrix
    ticks: Indices
    ends: Matrix


def make_adjoint(size: int, longest: int) -> Adjoint:
    """Return the adjoint at the last tick, of ``size`` errors, for lags up to ``longest`` ticks (0: none)."""
    ahead = longest // DISPLACEMENT_INTERVAL_TICKS + 1 if longest else 0
    rows = np.zeros((1 + 2 * ahead, size))
    return Adjoint(np.zeros((size, size)), rows, np.full(ahead, -1, np.int64), np.zeros((ahead, 5)))


@compile_kernel
def step_before_update(
    K: Matrix, H: Matrix, size: int, pull: Vector, inverse: Matrix, turn: Vector, adjoint: Adjoint, B: Matrix
) -> None:
    """Propagate the adjoint back over one update."""
    information, rows = adjoint.information, adjoint.rows
    n = information.shape[0]
    turn_rows(rows.T, turn, rows.shape[0], True)
    turn_rows(information, turn, n, True)
    turn_rows(information.T, turn, n, True)
    for r in range(rows.shape[0]):
        for a in range(size):
            s = 0.0
            for i in range(n):
                s += K[a, i] * rows[r, i]
            B[a, 0] = s + (pull[a] if r == 0 else 0.0)
        for a in range(size):
            f = B[a, 0]
            for i in range(n):
                rows[r, i] -= H[a, i] * f
    for a in range(size):  # B = K' Λ
        B[a, :n] = 0.0
        for i in range(n):
            f = K[a, i]
            for j in range(n):
                B[a, j] += f * information[i, j]
    for a in range(size):
        for b in range(size):
            s = inverse[a, b]
            for j in range(n):
                s += B[a, j] * K[b, j]
            B[a, n + b] = 0.5 * s
    for a in range(size):
        for b in range(size):
            f = B[a, n + b]
            for j in range(n):
                B[a, n + 3 + j] = (B[a, n + 3 + j] if b > 0 else 0.0) + f * H[b, j]
        for j in range(n):
            B[a, j] -= B[a, n + 3 + j]
    for a in range(size):
        for i in range(n):
            h, f = H[a, i], B[a, i]
            for j in range(n):
                information[i, j] -= h * B[a, j] + f * H[a, j]


@compile_kernel
def step_before_motion(F: Matrix, kept: Vector, indices: Indices, m: int, adjoint: Adjoint, W: Matrix) -> None:
    """Propagate the adjoint back over the motion of a tick."""
    information, rows = adjoint.information, adjoint.rows
    n = information.shape[0]
    for i in range(n):
        f = kept[i]
        if f != 1.0:
            information[i] *= f
            information[:, i] *= f
            rows[:, i] *= f
    for r in range(rows.shape[0]):
        for a in range(m):
            W[0, a] = rows[r, indices[a]]
        for b in range(m):
            s = 0.0
            for a in range(m):
                s += F[a, b] * W[0, a]
            rows[r, indices[b]] = s
    for _ in range(2):  # F' from the left, twice: Λ is symmetric
        W[:m] = 0.0
        for a in range(m):
            for b in range(m):
                f = F[a, b]
                for j in range(n):
                    W[b, j] += f * information[indices[a], j]
        for b in range(m):
            information[indices[b]] = W[b]
        for i in range(n):
            for j in range(i):
                s = information[i, j]
                information[i, j] = information[j, i]
                information[j, i] = s
    # The step over an update assumes that Λ is symmetric: without this, an asymmetry by rounding would grow to the size
    # of Λ within half an hour.
    for i in range(n):
        for j in range(i):
            information[i, j] = information[j, i] = 0.5 * (information[i, j] + information[j, i])


@compile_kernel
def _turn_covariance(x: Vector, c: Matrix, axis: int, other: int) -> float:
    """Return the covariance of positions along two ENU axes from the covariance along axes of the state."""
    s = 0.0
    for i in range(3):
        for j in range(3):
            s += x[3 * axis + i] * x[3 * other + j] * c[Error.RHO + i, Error.RHO + j]
    return s


@compile_kernel
def _smooth_tick(
    k: int,
    P: Matrix,
    x: Vector,
    model: FilterModel,
    adjoint: Adjoint,
    lags: Indices,
    out: Smoothed,
    A: Matrix,
    room: Any,
) -> None:
    """Fill the smoothed estimate at tick k."""
    information, rows, ticks, ends = adjoint
    d, turn, c, after = room
    n = P.shape[0]
    d[:] = 0.0
    for i in range(n):
        s = 0.0
        for j in range(n):
            s -= P[i, j] * rows[0, j]
        d[model.active[i]] = s
    displace_state(x, d, 1.0, out.states[k], turn)
    # Covariance of rotation, position and velocity; of all errors only every `STD_INTERVAL` ticks.
    count = n if k % STD_INTERVAL == 0 else 9
    for i in range(n):
        if i >= count and not model.mount <= i < model.mount + 3:
            continue
        A[i] = 0.0
        for b in range(n):
            f = P[i, b]
            for j in range(n):
                A[i, j] += f * information[b, j]
    if count == n:
        for i in range(n):
            s = P[i, i]
            for j in range(n):
                s -= A[i, j] * P[j, i]
            out.stds[k // STD_INTERVAL, i] = sqrt(max(s, 0.0))
    size = 9 if model.mount < 0 else 12
    for i in range(size):
        row = i if i < 9 else model.mount + i - 9
        for j in range(size):
            column = j if j < 9 else model.mount + j - 9
            s = P[row, column]
            for b in range(n):
                s -= A[row, b] * P[b, column]
            c[i, j] = s
    for i in range(3, size - 6):  # the robot's rotation error: that of the IMU plus that of its mounting
        for j in range(size):
            c[i - 3, j] += c[6 + i, j]
    for i in range(3, size - 6):
        for j in range(size):
            c[j, i - 3] += c[j, 6 + i]
    for axis in range(3):
        out.variances[k, axis] = _turn_covariance(x, c, axis, axis)
    level2 = max(x[0] * x[0] + x[3] * x[3], 1e-6)  # yaw = atan2(R10, R00)
    jy, jz = x[7] / level2, x[8] / level2
    out.variances[k, 3] = jy * jy * c[1, 1] + 2.0 * jy * jz * c[1, 2] + jz * jz * c[2, 2]
    out.variances[k, 4] = c[Error.U, Error.U]
    # Displacements to later ticks, along their direction.
    for q in range(ticks.size):
        for column in range(lags.size):
            if ticks[q] < 0 or ticks[q] - k != lags[column]:
                continue
            east, north = ends[q, 0] - out.states[k, 9], ends[q, 1] - out.states[k, 10]
            short = 0.5 * 0.01 * 0.01  # m²: if the robot hardly moves, the direction is arbitrary
            share = (east * east + short, 2.0 * east * north, north * north + short)
            s = 0.0
            for axis in range(2):
                for other in range(axis, 2):
                    v = ends[q, 2 + axis + other] + _turn_covariance(x, c, axis, other)
                    for i in range(3):
                        line = P[Error.RHO + i]
                        for j in range(n):
                            v -= line[j] * x[3 * axis + i] * rows[1 + 2 * q + other, j]
                            v -= line[j] * x[3 * other + i] * rows[1 + 2 * q + axis, j]
                    s += share[axis + other] * v
            s /= east * east + north * north + 2.0 * short
            out.displacement_m2[k, column] = max(s, 0.0)
    if ticks.size and k % DISPLACEMENT_INTERVAL_TICKS == 0:
        q = (k // DISPLACEMENT_INTERVAL_TICKS) % ticks.size
        ticks[q] = k
        ends[q, 0], ends[q, 1] = out.states[k, 9], out.states[k, 10]
        for axis in range(2):
            for b in range(axis, 2):
                ends[q, 2 + axis + b] = _turn_covariance(x, c, axis, b)
            after[:] = 0.0
            for j in range(n):
                for i in range(3):
                    after[j] += P[Error.RHO + i, j] * x[3 * axis + i]
            for i in range(n):
                s = x[3 * axis + i - Error.RHO] if Error.RHO <= i < Error.RHO + 3 else 0.0
                for j in range(n):
                    s -= information[i, j] * after[j]
                rows[1 + 2 * q + axis, i] = s


@compile_kernel
def _score_events(k: int, adjoint: Adjoint, candidates: Candidates, B: Matrix, L: Matrix) -> None:
    """Store the evidence of events at tick k, if it exceeds the evidence at later ticks."""
    indices, stds, sizes, _, best = candidates
    for c in range(sizes.size):
        m = sizes[c]
        for a in range(m):
            for b in range(a + 1):
                B[a, b] = stds[c, a] * adjoint.information[indices[c, a], indices[c, b]] * stds[c, b]
            B[a, a] += 1.0
        factorize(B, np.arange(m), m, L)
        evidence = 0.0
        for a in range(m):
            s = stds[c, a] * adjoint.rows[0, indices[c, a]]
            for b in range(a):
                s -= L[a, b] * B[b, m]
            B[a, m] = s / L[a, a]
            evidence += 0.5 * B[a, m] ** 2 - log(L[a, a])
        if evidence > best[c, 0]:
            best[c, 0], best[c, 1] = evidence, k
            for a in range(m):  # rows of chol(B)⁻¹ give the diagonal of S B⁻¹ S
                best[c, 2 + a] = best[c, 2 + LARGEST_EVENT + a] = 0.0
                for b in range(a + 1):
                    s = 1.0 if a == b else 0.0
                    for j in range(b, a):
                        s -= L[a, j] * B[j, b]
                    B[a, b] = s / L[a, a]
            for a in range(m):
                for b in range(a, m):
                    best[c, 2 + a] -= stds[c, a] * B[b, a] * B[b, m]
                    best[c, 2 + LARGEST_EVENT + a] += (stds[c, a] * B[b, a]) ** 2
                best[c, 2 + LARGEST_EVENT + a] = sqrt(best[c, 2 + LARGEST_EVENT + a])


@compile_kernel
def smooth_ticks(
    first: int,
    last: int,
    inputs: TickInputs,
    model: FilterModel,
    steps: Steps,
    lags: Indices,
    adjoint: Adjoint,
    candidates: Candidates,
    out: Smoothed,
) -> None:
    """Smooth ticks ``last - 1`` down to ``first``.

    Parameters
    ----------
    steps : of these ticks, filled by `filter_ticks`.
    lags : durations of displacements, in ticks.
    adjoint : at tick ``last`` before its motion; becomes the adjoint at ``first`` before its motion.
    candidates : events whose evidence is computed at these ticks.
    out : output for these ticks.
    """
    n = adjoint.information.shape[0]
    A, B = np.zeros((n, n)), np.zeros((3, 2 * n + 3))
    room = (np.zeros(N), np.zeros(9), np.zeros((12, 12)), np.zeros(n))
    C, L = np.zeros((LARGEST_EVENT, LARGEST_EVENT + 1)), np.zeros((LARGEST_EVENT, LARGEST_EVENT))
    for k in range(last - 1, first - 1, -1):
        row = k - first
        _smooth_tick(k, steps.P[row], steps.x[row], model, adjoint, lags, out, A, room)
        for kind in range(KINDS - 1, -1, -1):
            if steps.used[row, kind]:
                step_before_update(
                    steps.K[row, kind], steps.H[row, kind], SIZES[kind], steps.pull[row, kind],
                    steps.inverse[row, kind], steps.turn[row, kind], adjoint, B,
                )  # fmt: skip
        if k >= candidates.earliest:
            _score_events(k, adjoint, candidates, C, L)
        if k > 0:
            motion = KINDS + (inputs.mode[k] >= Mode.GYRO_TURN)
            indices, m = model.depends[motion], model.counts[motion]
            step_before_motion(steps.F[row], steps.kept[row], indices, m, adjoint, A)
