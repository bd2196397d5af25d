# SPDX-License-Identifier: Apache-2.0
r"""Damps a mode by a sensor, for arms that take positions, with a small correction of the position command.

If a joint follows its command q, a strain :math:`\eta` that shows one mode obeys

.. math:: \ddot\eta + 2\zeta\omega\dot\eta + \omega^2\eta = -c\,\ddot q.

A joint velocity in proportion to the strain therefore damps the mode; as a position, this is the integral of the
strain. Delay and drive shift the phase. Near the mode's frequency, delay, drive and c together are one complex number
:math:`\beta`. The complex amplitude z of the mode responds to a correction u by

.. math:: \dot z = p z + \beta u, \qquad y = \operatorname{Re} z + b, \qquad p = -\zeta\omega + i\omega\sqrt{1-\zeta^2},

where y is the reading and b its bias. `identified` finds :math:`\beta` from a short burst of the command. With

.. math:: u = -\kappa \operatorname{Re}\frac{\bar\beta z}{|\beta|}, \qquad
          \kappa = \frac{2 (\zeta_w - \zeta)\,\omega}{|\beta|},

the averaged mode has the desired damping ratio :math:`\zeta_w`: :math:`\dot z \approx (p - \kappa|\beta|/2) z`, by the
method of averaging (Sanders, Verhulst & Murdock 2007, chapter 2). z and b come from an observer with that model,

.. math:: \dot{\hat z} = p\hat z + \beta u + 2\mu\omega r, \qquad \dot{\hat b} = 2\nu\mu\omega r, \qquad
          r = y - \operatorname{Re}\hat z - \hat b.

The observer is narrow-band, so that other modes and the noise hardly pass. If the loop of this model would be unstable
with a frequency that is off by `MARGIN`, the constructor refuses it.

An accelerometer can be the sensor, too, with another phase. Its own motion with the joint is neglected: this part is
mostly in phase with the correction, and changes the frequency a little, not the damping.

A velocity command receives the correction's rate, whose integral is the correction.

The bounds scale the correction instead of clipping it, so it stays a sine: a clipped one would come late. The constant
reading of a stuck sensor becomes bias, and the correction dies out.
"""

import cmath
import math

import numpy as np

from flexarm_dynamics.errors import DesignError
from flexarm_dynamics.parameters import parameter

PARAMETERS = (
    parameter("frequency", 1.0, "Hz", 0.05, 100.0, read_only=True).described(
        "Natural frequency of the mode that is damped, measured with the drives on."
    ),
    parameter("damping", 0.005, "-", 0.0, 0.3, read_only=True).described(
        "Damping ratio of this mode without correction."
    ),
    parameter("sensitivity", 1.0, "1/(rad s)", 1e-12, 1e12, read_only=True).described(
        "Growth of the reading's amplitude by a correction of one radian, identified by a burst."
    ),
    parameter("phase", 1.5, "rad", -3.2, 3.2, read_only=True).described(
        "Phase of that response, identified with it; pi/2 of either sign without any lag."
    ),
    parameter("target", 0.2, "-", 0.01, 0.5, read_only=True).described("Desired damping ratio."),
    parameter("observer", 0.5, "-", 0.02, 2.0, read_only=True).described(
        "Rate at which the observer follows the reading, relative to the mode's angular frequency."
    ),
    parameter("max_correction", 0.02, "rad", 1e-9, 3.0, read_only=True).described(
        "Largest correction of the position."
    ),
    parameter("max_rate", 0.5, "rad/s", 1e-9, 100.0, read_only=True).described(
        "Largest rate of the correction."
    ),
    parameter("full_scale", 0.02, "-", 1e-12, 1e9, read_only=True).described(
        "A reading beyond this is in doubt."
    ),
    parameter("timeout", 0.05, "s", 0.001, 10.0, read_only=True).described(
        "If the sensor is silent or in doubt for longer, the correction fades out."
    ),
    parameter("fade", 0.2, "s", 0.001, 10.0, read_only=True).described(
        "Time in which the correction goes from full to zero, and back."
    ),
    parameter("rejoin", 1.0, "s", 0.0, 60.0, read_only=True).described(
        "The sensor must be good for this long before the correction comes back."
    ),
    parameter("max_saturated", 2.0, "s", 0.1, 3600.0, read_only=True).described(
        "If the correction is at its bounds for this long while the mode swings no less, it is off until the next"
        " start."
    ),
)
#: The loop must be stable with the mode's frequency off by this fraction.
MARGIN = 0.15
#: Ratio of the rate of the bias to that of the observer [-].
DRIFT = 0.1
#: After a gap, a reading corrects the observer for at most this many periods: a longer step would overshoot.
LATE = 2.0
#: After `max_saturated` at the bounds, the mode must swing less than this fraction of its largest swing in that time
#: [-].
LESS = 0.9
#: Number of periods of a burst; after its end the drive has this fraction of a period to settle.
BURST_PERIODS, SETTLE = 2.0, 0.25
#: Number of periods for which ringing must be recorded after the burst.
RINGING_PERIODS = 1.0
ACTIVE, FADING, OFF = "active", "fading", "off"


def pole(frequency, damping):
    """Return the mode's pole [rad/s]; `frequency` in Hz, `damping` as a ratio."""
    w = 2.0 * math.pi * frequency
    return complex(-damping * w, w * math.sqrt(1.0 - damping**2))


def moved(z, p, beta, u, time):
    """The mode's exact amplitude after a time with constant correction.

    Parameters
    ----------
    z, p, beta : complex
        Amplitude, pole [rad/s], response [1/(rad s)].
    u : float
        Correction [rad].
    time : float
        [s]
    """
    e = cmath.exp(p * time)
    return e * z + (e - 1.0) / p * beta * u


def burst(frequency, amplitude, period):
    """Corrections that excite the mode, and begin and end at 0: a sine in a Hann window (k,) [rad].

    Parameters
    ----------
    frequency : float
        [Hz]
    amplitude : float
        [rad]
    period : float
        Period of the commands [s].
    """
    t = np.arange(int(BURST_PERIODS / (frequency * period)) + 1) * period
    window = np.sin(np.pi * t * frequency / BURST_PERIODS) ** 2
    out = amplitude * window * np.sin(2.0 * np.pi * frequency * t)
    return np.append(out, 0.0)


def identified(frequency, damping, period, corrections, readings):
    """Identify the mode's response to corrections, from the ringing after they ended.

    Parameters
    ----------
    frequency : float
        Measured frequency [Hz].
    damping : float
        Measured ratio [-].
    period : float
        Period of both records [s].
    corrections : (k,) array_like
        Corrections sent from rest; they end where they began [rad].
    readings : (k,) array_like
        Reading of the sensor when each was sent.

    Returns
    -------
    beta : complex
        Its modulus is the `sensitivity`, its angle the `phase`.
    left : float
        Ratio of the rms that the mode does not explain to the rms of the ringing [-].

    Raises
    ------
    DesignError
        If there are not as many readings, the corrections do not move, or no period of ringing is recorded.
    """
    u, y = np.asarray(corrections, float), np.asarray(readings, float)
    if u.ndim != 1 or u.shape != y.shape:
        raise DesignError("readings", field="readings", value=y.size, limit=f"{u.size} corrections")
    changes = np.flatnonzero(np.diff(u))
    if not changes.size:
        raise DesignError("do not move", field="corrections", hint="send a burst")
    first = int(changes[-1] + 1 + SETTLE / (frequency * period))
    if (u.size - first) * period < RINGING_PERIODS / frequency:
        hint = f"record {RINGING_PERIODS:g} period after the burst"
        raise DesignError("is too short", field="ringing", value=u.size - first, hint=hint)
    p = pole(frequency, damping)
    z = np.zeros(u.size, complex)
    for k in range(u.size - 1):
        z[k + 1] = moved(z[k], p, 1.0, u[k] - u[0], period)
    parts = np.column_stack([z.real, -z.imag, np.ones(u.size)])[first:]
    found = np.linalg.lstsq(parts, y[first:], rcond=None)[0]
    rings = np.linalg.norm(y[first:] - y[first:].mean())
    left = np.linalg.norm(y[first:] - parts @ found) / max(rings, 1e-300)
    return complex(found[0], found[1]), float(left)


class StrainDamping:
    """The correction, one command after the other; see the module.

    Parameters
    ----------
    settings : mapping
        Checked values of `PARAMETERS`.
    period : float
        Period of the commands [s].

    Attributes
    ----------
    correction : float
        Value to add to the position command now [rad].
    rate : float
        Value to add to a velocity command instead, for a period; its integral is the correction [rad/s].
    state : str
        `ACTIVE`; `FADING`, out or in; `OFF`.
    reason : str
        Why the correction fades out or is off; empty if it is on, or fades in.
    latched : bool
        Whether it stays off until `begin`.

    Raises
    ------
    DesignError
        If the target is no more than the mode's own damping, or the loop is unstable with the frequency off by
        `MARGIN`.
    """

    def __init__(self, settings, period):
        self.settings, self.period = settings, period
        self._p = pole(settings["frequency"], settings["damping"])
        self._w = abs(self._p)
        self._beta = cmath.rect(settings["sensitivity"], settings["phase"])
        if settings["target"] <= settings["damping"]:
            raise DesignError(
                "is no more than the mode has",
                field="target",
                value=settings["target"],
                limit=settings["damping"],
            )
        added = (settings["target"] - settings["damping"]) * self._w
        self._gain = 2.0 * added / abs(self._beta)
        self._rate = 2.0 * settings["observer"] * self._w
        self._largest = min(settings["max_correction"], settings["max_rate"] / self._w)
        self._refuse_unstable()
        self.begin()

    def begin(self):
        """Start at rest; the next good reading is the bias."""
        self._z, self._bias, self._weight = 0j, None, 1.0
        self._time = self._stamp = self._read_at = self._good_since = self._good_at = None
        self._saturated_since, self._swing = None, 0.0
        self.correction, self.state, self.reason, self.latched = 0.0, ACTIVE, "", False
        self.rate = 0.0

    def update(self, now, strain=None, stamp=None):
        """Return the correction for the next command [rad]; call once in each period of the commands.

        ================================== ================================================================
        the sensor                         what happens
        ================================== ================================================================
        silent, NaN, beyond full scale,    the observer goes on without it; after `timeout` the correction
        with an old or repeated stamp      fades out, until the sensor has been good for `rejoin`
        good                               the correction damps, within size and rate
        ================================== ================================================================

        If the correction is at its bounds for `max_saturated` while the mode swings as before, it fades out and stays
        off until `begin`.

        Parameters
        ----------
        now : float
            Time [s].
        strain : float, optional
            The newest reading; None: there is none.
        stamp : float, optional
            Time of that reading [s]; `now` if not given.
        """
        step = self._step_to(now)
        self._z = moved(self._z, self._p, self._beta, self.correction, step)
        problem = self._problem(now, strain, now if stamp is None else stamp)
        if not problem:
            self._correct(float(strain), now)
        self._judge(now, problem)
        amplitude = self._gain * abs(self._z)
        self._note_saturation(now, amplitude)
        self._fade(step)
        before, self.correction = self.correction, self._bounded(amplitude, step)
        largest = self.settings["max_rate"]
        self.rate = min(max((self.correction - before) / self.period, -largest), largest)
        return self.correction

    def _step_to(self, now):
        """Time since the previous call [s]; if the clock goes back, earlier times are forgotten."""
        last, self._time = self._time, now
        if last is None:
            return 0.0
        if now < last:
            self._stamp = self._read_at = self._good_since = self._good_at = None
            self._saturated_since = None
        return max(now - last, 0.0)

    def _problem(self, now, strain, stamp):
        """What is wrong with a reading; empty if nothing is."""
        last = self._stamp
        if strain is None:
            return "the sensor is silent"
        if not math.isfinite(stamp) or abs(now - stamp) > self.settings["timeout"]:
            return "the sensor's reading is not of now"
        if last is not None and stamp <= last:
            return "the sensor's reading is not a new one"
        self._stamp = stamp
        if not math.isfinite(strain):
            return "the sensor's reading is not finite"
        if abs(strain) > self.settings["full_scale"]:
            return "the sensor's reading is beyond its full scale"
        return ""

    def _correct(self, strain, now):
        """Correct the observer by a reading, in proportion to the time since the previous reading."""
        if self._bias is None:
            self._z, self._bias = 0j, strain
        since = 0.0 if self._read_at is None else now - self._read_at
        self._read_at = now
        part = self._rate * min(since, LATE * self.period)
        error = strain - self._z.real - self._bias
        self._z += part * error
        self._bias += DRIFT * part * error

    def _judge(self, now, problem):
        """Decide whether the correction is wanted, by how long the sensor has been good or bad."""
        if problem:
            self._good_at = now if self._good_at is None else self._good_at
            if now - self._good_at > self.settings["timeout"]:
                self._good_since = None
                self.reason = self.reason if self.latched else problem
            return
        self._good_at = now
        self._good_since = now if self._good_since is None else self._good_since
        if not self.latched and now - self._good_since >= self.settings["rejoin"]:
            self.reason = ""

    def _fade(self, step):
        """Move the weight of the correction towards one or zero."""
        way = step / self.settings["fade"]
        self._weight += -min(way, self._weight) if self.reason else min(way, 1.0 - self._weight)
        self.state = {0.0: OFF, 1.0: ACTIVE}.get(self._weight, FADING)
        if self.reason and self.state == OFF and self._good_since is None:
            self._z, self._bias = 0j, None

    def _bounded(self, amplitude, step):
        """The correction: a sine within the bounds, which moves at most at its rate [rad]."""
        scale = min(1.0, self._largest / amplitude) if amplitude else 1.0
        wanted = -self._gain * (self._beta.conjugate() * self._z).real / abs(self._beta)
        way = self.settings["max_rate"] * step
        return min(max(self._weight * scale * wanted, self.correction - way), self.correction + way)

    def _note_saturation(self, now, amplitude):
        """Watch a correction at its bounds, and switch it off for good if the mode swings no less."""
        if self.reason or amplitude <= self._largest:
            self._saturated_since = None
            return
        if self._saturated_since is None:
            self._saturated_since, self._swing = now, 0.0
        self._swing = max(self._swing, amplitude)
        if now - self._saturated_since >= self.settings["max_saturated"]:
            if amplitude > LESS * self._swing:
                self.latched = True
                self.reason = (
                    "the correction was at its bounds and the mode swings no less:"
                    " check frequency, phase and the sensor's sign"
                )
            self._saturated_since = None

    def radius(self, factor=1.0):
        """Largest modulus of the eigenvalues of the model's loop, with the mode's frequency times a factor.

        The lag, by which the phase is short of pi/2, is a constant time, so another frequency has another phase.

        Parameters
        ----------
        factor : float
            [-]
        """
        p = self._p * factor
        turn = cmath.exp(-1j * (factor - 1.0) * self._lag())
        beta = self._beta * factor * turn
        part = self._rate * self.period
        loop = np.zeros((5, 5))
        for i, unit in enumerate(np.eye(5)):
            x, z, bias = complex(*unit[:2]), complex(*unit[2:4]), unit[4]
            u = -self._gain * (self._beta.conjugate() * z).real / abs(self._beta)
            x = moved(x, p, beta, u, self.period)
            z = moved(z, self._p, self._beta, u, self.period)
            error = x.real - z.real - bias
            z, bias = z + part * error, bias + DRIFT * part * error
            loop[:, i] = x.real, x.imag, z.real, z.imag, bias
        return float(np.abs(np.linalg.eigvals(loop)).max())

    def _lag(self):
        """Phase of the lag [rad], from -pi/4 to 3 pi/4."""
        return (math.pi / 2.0 - self.settings["phase"] + math.pi / 4.0) % math.pi - math.pi / 4.0

    def _refuse_unstable(self):
        for factor in (1.0 - MARGIN, 1.0, 1.0 + MARGIN):
            radius = self.radius(factor)
            if radius >= 1.0:
                raise DesignError(
                    f"is outside of the unit circle with {factor:g} times the frequency",
                    field="largest eigenvalue",
                    value=float(f"{radius:.6g}"),
                    limit=1.0,
                    hint="lower target or observer, or shorten the period",
                )
