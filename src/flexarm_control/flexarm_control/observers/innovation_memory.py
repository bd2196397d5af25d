# SPDX-License-Identifier: Apache-2.0
r"""Predicts a filter's next innovation from its past ones.

A Kalman filter with the right model leaves white innovations. Vibration that its model lacks, and noise of another
colour than it assumes, make successive innovations correlated. A noise model in series with the filter,

.. math::
    \hat\nu_k = \sum_{l=1}^{L} A_l\,\nu_{k-l},

predicts that part (Ljung, System Identification, 1999, 3.2: the prediction of a model with coloured noise). The
matrices A_l, from all gauges to all gauges, are estimated online by recursive least squares without forgetting,

.. math::
    k = \frac{P\varphi}{1 + \varphi^TP\varphi}, \quad \Theta \leftarrow \Theta + k(\nu - \Theta^T\varphi)^T, \quad
    P \leftarrow P - k\varphi^TP,

where :math:`\varphi` are the last innovations, each in units of its gauge's noise, with a wide prior about zero. The
filter's state does not depend on this prediction.
"""

import numpy as np

#: Prior variance of the coefficients, for innovations in units of the noise.
PRIOR = 10.0


class InnovationMemory:
    """Predicts innovations from past ones; see the module.

    Parameters
    ----------
    noise : ndarray, shape (g,)
        Noise of each gauge [-], above zero.
    order : int
        L; 0: the prediction is zero.

    Attributes
    ----------
    learning : bool
        Whether coefficients follow the innovations; set to False to keep them.
    coefficients : ndarray, shape (L g, g)
        The transposed A_l, that of the newest sample first.
    """

    def __init__(self, noise, order):
        g = len(noise)
        self._noise, self.learning = np.asarray(noise, float), True
        self.coefficients = np.zeros((order * g, g))
        self._past = np.zeros(order * g)
        self._P = PRIOR * np.eye(order * g)

    def forget_past(self):
        """Forget the past innovations after a gap, so that none predicts the next one."""
        self._past[:] = 0.0

    def predict(self):
        """The predicted next innovation, shape (g,) [-]."""
        return self._noise * (self._past @ self.coefficients)

    def take(self, innovation):
        """Learn from an innovation (g,) and remember it; with NaN, for a gauge that is left out, nothing is learnt."""
        if not self._past.size:
            return
        known = np.isfinite(innovation)
        scaled = np.where(known, innovation, 0.0) / self._noise
        if self.learning and known.all():
            change = self._P @ self._past
            gain = change / (1.0 + self._past @ change)
            self.coefficients += np.outer(gain, scaled - self._past @ self.coefficients)
            self._P -= np.outer(gain, change)
        self._past = np.concatenate([scaled, self._past[: -scaled.size]])
