# SPDX-License-Identifier: Apache-2.0
"""Integration of a plant: fixed steps in real time and in lockstep, error-controlled offline."""

import numpy as np
from scipy.integrate import solve_ivp

from flexarm_dynamics.errors import ModelError
from flexarm_dynamics.models.fixed_step import MAX_SUBSTEPS, METHODS, PHASE_PER_STEP, substeps

__all__ = ["MAX_SUBSTEPS", "METHODS", "PHASE_PER_STEP", "integrate", "substeps"]


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
        When the integration fails.
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
