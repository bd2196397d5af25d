# SPDX-License-Identifier: Apache-2.0
r"""Makes small motions that cause an arm to ring, within bounds, and stops a measurement that leaves its bounds.

``step``: each joint goes a small distance and back, with maximum acceleration and then deceleration, and rests after
each, so it rings freely. ``sweep``: each joint swings with

.. math:: x = A(f)\sin\varphi(t),\quad \dot\varphi = 2\pi f,\quad f = f_1(f_2/f_1)^{t/T},\quad
    A = 0.9\min\Bigl(d, \frac{v}{2\pi f}, \frac{a}{(2\pi f)^2}\Bigr)

faded in and out, and rests. The points have positions and velocities; between them the motion is cubic, as in every
trajectory controller.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.interpolate import BPoly

from flexarm_dynamics.errors import FlexarmError

#: Fraction of the bounds that a motion uses [-].
USED = 0.9
#: A sweep is made smaller if it would use more than this fraction of the bounds [-].
MOST = 0.97
#: Points per second of a sweep, and of the check.
RATE, CHECKED = 100.0, 1000.0
#: Fraction of a sweep in which it is faded in, and out [-].
FADED = 0.1
#: Time after a motion's end until the controller has settled and free ringing begins [s].
SETTLED = 0.2
#: If speeds are not measured, they are differences of positions over this time [s].
OVER = 0.02
STEP, SWEEP = "step", "sweep"


@dataclass(frozen=True)
class Bounds:
    """Bounds of the motion, and bounds of the arm's measured motion.

    Attributes
    ----------
    travel, velocity, acceleration : float
        Bounds of the motion, about the arm's position [rad], [rad/s], [rad/s^2].
    stop_travel, stop_velocity : float
        Bounds of the measured joints; beyond these the measurement stops [rad], [rad/s].
    silence : float
        Max. time without joint states; after it the measurement stops, too [s].
    """

    travel: float = 0.05
    velocity: float = 0.5
    acceleration: float = 5.0
    stop_travel: float = 0.15
    stop_velocity: float = 1.5
    silence: float = 0.5

    def __post_init__(self):
        """Refuse values that are not bounds.

        Raises
        ------
        FlexarmError
        """
        for name in ("travel", "velocity", "acceleration", "silence"):
            value = getattr(self, name)
            if not 0.0 < value < np.inf:
                raise FlexarmError(
                    "is out of range", field=f"bounds: {name}", value=value, limit="above 0"
                )
        for name in ("travel", "velocity"):
            own, least = getattr(self, f"stop_{name}"), getattr(self, name)
            if not least < own < np.inf:
                field, limit = f"bounds: stop_{name}", f"above {name}, {least:g}"
                raise FlexarmError("is out of range", field=field, value=own, limit=limit)


@dataclass(frozen=True, eq=False)
class RingingMotion:
    """Points of a motion, relative to the arm's position.

    Attributes
    ----------
    times : ndarray, shape (k,)
        From 0 [s].
    positions, velocities : ndarray, shape (k, n)
        [rad], [rad/s]
    free, swept : tuple of (float, float, int)
        Begin, end and joint of each free ringing, and of each sweep with the ringing after it [s].
    """

    times: np.ndarray
    positions: np.ndarray
    velocities: np.ndarray
    free: tuple
    swept: tuple

    @property
    def duration(self):
        """Duration with the rest at its end [s]."""
        return max((end for _, end, _ in (*self.free, *self.swept)), default=float(self.times[-1]))

    @cached_property
    def _splines(self):
        spline = BPoly.from_derivatives(
            self.times, np.stack([self.positions, self.velocities], axis=1)
        )
        return [spline, spline.derivative(), spline.derivative(2)]

    def derivative(self, order, time):
        """Derivative of an `order` from 0 (position) to 2 at times (k,) [s], shape (k, n); at rest before and after."""
        time = np.asarray(time, float)
        values = self._splines[order](np.clip(time, 0.0, self.times[-1]))
        moves = (time >= 0.0) & (time < self.times[-1])
        return values if order == 0 else np.where(moves[:, None], values, 0.0)


def design(kind, joints, n, bounds, rest=4.0, band=(1.0, 15.0), duration=10.0) -> RingingMotion:
    """A motion within bounds.

    Parameters
    ----------
    kind : str
        ``step`` or ``sweep``.
    joints : sequence of int
        Joints that move, one after the other.
    n : int
        Number of joints.
    bounds : Bounds
    rest : float
        After each motion of a joint [s].
    band : (float, float)
        Of a sweep [Hz].
    duration : float
        Of a sweep [s].

    Raises
    ------
    FlexarmError
        For an impossible kind, joint, time or band.
    """
    if kind not in (STEP, SWEEP):
        raise FlexarmError("is unknown", field="kind", value=kind, limit=f"{STEP}, {SWEEP}")
    for joint in joints:
        if not 0 <= joint < n:
            raise FlexarmError("is no joint", field="joints", value=joint, limit=f"0 to {n - 1}")
    for name, value in (("rest", rest), ("duration", duration)):
        if not 0.0 < value <= 600.0:
            raise FlexarmError(
                "is out of range", field=name, value=value, limit="above 0, at most 600 s"
            )
    if not 0.0 < band[0] < band[1] <= 0.4 * RATE:
        limit = f"0 < low < high <= {0.4 * RATE:g} Hz"
        raise FlexarmError("is no band of a sweep", field="band", value=list(band), limit=limit)
    pieces, at, free, swept = [], 0.0, [], []
    for joint in joints:
        rows = (
            [_step(bounds, 1.0), _step(bounds, -1.0)]
            if kind == STEP
            else [_sweep(bounds, band, duration)]
        )
        for time, position, velocity in rows:
            pieces.append((at + time, position, velocity, joint))
            begin, at = at, at + time[-1] + rest
            if kind == STEP:
                free.append((begin + float(time[-1]) + SETTLED, at, joint))
            else:
                swept.append((begin, at, joint))
    made = _joined(pieces, n, tuple(free), tuple(swept))
    check(made, bounds)
    return made


def _step(bounds, sign):
    """A motion there (or back) and a stop: time, position and speed at the corners of the speed."""
    travel, top = USED * bounds.travel, USED * bounds.velocity
    acceleration = USED * bounds.acceleration
    rise = min(np.sqrt(travel / acceleration), top / acceleration)
    speed = acceleration * rise
    cruise = travel / speed - rise
    corners = np.array([0.0, rise, rise + cruise, 2.0 * rise + cruise])
    way = np.array([0.0, 0.5 * speed * rise, travel - 0.5 * speed * rise, travel])
    keep = np.array([True, True, cruise > 1e-3, True])
    start = 0.0 if sign > 0.0 else travel
    return corners[keep], start + sign * way[keep], sign * np.array([0.0, speed, speed, 0.0])[keep]


def _sweep(bounds, band, duration):
    """Time, position and speed of a sweep."""
    low, high = band
    count = int(duration * RATE)
    fine = np.linspace(0.0, duration, 20 * count + 1)
    hertz = low * (high / low) ** (fine / duration)
    phase = 2.0 * np.pi * low * duration / np.log(high / low) * (hertz / low - 1.0)
    omega = 2.0 * np.pi * hertz
    # A smooth minimum, because corners of the amplitude would cause steps of the speed.
    limits = (1.0 / bounds.travel, omega / bounds.velocity, omega**2 / bounds.acceleration)
    amplitude = USED * sum(limit**4 for limit in limits) ** -0.25
    edge = np.clip(np.minimum(fine, duration - fine) / (FADED * duration), 0.0, 1.0)
    position = amplitude * np.sin(np.pi / 2.0 * edge) ** 2 * np.sin(phase)
    velocity = np.gradient(position, fine, edge_order=2)
    velocity[[0, -1]] = position[[0, -1]] = 0.0
    time, position, velocity = fine[::20], position[::20], velocity[::20]
    # Fading in and a quick sweep need more speed and acceleration than the momentary sine.
    spline = BPoly.from_derivatives(time, np.stack([position, velocity], axis=1))
    near = np.linspace(0.0, duration, int(CHECKED * duration) + 1)
    limits = (bounds.travel, bounds.velocity, bounds.acceleration)
    peaks = [np.abs(spline.derivative(k)(near) if k else spline(near)).max() for k in range(3)]
    factor = min(1.0, *(MOST * limit / peak for limit, peak in zip(limits, peaks, strict=True)))
    return time, factor * position, factor * velocity


def _joined(pieces, n, free, swept):
    times, positions, velocities = [], [], []
    held = np.zeros(n)
    for time, position, velocity, joint in pieces:
        rows, speeds = np.tile(held, (time.size, 1)), np.zeros((time.size, n))
        rows[:, joint], speeds[:, joint] = position, velocity
        times.append(time)
        positions.append(rows)
        velocities.append(speeds)
        held = rows[-1].copy()
    return RingingMotion(
        *(np.concatenate(parts) for parts in (times, positions, velocities)), free, swept
    )


def check(made, bounds):
    """Refuse a motion that is beyond its bounds anywhere.

    Parameters
    ----------
    made : RingingMotion
    bounds : Bounds

    Raises
    ------
    FlexarmError
        Naming joint, time, value and limit.
    """
    time = np.arange(0.0, made.times[-1], 1.0 / CHECKED)
    limits = (bounds.travel, bounds.velocity, bounds.acceleration)
    for order, (name, limit) in enumerate(
        zip(("travel", "velocity", "acceleration"), limits, strict=True)
    ):
        size = np.abs(made.derivative(order, time))
        if not size.max(initial=0.0) <= limit * (1.0 + 1e-9):
            row, joint = np.unravel_index(np.argmax(size), size.shape)
            field = f"motion: {name} of joint {joint + 1} at {time[row]:.3g} s"
            raise FlexarmError(
                "is beyond its bound", field=field, value=float(size[row, joint]), limit=limit
            )


class Arm(ABC):
    """An arm that is moved through its trajectory interface; defines what a measurement needs.

    Attributes
    ----------
    joint_names : tuple of str
        Names of the n joints.
    begin : float
        Time when the motion was sent, as the streams count it [s].
    """

    joint_names: tuple
    begin: float

    @abstractmethod
    def sample(self, patience):
        """The next joint state: clock [s], position and velocity (n,) [rad], [rad/s].

        None if no state arrives within `patience` [s]. The velocity is None if it is not measured.
        """

    @abstractmethod
    def move(self, motion, start):
        """Send a `motion`, relative to `start` (n,) [rad]."""

    @abstractmethod
    def stop(self):
        """Stop the arm and discard its current motion."""

    @abstractmethod
    def streams(self):
        """What was measured, a list of `Stream`."""


class Watch:
    """Monitors whether the measured joints are within their bounds.

    Parameters
    ----------
    joint_names : sequence of str
    start : ndarray, shape (n,)
        Position of the arm [rad].
    bounds : Bounds
    """

    def __init__(self, joint_names, start, bounds):
        self._names, self._start, self._bounds = joint_names, np.asarray(start, float), bounds
        self._last = None

    def refuse(self, clock, position, velocity=None):
        """Refuse a joint state that is beyond the bounds.

        Parameters
        ----------
        clock : float
            [s]
        position, velocity : ndarray, shape (n,)
            [rad], [rad/s]; without velocities, differences of the positions are used.

        Raises
        ------
        FlexarmError
            Naming joint, value and limit.
        """
        bounds = self._bounds
        self._within("position", position, np.inf)
        self._within("travel", position - self._start, bounds.stop_travel)
        measured = velocity is not None and np.isfinite(velocity).all()
        self._within(
            "velocity",
            velocity if measured else self._difference(clock, position),
            bounds.stop_velocity,
        )

    def _difference(self, clock, position):
        """Mean speed since a reference sample, over at least `OVER`; the reference is replaced when it is that old."""
        if self._last is None:
            self._last = clock, position
            return np.zeros_like(position)
        before, there = self._last
        passed = clock - before
        if passed >= OVER:
            self._last = clock, position
        return (position - there) / max(passed, OVER)

    def _within(self, name, values, limit):
        wrong = ~(np.abs(values) <= limit) | ~np.isfinite(values)
        if wrong.any():
            joint = int(np.argmax(wrong))
            field, hint = (
                f"measured {name} of {self._names[joint]}",
                "the arm has been stopped; nothing was measured",
            )
            limit = limit if np.isfinite(limit) else "finite"
            problem = "is beyond the bound of the measurement"
            raise FlexarmError(
                problem, field=field, value=float(values[joint]), limit=limit, hint=hint
            )


def measure(arm, motion, bounds, settle=1.0):
    """Move an arm, and watch it until the motion and its last rest are over; it is stopped if anything goes wrong.

    Parameters
    ----------
    arm : Arm
    motion : RingingMotion
    bounds : Bounds
    settle : float
        Time for which the arm must stand still before the motion [s].

    Returns
    -------
    ndarray, shape (n,)
        Position in which it stood [rad].

    Raises
    ------
    FlexarmError
        If the arm does not stand still before the motion, leaves its bounds, or sends no more states.
    """
    check(motion, bounds)
    start = _standing(arm, bounds, settle)
    watch = Watch(arm.joint_names, start, bounds)
    try:
        arm.move(motion, start)
        clock, _, _ = _next(arm, bounds)
        end = clock + motion.duration + SETTLED
        while clock < end:
            clock, position, velocity = _next(arm, bounds)
            watch.refuse(clock, position, velocity)
    except BaseException:  # Ctrl-C as well
        arm.stop()
        raise
    return start


def _standing(arm, bounds, settle):
    """Position of the arm at rest; refused if the arm moves by a tenth of the motion's distance."""
    clock, start, _ = _next(arm, bounds)
    watch, end = Watch(arm.joint_names, start, bounds), clock + settle
    while clock < end:
        clock, position, _ = _next(arm, bounds)
        watch.refuse(clock, position)
        away = np.abs(position - start)
        if away.max() > 0.1 * bounds.travel:
            joint = int(np.argmax(away))
            field, hint = f"joint {arm.joint_names[joint]}", "wait until the arm stands"
            limit = 0.1 * bounds.travel
            raise FlexarmError(
                "moves already", field=field, value=float(away[joint]), limit=limit, hint=hint
            )
    return start


def _next(arm, bounds):
    found = arm.sample(bounds.silence)
    if found is None:
        hint = "the arm has been stopped; is its driver alive?"
        raise FlexarmError(f"none came for {bounds.silence:g} s", field="joint states", hint=hint)
    return found
