# SPDX-License-Identifier: Apache-2.0
r"""Finds a sensor's response to small motions of each joint, near a mode, which damping by that sensor needs to know.

With the model of `flexarm_control.shaping.strain_damping`, :math:`\dot z = p z + \beta u` and a reading Re z, a command
from one place to another leaves ringing of the amplitude

.. math:: a(t) = \frac{\beta}{p}\int \dot u(\tau)\,e^{p(t-\tau)}\,d\tau,

because the place where a joint stands does not bend the links. :math:`\beta` is the amplitude after each step of a
measurement, minus the rest of the ringing before it, divided by this integral. Its modulus is the sensitivity. Its
angle is the phase, with delay and drive included.
"""

import cmath
from dataclasses import dataclass

import numpy as np

from flexarm_control.shaping import strain_damping
from flexarm_dynamics.errors import FlexarmError
from flexarm_dynamics.parameters import check_all

from .motion import SETTLED

#: Cells in which a step is integrated.
CELLS = 2000
#: Sensors that can damp, and their name in the node's parameters.
SENSORS = {"strain": "strain", "linear_acceleration": "imu"}
#: Full scale of an IMU, in the lines to paste [m/s^2].
FULL_SCALE = 40.0
#: Period of the commands for which the damping is checked [s].
PERIOD = 0.008


@dataclass(frozen=True)
class Answer:
    """A reading's answer to corrections of a joint.

    Attributes
    ----------
    joint, channel, sensor : str
        Names; the sensor as in the node's parameters.
    index : int
        Index of the channel among those of its sensor.
    frequency, damping : float
        Of the mode [Hz], [-].
    beta : complex
        [1/(rad s)] times the reading's unit.
    scatter : float
        Scatter between the steps of the measurement, over the modulus [-].
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
    """Answers of every gauge and accelerometer to every joint that has moved, near the mode that rings most.

    Parameters
    ----------
    found : Channels
    windows : list of Window
        As from `measured.rings`, for a measurement by steps.
    families : list of Family
        Of these windows.
    motion : RingingMotion
    begin : float
        Time when it was sent, as the recording counts it [s].

    Returns
    -------
    list of Answer
        One per joint, all of the channel that has the answer with the smallest scatter; the largest sensitivity first.
        Empty if the mode rang after no step.
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
    """Amplitude of a mode in each channel at a window's begin, (c,) complex, by least squares of all its modes."""
    part = found.rows(window.begin, window.end)
    time = found.period * np.arange(part.stop - part.start)
    turning = np.exp(np.array([m.pole for m in window.fit.modes]) * time[:, None])
    known = np.hstack([turning.real, -turning.imag, np.ones((time.size, 1))])
    rang = np.linalg.lstsq(known, found.values[part], rcond=None)[0]
    count = len(window.fit.modes)
    k = next(k for k, own in enumerate(window.fit.modes) if own is mode)
    return rang[k] + 1j * rang[count + k]


def _step(pole, motion, joint, first, last, at):
    """Response at the time `at` to the motion of a joint from time `first` to `last`, for a beta of 1 [rad s]."""
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
