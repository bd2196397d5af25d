"""Controller of an arm: reference, composite control, limits, and what happens when a state is bad."""

from enum import IntEnum

import numpy as np

from flexarm_dynamics.errors import MessageError
from flexarm_dynamics.parameters import Parameter

from .arm_observer import check_finite
from .samples import SampleOrder
from .trajectory import ReferenceGenerator, Verdict

#: Parameters of the controller that belong to no single law.
PARAMETERS = (
    Parameter(
        "torque_limit",
        "float_array",
        [0.0],
        "Largest torque sent, per joint; 0.0: the arm file's limits.torque. Never above the arm file's.",
        unit="N m",
        low=0.0,
        high=1e6,
        length="joints",
    ),
    Parameter(
        "torque_rate_limit",
        "float_array",
        [0.0],
        "Largest change of torque per second, against the last torque sent; 0.0: none.",
        unit="N m/s",
        low=0.0,
        high=1e9,
        length="joints",
    ),
)

START_TOLERANCE = Parameter(
    "start_tolerance",
    "float",
    0.01,
    "How far a first point at time 0 may lie from the reference; farther is refused.",
    unit="rad",
    low=0.0,
    high=10.0,
    read_only=True,
)


class Supervisor(IntEnum):
    """States as in CompositeState."""

    INACTIVE = 0
    READY = 1
    TRACKING = 2
    HOLDING = 3
    STOPPING = 4
    FAULT = 5


class ArmController:
    """One composite controller: samples in, torques out, without ROS.

    Parameters
    ----------
    model : ArmModel
        The arm as the controller knows it.
    law : CompositeControl
    settings : mapping
        Checked values of `PARAMETERS`.
    start_tolerance : float
        [rad], see `START_TOLERANCE`.

    Attributes
    ----------
    torque : ndarray, shape (n,)
        What to send [N m]; zero when not `enabled`.
    enabled : bool
        Whether the torque may be applied, or each joint's safe action is to be taken.
    state : Supervisor
    law, answered_by : CompositeControl
        For the next sample, and the one that made `torque`: `law` may be replaced whole at any time.
    saturated : bool
        A limit was met at this sample.
    """

    def __init__(self, model, law, settings, start_tolerance=0.01):
        n = model.n_joints
        self.model, self.law, self.answered_by = model, law, law
        fastest = [j.limits.velocity for j in model.arm.joints]
        self.reference = ReferenceGenerator(model.joint_names, start_tolerance, fastest)
        self._start_tolerance = start_tolerance
        self.torque = np.zeros(n)
        self.position_error, self.velocity_error = np.zeros(n), np.zeros(n)
        self.enabled, self.saturated = False, False
        self.state = Supervisor.INACTIVE
        self._state_reason, self._trajectory_reason = "", ""
        self._waiting = False  # joints known, deflections not yet
        self._order = SampleOrder()
        self._last_ns = 0
        self.configure(settings)

    def configure(self, settings):
        """Take new limits; call between two samples."""
        from_file = np.array([j.limits.torque for j in self.model.arm.joints])
        wanted = np.array(settings["torque_limit"])
        limit = np.where(wanted > 0.0, np.minimum(wanted, from_file), from_file)
        rate = np.array(settings["torque_rate_limit"])
        rate = np.where(rate > 0.0, rate, np.inf)
        self._limit, self._rate_limit = limit, rate
        self._rate_limited = bool(np.isfinite(rate).any())

    @property
    def torque_limit(self):
        """Limit in force, shape (n,) [N m]; infinite where neither file nor parameter sets one."""
        return self._limit

    @property
    def trajectory_id(self):
        """Number of the last accepted trajectory; 0: none yet."""
        return self.reference.accepted_id

    @property
    def reason(self):
        """Why the last state or the last trajectory was refused; empty if neither was."""
        return self._state_reason or self._trajectory_reason

    def refuse(self, reason):
        """Note a trajectory that was refused before it could be offered."""
        self._trajectory_reason = reason

    @property
    def plans(self):
        """Whether a trajectory is worth a `prepare` before it is offered."""
        return self.law.feedforward is not None and self.law.feedforward.plans

    def prepare(self, trajectory, law):
        """Design work for a trajectory that is about to be offered; off the control path, in any thread.

        Parameters
        ----------
        trajectory : JointTrajectoryData
        law : CompositeControl
            The one in force.

        Returns
        -------
        object or None
            For `offer`; None where there is none to do.

        Raises
        ------
        DesignError
            When it can't be done: the trajectory may be offered without.
        """
        if law.feedforward is None:
            return None
        start = self.reference.resting
        return None if start is None else law.feedforward.prepare(trajectory, start)

    def offer(self, trajectory, plan=None):
        """Offer a trajectory.

        While the observer converges, too: one with stamp 0 then starts with the first torque; one whose
        explicit start passes before that is given up.

        Parameters
        ----------
        trajectory : JointTrajectoryData
        plan : object, optional
            What `prepare` made for it.

        Returns
        -------
        Verdict
            Refusals are kept in `reason`; repeats are none.
        """
        if not (self.enabled or self._waiting):
            verdict = Verdict(False, f"no valid state: {self._state_reason or 'none yet'}", 0)
        else:
            verdict = self.reference.offer(trajectory)
        if verdict.accepted:
            self._trajectory_reason = ""
            if self.law.feedforward is not None:
                self.law.feedforward.take(plan, verdict.trajectory_id)
        elif not verdict.repeat:
            self._trajectory_reason = verdict.reason
        return verdict

    def step(self, sample):
        """Answer one estimated state; the control path.

        Parameters
        ----------
        sample : ArmSample
            With amplitude and rate.

        Returns
        -------
        bool
            `enabled`. Every sample is answered; a repeated (session, sequence) from what was answered before.
        """
        try:
            verdict = self._judge(sample)
        except MessageError as error:
            self.disable(str(error))
            return False
        if verdict == SampleOrder.REPEAT and (self.enabled or self._waiting):
            return self.enabled
        law = self.answered_by = self.law
        law.limit = self._limit
        if sample.amplitude is None or (sample.rate is None and law.needs_rates):
            self._wait(sample, verdict)
            return False
        if verdict == SampleOrder.RESTART or self.state == Supervisor.INACTIVE:
            self._begin(sample, verdict)
            law.reset()
        dt = 1e-9 * (sample.stamp_ns - self._last_ns)  # 0 for the first
        self._state_reason = ""
        reference = self.reference
        reference.sample(sample.stamp_ns)
        q, qd = sample.position, sample.velocity
        np.subtract(reference.position, q, out=self.position_error)
        np.subtract(reference.velocity, qd, out=self.velocity_error)
        try:
            u = law.step(q, qd, sample.amplitude, sample.rate, reference, dt)
        except Exception as error:  # a law may be anybody's: whatever it raises, no torque follows
            self.disable(f"the control law failed: {type(error).__name__}: {error}")
            return False
        if not np.isfinite(u).all():
            i = int(np.argmin(np.isfinite(u)))
            self.disable(f"torque of {self.model.joint_names[i]} came out as {u[i]}")
            return False
        self._limited(u, dt)
        self._last_ns = sample.stamp_ns
        self.enabled = True
        if reference.active:
            self.state = Supervisor.TRACKING
        elif self.state != Supervisor.READY or reference.finished:
            self.state = Supervisor.HOLDING
        return True

    def disable(self, reason):
        """Send no torque until a valid state comes; the present trajectory is given up.

        The next valid state is where the arm is held.
        """
        self.enabled, self.state, self._state_reason = False, Supervisor.INACTIVE, reason
        self.torque[:] = 0.0
        self.saturated, self._waiting = False, False

    def _judge(self, sample):
        """Class of the sample, which is the last one from now on; raises for one that can't be used."""
        joints, modes = self.model.joint_names, self.model.mode_names
        check_finite(sample.position, joints, "joint_position")
        if not sample.velocity_known:
            raise MessageError("joint_velocity is empty: the observer is to fill it in")
        check_finite(sample.velocity, joints, "joint_velocity")
        if sample.amplitude is not None:
            check_finite(sample.amplitude, modes, "modal_amplitude")
        if sample.rate is not None:
            check_finite(sample.rate, modes, "modal_rate")
        verdict = self._order.judge(sample)
        if verdict == SampleOrder.STALE:
            raise MessageError(
                f"state {sample.sequence} is not newer than {self._order.sequence}: the stream went back"
            )
        if verdict != SampleOrder.REPEAT:
            self._order.take(sample)
        return verdict

    def _wait(self, sample, verdict):
        """No torque without deflections; the joints are known, so that trajectories may be offered."""
        waiting = self._waiting and verdict != SampleOrder.RESTART
        what = "modal_amplitude" if sample.amplitude is None else "modal_rate"
        self.disable(f"{what} is not known yet")
        self._waiting = True
        if not waiting:
            self.reference.start(sample.position, sample.stamp_ns)

    def _begin(self, sample, verdict):
        """First torque of a session, or after a time without: from the position that is found."""
        keeps = self._waiting and verdict != SampleOrder.RESTART and self.reference.pending
        if keeps and (given_up := self._left_behind(sample)):
            self._trajectory_reason = given_up
            keeps = False
        if not keeps:
            self.reference.start(sample.position, sample.stamp_ns)
        self._waiting, self.state = False, Supervisor.READY
        self.torque[:] = 0.0
        self._last_ns = sample.stamp_ns

    def _left_behind(self, sample):
        """Why what was offered while waiting can't be followed from here; empty if it can."""
        if self.reference.overdue(sample.stamp_ns):
            return "the trajectory was to start before the observer had converged: send it again"
        moved = np.abs(sample.position - self.reference.position)
        if moved.max() > self._start_tolerance:
            name = self.model.joint_names[int(np.argmax(moved))]
            return f"{name} moved {moved.max():.3g} rad while the observer converged: send it again"
        return ""

    def _limited(self, u, dt):
        """Torque within its size and rate, into `torque`."""
        previous = self.torque.copy() if self._rate_limited else None
        np.clip(u, -self._limit, self._limit, out=self.torque)
        if self._rate_limited:
            step = np.full_like(u, np.inf)  # not inf * dt, which is NaN at a start, where dt is 0
            np.multiply(self._rate_limit, dt, out=step, where=np.isfinite(self._rate_limit))
            np.clip(self.torque, previous - step, previous + step, out=self.torque)
        self.saturated = bool((self.torque != u).any())
