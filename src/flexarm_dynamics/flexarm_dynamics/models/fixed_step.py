# SPDX-License-Identifier: Apache-2.0
r"""Fixed-step methods for an arm's compiled integrators, and how short their steps must be.

Dormand and Prince's explicit Runge-Kutta method of order eight (scipy's tableau): with omega h = 1 it loses 3e-7 of a
mode's energy a period, and of one of half the frequency 6e-10; RK4 loses 9e-7 with omega h = 0.1. The structural
damping of an arm takes a thousandth and more.
"""

import numpy as np
from scipy.integrate import DOP853

from ..errors import ModelError
from .model import Tableau

_STAGES = DOP853.n_stages

#: Two explicit Runge-Kutta methods, of order 8 and 4, and a linearly implicit one of order 2
#: (`kernels.implicit_steps.implicit_step`), which stays stable however stiff the highest modes are.
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
PHASE_PER_STEP = {"dop853": 1.0, "rk4": 0.1}
#: Where there is play, fastest transmission's angular frequency times substep, of all methods: each time flanks meet
#: or part, a step loses some 1e-6 of the energy.
PLAY_PHASE_PER_STEP = 0.05
#: More substeps than this per sample is no simulation any more.
MAX_SUBSTEPS = 10_000


def substeps(model, period, method="dop853"):
    """Substeps per sample that keep the highest free mode's phase below `PHASE_PER_STEP`; implicit: one.

    With play in a transmission, all methods also keep that one's phase below `PLAY_PHASE_PER_STEP`.

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
        When the highest mode would need more than `MAX_SUBSTEPS`.
    """
    fastest, with_play = model.transmission_rates()
    count = max(1, int(np.ceil(with_play * period / PLAY_PHASE_PER_STEP)))
    highest = with_play
    if method in PHASE_PER_STEP:
        highest = max(fastest, float(model.frequencies()[-1]) if model.n_modes else 0.0)
        count = max(count, int(np.ceil(highest * period / PHASE_PER_STEP[method])))
    if count > MAX_SUBSTEPS:
        raise ModelError(
            f"rad/s needs {count} substeps per sample of {period:g} s",
            field=f"highest mode of {model.arm.name}",
            value=highest,
            limit=f"at most {MAX_SUBSTEPS}",
            hint="take fewer modes, or integrator implicit",
        )
    return count
