# SPDX-License-Identifier: Apache-2.0
"""Computes time scales over the workspace: mu, spectra of slow and fast subsystem, and reachability by the torques.

mu is the paper's estimate: the highest frequency of the slow subsystem under its control, divided by the smallest
frequency of the boundary layer (11) without control.
"""

import numpy as np

from flexarm_control.composite import full_order
from flexarm_dynamics.errors import DesignError, FlexarmError
from flexarm_dynamics.singular_perturbation import (
    fast_subsystem,
    frequencies_and_damping,
    is_stabilisable,
    time_scales,
)

from . import case as cases

#: Range of joints without limits, to either side [rad].
TURN = np.pi
#: Factors of slow.kp in the sweep.
GAINS = np.geomspace(0.1, 10.0, 13)


def pairs(values):
    """Complex numbers as JSON has them: [real, imaginary]."""
    return [[float(v.real), float(v.imag)] for v in np.atleast_1d(values).astype(complex)]


def slow_poles(case):
    """Poles of the slow subsystem under its control, at the motion's end [1/s]; None for a law that has none."""
    law, n = case.law, case.model.n_joints
    if law.slow.drifts:
        return None
    gains = law.slow.error_gains()
    if gains is not None:
        kp, kv = (np.broadcast_to(g, n) for g in gains)
        return np.concatenate([np.roots([1.0, v, p]) for p, v in zip(kp, kv, strict=True)])
    from .bound import blocks

    return np.linalg.eigvals(blocks(case).A11)


def at(case, q, qd, slow):
    """Time scales and reachability at one state, for these poles of the `slow` subsystem [1/s].

    Returns ``mu``, ``mu_closed`` (of the controlled boundary layer), and ``singular_value`` of Hautus' test.
    """
    terms = case.model.terms(q, qd)
    A2, B2 = fast_subsystem(terms)
    speed = np.abs(slow).max()
    smallest = np.abs(np.linalg.eigvals(A2)).min()
    if smallest == 0.0:
        raise DesignError("a fast eigenvalue is zero: the deflections have no stiffness here")
    K = case.law.fast.gain(q)
    closed = None if K is None else np.abs(np.linalg.eigvals(A2 + B2 @ K)).min()
    # This tests every mode that does not decay by itself, or decays slower than required.
    alpha = float(case.law.fast.parameters.get("alpha", 0.0))
    ok, worst = is_stabilisable(A2, B2, alpha)
    return {
        "mu": float(speed / smallest),
        "mu_closed": None if closed is None else float(speed / closed),
        "stabilisable": ok,
        "singular_value": worst if np.isfinite(worst) else None,
    }


def configurations(model, count, seed):
    """Configurations within the joints' limits: evenly spaced for one joint, else random, shape (count, n) [rad]."""
    ranges = []
    for joint in model.arm.joints:
        low, high = joint.limits.position
        ranges.append((low if np.isfinite(low) else -TURN, high if np.isfinite(high) else TURN))
    low, high = np.array(ranges).T
    if len(ranges) == 1:
        return np.linspace(low, high, count)
    return np.random.default_rng(seed).uniform(low, high, (count, len(ranges)))


def study(case, count=200, seed=0):
    """Time scales along the motion and in `count` configurations of the workspace.

    Ready for JSON; only ``reason`` if there is no slow loop, or no modes.
    """
    slow = slow_poles(case)
    if slow is None or not case.model.n_modes:
        why = case.without_poles or f"{case.model.arm.name} has no modes"
        return {"reason": f"{why}: there are no two time scales"}
    along = [at(case, q, qd, slow) for q, qd in zip(case.positions, case.velocities, strict=True)]
    n = case.model.n_joints
    everywhere = configurations(case.model, count, seed)
    over = [at(case, q, np.zeros(n), slow) for q in everywhere]
    return {
        "reason": "",
        "spectra": spectra(case, slow),
        "along": {"time_s": case.times.tolist(), **_columns(along)},
        "along_worst": _worst(along, case.positions),
        "workspace": {"count": count, **_worst(over, everywhere)},
    }


def _columns(rows):
    return {k: [r[k] for r in rows] for k in rows[0]}


def _worst(rows, positions):
    mu = np.array([r["mu"] for r in rows])
    reach = np.array([np.inf if r["singular_value"] is None else r["singular_value"] for r in rows])
    k = int(np.argmin(reach))
    return {
        "mu_min": float(mu.min()),
        "mu_max": float(mu.max()),
        "mu_max_at_rad": np.asarray(positions[int(np.argmax(mu))]).tolist(),
        "stabilisable": all(r["stabilisable"] for r in rows),
        "singular_value_min": float(reach[k]) if np.isfinite(reach[k]) else None,
        "singular_value_min_at_rad": np.asarray(positions[k]).tolist(),
    }


def spectra(case, slow):
    """Poles of the slow and the fast subsystem, open and closed, and of the whole loop, at the motion's end."""
    model, q = case.model, case.q
    terms, K = model.terms(q, np.zeros(model.n_joints)), case.law.fast.gain(q)
    opened = time_scales(terms).fast
    closed = None if K is None else time_scales(terms, K_f=K).fast
    smallest = None if closed is None else np.abs(closed).min()
    return {
        "at_rad": q.tolist(),
        "slow_open": pairs(np.zeros(2 * model.n_joints)),
        "slow_closed": pairs(slow),
        "fast_open": pairs(opened),
        "fast_closed": None if closed is None else pairs(closed),
        "full_order": pairs(case.poles()),
        "separation_open": float(np.abs(opened).min() / np.abs(slow).max()),
        "separation_closed": None if smallest is None else float(smallest / np.abs(slow).max()),
    }


def gain_sweep(case, factors=GAINS):
    """Effect of a faster slow loop on the bending: full-order poles over slow.kp, with kv for critical damping.

    `factors` multiply slow.kp [-]. Returns ``reason``, or ``rows``: per factor the fast modes' frequency [rad/s] and
    damping ratio (those of the 2m fastest poles), the slowest pole's real part and the poles; a row whose design fails
    has None.
    """
    parameters = case.law.slow.parameters
    if not {"kp", "kv"} <= set(parameters):
        return {"reason": "the slow law has no gains slow.kp, slow.kv", "rows": []}
    if case.without_poles:
        return {"reason": case.without_poles, "rows": []}
    kp, rows = np.asarray(parameters["kp"], float), []
    for factor in factors:
        row = {"factor": float(factor), "kp": (factor * kp).tolist()}
        row["kv"] = (2.0 * np.sqrt(factor * kp)).tolist()
        rows.append(row | _swept(case, row["kp"], row["kv"]))
    return {"reason": "", "rows": rows}


def _swept(case, kp, kv):
    nothing = {"fast_frequencies": None, "fast_damping": None, "slowest": None, "poles": None}
    try:
        law = cases.redesigned(case, slow__kp=kp, slow__kv=kv)
    except FlexarmError:
        return nothing
    s = full_order.poles(law, case.q, case.period)
    fast = s[np.argsort(np.abs(s))][-2 * case.model.n_modes :]
    omega, zeta = frequencies_and_damping(fast)
    return {
        "fast_frequencies": omega.tolist(),
        "fast_damping": zeta.tolist(),
        "slowest": float(s[0].real),
        "poles": pairs(s),
    }
