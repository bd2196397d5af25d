# SPDX-License-Identifier: Apache-2.0
r"""Poles of sampled loops under gains, and their derivatives by the gains: see `robust.decay`.

Of a stack of loops with equally many states, :math:`F - GKN` is reduced to Hessenberg form, :math:`Q^T(F - GKN)Q = H`
with reflectors :math:`Q = (I - \tau_0v_0v_0^T)(I - \tau_1v_1v_1^T)\dots`, whose eigenvalues LAPACK finds. The
eigenvectors of those that matter follow by inverse iteration.
"""

import numpy as np

from .eigenvectors import eigenvectors

#: LAPACK's, which `kernels.compiled` puts here: see `lapack`.
dgehrd = dhseqr = None

#: Poles nearer to the origin of the z plane are those of delays and filters.
DEAD_BEAT = 1e-6
#: Beyond this many times omega_1 less decay is asked.
SOFT = 4.0
#: Columns of LAPACK's work space.
BLOCK = 64


def asked(s, fraction, omega_1, omega_c, zeta):
    """d of a pole [1/s]: the decay that is asked of it, in a loop with a `fraction`; see `robust.decay`."""
    if s.real >= 0.0:
        return omega_1
    size = max(abs(s), 1e-12)
    if size <= omega_c:
        return fraction * omega_1 * min(1.0, np.sqrt(SOFT * omega_1 / size))
    return fraction * min(omega_1, zeta * size)


def closed(F, G, N, K, out):
    """Fill `out` with the transpose of F - G K N: Fortran's matrices are stored by columns. False: not finite."""
    size, n = G.shape
    row, finite = np.zeros((n, size)), True
    for a in range(n):
        for b in range(N.shape[0]):
            if K[a, b] != 0.0:
                for j in range(size):
                    row[a, j] += K[a, b] * N[b, j]
    for j in range(size):
        for i in range(size):
            value = F[i, j]
            for a in range(n):
                value -= G[i, a] * row[a, j]
            out[j, i] = value
            finite = finite and np.isfinite(value)
    return finite


def reduced(H, tau, z, work):
    """Reduce the transposed matrix in `H` in place, and fill `z` with its eigenvalues; False: they are not found.

    Parameters
    ----------
    H : ndarray, shape (N, N)
        Becomes the Hessenberg form, transposed, with the reflectors beyond it.
    tau : ndarray, shape (N,)
        Becomes the factors of the reflectors, N - 1 of them.
    z : ndarray, shape (N,)
        [-]
    work : ndarray, shape (BLOCK N,)
        For LAPACK to write on.
    """
    size = H.shape[0]
    whole, first, found, length = (
        np.array([size], np.int32),
        np.array([1], np.int32),
        np.array([0], np.int32),
        np.array([work.size], np.int32),
    )
    dgehrd(
        whole.ctypes, first.ctypes, whole.ctypes, H.ctypes, whole.ctypes, tau.ctypes,
        work.ctypes, length.ctypes, found.ctypes,
    )  # fmt: skip
    if found[0] != 0:
        return False
    real, imaginary, T = np.empty(size), np.empty(size), H.copy()
    alone, none = np.array([ord("E")], np.uint8), np.array([ord("N")], np.uint8)
    dhseqr(
        alone.ctypes, none.ctypes, whole.ctypes, first.ctypes, whole.ctypes, T.ctypes, whole.ctypes,
        real.ctypes, imaginary.ctypes, work.ctypes, first.ctypes, work.ctypes, length.ctypes,
        found.ctypes,
    )  # fmt: skip
    for k in range(size):
        z[k] = complex(real[k], imaginary[k])
    return found[0] == 0 and np.isfinite(real).all() and np.isfinite(imaginary).all()


def ranked_poles(wanted, F, G, N, K, period, fraction, H, tau, z, s, d, v, count):
    """Fill the arrays of a stack of L loops, of each the poles in the upper half plane, the largest v first.

    Parameters
    ----------
    wanted : ndarray, shape (3,)
        omega_1, omega_c [rad/s] and zeta [-].
    F, G, N, K : ndarray, shape (L, ., .)
    period, fraction : ndarray, shape (L,)
    H, tau : ndarray, shape (L, N, N) and (L, N)
        See `reduced`.
    z, s : ndarray, shape (L, N)
        Poles [-], [1/s]; 0 after the last one.
    d, v : ndarray, shape (L, N)
        What is asked of them [1/s], 1 after the last one, and v [-], -inf after the last one.
    count : ndarray, shape (L,)
        Poles of each loop; -1: its eigenvalues are not found.
    """
    size = F.shape[1]
    all_, work = np.empty(size, np.complex128), np.empty(BLOCK * size)
    for k in range(F.shape[0]):
        z[k], s[k], d[k], v[k] = 0.0, 0.0, 1.0, -np.inf
        count[k] = -1
        if not closed(F[k], G[k], N[k], K[k], H[k]) or not reduced(H[k], tau[k], all_, work):
            continue
        kept = 0
        for one in all_:
            if abs(one) <= DEAD_BEAT or one.imag < 0.0:
                continue
            pole = np.log(one) / period[k]
            most = asked(pole, fraction[k], wanted[0], wanted[1], wanted[2])
            value, i = pole.real / most, kept
            while i > 0 and v[k, i - 1] < value:
                z[k, i], s[k, i] = z[k, i - 1], s[k, i - 1]
                d[k, i], v[k, i] = d[k, i - 1], v[k, i - 1]
                i -= 1
            z[k, i], s[k, i], d[k, i], v[k, i] = one, pole, most, value
            kept += 1
        count[k] = kept


def turned(H, tau, x):
    """Turn a vector of the Hessenberg form's coordinates into one of the matrix's, Q x, in place."""
    size = x.size
    for k in range(size - 2, -1, -1):
        along = x[k + 1]
        for i in range(k + 2, size):
            along += H[k, i] * x[i]
        along *= tau[k]
        x[k + 1] -= along
        for i in range(k + 2, size):
            x[i] -= along * H[k, i]


def pole_gradients(H, tau, G, N, z, known, count, period, out):
    r"""Fill `out` with the derivatives of the real parts of poles :math:`s = \ln(z)/h` by gains.

    Parameters
    ----------
    H, tau, G, N : ndarray, shape (L, ., .) and (L, .)
        As in `ranked_poles`.
    z : ndarray, shape (L, p)
    known, count : ndarray, shape (L,)
        Of each loop, the derivatives of poles `known` to `count` - 1 are computed.
    period : ndarray, shape (L,)
        h [s]
    out : ndarray, shape (L, p, n, k)
        Zero where the matrix is singular to the last bit.
    """
    size, n, m = G.shape[1], G.shape[2], N.shape[1]
    by_torque, by_measurement = np.zeros(n, np.complex128), np.zeros(m, np.complex128)
    for k in range(G.shape[0]):
        form = np.ascontiguousarray(H[k].T)
        for p in range(known[k], count[k]):
            x, y = eigenvectors(form, z[k, p])
            turned(H[k], tau[k], x)
            turned(H[k], tau[k], y)
            across = 0.0j
            by_torque[:] = 0.0
            for i in range(size):
                left = np.conj(y[i])
                across += left * x[i]
                for j in range(n):
                    by_torque[j] += left * G[k, i, j]
            for b in range(m):
                total = 0.0j
                for i in range(size):
                    total += N[k, b, i] * x[i]
                by_measurement[b] = total
            by_torque /= -period[k] * z[k, p] * across
            for a in range(n):
                for b in range(m):
                    value = (by_torque[a] * by_measurement[b]).real
                    out[k, p, a, b] = value if np.isfinite(value) else 0.0
