# SPDX-License-Identifier: Apache-2.0
r"""Computes values that follow from an arm file: frequencies, damping and coupling of its modes.

They are for the undeformed arm at rest in one configuration, with joints locked and free. The coupling of joint j with
the locked mode i is :math:`\gamma_{ji} = (M_{12}\Psi)_{ji}`, where the mode's shape :math:`\Psi_i` has unit modal mass.
Its square is the part of the inertia about joint j that mode i contributes. Free modes are those of (2) with structural
damping and the joints' viscous friction. Intervals come from the parameters' covariance by the delta method.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import eigh

from flexarm_dynamics.models import model

from .quantities import changed

#: Difference step, as a fraction of a quantity's scale [-].
STEP = 1e-5


@dataclass(frozen=True)
class Derived:
    """A value that follows from the parameters.

    Attributes
    ----------
    name, unit : str
    value : float
    half_width : float
        Half of the 95 % interval; NaN without a covariance.
    """

    name: str
    unit: str
    value: float
    half_width: float


def derived(arm, position, identified=None):
    """Frequencies, damping ratios and coupling of an arm at a joint `position` (n,) [rad], as a list of `Derived`.

    The result of a fit, `identified`, gives their intervals.
    """
    names, values = values_of(arm, position)
    widths = np.full(values.size, np.nan)
    if identified is not None and values.size:
        found, base = identified.quantities, identified.values
        derivative = np.zeros((values.size, len(found)))
        for j in np.flatnonzero(np.isfinite(identified.half_widths)):
            if found[j].kind in ("gain", "bias"):
                continue
            moved = base.copy()
            moved[j] += STEP * found[j].scale
            other = values_of(changed(identified.arm, found, moved), position)[1]
            derivative[:, j] = (other - values) / (STEP * found[j].scale)
        variance = np.einsum("ij,jk,ik->i", derivative, identified.covariance, derivative)
        widths = 1.959964 * np.sqrt(np.maximum(variance, 0.0))
    return [
        Derived(name, unit, float(v), float(w))
        for (name, unit), v, w in zip(names, values, widths, strict=True)
    ]


def values_of(arm, position):
    """Names with units, and values (k,)."""
    built = model.build(arm)
    n, m = built.n_joints, built.n_modes
    if not m:
        return [], np.zeros(0)
    terms, K = built.terms(np.asarray(position, float), np.zeros(n)), built.stiffness_matrix()
    C = np.zeros((n + m, n + m))
    C[n:, n:] = terms.C2
    squares, psi = eigh(K, terms.M[n:, n:])
    omega = np.sqrt(squares)
    damping = np.einsum("ji,jk,ki->i", psi, terms.C2, psi) / (2.0 * omega)
    coupling = terms.M[:n, n:] @ psi
    coupling *= np.where(coupling[0] < 0.0, -1.0, 1.0)
    free, free_damping = _free(terms.M, K, C, built.friction_table()[:, 0], n)
    names, values = [], []
    for what, unit, numbers in (
        ("locked frequency", "Hz", omega / (2.0 * np.pi)),
        ("locked damping", "-", damping),
        ("free frequency", "Hz", free / (2.0 * np.pi)),
        ("free damping", "-", free_damping),
    ):
        names += [(f"{what} {i + 1}", unit) for i in range(len(numbers))]
        values += list(numbers)
    for j, joint in enumerate(built.joint_names):
        names += [(f"coupling {joint} mode {i + 1}", "kg^0.5 m") for i in range(m)]
        values += list(coupling[j])
    return names, np.array(values)


def _free(M, K, C, viscous, n):
    """Angular frequencies and damping ratios of the bending with joints free, ascending."""
    size = M.shape[0]
    stiffness = np.zeros((size, size))
    stiffness[n:, n:] = K
    C = C.copy()
    C[:n, :n] += np.diag(viscous)
    A = np.zeros((2 * size, 2 * size))
    A[:size, size:] = np.eye(size)
    A[size:, :size], A[size:, size:] = -np.linalg.solve(M, stiffness), -np.linalg.solve(M, C)
    poles = np.linalg.eigvals(A)
    poles = poles[poles.imag > 1e-6 * np.abs(poles).max()]
    poles = poles[np.argsort(np.abs(poles))]
    return np.abs(poles), -poles.real / np.abs(poles)
