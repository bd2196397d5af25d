# SPDX-License-Identifier: Apache-2.0
r"""Fixed-step methods for an arm's compiled integrators, and how short their steps must be.

Dormand and Prince's explicit Runge-Kutta method of order eight (scipy's tableau): with omega h = 1 it loses 3e-7 of a
mode's energy per period, and 6e-10 for a mode of half that frequency. RK4 loses 9e-7 with omega h = 0.1. With omega h =
2, Dormand and Prince's method loses 2e-4, while a structural damping of 0.01 takes 0.12 of the mode's energy: such a
mode needs less resolution than an undamped one.
"""

import numpy as np
from scipy.integrate import DOP853

from ..errors import ModelError
from .model import Tableau

_STAGES = DOP853.n_stages

#: Two explicit Runge-Kutta methods, of order 8 and 4, and a linearly implicit one of order 2
#: (`kernels.implicit_steps.implicit_step`). At rest, the last one stays stable however stiff the highest modes are; the
#: stiffness that a motion's loads add to a bent arm is treated explicitly.
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
#: A damped mode may have a larger phase per step, up to this, as long as the method takes no more than this fraction of
#: the energy that the mode's own damping takes.
DAMPED_PHASE_PER_STEP, PART_OF_DAMPING = {"dop853": 2.0, "rk4": 0.1}, 0.01
#: With play: angular frequency of the fastest transmission times substep, for all methods. Each time flanks meet or
#: part, a step loses some 1e-6 of the energy.
PLAY_PHASE_PER_STEP = 0.05
#: A simulation that needs more substeps than this per sample is refused.
MAX_SUBSTEPS = 10_000


def substeps(model, period, method="dop853", undamped=False):
    """Substeps per sample that keep the highest free mode's phase below `PHASE_PER_STEP`; implicit: one.

    Without transmissions, the phase of damped modes may be up to `DAMPED_PHASE_PER_STEP`, see there.

    With play in a transmission, all methods also keep the transmission's phase below `PLAY_PHASE_PER_STEP`.

    Parameters
    ----------
    model : ArmModel
    period : float
        Sample period [s].
    method : str
        One of `METHODS`.
    undamped : bool
        True: treat damped modes as undamped.

    Returns
    -------
    int

    Raises
    ------
    ModelError
        If the highest mode needs more than `MAX_SUBSTEPS`.
    """
    fastest, with_play = model.transmission_rates()
    count = max(1, int(np.ceil(with_play * period / PLAY_PHASE_PER_STEP)))
    highest = with_play
    if method in PHASE_PER_STEP:
        highest = max(fastest, float(model.frequencies()[-1]) if model.n_modes else 0.0)
        count = max(count, int(np.ceil(highest * period / PHASE_PER_STEP[method])))
        if count > 1 and not (undamped or fastest or with_play):
            count = _damped_substeps(model, period, method, count)
    if count > MAX_SUBSTEPS:
        raise ModelError(
            f"rad/s needs {count} substeps per sample of {period:g} s",
            field=f"highest mode of {model.arm.name}",
            value=highest,
            limit=f"at most {MAX_SUBSTEPS}",
            hint="take fewer modes, or integrator implicit",
        )
    return count


def lost(method, phase):
    r"""Fraction of a mode's energy that an explicit method takes per period.

    Parameters
    ----------
    method : str
    phase : ndarray, shape (k,)
        :math:`\phi`, by which modes turn in a step [rad].

    Returns
    -------
    ndarray, shape (k,)
        :math:`1 - |R(i\phi)|^{4\pi/\phi}`, with the method's :math:`R(z) = 1 + z\,b^T(I - zA)^{-1}\mathbf{1}` [-].
    """
    tableau, ones = METHODS[method], np.ones(len(METHODS[method].weights))
    z = 1j * np.asarray(phase, float)[..., None, None]
    stages = np.linalg.solve(np.eye(ones.size) - z * tableau.A, ones[:, None])
    gain = 1.0 + (z * tableau.weights @ stages)[..., 0, 0]
    return 1.0 - np.abs(gain) ** (4.0 * np.pi / phase)


def _damped_substeps(model, period, method, count):
    """The fewest substeps, at most `count`, with which the method's loss is small compared with each mode's damping."""
    n = model.n_joints
    omega, shapes = model.normal_modes()
    C = model.terms(np.zeros(n), np.zeros(n)).C2
    damping = np.einsum("ki,kl,li->i", shapes[n:], C, shapes[n:])  # of modes of unit mass [1/s]
    allowed = PART_OF_DAMPING * 2.0 * np.pi * damping / omega
    for fewer in range(int(np.ceil(omega[-1] * period / DAMPED_PHASE_PER_STEP[method])), count):
        phase = omega * period / fewer
        beyond = phase > PHASE_PER_STEP[method]
        if (lost(method, phase[beyond]) <= allowed[beyond]).all():
            return fewer
    return count
