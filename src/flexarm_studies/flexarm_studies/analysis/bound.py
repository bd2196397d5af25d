# SPDX-License-Identifier: Apache-2.0
r"""Computes how large mu may be, by the composite Lyapunov function of Saberi and Khalil, for the loop as designed.

The closed loop, continuous and linear about rest at the motion's end, in slow error x = (q, qd) and fast deviation
y = z_f, reads without any approximation

.. math::
    \dot x &= A_{11}x + A_{12}y, \\
    \dot y &= A_{21}x + \left(\tfrac{\mu}{\varepsilon}A_f + R\right)y, \qquad A_f = A_2 + B_2K_f,

at epsilon = mu: A_f is the boundary layer (11) under its control, R contains everything else that moves y. Slower
bending is a larger epsilon. With :math:`A_{11}^TP_1 + P_1A_{11} = -S_1^TS_1`, :math:`A_f^TP_2 + P_2A_f = -S_2^TS_2` and
the composite function :math:`\nu = (1-d)x^TP_1x + d\,y^TP_2y`, theorem 1 of Saberi & Khalil (1984) (Kokotovic, Khalil &
O'Reilly 1986, theorem 7.5.1 there; Khalil, Nonlinear Systems, theorem 11.3) requires

.. math::
    \dot V|_{y=0} \le -\alpha_1\psi_1^2, \quad \dot W|_{layer} \le -\alpha_2\psi_2^2, \quad
    2x^TP_1A_{12}y \le \beta_1\psi_1\psi_2, \quad
    2y^TP_2(A_{21}x + Ry) \le \beta_2\psi_1\psi_2 + \gamma\psi_2^2

with :math:`\psi_1 = |S_1x|, \psi_2 = |S_2y|`, so that alpha_1 = alpha_2 = 1, and gives stability for all

.. math:: \varepsilon < \varepsilon^* = \frac{\alpha_1\alpha_2}{\alpha_1\gamma + \beta_1\beta_2}
    \quad\text{at}\quad d^* = \frac{\beta_1}{\beta_1 + \beta_2}.

S_1 and S_2 are free: they are chosen for the largest bound, numerically.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import matrix_balance, solve_continuous_lyapunov

# Not `solve_triangular`: for matrices of this size its threads take ten times as long as the arithmetic.
from scipy.linalg.blas import dtrsm
from scipy.optimize import minimize

from flexarm_control.composite import full_order
from flexarm_dynamics import linear
from flexarm_dynamics.errors import DesignError
from flexarm_dynamics.singular_perturbation import fast_subsystem

from ..loop import scenario as scenarios
from . import case as cases
from . import trial

#: Largest factor of mu that is tried: bending slower by this factor [-].
MAX_FACTOR = 30.0
#: Runs are made this fraction below and above the limit [-].
BESIDE = 0.15


@dataclass(frozen=True)
class Blocks:
    """The linear closed loop in slow error and fast deviation; see the module."""

    A11: np.ndarray
    A12: np.ndarray
    A21: np.ndarray
    A_f: np.ndarray
    R: np.ndarray

    def matrix(self, factor):
        """The loop with mu times a factor, shape (2 (n + m), 2 (n + m))."""
        return np.block([[self.A11, self.A12], [self.A21, self.A_f / factor + self.R]])


def blocks(case):
    """The case's loop as `Blocks`; a fast law with states, and an arm without modes, are refused."""
    model, law, q = case.model, case.law, case.q
    n, m = model.n_joints, model.n_modes
    K = law.fast.gain(q)
    if not m:
        raise DesignError("has no modes: there is no fast subsystem", field=model.arm.name)
    if K is None:
        raise DesignError("the fast law has states: the theorem is applied to K_f z_f only")
    A, B = linear.linear_plant(model, q)
    U, Z = full_order.linear_law(law, q)
    joints = np.zeros((2 * n, A.shape[0]))
    joints[:n, :n] = joints[n:, n + m : 2 * n + m] = np.eye(n)
    to = np.vstack([joints, Z])
    closed = to @ (A + B @ (U + K @ Z)) @ np.linalg.inv(to)
    A2, B2 = fast_subsystem(model.terms(q, np.zeros(n)))
    A_f = A2 + B2 @ K
    k = 2 * n
    return Blocks(closed[:k, :k], closed[:k, k:], closed[k:, :k], A_f, closed[k:, k:] - A_f)


def constants(b, S1, S2):
    """alpha_1, alpha_2, beta_1, beta_2, gamma, d* and the bound, as a factor of mu, for weights S1, S2."""
    P1 = solve_continuous_lyapunov(b.A11.T, -S1.T @ S1)
    P2 = solve_continuous_lyapunov(b.A_f.T, -S2.T @ S2)

    def by_weights(left, M, right):  # left^-T M right^-1
        return dtrsm(1.0, right, dtrsm(1.0, left, M, trans_a=1), side=1)

    beta1 = 2.0 * np.linalg.norm(by_weights(S1, P1 @ b.A12, S2), 2)
    beta2 = 2.0 * np.linalg.norm(by_weights(S2, P2 @ b.A21, S1), 2)
    symmetric = by_weights(S2, P2 @ b.R + b.R.T @ P2, S2)
    gamma = max(float(np.linalg.eigvalsh(0.5 * (symmetric + symmetric.T))[-1]), 0.0)
    below = gamma + beta1 * beta2
    return {
        "alpha1": 1.0,
        "alpha2": 1.0,
        "beta1": float(beta1),
        "beta2": float(beta2),
        "gamma": gamma,
        "d": float(beta1 / (beta1 + beta2)) if beta1 + beta2 > 0.0 else 0.5,
        "factor": float(1.0 / below) if below > 0.0 else math.inf,
    }


def optimised(b, evaluations=2500):
    """`constants` with the largest bound that a search over the weights finds, in about this number of `evaluations`.

    `b` are the `Blocks`. If the slow or the fast part alone is unstable, the theorem does not apply: a DesignError.
    """
    for name, A in (("slow", b.A11), ("fast", b.A_f)):
        worst = np.linalg.eigvals(A).real.max()
        if worst >= -1e-9:
            raise DesignError(f"the {name} part alone is not stable, a pole at {worst:.3g} 1/s")
    k, m = len(b.A11), len(b.A_f)

    def weights(p):
        return _triangular(p[: k * (k + 1) // 2], k), _triangular(p[k * (k + 1) // 2 :], m)

    def cost(p):
        try:
            value = math.log(constants(b, *weights(p))["factor"])
        except (np.linalg.LinAlgError, ValueError):
            return 1e3
        return -value if math.isfinite(value) else 1e3

    best = None
    for start in _starts(b):
        p = start
        # Norms have kinks at which a search along gradients stops: it is restarted from there.
        left, before = evaluations // 2, math.inf
        while left > 0:
            found = minimize(cost, p, method="L-BFGS-B", options={"maxfun": left, "maxiter": 200})
            left -= max(found.nfev, 1)
            if found.fun > before - 1e-3:
                break
            p, before = found.x, found.fun
        if best is None or cost(p) < best[0]:
            best = (cost(p), p)
    return constants(b, *weights(best[1]))


def _triangular(p, size):
    """Upper triangular matrix from the logarithms of its diagonal and the other entries relative to the diagonal."""
    diagonal = np.exp(np.clip(p[:size], -50.0, 50.0))
    S = np.zeros((size, size))
    S[np.triu_indices(size, 1)] = p[size:]
    return diagonal[:, None] * (S + np.eye(size)) if size else S


def _starts(b):
    """First weights: balanced units, and units in which the parts are as close to normal matrices as possible."""
    for near in (_balanced, _modal):
        yield np.concatenate([_parameters(near(b.A11)), _parameters(near(b.A_f))])


def _balanced(A):
    _, (units, _) = matrix_balance(A, permute=False, separate=True)
    return np.diag(1.0 / units)


def _modal(A):
    """Square root of the inverse Gramian of the eigenvectors, regularised for a defective A."""
    units = _balanced(A)
    scaled = units @ A @ np.linalg.inv(units)
    _, V = np.linalg.eig(scaled)
    G = np.linalg.inv((V @ V.conj().T).real + 1e-3 * np.eye(len(A)))
    return np.linalg.cholesky(0.5 * (G + G.T)).T @ units


def _parameters(S):
    S = np.linalg.qr(S)[1]
    S = S * np.sign(np.diag(S))[:, None]
    diagonal = np.diag(S)
    return np.concatenate([np.log(diagonal), (S / diagonal[:, None])[np.triu_indices(len(S), 1)]])


def stable_factor(b, until=MAX_FACTOR):
    """Factor of mu up to which the linear loop of the theorem is in fact stable; None if it is up to `until`."""
    return cases.first_loss(
        lambda f: np.linalg.eigvals(b.matrix(f)).real.max() < -full_order.ROUNDING,
        1.0,
        until,
        scan=60,
    )


def redesign_factor(case, until=MAX_FACTOR):
    """Factor of mu up to which a design made for the slower bending is stable, by the poles of the sampled loop.

    None if it is stable up to `until`.
    """

    def stable(factor):
        try:
            slower = cases.slower_bending(case.scenario, factor)
            slower = replace(slower, controller=slower.controller | {"feedforward": "none"})
            law = scenarios.loop_of(slower).controller.law
        except DesignError:
            return False
        return full_order.poles(law, case.q, case.period)[0].real < -full_order.ROUNDING

    return cases.first_loss(stable, 1.0, until, scan=10, steps=8)


def simulated(case, factor):
    """Nonlinear runs of redesigned loops, on either side of the factor of mu from `redesign_factor`."""
    found = {}
    for name, beside in (("inside", 1.0 - BESIDE), ("beyond", 1.0 + BESIDE)):
        f = factor * beside
        slower = cases.slower_bending(case.scenario, f)
        watched = min(trial.WATCHED * max(f, 1.0), trial.MAX_WATCHED)
        found[name] = trial.dies_out(slower, case.q, watched=watched)
        found[f"{name}_factor"] = f
    return found


def study(case, mu, quick=False):
    """The bound, and the mu at which the loop in fact becomes unstable; if `quick`, by a shorter search, without runs.

    Returns ``mu`` of the design; ``bound``, a mu, and its constants; ``linear_limit`` and ``redesign_limit``, the mu at
    which the linear family and the redesigned loop lose stability (None: not up to ``searched``; mu itself: the design
    is unstable); and ``simulated``, whether nonlinear runs on either side of the latter are stable. Without a bound, it
    returns ``reason``.
    """
    found = {"mu": mu, "searched": MAX_FACTOR * mu}
    reason = case.without_poles
    if not reason:
        try:
            b = blocks(case)
            c = optimised(b, 600 if quick else 2500)
        except DesignError as error:
            reason = str(error)
    if reason:
        return found | {"bound": None, "reason": reason}
    factors = {"linear_limit": stable_factor(b), "redesign_limit": redesign_factor(case)}
    limits = {k: None if v is None else v * mu for k, v in factors.items()}
    runs = None
    if not quick and factors["redesign_limit"] is not None:
        runs = simulated(case, factors["redesign_limit"])
        runs |= {f"{k}_mu": runs.pop(f"{k}_factor") * mu for k in ("inside", "beyond")}
    return found | {
        "bound": c["factor"] * mu,
        "constants": c,
        **limits,
        "simulated": runs,
        "reason": "",
    }
