# SPDX-License-Identifier: Apache-2.0
r"""Fading of jumps: when one signal replaces another, the output changes to the new one without a step.

The old signal minus the new one, at the exchange, is added to the new signal and fades:

.. math::
    s(t) + \sum_i J_i\,\phi(t - t_i), \qquad
    \phi(t) = \bigl(1 + \lambda t + \tfrac{1}{2}\lambda^2t^2\bigr)\,e^{-\lambda t}.

J_i is the old signal minus the new one at t_i. The first two derivatives of phi are zero at the exchange. A hundredth
is left after 8.4 / lambda; with lambda = `FADING` omega_1 this is a ninth of the lowest bending mode's period.
"""

import numpy as np

from . import kernels

#: Ratio of lambda to the lowest bending frequency with locked joints.
FADING = 12.0
#: A jump counts as gone when less than this is left of it in every coordinate and torque.
GONE = 1e-12
#: Used for a rigid arm in place of the lowest bending frequency [rad/s].
RIGID = 10.0


def lowest(model, q=None):
    """Lowest bending frequency with the joints locked at q, omega_1 [rad/s]; `RIGID` for a rigid arm."""
    return float(model.frequencies(q, locked=True)[0]) if model.n_modes else RIGID


def fading_rate(model, q=None):
    """Rate at which jumps of an arm's signals fade, lambda [1/s], with the joints at q; without q, straight."""
    return FADING * lowest(model, q)


class Fading:
    """Jumps that fade; see the module.

    Parameters
    ----------
    size : int
        Size of the signal that jumps.
    rate : float
        lambda [1/s].
    """

    def __init__(self, size, rate):
        self.rate = rate
        # (c0 + c1 t + c2 t^2) e^{-lambda t} from now on is the sum of all jumps, however many there were.
        self._c, self._active = np.zeros((3, size)), False

    @property
    def left(self):
        """What is left of all jumps, shape (size,)."""
        return self._c[0]

    def clear(self):
        """Forget all jumps."""
        self._c[:], self._active = 0.0, False

    def take(self, other):
        """Take the jumps of another `Fading` of the same size."""
        self._c[:], self._active = other._c, other._active

    def advance(self, dt):
        """Go on by a time [s]."""
        if not self._active:
            return
        if kernels.compiled().faded(self._c, self.rate, dt) < GONE:
            self.clear()

    def jump(self, by):
        """Add a jump, (size,)."""
        for c, factor in zip(self._c, (1.0, self.rate, 0.5 * self.rate**2), strict=True):
            c += factor * by
        self._active = True
