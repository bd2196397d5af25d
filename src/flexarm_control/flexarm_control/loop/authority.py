# SPDX-License-Identifier: Apache-2.0
r"""Bounds the law's torque before it is sent: its size, its rate of change, and the ramp in which it returns.

After any time without torque, the law's torque u returns in a ramp. The ramp starts from u_g, the torque that holds the
arm's weight in its position at that time,

.. math:: u_{sent} = u_g + a(t)\,(u - u_g), \qquad a = \min(1, (t/T)^2),

so that torque and stiffness grow together. In the ramp, u - u_g is bounded by the torque limit. With T = `return_time`
of 65 ms, a is below a tenth for the first 20 ms. Without gravity u_g is zero. If the arm rests and u begins within
`SMALL` of u_g, there is no ramp.

The rate is bounded in the ramp and after it. After lost samples the torque may change no more than in one period,
because an estimate is at its worst then. If the arm file gives no limit of the rate, the limit is
:math:`8\,\omega_1` times the torque limit per second, with omega_1 the lowest bending frequency with the joints locked.
This is the rate of a torque that swings between its limits eight times as fast as the softest mode. A motion needs a
hundredth of it.
"""

import numpy as np

from flexarm_dynamics.errors import FlexarmError
from flexarm_dynamics.parameters import parameter
from flexarm_dynamics.singular_perturbation import slow_torque

from .. import kernels
from ..arrays import clip

#: An arm at rest whose torque begins within this fraction of the torque limit from u_g needs no ramp [-].
SMALL = 0.02
#: This rate limit, or a larger one, means that there is none [N m/s].
NO_RATE = 1e9
#: Rate limit if the arm file gives none, divided by torque limit and lowest bending frequency [-].
BUDGET = 8.0

PARAMETERS = (
    parameter("torque_limit", [0.0], "N m", 0.0, 1e6, length="joints").described(
        "Largest torque sent, per joint; 0.0: the arm file's limits.torque. Never above the arm file's."
    ),
    parameter("torque_rate_limit", [0.0], "N m/s", 0.0, NO_RATE, length="joints").described(
        "Largest change of torque per second, counted from the last torque sent; 0.0: the arm file's"
        " limits.torque_rate; 1e9: no limit."
    ),
    parameter("return_time", 0.065, "s", 0.0, 10.0).described(
        "Time in which torque returns after an interruption, and at the start; 0.0: at once."
    ),
)


def torque_rates(model):
    """Largest rate of each joint's torque, (n,) [N m/s]: the arm file's, else `BUDGET`'s; infinite without both."""
    arm = model.arm
    stated = arm.torque_rates
    if not np.isinf(stated).any() or not model.n_modes:
        return stated
    omega = float(model.frequencies(locked=True)[0])
    return np.where(np.isinf(stated), BUDGET * omega * arm.torque_limits, stated)


class Authority:
    """Keeps the torque within its limits of size and rate, and lets it return in a ramp; see the module.

    Parameters
    ----------
    model : ArmModel
    settings : mapping
        Checked values of `PARAMETERS`.

    Attributes
    ----------
    limit, rate : ndarray, shape (n,)
        Active limits [N m], [N m/s]; infinite where there is none.
    torque : ndarray, shape (n,)
        The torque sent last [N m]; overwritten in place.
    returned : bool
        Whether the ramp is over.
    """

    def __init__(self, model, settings):
        self.model = model
        self._rates = torque_rates(model)
        self.torque, self._weight = np.zeros((2, model.n_joints))
        self._elapsed, self._first = np.inf, False
        self._kernels = kernels.compiled()
        self.configure(settings)

    def configure(self, settings):
        """Take new limits."""
        self.limit = self.limits_of(settings)
        wanted = np.array(settings["torque_rate_limit"])
        self.rate = np.where(wanted > 0.0, wanted, self._rates)
        self.rate[wanted >= NO_RATE] = np.inf
        self._time = settings["return_time"]
        self._small = np.where(np.isfinite(self.limit), SMALL * self.limit, 0.0)

    def limits_of(self, settings):
        """Torque limits that settings ask for, (n,) [N m]; never above the arm file's."""
        from_file, wanted = self.model.arm.torque_limits, np.array(settings["torque_limit"])
        return np.where(wanted > 0.0, np.minimum(wanted, from_file), from_file)

    @property
    def returned(self):
        """Whether the full torque is back."""
        return self._elapsed >= self._time

    def begin(self, q, rests):
        """Begin the ramp at q (n,) [rad] with the torque that holds the weight; `rests`: whether the arm is at rest."""
        self._elapsed, self._first = 0.0, rests
        self._weight[:] = self._holding(q)
        clip(self._weight, -self.limit, self.limit)
        self.torque[:] = self._weight

    def _holding(self, q):
        n = self.model.n_joints
        try:
            found = slow_torque(self.model.terms(q, np.zeros(n)), np.zeros(n))
        except (FlexarmError, np.linalg.LinAlgError):
            return 0.0
        return np.where(np.isfinite(found), found, 0.0)

    def off(self):
        """Set the torque to zero."""
        self.torque[:] = 0.0

    def send(self, u, dt, period):
        """Set `torque` to the law's torque u (n,) [N m], within its limits.

        Parameters
        ----------
        u : ndarray, shape (n,)
            Torque of the law [N m].
        dt : float
            Time since the last torque [s].
        period : float
            Time that counts for the rate limit: `dt` without the time of lost samples [s].

        Returns
        -------
        bool
            Whether a limit was met.
        """
        torque, part = self.torque, 1.0
        if self._first:
            self._first = False
            if (np.abs(u - self._weight) <= self._small).all():
                self._elapsed = np.inf
                # The weight alone may take nearly all of the torque.
                np.clip(u, -self.limit, self.limit, out=torque)
                return bool((torque != u).any())
        if self._elapsed < self._time:
            self._elapsed += dt
            part = min(1.0, (self._elapsed / self._time) ** 2)
        return self._kernels.sent(u, self._weight, part, self.rate, period, self.limit, torque)
