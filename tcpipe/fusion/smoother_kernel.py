r"""Smoother of the error-state unscented filter.

The unscented Rauch-Tung-Striebel smoother (Särkkä 2008) in the form of Bryson and Frazier (Bierman 1973), which inverts no
covariance and smooths only where an estimate is wanted. The sigma points of a prediction and of an update are, to second moments, those
of the linear maps F = C' P⁻¹ with C = cov(dx_k, dx_{k+1}⁻), and H = (P⁻⁻¹ cov(dx⁻, z))'. With K, S and the innovation y of each update,
and J, which carries errors over to the axes that the update has turned (`error_state_kernel._reset`), back in time::

    l ← J' l, L ← J' L J    l ← (I - K H)' l - H' S⁻¹ y,  L ← (I - K H)' L (I - K H) + H' S⁻¹ H    l ← F' l, L ← F' L F
    x^s = x ⊞ (-P l)    P^s = P - P L P    cov(dx_j, dx_k) = P_j (product of all J (I - K H) F from j to k)' (I - L_k P_k),  j < k

References: S. Särkkä, "Unscented Rauch-Tung-Striebel smoother", IEEE TAC 53 (3), 2008; G. J. Bierman, "Fixed interval smoothing with
discrete measurements", International Journal of Control 18 (1), 1973.
"""

from __future__ import annotations

from math import sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tcpipe.compiled import compile_kernel
from tcpipe.fusion.state_kernel import (
    MOVED,
    NX,
    Matrix,
    N,
    Vector,
    allocate_workspace,
    copy_values,
    displace_state,
    save_state,
)


@compile_kernel
def _multiply_transposed(F: Matrix, scale: float, A: Matrix, out: Matrix) -> None:
    """F' A; ``scale`` is what remains of s_w."""
    n = A.shape[0]
    for i in range(n):
        if 3 <= i < 9 or i >= 12:
            f = scale if i == 15 else 1.0
            for j in range(n):
                out[i, j] = f * A[i, j]
        else:
            for j in range(n):
                out[i, j] = 0.0
    for i in range(12):
        for c in range(9):
            f = F[i, c]
            row = A[MOVED[c]]
            for j in range(n):
                out[i, j] += f * row[j]


@compile_kernel
def _multiply(A: Matrix, B: Matrix, out: Matrix) -> None:
    n = A.shape[0]
    for i in range(n):
        for j in range(n):
            out[i, j] = 0.0
        for k in range(n):
            f = A[i, k]
            for j in range(n):
                out[i, j] += f * B[k, j]


@compile_kernel
def _fill_link_variances(
    j: int, xy: Vector, P: Matrix, Ps: Matrix, rest: Matrix, links: Any, variances: Matrix
) -> None:
    """Fill row ``j`` of ``variances``: how far the displacement from wanted stamp j to later ones may be wrong, along its direction.

    ``P`` is the filter's covariance, ``Ps`` the smoother's, ``rest`` is I - L P. Products over longer lags are made of shorter ones.
    """
    _, chains, ends, places, recipe, lags, wanted = links
    n = P.shape[0]
    size = chains.shape[1]
    here = j % size
    for i in range(n):
        for b in range(2):
            ends[here, i, b] = rest[i, 12 + b]
    for b in range(2):
        places[here, b] = xy[b]
        for c in range(2):
            places[here, 2 + 2 * b + c] = Ps[12 + b, 12 + c]
    newest = variances.shape[0] - 1
    for node in range(1, lags.size):
        if j + lags[node] <= newest:
            between = (j + lags[recipe[node, 0]]) % size
            _multiply(chains[recipe[node, 0], here], chains[recipe[node, 1], between], chains[node, here])
    for column in range(wanted.size):
        node = wanted[column]
        if j + lags[node] > newest:
            continue
        there = (j + lags[node]) % size
        east = places[there, 0] - xy[0]
        north = places[there, 1] - xy[1]
        length = max(sqrt(east * east + north * north), 1e-12)
        u = (east / length, north / length)
        variance = 0.0
        for b in range(2):
            for c in range(2):
                variance += u[b] * u[c] * (places[here, 2 + 2 * b + c] + places[there, 2 + 2 * b + c])
        for i in range(n):
            before = u[0] * P[12, i] + u[1] * P[13, i]
            after = 0.0
            for m in range(n):
                after += chains[node, here, i, m] * (u[0] * ends[there, m, 0] + u[1] * ends[there, m, 1])
            variance -= 2.0 * before * after
        variances[j, column] = max(variance, 0.0)


@compile_kernel
def smooth_block(
    first: int,
    last: int,
    output: NDArray[np.int64],
    store: Any,
    adjoint: Vector,
    information: Matrix,
    outputs: Matrix,
    links: Any,
    displacement_variances: Matrix,
) -> None:
    """Smooth events ``last - 1`` down to ``first``.

    Parameters
    ----------
    store : of these events, as `filter_block` kept it.
    adjoint, information : l (n,) and L (n, n) of the state before event ``last``; become those before ``first``.
    outputs : holds the filter's states at the wanted stamps; they become the smoothed ones.
    links : what `_fill_link_variances` remembers of later wanted stamps, see `tcpipe.fusion.error_state_pass`.
    displacement_variances : filled by `_fill_link_variances`.
    """
    n = information.shape[0]
    work, _ = allocate_workspace(n)
    _, _, d, x, _, shifted, _, turn, _ = work
    store_F, store_KH, store_y, store_P = store
    T = np.zeros((n, n))
    Ps = np.zeros((n, n))
    B = np.zeros((3, n))
    chain = links[0]  # (product of F and I - K H from here to the next wanted stamp)'
    wanted = 0
    for e in range(first, last):
        wanted += 1 if output[e] >= 0 else 0
    for e in range(last - 1, first - 1, -1):
        row = e - first
        if output[e] >= 0:
            wanted -= 1
            P = store_P[wanted]
            out = outputs[output[e]]
            for i in range(NX):
                x[i] = out[i]
            for i in range(NX, x.size):
                x[i] = out[30 + i - NX]
            for i in range(n):
                d[i] = 0.0
                for j in range(n):
                    d[i] -= P[i, j] * adjoint[j]
            displace_state(x, d, 1.0, True, shifted, turn)
            _multiply(information, P, T)
            _multiply(P, T, Ps)
            for i in range(n):
                for j in range(n):
                    T[i, j] = (1.0 if i == j else 0.0) - T[i, j]
            for i in range(n):
                for j in range(i + 1):
                    s = 0.5 * (P[i, j] - Ps[i, j] + P[j, i] - Ps[j, i])
                    Ps[i, j] = s
                    Ps[j, i] = s
            save_state(shifted, Ps, out)
            copy_values(chain, links[1][0, output[e] % links[1].shape[1]])
            for i in range(n):
                for j in range(n):
                    chain[i, j] = 1.0 if i == j else 0.0
            _fill_link_variances(output[e], shifted[18:20], P, Ps, T, links, displacement_variances)
        if store_y[row, 2] > 0.0:
            _step_before_update(store_KH[row, 0], store_KH[row, 1], store_y[row], adjoint, information, chain, B)
        if store_y[row, 0] > 0.0:
            F = store_F[row]
            scale = store_y[row, 1]
            for i in range(n):
                d[i] = adjoint[i]
            for i in range(12):
                s = d[i] if 3 <= i < 9 else 0.0
                for c in range(9):
                    s += F[i, c] * d[MOVED[c]]
                adjoint[i] = s
            adjoint[15] = scale * d[15]
            _multiply_transposed(F, scale, information, T)
            for i in range(n):
                for j in range(n):
                    Ps[i, j] = T[j, i]
            _multiply_transposed(F, scale, Ps, information)
            _multiply_transposed(F, scale, chain, T)
            copy_values(T, chain)
        kept = store_y[row, 24]
        for i in range(N, n if kept != 1.0 else N):
            adjoint[i] *= kept
            for j in range(n):
                information[i, j] *= kept
                information[j, i] *= kept
                chain[i, j] *= kept


@compile_kernel
def _project_gain(K: Matrix, A: Matrix, B: Matrix) -> None:
    """Fill B, shape (3, n), with K' A; K holds K'."""
    n = A.shape[0]
    for a in range(3):
        for j in range(n):
            B[a, j] = 0.0
        for i in range(n):
            f = K[a, i]
            for j in range(n):
                B[a, j] += f * A[i, j]


@compile_kernel
def _step_before_update(
    K: Matrix, H: Matrix, y: Vector, adjoint: Vector, information: Matrix, chain: Matrix, B: Matrix
) -> None:
    """Take l, L and the chain back over an update; K holds K', y what `filter_block` kept."""
    t = np.empty(3)
    n = information.shape[0]
    for j in range(n):  # J' from the left
        for A in (information, chain):
            for i in range(3):
                t[i] = y[15 + i] * A[0, j] + y[18 + i] * A[1, j] + y[21 + i] * A[2, j]
            for i in range(3):
                A[i, j] = t[i]
    for j in range(n):  # J from the right
        for i in range(3):
            t[i] = y[15 + i] * information[j, 0] + y[18 + i] * information[j, 1] + y[21 + i] * information[j, 2]
        for i in range(3):
            information[j, i] = t[i]
    for i in range(3):
        t[i] = y[15 + i] * adjoint[0] + y[18 + i] * adjoint[1] + y[21 + i] * adjoint[2]
    for i in range(3):
        adjoint[i] = t[i]
    for a in range(3):
        s = y[3 + a]
        for i in range(n):
            s += K[a, i] * adjoint[i]
        B[a, 0] = s
    for i in range(n):
        adjoint[i] -= H[0, i] * B[0, 0] + H[1, i] * B[1, 0] + H[2, i] * B[2, 0]
    _project_gain(K, chain, B)
    for i in range(n):
        for j in range(n):
            chain[i, j] -= H[0, i] * B[0, j] + H[1, i] * B[1, j] + H[2, i] * B[2, j]
    _project_gain(K, information, B)
    half = np.empty((3, 3))
    for a in range(3):
        for b in range(3):
            s = y[6 + 3 * a + b]
            for j in range(n):
                s += B[a, j] * K[b, j]
            half[a, b] = 0.5 * s
    for j in range(n):
        b0 = B[0, j] - half[0, 0] * H[0, j] - half[0, 1] * H[1, j] - half[0, 2] * H[2, j]
        b1 = B[1, j] - half[1, 0] * H[0, j] - half[1, 1] * H[1, j] - half[1, 2] * H[2, j]
        b2 = B[2, j] - half[2, 0] * H[0, j] - half[2, 1] * H[1, j] - half[2, 2] * H[2, j]
        B[0, j] = b0
        B[1, j] = b1
        B[2, j] = b2
    for i in range(n):
        for j in range(i + 1):
            s = H[0, i] * B[0, j] + H[1, i] * B[1, j] + H[2, i] * B[2, j]
            s += B[0, i] * H[0, j] + B[1, i] * H[1, j] + B[2, i] * H[2, j]
            information[i, j] -= s
            information[j, i] = information[i, j]
