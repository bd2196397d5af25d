# SPDX-License-Identifier: Apache-2.0
r"""Joins the same mode from several windows: spread of frequency and damping, and dependence on the joints.

Between configurations the frequency is :math:`f(q) = f_0 + g\cdot(q - \bar q)`, fitted by least squares that are
weighted with the intervals. It is used if it predicts left-out windows clearly better than a constant does.
"""

from dataclasses import dataclass

import numpy as np

#: Modes are different if the logarithms of their frequencies differ by more than this [-].
GAP = 0.2
#: An amplitude divided by this power of omega is the amplitude of a deflection.
POWERS = {"linear_acceleration": 2, "acceleration": 2, "velocity": 1, "angular_velocity": 1}
#: A fit over the joints is used if its error for left-out windows is below this fraction of the mean's error [-].
BETTER = 0.6
#: A joint that moves less than this between the windows has no slope [rad or m].
MOVES = 0.02


@dataclass(frozen=True, eq=False)
class Family:
    """A mode that was found in several windows.

    Attributes
    ----------
    modes : tuple of Mode
        One per window in which the mode rings.
    windows : tuple of int
        Indices of these windows.
    part : float
        Fraction of the squares of all deflections, over all windows and channels [-].
    """

    modes: tuple
    windows: tuple
    part: float

    def values(self, name):
        """An attribute of all its modes, such as ``frequency``, shape (k,)."""
        return np.array([getattr(mode, name) for mode in self.modes])

    @property
    def frequencies(self):
        """Lowest and highest frequency, including their intervals [Hz]."""
        value, width = self.values("frequency"), self.values("frequency_width")
        return float((value - width).min()), float((value + width).max())

    @property
    def dampings(self):
        """Lowest, median and highest damping ratio that was found [-]."""
        return tuple(float(d) for d in np.quantile(self.values("damping"), (0.0, 0.5, 1.0)))

    @property
    def frequency(self):
        """Middle of `frequencies` [Hz]."""
        return float(np.mean(self.frequencies))


@dataclass(frozen=True, eq=False)
class Dependence:
    """Dependence of a family's frequency on the joints.

    Attributes
    ----------
    mean : ndarray, shape (n,)
        Mean configuration [rad].
    frequency : float
        Frequency at the mean configuration [Hz].
    slope : ndarray, shape (n,)
        [Hz/rad]
    error, constant_error : float
        Rms error of its prediction for a left-out window, and of the prediction by the mean [Hz].
    """

    mean: np.ndarray
    frequency: float
    slope: np.ndarray
    error: float
    constant_error: float

    @property
    def counts(self):
        """Whether it predicts better than the mean."""
        return self.error < BETTER * self.constant_error

    def at(self, configuration):
        """Frequency at a configuration (n,) [Hz]."""
        return float(self.frequency + self.slope @ (configuration - self.mean))


def families(windows, quantities):
    """The modes of several windows, joined.

    Parameters
    ----------
    windows : sequence of Window
    quantities : sequence of str
        Of each channel.

    Returns
    -------
    list of Family
        Ascending.
    """
    all_modes = [(mode, i) for i, window in enumerate(windows) for mode in window.fit.modes]
    all_modes.sort(key=lambda item: item[0].frequency)
    if not all_modes:
        return []
    squares = np.array([_deflections(mode, quantities) ** 2 for mode, _ in all_modes])
    # All quantities have the same weight, independent of their units. Within a quantity, channels that ring more have
    # more weight.
    size = {
        q: squares[:, [k for k, of in enumerate(quantities) if of == q]].sum() for q in quantities
    }
    weight = np.array([1.0 / max(size[q], 1e-300) for q in quantities]) / len(size)
    parts = squares @ weight
    groups = _groups(all_modes, list(range(len(all_modes))))
    return [
        Family(
            tuple(all_modes[k][0] for k in group),
            tuple(all_modes[k][1] for k in group),
            float(parts[group].sum()),
        )
        for group in groups
    ]


def _deflections(mode, quantities):
    powers = np.array([POWERS.get(q, 0) for q in quantities])
    return mode.amplitude / (2.0 * np.pi * mode.frequency) ** powers


def _groups(all_modes, members):
    """Split at the widest gap until no gap is wide, and no window is twice in a group."""
    if len(members) == 1:
        return [members]
    gaps = np.diff(np.log([all_modes[k][0].frequency for k in members]))
    widest = int(np.argmax(gaps))
    windows = [all_modes[k][1] for k in members]
    if gaps[widest] <= GAP and len(set(windows)) == len(windows):
        return [members]
    left, right = members[: widest + 1], members[widest + 1 :]
    return _groups(all_modes, left) + _groups(all_modes, right)


def dependence(family, windows):
    """How a family's frequency depends on the joints; None if too few windows have it, or no joint moved between them.

    Parameters
    ----------
    family : Family
    windows : sequence of Window
        All, as for `families`.

    Returns
    -------
    Dependence or None
    """
    configurations = np.array([windows[i].configuration for i in family.windows])
    moves = np.ptp(configurations, axis=0) > MOVES
    count = len(family.modes)
    if count < moves.sum() + 3 or not moves.any():
        return None
    mean = configurations.mean(axis=0)
    B = np.column_stack([np.ones(count), (configurations - mean)[:, moves]])
    target = family.values("frequency")
    spread = 0.1 * target.std()
    weight = 1.0 / np.maximum(np.hypot(family.values("frequency_width"), spread), 1e-9)
    errors, constant = _left_out(B, target, weight), _left_out(B[:, :1], target, weight)
    x = _solve(B, target, weight)
    slope = np.zeros(mean.size)
    slope[moves] = x[1:]
    rms = [float(np.sqrt(np.mean(e**2))) for e in (errors, constant)]
    return Dependence(mean, float(x[0]), slope, *rms)


def _solve(B, target, weight):
    return np.linalg.lstsq(B * weight[:, None], target * weight, rcond=1e-6)[0]


def _left_out(B, target, weight):
    keep = ~np.eye(len(target), dtype=bool)
    return np.array(
        [
            t - row @ _solve(B[k], target[k], weight[k])
            for k, row, t in zip(keep, B, target, strict=True)
        ]
    )
