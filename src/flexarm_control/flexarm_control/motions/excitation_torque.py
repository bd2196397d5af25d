# SPDX-License-Identifier: Apache-2.0
r"""Torques that excite an arm, for identifying its parameters: pulse, ring-down and sweep.

The joints are excited one after the other, with amplitude A and a pause in which the arm rings freely:

- pulse: :math:`A` for half of the duration, then :math:`-A`: the rigid arm comes to rest again;
- ring_down: :math:`A\sin(2\pi f t)`, some periods at the first bending frequency f with the joints free;
- sweep: :math:`A\,w(t)\sin 2\pi(f_0 t + (f_1 - f_0)t^2/2T)`, from f_0 to f_1, faded in and out by w.

A torque that holds the arm's weight at its start position is added. A soft spring and damper about that position may be
added as well (`excitation_run`): :math:`-(\omega_h^2\,\Delta q + 1.4\,\omega_h\,\dot q) / B_{jj}`. The recorded torque
is the sum, which is all that a fit needs.
"""

from collections.abc import Mapping

import numpy as np

from flexarm_dynamics.errors import DesignError
from flexarm_dynamics.parameters import check_all, parameter
from flexarm_dynamics.singular_perturbation import slow_subsystem

KINDS = ("ring_down", "sweep", "pulse")
PARAMETERS = (
    parameter("kind", "sweep", choices=KINDS).described(
        "Shape of the torque over time: a sweep of frequencies, a pulse forth and back, or some periods at the first"
        " bending frequency."
    ),
    parameter("joint", "").described("Excited joint; empty: all, one after the other."),
    parameter("amplitude", 0.0, "N m", 0.0, 1e6).described(
        "Amplitude of the torque, at most the joint's limit; 0: a fifth of the limit."
    ),
    parameter("duration", 0.0, "s", 0.0, 600.0).described(
        "Duration of the excitation of one joint; 0: from the kind and the slowest mode."
    ),
    parameter("rest", 2.0, "s", 0.0, 600.0).described(
        "Time after each joint in which the arm vibrates freely."
    ),
    parameter("frequency_low", 0.0, "Hz", 0.0, 10000.0).described(
        "Start of a sweep; 0: a quarter of the lowest bending frequency."
    ),
    parameter("frequency_high", 0.0, "Hz", 0.0, 10000.0).described(
        "End of a sweep; 0: 1.3 times the highest bending frequency of the arm file."
    ),
)
#: Fraction of a sweep over which it fades in, and out [-].
FADE = 0.05
#: Periods of the first bending frequency in a ring-down's torque.
PUSHES = 3
#: Minimum duration of a sweep [s], and in periods of the slowest mode.
MIN_SWEEP, SWEEP_PERIODS = 4.0, 12.0


class ExcitationTorque:
    """A torque over time.

    Parameters
    ----------
    model : ArmModel
    settings : mapping
        Values of `PARAMETERS`; a missing one takes its default.
    position : ndarray, shape (n,), optional
        Where the arm is at rest [rad]; zero if not given.

    Attributes
    ----------
    duration : float
        Duration of the whole torque [s].
    hold : ndarray, shape (n,)
        Torque that holds the arm's weight at `position` [N m].

    Raises
    ------
    ParameterError, DesignError
        If a joint is unknown, an amplitude is beyond the joint's limit, or a sweep's end is not above its start.
    """

    def __init__(self, model, settings: Mapping, position=None):
        n = model.n_joints
        self.settings = s = check_all(PARAMETERS, settings)
        position = np.zeros(n) if position is None else np.asarray(position, float)
        a, B = slow_subsystem(model.terms(position, np.zeros(n)))
        self.hold = -np.linalg.solve(B, a)
        #: Inertia that each joint moves by itself [kg m^2].
        self.inertia = 1.0 / np.diag(B)
        self.joints = _joints(model, s["joint"])
        self.amplitude = np.array(
            [_amplitude(model.arm.joints[j], s["amplitude"], self.hold[j]) for j in self.joints]
        )
        modes = model.frequencies(position) / (2.0 * np.pi) if model.n_modes else np.array([1.0])
        self.low = s["frequency_low"] or 0.25 * modes[0]
        self.high = s["frequency_high"] or 1.3 * modes[-1]
        self.first = modes[0]
        if s["kind"] == "sweep" and not self.high > self.low:
            raise DesignError(
                "Hz, the end of the sweep, is not above its start",
                field="frequency_high",
                value=float(self.high),
                limit=f"above frequency_low, {self.low:g}",
            )
        default = {
            "sweep": max(MIN_SWEEP, SWEEP_PERIODS / modes[0]),
            "pulse": 0.5 / modes[0],
            "ring_down": PUSHES / modes[0],
        }
        self.shaking = s["duration"] or default[s["kind"]]
        self.duration = len(self.joints) * (self.shaking + s["rest"])

    def torque(self, time):
        """Torque at a time from the start, shape (n,) [N m]."""
        out = self.hold.copy()
        span = self.shaking + self.settings["rest"]
        k = int(time // span)
        if time >= 0.0 and k < len(self.joints):
            out[self.joints[k]] += self.amplitude[k] * self._shape(time - k * span)
        return out

    def _shape(self, t):
        """Torque of one joint, as a fraction of its amplitude [-]."""
        T, kind = self.shaking, self.settings["kind"]
        if t >= T:
            return 0.0
        if kind == "pulse":
            return 1.0 if t < 0.5 * T else -1.0
        if kind == "ring_down":
            return np.sin(2.0 * np.pi * self.first * t)
        window = min(1.0, t / (FADE * T), (T - t) / (FADE * T))
        return window * np.sin(2.0 * np.pi * t * (self.low + 0.5 * (self.high - self.low) * t / T))


def _joints(model, name):
    """Indices of the excited joints."""
    names = model.joint_names
    if name and name not in names:
        raise DesignError("is unknown", field="joint", value=name, limit=", ".join(names))
    return [names.index(name)] if name else list(range(model.n_joints))


def _amplitude(joint, wanted, hold):
    """Amplitude of a joint, within what its limit leaves after the weight [N m]."""
    left = joint.limits.torque - abs(hold)
    if not wanted:
        if not np.isfinite(left):
            raise DesignError(
                f"is needed, for the arm file has no torque limit of {joint.name}",
                field="amplitude",
                hint="give one [N m]",
            )
        wanted = 0.2 * left
    if not 0.0 < wanted <= left:
        raise DesignError(
            f"N m is too much: {joint.name} needs {abs(hold):.3g} N m of its {joint.limits.torque:g} N m to hold the"
            " arm's weight",
            field="amplitude",
            value=wanted,
            limit=f"above 0, at most {left:.4g}",
        )
    return wanted
