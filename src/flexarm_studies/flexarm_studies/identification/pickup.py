# SPDX-License-Identifier: Apache-2.0
r"""Finds what the bridges of gauges pick up from the motors: noise that all gauges share and that the currents show.

In addition to the strain of its link, every gauge c picks up the motor currents I through the same filter,

.. math::
    e_c(k) = \sum_j \sum_{l=0}^{L} h_{jl}\,I_j(k - l) + r_c(k),

where e is measured minus predicted strain. Both sides pass a high pass without phase. Below its corner the currents
follow the motion, and a regression on them would hide what the model lacks. The filter h is the same for all gauges, so
it describes noise: a vibration gives a different reading on each gauge. The sum of :math:`(r_c/\sigma_c)^2` is smallest
if h is fitted to the mean of the gauges with the weights :math:`1/\sigma_c^2`. This is done by ridge regression
(`ridge`). The filter is used only if it explains blocks of the fitted part to which it was not fitted.
"""

from dataclasses import dataclass

import numpy as np

from flexarm_dynamics.errors import FlexarmError

from . import ridge
from .scores import filled, high_passed

#: Length of the past that is used [s].
PAST = 0.2
#: The filter is used if it leaves less than this fraction of the sum of squares in blocks to which it was not fitted.
USEFUL = 0.99
#: Smallest mean square.
LEAST = 1e-300


@dataclass(frozen=True, eq=False)
class Pickup:
    """The filter of all gauges.

    Attributes
    ----------
    taps : ndarray, shape (L + 1, c)
        Strain per ampere of each joint's current; row l is for the current l samples ago [1/A].
    joints : tuple of int
        Joints whose current was recorded.
    above : float
        Corner of the high pass [Hz].
    left : float
        Remaining fraction of the sum of squares above that frequency, in blocks to which the filter was not fitted [-].
    """

    taps: np.ndarray
    joints: tuple
    above: float
    left: float

    @property
    def useful(self):
        """Whether it explains samples to which it was not fitted."""
        return self.left < USEFUL

    def strain(self, run):
        """What each gauge picks up in a `Recording` with the same currents, shape (s,) [-]."""
        return _past(run, list(self.joints), self.above, len(self.taps)) @ self.taps.ravel()


def fit(run, error, fitted, above):
    """The `Pickup` of a recording.

    Parameters
    ----------
    run : Recording
        With motor currents.
    error : ndarray, shape (s, g)
        Measured minus predicted strains, NaN where they were not measured [-].
    fitted : slice
        Samples that are used.
    above : float
        Corner of the high pass [Hz].

    Raises
    ------
    FlexarmError
        For a recording without currents, and for a frequency out of range.
    """
    if not 0.0 < above < 0.5 / run.period:
        limit = f"above 0, below {0.5 / run.period:g} Hz, half of the rate"
        raise FlexarmError("is out of range", field="--pickup", value=above, limit=limit)
    known = [] if run.current is None else np.flatnonzero(np.isfinite(run.current).all(axis=0))
    if not len(known):
        raise FlexarmError(
            "has no motor current", field="recording",
            hint="leave out --pickup, or map a column to the quantity `current`",
        )  # fmt: skip
    size = 1 + round(PAST / run.period)
    fast = high_passed(filled(error), run.period, above)[fitted]
    weight = 1.0 / np.maximum(np.mean(fast**2, axis=0), LEAST)
    taps, left = ridge.chosen(_past(run, known, above, size)[fitted], fast, weight)
    return Pickup(taps.reshape(size, -1), tuple(int(j) for j in known), above, left)


def _past(run, joints, above, size):
    """High-passed currents of this sample and of earlier ones, shape (s, size c) [A]."""
    return ridge.lagged(high_passed(run.current[:, joints], run.period, above), 0, size - 1)
