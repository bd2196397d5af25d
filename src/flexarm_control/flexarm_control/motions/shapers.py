# SPDX-License-Identifier: Apache-2.0
r"""Input shapers: they make a motion the sum of delayed copies of itself, so that each cancels what others excite.

In a mode :math:`\omega,\zeta` that was at rest, an impulse train :math:`\sum_i A_i\,\delta(t-t_i)`,
:math:`\sum A_i = 1`, leaves after its last impulse :math:`t_n` the fraction

.. math:: V(\omega,\zeta) = e^{-\zeta\omega t_n}\sqrt{C^2 + S^2},\quad
    C = \sum_i A_i e^{\zeta\omega t_i}\cos\omega_d t_i,\quad S = \sum_i A_i e^{\zeta\omega t_i}\sin\omega_d t_i

of the vibration that a single impulse causes (Singer & Seering 1990), :math:`\omega_d=\omega\sqrt{1-\zeta^2}`.
Any motion convolved with the train leaves the same fraction of its own vibration. With
:math:`K = e^{-\zeta\pi/\sqrt{1-\zeta^2}}`:

- ZV (zero vibration), half a period long: A = (1, K) / (1 + K), V = 0 at the design frequency;
- ZVD (and zero derivative), one period: A = (1, 2K, K^2) / (1 + K)^2, dV/domega = 0 there as well. It is
  ZV convolved with itself;
- EI (extra insensitive, Singhose, Seering & Singer 1994), one period: at the design frequency V = `EI_RESIDUAL`, and
  zero at one frequency on either side. In ZV, -K is the zero of the train's polynomial; here the two zeros
  :math:`-Ke^{\pm j\varphi}` make A proportional to (1, 2K cos phi, K^2), with
  :math:`\cos\varphi = (2K^2 - V(1+K^2))/(2K^2 + 2KV)`. Without damping these are the published
  ((1 + V)/4, (1 - V)/2, (1 + V)/4);
- MZV (Klipper's input shaper), 3/4 of a period: three impulses 3/8 of a period apart, with k the decay from one to
  the next, A proportional to (1, sqrt 2 k, k^2). V = 0 at the design frequency, at less delay than ZVD and EI;
- ZVDD (two derivatives), 3/2 periods: A = (1, 3K, 3K^2, K^3) / (1 + K)^3, ZV convolved with itself twice;
- two-hump EI (Singhose, Porter, Tuttle & Singer 1997), 3/2 periods: V = 0 at the design frequency and at one on
  either side; between them two humps as high as `EI_RESIDUAL`. Zeros at -K and :math:`-Ke^{\pm j\varphi}` make A
  proportional to (1, cK, cK^2, K^3), :math:`c = 1 + 2\cos\varphi`. Without damping
  :math:`V = |T_3(x_0\cos\frac{\omega T}{4})| / T_3(x_0)`, with T_3 the Chebyshev polynomial and T the design period,
  which gives :math:`x_0 = \cosh(\frac13 \mathrm{arcosh}\frac1V)` and :math:`\cos\varphi = 1 - 3/(2x_0^2)`, that is, the
  published amplitudes. With damping the humps have only approximately that height.

For several modes the trains are convolved (Singhose, Seering & Singer 1997). The modes are those of the fast
subsystem (11), whose input is the slow torque of the motion. While mass matrix and configuration do not change,
the torque is shaped like the motion, and V is exact.
"""

from dataclasses import dataclass
from functools import reduce
from operator import matmul

import numpy as np

from flexarm_dynamics.errors import DesignError
from flexarm_dynamics.singular_perturbation import fast_subsystem, frequencies_and_damping

from .profiles import Motion

#: A longer train is refused, since every sample of a shaped motion evaluates the motion once per impulse.
MAX_IMPULSES = 1000
#: Fraction of the vibration that EI leaves at the design frequency [-].
EI_RESIDUAL = 0.05
#: Time between two impulses of MZV over half the damped period [-].
MZV_SPACING = 0.75


@dataclass(frozen=True, eq=False)
class Shaper:
    """A train of impulses."""

    times: np.ndarray  # from 0, ascending, (k,) [s]
    amplitudes: np.ndarray  # above 0, with sum 1, (k,) [-]

    def __iter__(self):
        """``times, amplitudes = shaper``."""
        return iter((self.times, self.amplitudes))

    @property
    def duration(self):
        """Time by which it makes a motion longer [s]."""
        return float(self.times[-1])

    def __matmul__(self, other):
        """Convolve with another shaper."""
        times = np.add.outer(self.times, other.times).ravel()
        order = np.argsort(times, kind="stable")
        amplitudes = np.outer(self.amplitudes, other.amplitudes).ravel()
        return Shaper(times[order], amplitudes[order])

    def residual(self, omega, zeta):
        """Return V, the fraction of a mode's vibration that is left: 0: none, 1: as without shaper.

        Parameters
        ----------
        omega, zeta : float or array
            Natural frequency [rad/s] and damping ratio [-] of the mode.
        """
        omega, zeta = np.asarray(omega, float)[..., None], np.asarray(zeta, float)[..., None]
        pole = omega * (-zeta + 1j * np.sqrt(1.0 - zeta**2))
        # With e^{-zeta omega t_n} inside the sum, where it can't overflow.
        left = self.amplitudes * np.exp(-pole * self.times + pole.real * self.duration)
        return np.abs(left.sum(axis=-1))

    def apply(self, profile):
        """Return the shaped motion: `ShapedProfile`."""
        return ShapedProfile(profile, self)


class ShapedProfile(Motion):
    """A motion convolved with a shaper: the sum of its delayed copies, each with its amplitude.

    Its derivatives are as exact as those of the motion. It is longer by the shaper's duration.

    Parameters
    ----------
    profile : Motion
    shaper : Shaper
    """

    def __init__(self, profile, shaper):
        self._profile, self._shaper = profile, shaper
        self.start, self.angle = profile.start, profile.angle
        self.duration = profile.duration + shaper.duration

    def derivative(self, order, t):
        t = np.asarray(t, float)
        shaper, derivative = self._shaper, self._profile.derivative
        copies = zip(shaper.amplitudes, shaper.times, strict=True)
        return sum(amplitude * derivative(order, t - delay) for amplitude, delay in copies)


def zv(omega, zeta) -> Shaper:
    """Return the zero-vibration shaper of a mode.

    Parameters
    ----------
    omega : float
        Natural frequency [rad/s], above 0.
    zeta : float
        Damping ratio, at least 0 and below 1 [-].

    Raises
    ------
    DesignError
        If the mode does not vibrate, or grows.
    """
    half, K = half_period(omega, zeta)
    return _spaced(half, [1.0, K])


def zvd(omega, zeta) -> Shaper:
    """Return the zero-vibration-and-derivative shaper of a mode; parameters as for `zv`."""
    half, K = half_period(omega, zeta)
    return _spaced(half, [1.0, 2.0 * K, K**2])


def zvdd(omega, zeta) -> Shaper:
    """Return the shaper of a mode with two derivatives that are zero; parameters as for `zv`."""
    half, K = half_period(omega, zeta)
    return _spaced(half, [1.0, 3.0 * K, 3.0 * K**2, K**3])


def mzv(omega, zeta) -> Shaper:
    """Return the modified zero-vibration shaper of a mode; parameters as for `zv`."""
    half, K = half_period(omega, zeta)
    k = K**MZV_SPACING
    return _spaced(MZV_SPACING * half, [1.0, np.sqrt(2.0) * k, k**2])


def ei(omega, zeta) -> Shaper:
    """Return the extra-insensitive shaper of a mode; parameters as for `zv`."""
    half, K = half_period(omega, zeta)
    V = EI_RESIDUAL
    # If the damping is so high that less than V is left without it, the middle impulse vanishes.
    cosine = max((2.0 * K**2 - V * (1.0 + K**2)) / (2.0 * K**2 + 2.0 * K * V), 0.0)
    return _spaced(half, [1.0, 2.0 * K * cosine, K**2])


def two_hump_ei(omega, zeta) -> Shaper:
    """Return the two-hump extra-insensitive shaper of a mode; parameters as for `zv`."""
    half, K = half_period(omega, zeta)
    x0 = np.cosh(np.arccosh(1.0 / EI_RESIDUAL) / 3.0)
    c = 3.0 - 3.0 / x0**2
    return _spaced(half, [1.0, c * K, c * K**2, K**3])


def half_period(omega, zeta):
    """Return half the damped period of a mode [s], and K, its decay in that time [-].

    Parameters
    ----------
    omega : float
        Natural frequency [rad/s], above 0.
    zeta : float
        Damping ratio, at least 0 and below 1 [-].

    Raises
    ------
    DesignError
        If the mode does not vibrate, or grows.
    """
    omega, zeta = float(omega), float(zeta)
    if not 0.0 < omega < np.inf:
        raise DesignError(
            "rad/s is out of range", field="shaper frequency", value=omega, limit="finite, above 0"
        )
    if not 0.0 <= zeta < 1.0:
        raise DesignError(
            f"of the mode at {omega:g} rad/s is not that of a vibration",
            field="shaper damping ratio",
            value=zeta,
            limit="at least 0, below 1",
            hint="shape fewer modes",
        )
    root = np.sqrt(1.0 - zeta**2)
    return np.pi / (omega * root), np.exp(-zeta * np.pi / root)


def _spaced(spacing, train):
    """The shaper of a train of equal spacing; impulses of 0 are left out."""
    train = np.array(train)
    kept = train > 0.0
    return Shaper(spacing * np.arange(train.size)[kept], train[kept] / train.sum())


#: Shapers by name. A motion gets longer by 1/2 (ZV), 3/4 (MZV), 1 (ZVD, EI) or 3/2 (2hump_ei, ZVDD) periods per mode.
SHAPERS = {
    "zv": zv,
    "mzv": mzv,
    "zvd": zvd,
    "ei": ei,
    "2hump_ei": two_hump_ei,
    "zvdd": zvdd,
}
#: Leaves a motion as it is.
NONE = "none"


def impulses(kind, frequency, damping) -> Shaper:
    """Return the shaper of one mode; ``times, amplitudes = impulses(...)`` gives its train.

    Parameters
    ----------
    kind : str
        One of `SHAPERS`, or ``none``: a single impulse, whatever the mode.
    frequency : float
        Natural (undamped) frequency, above 0 [Hz].
    damping : float
        Damping ratio, at least 0 and below 1 [-].

    Raises
    ------
    DesignError
        If there is no such shaper, or the mode does not vibrate, or grows.
    """
    if kind == NONE:
        return Shaper(np.zeros(1), np.ones(1))
    if kind not in SHAPERS:
        limit = ", ".join([*SHAPERS, NONE])
        raise DesignError("is unknown", field="shaper", value=kind, limit=limit)
    return SHAPERS[kind](2.0 * np.pi * float(frequency), damping)


def convolve(trains) -> Shaper:
    """Return the convolution of shapers: each removes its mode, and the delays add up.

    Parameters
    ----------
    trains : sequence of Shaper or of (times, amplitudes)

    Raises
    ------
    DesignError
        If there is none, or they have more impulses than `MAX_IMPULSES` together.
    """
    trains = [
        train if isinstance(train, Shaper) else Shaper(*(np.asarray(part, float) for part in train))
        for train in trains
    ]
    if not trains:
        raise DesignError("no modes", field="shaper modes", hint="give at least one")
    count = int(np.prod([float(train.times.size) for train in trains]))
    if count > MAX_IMPULSES:
        raise DesignError(
            f"of {len(trains)} modes are too many",
            field="shaper impulses",
            value=count,
            limit=MAX_IMPULSES,
            hint="shape fewer modes",
        )
    return reduce(matmul, trains)


def for_modes(kind, omega, zeta) -> Shaper:
    """Return the shaper of several modes.

    Parameters
    ----------
    kind : str
        One of `SHAPERS`, or ``none``.
    omega, zeta : (k,) array_like
        Natural frequencies [rad/s] and damping ratios [-].

    Raises
    ------
    DesignError
        As for `impulses` and `convolve`.
    """
    hertz = 2.0 * np.pi
    return convolve([impulses(kind, w / hertz, z) for w, z in zip(omega, zeta, strict=True)])


def modes_at(model, q):
    """Natural frequencies [rad/s] and damping ratios [-] of the fast subsystem (11) at rest, ascending."""
    n = model.n_joints
    if not model.n_modes:
        return np.zeros(0), np.zeros(0)
    A2, _ = fast_subsystem(model.terms(np.asarray(q, float), np.zeros(n)))
    omega, zeta = frequencies_and_damping(np.linalg.eigvals(A2))
    # Without damping an eigenvalue's real part is rounding, of either sign.
    return omega, np.where(np.abs(zeta) < 1e-12, 0.0, zeta)


def for_arm(model, q, kind, modes=2) -> Shaper:
    """Return the shaper of an arm's lowest modes (11), at the configuration where the motion ends.

    Parameters
    ----------
    model : ArmModel
    q : (n,) array_like
        Configuration where the motion ends, since the remaining vibration is there [rad].
    kind : str
        One of `SHAPERS`, or ``none``.
    modes : int
        Number of lowest modes; at most as many as the arm has.

    Raises
    ------
    DesignError
        If the arm does not have that many modes, and as for `for_modes`.
    """
    omega, zeta = modes_at(model, q)
    if not 1 <= modes <= omega.size:
        arm = model.arm.name
        raise DesignError(
            f"are not possible for {arm}" if omega.size else f"are not possible: {arm} is rigid",
            field="shaper modes",
            value=modes,
            limit=f"1 to {omega.size}" if omega.size else None,
        )
    return for_modes(kind, omega[:modes], zeta[:modes])
