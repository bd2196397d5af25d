# SPDX-License-Identifier: Apache-2.0
"""An arm in a few lines of Python: move it, follow a motion, stop, look at it, record it; here without ROS.

`flexarm_tools.arm.Arm` has the same methods and works with running nodes.

    from flexarm_studies.loop.arm import SimulatedArm

    with SimulatedArm("two_link") as arm, arm.recording() as run:
        arm.move([0.8, 0.4], 2.0)
    print(arm.state.tip, abs(run.record.reference - run.record.position).max())
"""

from abc import ABC, abstractmethod
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np

from flexarm_control import trajectory
from flexarm_control.loop.supervisor import State, longest_period
from flexarm_control.motions import profiles
from flexarm_control.trajectory import goal, specs
from flexarm_dynamics.errors import FlexarmError, TrajectoryError

from . import scenario

#: Minimum of a motion's default duration, in periods of the lowest mode; maximum fraction of the limits of speed and
#: torque that the motion then uses [-].
PERIODS, PART = 3.0, 0.5
#: Minimum of the default duration [s], and factor by which it is increased while the torque does not suffice [-].
MIN_DURATION, LONGER = 0.5, 1.3
#: Number of points of a motion.
POINTS = 201
#: Max. time after a motion's end in which a simulated arm must come to rest [s].
PATIENCE = 60.0


class MotionError(FlexarmError):
    """A motion was refused, or did not reach its goal."""


@dataclass(frozen=True)
class Reading:
    """What an arm and its controller are doing.

    Attributes
    ----------
    time : float
        Time of the arm's clock [s].
    position, velocity, reference, torque : ndarray, shape (n,)
        Values of the joints [rad], [rad/s], [rad], [N m].
    amplitude : ndarray, shape (m,)
        Modal amplitudes, from the gauges [m, rad].
    tip : ndarray, shape (3,)
        Position of the tip, from joint positions and modal amplitudes [m].
    supervisor : str
        READY, TRACKING, HOLDING, STOPPING, FAULT or INACTIVE.
    reason : str
        Why there is no torque, or why the last trajectory was refused; otherwise empty.
    """

    time: float
    position: np.ndarray
    velocity: np.ndarray
    reference: np.ndarray
    torque: np.ndarray
    amplitude: np.ndarray
    tip: np.ndarray
    supervisor: str
    reason: str


@dataclass(frozen=True)
class Arrival:
    """How a motion ended successfully.

    Attributes
    ----------
    seconds : float
        Time until the tip had come to rest, by the arm's clock [s].
    tip_swing : float
        Largest remaining swing of the tip [m].
    """

    seconds: float
    tip_swing: float


class Recording:
    """Result of `recording`; `record` is available when the block has ended.

    Attributes
    ----------
    record : Record or None
        References, positions, torques and deflections by sample, see `flexarm_studies.loop.metrics`.
    """

    def __init__(self):
        self.record = None


class BaseArm(ABC):
    """What both kinds of arms have.

    Attributes
    ----------
    arm : Arm
        Of the arm file.
    model : ArmModel
        As the controller knows it.
    """

    arm, model = None, None

    @property
    @abstractmethod
    def state(self):
        """The newest `Reading`."""

    @abstractmethod
    def stop(self):
        """Bring the arm to rest smoothly, and hold it there."""

    @abstractmethod
    def recover(self):
        """Leave a fault; return whether there was one."""

    @abstractmethod
    def recording(self):
        """A context manager that records; it gives a `Recording`."""

    @abstractmethod
    def _follow(self, data):
        """Follow a `JointTrajectoryData` that starts now; return an `Arrival`."""

    def move(self, to, duration=None):
        """Move the joints from where they are held, from rest to rest, and wait until the tip has come to rest.

        Parameters
        ----------
        to : float or (n,) array_like
            Positions at the end [rad]; a number counts for every joint.
        duration : float, optional
            Of the motion [s]; not given: a comfortable one, within half of the limits of speed and torque.

        Returns
        -------
        Arrival

        Raises
        ------
        TrajectoryError
            If these numbers do not give a motion.
        MotionError
            If it is refused, or the arm does not arrive.
        """
        start = np.array(self.state.reference)
        try:
            to = np.broadcast_to(np.asarray(to, float), start.shape)
        except ValueError:
            n = start.size
            limit = f"a number, or {n} of them"
            raise TrajectoryError("does not fit", field="to", value=to, limit=limit) from None
        if not np.isfinite(to).all():
            raise TrajectoryError("is not finite", field="to", value=to.tolist())
        if duration is not None:
            return self.follow(profiles.quintic(start, to, duration))
        return self.follow(profiles.quintic(start, to, self.comfortable(start, to)))

    def comfortable(self, start, to):
        """Duration of a motion from `start` to `to`, each (n,) [rad], if none is given [s].

        It is at least `PERIODS` periods of the lowest mode, and needs at most `PART` of the limits of speed and torque.
        """
        speed = PART * np.asarray(self.model.arm.velocity_limits)
        # The quintic's largest speed is 15/8 of its mean.
        time = max((1.875 * np.abs(to - start) / speed).max(), MIN_DURATION)
        time = max(time, PERIODS * longest_period(self.model))
        limit = PART * np.asarray(self.model.arm.torque_limits)
        if not np.isfinite(limit).any():
            return time
        state = np.array([start, 0.0 * start, 0.0 * start])
        for _ in range(30):
            try:
                data = self._data(profiles.quintic(start, to, time))
                trajectory.refuse_torque(self.model, data, state, limit)
            except TrajectoryError:
                time *= LONGER
                continue
            break
        return time

    def follow(self, motion):
        """Follow a motion from the arm's position, and wait until the tip has come to rest.

        Parameters
        ----------
        motion : Motion, str, Path or sequence
            A motion of `flexarm_control.motions`; one in a line, such as ``"line:tip=1;0.5;0,duration=2"``, or a file
            (`flexarm_control.trajectory.specs`); or (time, positions) of points, joined by straight lines.

        Returns
        -------
        Arrival

        Raises
        ------
        TrajectoryError, MotionError
            As `move`.
        """
        return self._follow(self._data(motion))

    def _data(self, motion):
        if isinstance(motion, profiles.Motion):
            points = profiles.rows(profiles.sample(motion, POINTS))
        elif isinstance(motion, (str, bytes)) or hasattr(motion, "__fspath__"):
            return specs.load(str(motion), self.model, np.array(self.state.reference))
        else:
            try:
                points = [
                    (round(1e9 * t), np.atleast_1d(q).tolist(), (), (), ()) for t, q in motion
                ]
            except (TypeError, ValueError):
                hint = "give (time, positions) of each point"
                raise TrajectoryError("is no motion", field="motion", hint=hint) from None
        names = self.model.joint_names
        return trajectory.validate(names, names, 0, points, *specs.limits(self.model))

    def _check(self, data, start_ns):
        """The `GoalCheck` of a motion that starts at a stamp, with the default tolerances of the nodes."""
        values = {p.name: p.default for p in goal.PARAMETERS}
        reach = self.arm.reach
        names = self.model.joint_names
        limits = goal.tolerances(names, reach, values)
        end = start_ns + int(data.times_ns[-1])
        return goal.GoalCheck(names, limits, end, longest_period(self.model))

    def close(self):
        """Release the arm."""

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()


class SimulatedArm(BaseArm):
    """An arm that is simulated in this process, under observer and controller, as fast as the machine allows.

    Parameters
    ----------
    arm : str or Arm
        Arm file: shipped name or path.
    settings : sequence of str
        Settings of the control, ``name=value`` each, see `scenario.parameters`. Without laws the control is that of a
        design, which takes up to some minutes the first time.
    file : str or Path, optional
        Parameter file of the control.
    fields
        Further fields of a `Scenario`: how the simulated arm differs from its file, noise, delay, …
    """

    def __init__(self, arm, settings=(), file=None, **fields):
        if file is None and isinstance(arm, str):
            file = scenario.parameter_files.of_arm(arm)
        values = scenario.parameters(file, settings, arm if isinstance(arm, str) else "")
        self.loop = scenario.loop_of(scenario.Scenario(arm, values, **fields))
        self.model = self.loop.model
        self.arm = self.model.arm
        self._rows = None
        for _ in range(round(self.loop.MAX_START * 1e9 / self.loop.simulator.period_ns)):
            self._step()
            if self.loop.controller.enabled:
                return
        raise MotionError(f"no torque: {self.loop.controller.reason}", field=self.arm.name)

    def _step(self):
        stamp, row = self.loop.recorded_step()
        if self._rows is not None:
            self._rows.append((stamp, row))

    @property
    def state(self):
        """As `BaseArm.state`."""
        loop, controller = self.loop, self.loop.controller
        estimate = loop.estimated
        amplitude = estimate.amplitude if estimate.amplitude is not None else np.zeros(0)
        return Reading(
            time=1e-9 * estimate.stamp_ns,
            position=estimate.position.copy(),
            velocity=estimate.velocity.copy(),
            reference=controller.reference.position.copy(),
            torque=controller.torque.copy(),
            amplitude=amplitude.copy(),
            tip=self.model.tip_position(estimate.position, amplitude),
            supervisor=controller.state.name,
            reason=controller.reason,
        )

    def _follow(self, data):
        loop, controller = self.loop, self.loop.controller
        if controller.plans:
            data = replace(data, stamp_ns=loop.simulator.stamp_ns + loop.simulator.period_ns)
        verdict = controller.offer(data, loop.prepared(data))
        if not verdict.accepted:
            raise MotionError(verdict.reason)
        begin = loop.simulator.stamp_ns
        check, limit = (
            self._check(data, begin),
            begin + int(data.times_ns[-1]) + round(PATIENCE * 1e9),
        )
        while loop.simulator.stamp_ns < limit:
            self._step()
            if controller.state not in (State.READY, State.TRACKING, State.HOLDING):
                raise MotionError(
                    controller.reason or f"the arm is in state {controller.state.name}"
                )
            estimate, reference = loop.estimated, controller.reference
            if not reference.finished:
                continue
            error = reference.position - estimate.position
            amplitude = estimate.amplitude if self.model.n_modes else np.zeros(0)
            tip = self.model.tip_position(estimate.position, amplitude)
            outcome = check.at_the_end(estimate.stamp_ns, error, estimate.velocity, tip)
            if outcome is not None:
                return Arrival(1e-9 * (estimate.stamp_ns - begin), outcome.swing)
        raise MotionError(
            f"the tip does not come to rest within {PATIENCE:g} s of the motion's end"
        )

    def wait(self, seconds):
        """Let the arm go on for a time [s]."""
        for _ in range(round(seconds * 1e9 / self.loop.simulator.period_ns)):
            self._step()

    def stop(self):
        """As `BaseArm.stop`."""
        if self.loop.controller.brake("stop was called"):
            while (
                self.loop.controller.state == State.STOPPING
                or self.loop.controller.reference.stopping
            ):
                self._step()

    def recover(self):
        """As `BaseArm.recover`."""
        was = self.loop.controller.recover()
        self._step()
        return was

    @contextmanager
    def recording(self):
        """As `BaseArm.recording`."""
        found, self._rows = Recording(), []
        try:
            yield found
        finally:
            rows, self._rows = self._rows, None
            if rows:
                found.record = self.loop.record_of(rows)
