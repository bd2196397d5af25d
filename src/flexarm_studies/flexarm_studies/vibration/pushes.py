# SPDX-License-Identifier: Apache-2.0
"""Pushes one link behind a position loop aside and releases it: how fast it comes to rest, damped by a sensor and not.

The parameters of the damping are measured on the same simulated arm, behind the same drives, with its actual payload.
Frequency and damping ratio come from the ringing after a small motion; the response to corrections comes from a burst
of the command.
"""

from dataclasses import dataclass

import numpy as np

from flexarm_control.shaping import strain_damping
from flexarm_dynamics.arm.strain_map import gauge_rows
from flexarm_dynamics.models import model
from flexarm_dynamics.parameters import check_all

from ..markdown import table, write_between
from . import cases
from .position_arm import COMMAND_RATE, DRIVE_RATE, PositionArm
from .study import measured

BEGIN, END = "<!-- pushes: begin -->", "<!-- pushes: end -->"
PERIOD = 1.0 / COMMAND_RATE
#: Payloads, as multiples of the one that the drives know.
PAYLOADS = (0.0, 1.0, 2.0, 3.0)
#: Bending of the link by the push [m]; noise of the strain [-].
PUSH, NOISE = 0.01, 1e-6
#: Larger noise that is tried [-].
NOISY = 1e-5
#: Noise of the accelerometer at the tip, at the rate of the commands, and its full scale [m/s^2].
IMU_NOISE, IMU_SCALE = 0.05, 40.0
#: Distance of the small motion whose ringing is measured [rad].
WAY = np.array([1.2])
#: Amplitude of the burst [rad], and number of periods of ringing recorded with it.
BURST, LISTEN = 0.01, 6.0
#: Periods for which the tip is watched after the release, and fraction of its first distance at which it has decayed.
WATCHED, DECAYED = 36.0, 0.1
#: The damping is also designed for frequencies that are too low and too high by this fraction [-].
OFF = strain_damping.MARGIN
COLUMNS = (
    "payload",
    "frequency, Hz",
    "damping, %",
    "phase, degrees",
    "without, s",
    "with, s",
    "faster",
    "-15 %",
    "+15 %",
    "made for payload 1",
    "noise 1e-5",
    "largest correction, mrad",
    "after a motion",
    "IMU: faster",
    "IMU: after a motion",
)


@dataclass(frozen=True)
class Decay:
    """How a push decayed.

    Attributes
    ----------
    payload : float
        Multiple of the payload that the drives know [-].
    frequency, ratio : float
        Measured, of the lowest mode [Hz], [-].
    phase : float
        Phase of its response to corrections [rad].
    without, damped : float
        Time until the tip stays within `DECAYED` of its first distance from rest, without and with damping [s].
    low, high : float
        The same, damped for a frequency that is too low, or too high, by `OFF` [s].
    other : float
        The same, damped for the payload that the drives know [s].
    noisy : float
        The same, damped, with noise of `NOISY` [s].
    largest : float
        Largest correction [rad].
    motion : float
        Residual swing after the case's first motion, damped over not damped [-].
    imu : float
        As `damped`, with an accelerometer at the tip in place of strain [s].
    imu_motion : float
        As `motion`, with the accelerometer [-].
    """

    payload: float
    frequency: float
    ratio: float
    phase: float
    without: float
    damped: float
    low: float
    high: float
    other: float
    noisy: float
    largest: float
    motion: float
    imu: float
    imu_motion: float

    def row(self):
        """The values of `COLUMNS`."""
        factors = (
            self.without / time
            for time in (self.damped, self.low, self.high, self.other, self.noisy)
        )
        angles = 100.0 * self.ratio, float(np.degrees(self.phase))
        times = self.without, self.damped
        rest = 1e3 * self.largest, self.motion
        imu = self.without / self.imu, self.imu_motion
        return (self.payload, self.frequency, *angles, *times, *factors, *rest, *imu)


class Bench:
    """An arm with a sensor: the first of its gauges, or an accelerometer at its tip.

    Parameters
    ----------
    arm : PositionArm
        With one joint.
    imu : bool
        Whether the sensor is the accelerometer; it measures across the undeformed link.
    """

    def __init__(self, arm, imu=False):
        self._arm, self._imu = arm, imu
        self._noise = IMU_NOISE if imu else NOISE
        self._row = gauge_rows(arm.plant.model, arm.plant.model.arm.gauges)[0]

    def drive(self, references, correct, pushed=0.0, noise=None):
        """Command the arm from rest.

        Parameters
        ----------
        references : (k,) ndarray
            References of its joint [rad].
        correct : callable
            ``correct(now, strain)`` gives the correction that is added [rad].
        pushed : float
            First modal amplitude at the start [m].
        noise : float
            Rms noise of the sensor, in its unit; if not given, the usual noise.

        Returns
        -------
        tip : (k, 3) ndarray
            Tip when each command is sent [m].
        strains, corrections : (k,) ndarrays
            [-], [rad]
        """
        plant, loop = self._arm.plant, self._arm.loop
        noise = self._noise if noise is None else noise
        added = np.random.default_rng(0).normal(0.0, noise, references.size)
        every = round(DRIVE_RATE / COMMAND_RATE)
        bent = np.array(plant.model.static_deflection(references[:1]), float)
        bent[0] += pushed
        plant.reset(references[:1], bent)
        loop.begin(references[:1])
        tip, strains, corrections, path = [], [], [], [self._tip()] * 3
        for k, reference in enumerate(references):
            now = k * PERIOD
            tip.append(path[-1])
            strains.append(self._reading(path) + added[k])
            corrections.append(correct(now, strains[-1]))
            loop.command(now, [reference + corrections[-1]])
            for i in range(every):
                loop.drive(plant, now + i / DRIVE_RATE)
                path = [*path[1:], self._tip()]
        return np.array(tip), np.array(strains), np.array(corrections)

    def _tip(self):
        plant = self._arm.plant
        return np.array(plant.model.tip_position(plant.q, plant.delta))

    def _reading(self, path):
        """Reading of the sensor, from the last three positions of the tip, one sample of the drives apart."""
        plant = self._arm.plant
        if not self._imu:
            return float(self._row @ plant.delta)
        across = np.array([-np.sin(plant.q[0]), np.cos(plant.q[0]), 0.0])
        return float(across @ (path[2] - 2.0 * path[1] + path[0])) * DRIVE_RATE**2

    def settings(self, found):
        """Settings of the damping, from the mode `found` and its response to a burst."""
        frequency, ratio = float(found.frequencies[0]), float(found.dampings[0])
        sent = strain_damping.burst(frequency, BURST, PERIOD)
        sent = np.append(sent, np.zeros(int(LISTEN / (frequency * PERIOD))))
        _, strains, _ = self.drive(sent, _no_correction)
        beta, _ = strain_damping.identified(frequency, ratio, PERIOD, sent, strains)
        given = {"frequency": frequency, "damping": ratio}
        answer = {"sensitivity": abs(beta), "phase": float(np.angle(beta))}
        if self._imu:
            answer["full_scale"] = IMU_SCALE
        return check_all(strain_damping.PARAMETERS, {**given, **answer})


def prepared(payload, seed=0, imu=False):
    """The case of a payload, its bench, and the settings of the damping measured on it."""
    case = cases.payload(payload, seed)
    arm = PositionArm(model.build(case.known), model.build(case.plant), 2.0 * np.pi / case.period)
    bench = Bench(arm, imu)
    return case, bench, bench.settings(measured(arm, np.zeros(1), WAY, case.period))


def decay(payload, seed=0) -> Decay:
    """Push one link with `payload` times its payload, with and without damping; `seed` is that of the case."""
    case, bench, settings = prepared(payload, seed)
    known = settings if payload == 1.0 else prepared(1.0, seed)[2]
    still = np.zeros(int(WATCHED * case.period / PERIOD))

    def pushed(correct, noise=None, bench=bench):
        tip, _, corrections = bench.drive(still, correct, PUSH, noise)
        return _time(tip), float(np.abs(corrections).max())

    laws = (_law(settings), _law(settings, 1.0 - OFF), _law(settings, 1.0 + OFF), _law(known))
    times, largest = zip(*map(pushed, (_no_correction, *laws)), strict=True)
    noisy, _ = pushed(_law(settings), NOISY)
    swings = [_swing(case, bench, correct) for correct in (_no_correction, _law(settings))]
    _, other, by_imu = prepared(payload, seed, imu=True)
    imu, _ = pushed(_law(by_imu), bench=other)
    swings.append(_swing(case, other, _law(by_imu)))
    mode = settings["frequency"], settings["damping"], settings["phase"]
    after = swings[1] / swings[0], imu, swings[2] / swings[0]
    return Decay(payload, *mode, *times, noisy, max(largest[:4]), *after)


def _swing(case, bench, correct):
    """Motion of the tip from one to four locked periods after the end of the case's first motion [m]."""
    motion = case.motions[0]
    first, last = (motion.duration + n * case.period for n in (1.0, 4.0))
    references = motion.position(np.arange(int(last / PERIOD)) * PERIOD)[:, 0]
    tip, _, _ = bench.drive(references, correct)
    return float(np.linalg.norm(np.ptp(tip[int(first / PERIOD) :], axis=0)))


def _no_correction(*_):
    return 0.0


def _law(settings, factor=1.0):
    """The damping, at rest before the push, with its frequency multiplied by a factor."""
    changed = {**settings, "frequency": settings["frequency"] * factor}
    damping = strain_damping.StrainDamping(changed, PERIOD)
    damping.update(-PERIOD, 0.0)
    return damping.update


def _time(tip):
    """Time from which the tip (k, 3) stays within `DECAYED` of its first distance from its last place [s]."""
    away = np.linalg.norm(tip - tip[-1], axis=1)
    over = np.flatnonzero(away > DECAYED * away[0])
    return float(over[-1] + 1) * PERIOD


def text(decays):
    """The table of some `Decay`, Markdown."""
    return "\n".join(table(COLUMNS, [found.row() for found in decays]))


def write(decays, path):
    """Put the table between the markers of a Markdown file."""
    write_between(path, BEGIN, END, text(decays))
