# SPDX-License-Identifier: Apache-2.0
r"""Finds a sensor's response to small motions of each joint, near a mode, which damping by that sensor needs to know.

The model is that of `flexarm_control.shaping.strain_damping`: :math:`\dot z = p z + \beta u` with the reading Re z. In
this model, a command from one position to another leaves ringing of the amplitude
.. math:: a(t) = \frac{\beta}{p}\int \dot u(\tau)\,e^{p(t-\tau)}\,d\tau,

because a constant position of a joint does not bend the links. After each step of a measurement, :math:`\beta` is the
amplitude, minus what is left of the ringing before the step, divided by this integral for :math:`\beta = 1`. Its
modulus is the sensitivity. Its angle is the phase, which includes delay and drive.
"""

import cmath
from dataclasses import dataclass

import numpy as np

from flexarm_control.shaping import strain_damping
from flexarm_dynamics.errors import FlexarmError
from flexarm_dynamics.parameters import check_all

from .motion import SETTLED

#: Number of cells for the integral over a step.
CELLS = 2000
#: Sensors that can damp, and their name in the node's parameters.
SENSORS = {"strain": "strain", "linear_acceleration": "imu"}
#: Full scale of an IMU, in the printed parameters [m/s^2].
FULL_SCALE = 40.0
#: Period of the commands for which the damping is checked [s].
PERIOD = 0.008


@dataclass(frozen=True)
class Answer:
    """Response of a reading to corrections of a joint.

    Attributes
    ----------
    joint, channel, sensor : str
        Names; `sensor` is the name in the node's parameters.
    index : int
        Index of the channel among those of its sensor.
    frequency, damping : float
        Of the mode [Hz], [-].
    beta : complex
        [1/(rad s)] times the reading's unit.
    scatter : float
        Scatter of beta between the steps of the measurement, over its modulus [-].
    """

    joint: str
    channel: str
    sensor: str
    index: int
    frequency: float
    damping: float
    beta: complex
    scatter: float

    def settings(self):
        """Parameters ``damping.*`` of the node `shaper`, without the prefix."""
        where = {"gauge": self.index}
        if self.sensor == "imu":
            where = {"axis": self.channel[-1], "full_scale": FULL_SCALE}
        return {
            "joint": self.joint, "sensor": self.sensor, **where,
            "frequency": self.frequency, "damping": self.damping,
            "sensitivity": abs(self.beta), "phase": cmath.phase(self.beta),
        }  # fmt: skip

    def refusal(self):
        """Why the damping is impossible, in words; empty if it is possible."""
        known = {parameter.name for parameter in strain_damping.PARAMETERS}
        given = {name: value for name, value in self.settings().items() if name in known}
        try:
            law = check_all(strain_damping.PARAMETERS, given)
            strain_damping.StrainDamping(law, PERIOD)
        except FlexarmError as error:
            return str(error)
        return ""


def answers(found, windows, families, motion, begin):
    """Responses of the gauges and accelerometers to every joint that has moved, near the mode that rings most.

    Parameters
    ----------
    found : Channels
    windows : list of Window
        From `measured.rings`, for a measurement by steps.
    families : list of Family
        Of these windows.
    motion : RingingMotion
    begin : float
        Time when the motion was sent, as the recording counts it [s].

    Returns
    -------
    list of Answer
        One per joint, the largest sensitivity first. All are of the same channel: the one that has the answer with the
        smallest scatter. Empty if the mode did not ring after any step.
    """
    main = max(families, key=lambda family: family.part)
    rung = {i: mode for mode, i in zip(main.modes, main.windows, strict=True)}
    parts = {}  # for each joint, by window: (response to the step for a beta of 1, amplitude)
    last, before = 0.0, None
    for first, end, joint in motion.free:
        number = _window(windows, begin + first, begin + end)
        mode = rung.get(number)
        if mode is not None:
            at = windows[number].begin
            z = _step(mode.pole, motion, joint, last, first - SETTLED, at - begin)
            amplitude = rang = _amplitude(found, windows[number], mode)
            if before is not None:
                amplitude = amplitude - before[1] * np.exp(before[2] * (at - before[0]))
            parts.setdefault(joint, []).append((z, amplitude))
        before = None if mode is None else (at, rang, mode.pole)
        last = end
    made = [
        answer for joint, pairs in parts.items() for answer in _of_joint(found, main, joint, pairs)
    ]
    if not made:
        return []
    best = min(made, key=lambda answer: answer.scatter).channel
    return sorted(
        (answer for answer in made if answer.channel == best), key=lambda answer: -abs(answer.beta)
    )


def _window(windows, first, end):
    """The number of the window that begins between two times [s]."""
    inside = [i for i, w in enumerate(windows) if first - SETTLED <= w.begin < end]
    return inside[0] if inside else None


def _amplitude(found, window, mode):
    """Amplitude of a mode in each channel at a window's begin, (c,) complex; all its modes are fitted together."""
    part = found.rows(window.begin, window.end)
    time = found.period * np.arange(part.stop - part.start)
    turning = np.exp(np.array([m.pole for m in window.fit.modes]) * time[:, None])
    known = np.hstack([turning.real, -turning.imag, np.ones((time.size, 1))])
    rang = np.linalg.lstsq(known, found.values[part], rcond=None)[0]
    count = len(window.fit.modes)
    k = next(k for k, own in enumerate(window.fit.modes) if own is mode)
    return rang[k] + 1j * rang[count + k]


def _step(pole, motion, joint, first, last, at):
    """Response of a pole at the time `at` to a joint's motion from time `first` to `last`, for a beta of 1 [rad s]."""
    step = (last - first) / CELLS
    time = first + step * (np.arange(CELLS) + 0.5)
    speed = motion.derivative(1, time)[:, joint]
    return complex(step * np.exp(pole * (at - time)) @ speed / pole)


def _of_joint(found, main, joint, pairs):
    z = np.array([pair[0] for pair in pairs])
    rang = np.array([pair[1] for pair in pairs])
    beta = z.conj() @ rang / (np.abs(z) ** 2).sum()
    off = np.sqrt(
        (np.abs(rang - z[:, None] * beta) ** 2).sum(axis=0) / (np.abs(rang) ** 2).sum(axis=0)
    )
    count = dict.fromkeys(SENSORS, 0)
    for k, quantity in enumerate(found.quantities):
        if quantity not in SENSORS:
            continue
        yield Answer(
            found.joint_names[joint], found.names[k], SENSORS[quantity], count[quantity],
            float(np.mean(main.values("frequency"))), float(np.mean(main.values("damping"))),
            complex(beta[k]), float(off[k]),
        )  # fmt: skip
        count[quantity] += 1
