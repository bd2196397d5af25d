r"""Fixed-step integration for the plant, and error-controlled integration offline.

In real time and in lockstep the plant takes an explicit Runge-Kutta method of order eight (Dormand and
Prince, scipy's tableau), in substeps short enough for the highest mode: with omega h = 0.5 it loses less than
1e-9 of that mode's energy a period, where RK4 loses 1e-4.
"""

import numpy as np
from scipy.integrate import DOP853, solve_ivp

from flexarm_dynamics.errors import ModelError
from flexarm_dynamics.model import Tableau

_STAGES = DOP853.n_stages

#: Fixed-step methods: two explicit Runge-Kutta methods, of order 8 and 4, and a linearly implicit one of
#: order 2 (`kernels.chain.implicit_step`), which stays stable however stiff the highest modes are.
METHODS = {
    "dop853": Tableau(
        np.ascontiguousarray(DOP853.A[:_STAGES, :_STAGES]),
        np.ascontiguousarray(DOP853.B),
        np.ascontiguousarray(DOP853.C[:_STAGES]),
    ),
    "rk4": Tableau(
        np.array([[0, 0, 0, 0], [0.5, 0, 0, 0], [0, 0.5, 0, 0], [0, 0, 1.0, 0]]),
        np.array([1, 2, 2, 1]) / 6.0,
        np.array([0, 0.5, 0.5, 1.0]),
    ),
    "implicit": None,
}

#: Highest angular frequency times substep of the explicit methods.
PHASE_PER_STEP = {"dop853": 0.5, "rk4": 0.1}
#: More substeps than this per sample is no simulation any more.
MOST_SUBSTEPS = 10_000


def substeps(model, period, method="dop853"):
    """Substeps per sample that keep the highest free mode's phase below `PHASE_PER_STEP`; implicit: one.

    Parameters
    ----------
    model : ArmModel
    period : float
        Sample period [s].
    method : str
        One of `METHODS`.

    Returns
    -------
    int

    Raises
    ------
    ModelError
        When the highest mode would need more than `MOST_SUBSTEPS`.
    """
    if method not in PHASE_PER_STEP:
        return 1
    highest = float(model.frequencies()[-1]) if model.n_modes else 0.0
    count = max(1, int(np.ceil(highest * period / PHASE_PER_STEP[method])))
    if count > MOST_SUBSTEPS:
        raise ModelError(
            f"{model.arm.name}: its highest mode, {highest:.3g} rad/s, needs {count} substeps per sample"
            f" of {period:g} s (at most {MOST_SUBSTEPS}): fewer modes, or integrator implicit"
        )
    return count


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
        Where the solution is wanted, from the initial time on [s].
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

    def slope(t, s):
        out = model.derivative(s, torque(t, s))
        if not np.isfinite(out).all():  # solve_ivp would shorten its step for ever
            raise ModelError(f"{model.arm.name}: integration stopped at {t} s: not finite any more")
        return out

    if times[0] == times[-1]:
        return np.tile(state, (len(times), 1))
    result = solve_ivp(
        slope,
        (times[0], times[-1]),
        state,
        method="DOP853",
        t_eval=times,
        rtol=rtol,
        atol=atol,
    )
    if not result.success:
        reached = result.t[-1] if result.t.size else times[0]
        raise ModelError(f"{model.arm.name}: integration stopped at {reached} s: {result.message}")
    return result.y.T
