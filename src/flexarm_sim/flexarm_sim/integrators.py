# SPDX-License-Identifier: Apache-2.0
"""Integrates a plant: with fixed steps in real time and in lockstep, with error control offline."""

import numpy as np
from scipy.integrate import solve_ivp

from flexarm_dynamics.errors import ModelError
from flexarm_dynamics.models.fixed_step import MAX_SUBSTEPS, METHODS, PHASE_PER_STEP, substeps

__all__ = [
    "MAX_SUBSTEPS", "METHODS", "PHASE_PER_STEP", "friction_warning", "integrate", "plant_substeps",
    "straight_mass_matrix", "substeps", "turning_rate",
]  # fmt: skip

#: Maximum of an explicit method's substep times the rate at which friction damps a joint that reverses: in longer
#: substeps light joints hunt. Maximum factor by which this increases the number of substeps [-].
FRICTION_PER_STEP, MOST = 2.0, 16


def straight_mass_matrix(model):
    """Mass matrix of the straight arm, (n + m, n + m)."""
    none = np.zeros(model.n_joints)
    if hasattr(model, "mass_matrix"):  # a chain: all terms would compile its complex recursion
        return model.mass_matrix(none)
    return model.terms(none, none).M


def turning_rate(model):
    r"""Fastest rate at which friction damps a joint that reverses [1/s].

    It is the largest eigenvalue of :math:`H\,\mathrm{diag}\bigl(f_v + (\max(f_c, f_b) + c\,u_{max})/v_0\bigr)`, with
    the joints' block H of the straight arm's inverse mass matrix; see `description.Friction`.
    """
    levels = []
    for joint in model.arm.joints:
        f, limit = joint.friction, joint.limits.torque
        load = f.load * limit if np.isfinite(limit) else 0.0
        levels.append(f.viscous + (max(f.coulomb, f.breakaway) + load) / f.smoothing)
    if not any(levels):
        return 0.0
    H = np.linalg.inv(straight_mass_matrix(model))[: len(levels), : len(levels)]
    return float(np.abs(np.linalg.eigvals(H @ np.diag(levels))).max())


def plant_substeps(model, period, method="dop853"):
    """`substeps` per sample of a `period` [s], increased so that friction does not make light joints hunt."""
    count = substeps(model, period, method)
    if METHODS[method] is None:
        return count
    return count * min(_more(model, period, count), MOST)


def _more(model, period, count):
    """Factor by which friction increases a `count` of substeps per `period` [s], without a limit."""
    return max(int(np.ceil(turning_rate(model) * period / count / FRICTION_PER_STEP)), 1)


def friction_warning(model, period, method="dop853"):
    """What to tell a user where a `method`'s substeps of a `period` [s] stay too long for the friction; else empty.

    `plant_substeps` takes at most `MOST` times as many as the modes need.
    """
    if METHODS[method] is None:
        return ""
    more = _more(model, period, substeps(model, period, method))
    if more <= MOST:
        return ""
    return (
        f"friction stops a light joint of arm {model.arm.name} {more / MOST:.3g} times too fast for the steps of the"
        f" integrator ({turning_rate(model):.3g} 1/s): such a joint may hunt, which the arm would not do. Take a higher"
        " rate, the integrator implicit, a larger friction.smoothing, or write rotor_inertia or hub_inertia"
    )


def integrate(model, state, torque, times, rtol=1e-10, atol=1e-12):
    """Error-controlled solution of the full equations of motion (scipy's DOP853).

    Parameters
    ----------
    model : ArmModel
    state : ndarray, shape (2 (n + m),)
        Initial (q, delta, qd, delta_d).
    torque : callable
        ``torque(t, state)`` -> (n,) [N m]; smooth between the given times.
    times : ndarray, shape (k,)
        Times of the solution, beginning with the initial time [s].
    rtol, atol : float
        Tolerances.

    Returns
    -------
    ndarray, shape (k, 2 (n + m))

    Raises
    ------
    ModelError
        If the integration fails.
    """

    def derivative(t, s):
        out = model.derivative(s, torque(t, s))
        if not np.isfinite(out).all():  # solve_ivp would shorten its step for ever
            raise ModelError(f"integration stopped at {t} s: not finite", field=model.arm.name)
        return out

    if times[0] == times[-1]:
        return np.tile(state, (len(times), 1))
    result = solve_ivp(
        derivative,
        (times[0], times[-1]),
        state,
        method="DOP853",
        t_eval=times,
        rtol=rtol,
        atol=atol,
    )
    if not result.success:
        reached = result.t[-1] if result.t.size else times[0]
        problem = f"integration stopped at {reached} s: {result.message}"
        raise ModelError(problem, field=model.arm.name)
    return result.y.T
