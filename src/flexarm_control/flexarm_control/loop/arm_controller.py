# SPDX-License-Identifier: Apache-2.0
"""The supervised controller of an arm, with reference, composite control and limits: samples in, torques out."""

import numpy as np

from flexarm_dynamics.errors import DesignError, FlexarmError, MessageError, TrajectoryError
from flexarm_dynamics.parameters import parameter

from ..arrays import finite, some
from ..payload import estimator
from ..payload.estimator import PayloadEstimator
from ..trajectory import ReferenceGenerator, Streaming, Verdict, refuse_torque, streams, validate
from ..trajectory.reference import GENTLE
from . import applied, authority, supervisor
from .applied import Applied
from .authority import Authority
from .samples import ArmSample, SampleOrder, clock_jumped
from .supervisor import State, Supervisor, longest_period
from .torque_delay import TorqueDelay

#: Duration of the ramp in which the fast control is switched on or off [s].
FAST_RAMP = 0.1

#: If the source restarts during operation, each joint must be this close to its last position [rad], and no faster
#: than this [rad/s].
SAME_PLACE, AT_REST = 0.01, 0.05
#: An arm that seems to move is watched this long before its first torque: the velocity may be noise or a swing [s].
SEEN = 0.01
#: A gap of up to this many periods is no interruption, however long a period is.
PERIODS_OF_GAP = 5.0
#: Text of a doubt for which the source gives no reason.
UNSTATED = "the source asks for a stop"
#: More repeats of one state than this are a fault: the source then measures nothing new.
MAX_REPEATS = 10

#: Parameters of the controller itself, which belong to none of its laws.
PARAMETERS = (
    *authority.PARAMETERS,
    *applied.PARAMETERS,
    parameter("resume_gap", 0.05, "s", 1e-3, 1e4).described(
        "After a longer time without a state, the motion is given up and torque returns in a ramp. Set it to the"
        " driver's torque_timeout. Up to five periods are no gap."
    ),
    parameter("trajectory_torque_margin", 1.0, "-", 0.0, 1e3).described(
        "Largest torque that a trajectory may need, as a multiple of the torque limit; one that needs more is refused."
        " Computed for the rigid arm with weight, friction and the arm file's payload. 0.0: not checked."
    ),
    parameter("allow_partial_joints_goal", False).described(
        "Whether a trajectory may leave out joints, which then stay where they are held; not while the arm moves."
    ),
    parameter("join_late_trajectories", False).described(
        "Whether a trajectory whose stamp is in the past, and whose end is not, is joined midway, as"
        " joint_trajectory_controller does; otherwise it is refused."
    ),
    *streams.PARAMETERS,
    parameter("speed_scaling", 1.0, "-", 0.0, 1.0).described(
        "Factor on the speed at which trajectories are followed. It changes smoothly. 0.0: the arm rests on its way."
        " Stops are not scaled."
    ),
    *supervisor.PARAMETERS,
    *estimator.PARAMETERS,
)

START_TOLERANCE = parameter("start_tolerance", 0.01, "rad", 0.0, 10.0, read_only=True).described(
    "How far a first point at time 0 may lie from the reference; a trajectory that begins farther away is refused."
)


class ArmController:
    """One composite controller: samples in, torques out, without ROS.

    Parameters
    ----------
    model : ArmModel
        The controller's model of the arm.
    law : CompositeControl
    settings : mapping
        Checked values of `PARAMETERS`.
    start_tolerance : float
        [rad], see `START_TOLERANCE`.

    Attributes
    ----------
    torque : ndarray
        Torque to send [N m], shape (n,); zero when not `enabled`.
    enabled : bool
        Whether the torque may be applied; if not, each joint takes its safe action.
    supervisor : Supervisor
        State and limits.
    law, answered_by : CompositeControl
        The control for the next sample, and the one that computed `torque`; `law` may be replaced as a whole at any
        time.
    fast_enabled : bool
        Whether the fast control takes part, see `enable_fast`.
    saturated : bool
        Whether a limit was met at this sample.
    late, missed, interruptions : int
        Number of samples that came after a later one and were ignored; number of samples that never came; number of
        times that torque was lost and returned.
    alive : bool
        Whether the last sample was a sign of life of the source: it was new, or the source's clock stands still.
    torque_delay : TorqueDelay
        Measures how long after a state's stamp its torque acts, from what the driver reports.
    controller_id : int
        Id under which torques are sent. 0: it is unknown, and the id that the driver confirms is not checked.
    judged : tuple of str
        Name of the last trajectory that was accepted or refused, and the reason for a refusal, or empty.
    payload : PayloadEstimator or None
        Estimate of the payload, which `learn` updates; None: `payload_estimate` is off.
    """

    def __init__(self, model, law, settings, start_tolerance=0.01):
        n = model.n_joints
        self.model, self.law, self.answered_by = model, law, law
        fastest = model.arm.velocity_limits
        self.reference = ReferenceGenerator(
            model.joint_names,
            start_tolerance,
            fastest,
            longest_period(model),
            model.arm.continuous,
        )
        self._start_tolerance = start_tolerance
        self._nothing = np.zeros(0)
        self.position_error, self.velocity_error = np.zeros(n), np.zeros(n)
        self.enabled, self.saturated, self.fast_enabled = False, False, True
        self._trajectory_reason, self.judged = "", ("", "")
        self._waiting = False  # joints known, deflections not yet
        self._seen = []  # stamp and positions of one or two samples, while waiting
        self.late = self.missed = self.controller_id = 0
        self._order, self._repeats = SampleOrder(), 0
        self._last_ns, self._period = 0, 0.0  # [ns], [s]
        self._jumped_ns = 0  # how far the source's clock jumped ahead of the reference's time [ns]
        self._count = 1  # states since the last one, missed ones included
        self._doubt = ""  # of the last sample
        self._foreign = self.interruptions = 0
        self._position = np.zeros(n)  # at the last sample
        self.alive = True
        self._authority = Authority(model, settings)
        self.torque = self._authority.torque
        self.supervisor = Supervisor(model, settings, self.torque_limit)
        self._expected = None
        self._applied = Applied(model, settings, self.torque_limit)
        self.torque_delay = TorqueDelay(n)
        self._take_limits(settings)
        self.payload = self._estimator(settings)
        # How long the joints have been slow, for the payload [s].
        self._slow_for, self._bending_period = 0.0, longest_period(model)

    def _estimator(self, settings):
        mode = settings["payload_estimate"]
        if mode == estimator.OFF:
            return None
        if self.law.slow.learns:
            raise DesignError(
                "and a slow law that learns would both correct the payload",
                field="payload_estimate",
                value=mode,
                hint="write off, or choose another slow.type",
            )
        return PayloadEstimator(self.model, mode, settings["payload_limit"])

    def replace_law(self, law):
        """Replace the control by another, which continues from its states; call between two samples."""
        law.resume(self.law)
        self.law = law

    # Payload -------------------------------------------------------------------------------------

    def learn(self):
        """Learn the loop's delay and the payload from the last samples; call once the torque is sent."""
        self.torque_delay.judge()
        self.law.take_delay(self.torque_delay.known)
        if self.payload is not None and self.enabled:
            self.payload.update(self.reference.resting is not None)

    @property
    def payload_scale(self):
        """Payload that the control is designed for, as a multiple of the arm file's [-]."""
        return self.law.model.payload_scale

    @property
    def payload_wanted(self):
        """Payload scale to design the control for now [-]; None: keep the present one, as always in motion."""
        found = self.payload
        if found is None or found.reason or self.law.slow.learns:
            return None
        if not (self.enabled and self._rests):
            return None
        if found.low <= self.payload_scale <= found.high:
            return None
        return round(found.value, 3)

    @property
    def _rests(self):
        at_rest = self.state in (State.READY, State.HOLDING) and self.reference.resting is not None
        # A swinging arm is slow at its turning points, too. So it must be slow for half a period.
        return at_rest and not self._doubt and self._slow_for >= 0.5 * self._bending_period

    def carry(self, law):
        """Take a control for another payload; returns False, and changes nothing, if the arm does not rest."""
        if not self._rests:
            return False
        self.replace_law(law)
        return True

    def _note(self, sample, dt):
        """Give the payload estimate what it needs of a sample; call this before the sample's torque is computed."""
        slow = np.abs(sample.velocity).max() < AT_REST
        self._slow_for = self._slow_for + dt if slow else 0.0
        if self._doubt:
            self.payload.discard(f"a sensor is in doubt: {self._doubt}")
            self.payload.restart()
            return
        known = finite(sample.torque)
        self.payload.note(
            sample.position, sample.amplitude, sample.torque if known else self.torque, dt
        )

    def configure(self, settings):
        """Take new limits, all at once; call between two samples.

        Raises
        ------
        ParameterError
            If a limit can't be used; then nothing has changed.
        """
        self.supervisor.configure(settings, self._authority.limits_of(settings))
        self._authority.configure(settings)
        self._take_limits(settings)

    def _take_limits(self, settings):
        self._applied.configure(settings, self.torque_limit)
        self.reference.joins = settings["join_late_trajectories"]
        deceleration, given = self.supervisor.deceleration, self.supervisor.deceleration_given
        self.reference.scale(settings["speed_scaling"], deceleration, given)
        self._resume_gap = settings["resume_gap"]
        self._max_gap = round(1e9 * settings["max_gap"])
        self._max_age = 1e9 * settings["max_age"] if settings["synchronised_clocks"] else None

    @property
    def state(self):
        """The `State` of the supervisor."""
        return self.supervisor.state

    @property
    def torque_limit(self):
        """Active limit, shape (n,) [N m]; infinite where neither file nor parameter sets one."""
        return self._authority.limit

    @property
    def period(self):
        """Time between the stamps of the last two states [s]; 0 before the second."""
        return self._period

    @property
    def trajectory_id(self):
        """Number of the last accepted trajectory; 0: none yet."""
        return self.reference.accepted_id

    @property
    def reason(self):
        """Why there is no torque, why the arm was stopped, or why the last trajectory was refused; else empty."""
        return self.supervisor.reason or self._trajectory_reason

    def view(self):
        """Values at the last sample, as arrays by the field names of `CompositeState`.

        Errors, parts of the torque and deflections are 0.0 where no torque was computed.
        """
        reference, law = self.reference, self.answered_by
        computed = {
            "position_error": self.position_error,
            "velocity_error": self.velocity_error,
            "slow_torque": law.slow_torque,
            "fast_torque": law.fast_torque,
            "quasi_steady_amplitude": law.quasi_steady,
            "fast_deviation": law.deviation,
        }
        if not self.enabled:  # the stored ones are those of an earlier sample
            computed = dict.fromkeys(computed, 0.0)
        return {
            "reference_position": reference.position,
            "reference_velocity": reference.velocity,
            "reference_acceleration": reference.acceleration,
            "torque": self.torque,
            **computed,
        }

    def refuse(self, reason, name=""):
        """Note a trajectory that was refused before it could be offered."""
        self._trajectory_reason, self.judged = reason, (name, reason)

    @property
    def held(self):
        """Positions of joints that a trajectory leaves out, (n,) [rad]; None: it must name all. Any thread may ask."""
        if not self.supervisor.settings["allow_partial_joints_goal"]:
            return None
        resting = self.reference.resting
        return None if resting is None else resting[0]

    @property
    def streaming(self):
        """How `validate` takes the points of streams. Any thread may ask."""
        settings, deceleration = self.supervisor.settings, self.supervisor.deceleration
        gentle = np.minimum(GENTLE, deceleration)
        return Streaming(
            moving_end=settings["allow_nonzero_velocity_at_trajectory_end"],
            timeout=settings["cmd_timeout"],
            deceleration=np.where(self.supervisor.deceleration_given, deceleration, gentle),
            period=self._bending_period,
            smoothing=settings["smoothing_time"],
            effort=settings["effort_in_points"],
        )

    @property
    def plans(self):
        """Whether a trajectory should pass `prepare` before it is offered."""
        return self.law.feedforward is not None and self.law.feedforward.plans

    def prepare(self, trajectory):
        """Do the design work for a `trajectory`, off the control path; give the result to `offer`.

        Returns None if there is nothing to prepare. Raises a `DesignError` if the work can't be done; then offer the
        trajectory without a plan.
        """
        start = self.reference.resting
        if start is None or not self.plans:
            return None
        return self.law.feedforward.prepare(trajectory, start)

    @property
    def torque_allowed(self):
        """Largest torque that a trajectory may need, shape (n,) [N m]; infinite: not checked."""
        margin = self.supervisor.settings["trajectory_torque_margin"]
        if margin == 0.0 or self.law.free:
            return np.full(self.model.n_joints, np.inf)
        return margin * self.torque_limit

    def _judge_torque(self, trajectory, start):
        refuse_torque(self.model, trajectory, start, self.torque_allowed)

    def offer(self, trajectory, plan=None, judged=False, name=""):
        """Offer a `trajectory`, with the `plan` that `prepare` made for it; after a refusal, `reason` says why.

        After the call the attribute `judged` has the `name` of this trajectory.

        The torque that it needs is checked here, unless the argument `judged` is true. The check takes a while.

        A trajectory may also be offered while the observer converges. With stamp 0 it then starts with the first
        torque; if its explicit start passes before that, it is given up.

        Returns
        -------
        Verdict
        """
        if self.state == State.FAULT:
            verdict = Verdict(False, f"in fault, call ~/recover first: {self.supervisor.reason}", 0)
        elif not (self.enabled or self._waiting):
            verdict = Verdict(False, f"no valid state: {self.supervisor.reason or 'none yet'}", 0)
        elif self._doubt:
            verdict = Verdict(False, f"a sensor is in doubt: {self._doubt}", 0)
        elif self._jumped_ns and trajectory.stamp_ns:
            verdict = Verdict(
                False, "header.stamp: the source's clock jumped, wait for the arm to rest", 0
            )
        else:
            verdict = self.reference.offer(trajectory, None if judged else self._judge_torque)
        if verdict.accepted:
            self._trajectory_reason = ""
            if self.law.feedforward is not None:
                made_for_it = None if verdict.joined else plan
                self.law.feedforward.take(made_for_it, verdict.trajectory_id)
        elif not verdict.repeat:
            self._trajectory_reason = verdict.reason
        refused = not (verdict.accepted or verdict.repeat)
        self.judged = name, verdict.reason if refused else ""
        return verdict

    def step(self, sample, now_ns=None):
        """Answer one estimated state; runs on the control path.

        Parameters
        ----------
        sample : ArmSample
            With amplitude and rate.
        now_ns : int, optional
            The time on the stamps' clock [ns]; needed with `synchronised_clocks`.

        Returns
        -------
        bool or None
            `enabled`; None for a sample that came after a later one: it has been answered, or needs no answer. A
            repeated (session, sequence) is answered as before.
        """
        if not self.model.n_modes:
            sample.amplitude = sample.rate = self._nothing  # read as unknown, but there are none
        try:
            verdict = self._judge(sample, now_ns)
        except MessageError as error:
            self.distrust(str(error))
            return False
        if verdict == SampleOrder.STALE:
            self.late += 1
            return None
        self.alive = verdict != SampleOrder.REPEAT or sample.clock_stopped
        if verdict == SampleOrder.REPEAT and not self._may_go_on(sample):
            return self.enabled
        if self.state == State.FAULT:
            return False
        if sample.trust == ArmSample.DISTRUSTED:
            self.distrust(sample.doubt or "the source distrusts this state")
            return False
        if verdict == SampleOrder.RESTART and self.enabled and (why := self._restarted(sample)):
            self.fail(why)
            return False
        self._doubt = sample.doubt or UNSTATED if sample.trust == ArmSample.STOP else ""
        law = self.answered_by = self.law
        law.limit = self.torque_limit
        if reason := self._lacks(sample, verdict):
            self._wait(sample, verdict, reason)
            return False
        dt = 1e-9 * (sample.stamp_ns - self._last_ns)
        if verdict == SampleOrder.RESTART or not self.supervisor.running:
            self._begin(sample, verdict)
            return self._control(sample, 0.0)
        gap, away = dt, self._applied.back_after(sample, self.controller_id)
        known, self._period = self._period, dt / self._count
        if gap > self._resume_gap and gap > PERIODS_OF_GAP * known:
            dt = self._after_gap(sample, gap, known)
        elif away > self._resume_gap:
            self._interrupted(sample, f"the driver has applied no torque for {away:.3g} s")
            dt = 0.0
        return self._control(sample, dt)

    def _control(self, sample, dt):
        """Compute the torque for a sample that can be trusted; returns whether it may be applied."""
        law, reference, supervisor = self.law, self.reference, self.supervisor
        if self.payload is not None:
            self._note(sample, dt)
        if self._jumped_ns and reference.resting is not None:
            self._rest_on(reference.position, sample.stamp_ns)
        reference.sample(sample.stamp_ns - self._jumped_ns)
        if reference.path is not self._expected:
            self._expect(reference.path)
        q, qd = sample.position, sample.velocity
        np.subtract(reference.position, q, self.position_error)
        np.subtract(reference.velocity, qd, self.velocity_error)
        law.fast_fraction = self._fast_fraction(law.fast_fraction, dt)
        try:
            u = law.step(q, qd, sample.amplitude, sample.rate, reference, dt)
        except Exception as error:  # a user's law may raise anything: no torque then
            self.fail(f"the control law failed: {type(error).__name__}: {error}")
            return False
        if some(reference.effort):
            u = u + reference.effort
        if not (u.dot(u) < np.inf or np.isfinite(u).all()):
            i = int(np.argmin(np.isfinite(u)))
            self.fail(f"torque of {self.model.joint_names[i]} came out as {u[i]}")
            return False
        self.saturated = self._authority.send(u, dt, min(dt, self._period))
        self._last_ns = sample.stamp_ns
        error = None if law.free else self.position_error
        verdict, why = supervisor.watch(q, qd, sample.amplitude, error, self.saturated, dt)
        refused = self._applied.judge(sample, self.controller_id, dt)
        self.torque_delay.add(sample.torque, self._count, self._period)
        if verdict == State.FAULT or refused:
            self.fail(refused or why)
            return False
        self._applied.note(self.torque)
        self.torque_delay.note(self.torque)
        self._position[:] = q
        self.enabled = True
        supervisor.follow(reference)
        if verdict is None and self._doubt:
            verdict, why = State.STOPPING, self._doubt
        if verdict == State.STOPPING and (reference.active or reference.pending):
            self.brake(why)  # from the next sample on
        return self.enabled

    def _expect(self, path):
        """Note the followed path, or None. If its torque was checked, the arm can also brake with its accelerations."""
        self._expected = path
        most = np.zeros(self.model.n_joints)
        if path is not None and np.isfinite(self.torque_allowed).all():
            margin = self.supervisor.settings["trajectory_torque_margin"]
            most = path.followed.peaks()[1] / max(margin, 1.0)
        self.supervisor.expect(most)

    def _fast_fraction(self, fraction, dt):
        """Fraction of the fast torque that is applied, which follows `enable_fast` in a ramp."""
        if fraction == self.fast_enabled:
            return fraction
        goal, step = float(self.fast_enabled), dt / FAST_RAMP
        return min(max(goal, fraction - step), fraction + step)

    def warm_up(self):
        """Run three samples and a trajectory on a second controller, so that compiled code is loaded."""
        model = self.model
        other = ArmController(model, self.law, self.supervisor.settings)
        sample = ArmSample(model.n_joints, model.n_modes)
        sample.rate = np.zeros(model.n_modes)
        still = np.zeros(model.n_joints)
        names, point = model.joint_names, (10**9, still, still, still, ())
        for k in range(3):
            sample.stamp_ns, sample.sequence = 1_000_000 * (k + 1), k
            other.step(sample)
            if k == 0:
                other.offer(validate(names, names, 0, [point]), judged=True)
        self.law.reset()

    # Stops, recovery and switches ---------------------------------------------------------------

    def brake(self, reason):
        """Bring the reference to rest smoothly, and hold it there; trajectories are given up.

        The log and the controller's state give the `reason`. Returns False, and changes nothing, if there is no torque.
        """
        if not self.enabled:
            return False
        try:
            self.reference.stop(
                self.reference.stamp_ns,
                self.supervisor.deceleration,
                self.supervisor.deceleration_given,
            )
        except FlexarmError as error:
            self.fail(f"{reason}; and no smooth stop: {error}")
            return True
        self.supervisor.stop(reason)
        return True

    def recover(self):
        """Leave a fault, and return whether there was one; torque begins where the arm is, at the next valid state."""
        self._foreign = self._repeats = 0
        return self.supervisor.recover()

    def enable_fast(self, enabled):
        """Switch the fast control on or off, in a ramp of `FAST_RAMP`."""
        self.fast_enabled = bool(enabled)

    def fail(self, reason):
        """Hard stop: no torque until `recover`; the trajectory is given up."""
        self.supervisor.fail(reason)
        self._off()

    def distrust(self, reason):
        """Give no torque, as the state can't be trusted: a fault if there was torque, else until a valid one comes."""
        if self.payload is not None:
            self.payload.discard(reason)
        self.supervisor.doubt(reason)
        self._off()

    def disable(self, reason):
        """Give no torque until a valid state comes, but no fault: for a node that ends or waits for its observer."""
        self.supervisor.wait(reason)
        self._off()

    def _off(self):
        self.enabled = self.saturated = self._waiting = False
        self._authority.off()

    # Samples -------------------------------------------------------------------------------------

    def _judge(self, sample, now_ns):
        """Class of the sample, which becomes the last one; raises an error if the sample can't be used."""
        order = self._order
        verdict = order.judge(sample)
        if verdict == SampleOrder.STALE:
            return verdict
        if verdict == SampleOrder.FOREIGN:
            self._foreign += 1
            if self._foreign > 1:  # one late message of an ended source is not a second source
                self.supervisor.fail(str(order.two_sources(sample)))
            raise order.two_sources(sample)
        since_ns = sample.stamp_ns - order.stamp_ns
        missed = max(sample.sequence - order.sequence - 1, 0)
        if verdict != SampleOrder.REPEAT:
            order.take(sample)  # even a bad one: the next one is compared with it
        if verdict == SampleOrder.RESTART:
            self._applied.forget()  # even in a fault: the driver may not have found this controller yet
        if verdict == SampleOrder.JUMP:
            raise _refused_stamp(
                -since_ns, "s before the last state, so the source's clock went back"
            )
        if now_ns is not None and self._max_age is not None:
            self._check_age(sample, now_ns)
        if verdict == SampleOrder.NEW:
            self._repeats, self._count = 0, missed + 1
            self.missed += missed
            if since_ns > self._max_gap and self.enabled:
                problem = (
                    f"s after the last state is beyond max_gap, and {missed} states are missing"
                )
                raise _refused_stamp(since_ns, problem, self._max_gap)
        sample.check(self.model)
        if not sample.velocity_known:
            hint = "have the observer fill it in"
            raise MessageError("is empty", field="joint_velocity", hint=hint)
        return verdict

    def _check_age(self, sample, now_ns):
        age = now_ns - sample.stamp_ns
        if abs(age) > self._max_age:
            when = "in the past" if age > 0 else "in the future"
            hint = "synchronise the clocks, or set synchronised_clocks to false"
            raise _refused_stamp(abs(age), f"s {when} is beyond max_age", self._max_age, hint)

    def _lacks(self, sample, verdict):
        """What is not known yet, but needed for torque; empty if everything is known."""
        if sample.amplitude is None:
            return "modal_amplitude is not known yet"
        if sample.rate is None and self.law.needs_rates:
            return "modal_rate is not known yet"
        begins = verdict == SampleOrder.RESTART or not self.supervisor.running
        if begins and _moves(sample) and self._seen_for(sample, verdict) < SEEN:
            return "how the arm moves is not known yet"
        return ""

    def _wait(self, sample, verdict, reason):
        """Give no torque, for a `reason`; the joints are known, so trajectories may be offered."""
        waiting = self._waiting and verdict != SampleOrder.RESTART
        if verdict == SampleOrder.RESTART:
            self.disable(reason)
        else:
            self.distrust(reason)
        if self.state == State.FAULT:
            return
        self._waiting = True
        if not waiting:
            self._rest_on(sample.position, sample.stamp_ns)
            self._seen = [(sample.stamp_ns, sample.position.copy())]
        elif 1e-9 * (sample.stamp_ns - self._seen[-1][0]) >= SEEN:
            self._seen = [self._seen[-1], (sample.stamp_ns, sample.position.copy())]

    def _begin(self, sample, verdict):
        """Begin with torque from the present position, in a new session or after a time without torque."""
        keeps = self._waiting and verdict != SampleOrder.RESTART and self.reference.pending
        if keeps and (given_up := self._left_behind(sample)):
            self._trajectory_reason = given_up
            keeps = False
        self._return(sample, self._seen[0] if self._waiting else None, keeps)

    def _return(self, sample, since, keeps=False):
        """Let torque return in a ramp; the reference begins where the arm is, and brakes the arm if it moves.

        `since` has the stamp [ns] and the positions (n,) [rad] of an earlier sample, for the mean speed; None: the
        mean speed is not used.
        """
        if not keeps:
            self._take_over(sample, since)
        self._waiting, self._repeats = False, 0
        self.supervisor.begin()
        self._authority.begin(sample.position, not _moves(sample))
        self._applied.begin(self.torque)
        self.torque_delay.begin()
        self.law.reset()

    def _take_over(self, sample, since):
        """Let the reference begin where the arm is, and brake the arm from its present motion."""
        position, stamp, velocity = sample.position, sample.stamp_ns, None
        if _moves(sample):
            velocity = sample.velocity if since is None else _steady_velocity(sample, *since)
        deceleration = np.minimum(GENTLE, self.supervisor.deceleration)
        self._jumped_ns = 0
        try:
            self.reference.start(position, stamp, velocity, deceleration)
        except TrajectoryError:  # it moves too fast to be braked: the supervisor's limits stop it
            self.reference.start(position, stamp)

    def _rest_on(self, position, stamp_ns):
        """Let the reference hold a position (n,) [rad] from a stamp [ns] on; it follows the source's clock again."""
        self._jumped_ns = 0
        self.reference.start(position.copy(), stamp_ns)

    def _seen_for(self, sample, verdict):
        """Time since the earliest position that is stored while the controller waits [s]."""
        waiting = self._waiting and verdict != SampleOrder.RESTART
        return 1e-9 * (sample.stamp_ns - self._seen[0][0]) if waiting else 0.0

    def _interrupted(self, sample, what, since=None):
        """Go on after the driver took its safe action, for the reason `what`; `since` is as in `_return`."""
        moved = self.reference.active or self.reference.pending
        self.interruptions += 1
        self._trajectory_reason = f"{what}: torque returns in a ramp" + (
            ", the motion was given up: send it again" if moved else ""
        )
        self._return(sample, since)

    def _after_gap(self, sample, gap, period):
        """Time that counts as passed in a gap between two stamps [s]; 0 if torque was lost.

        If the joints show that the source's clock jumped, the reference continues in its own time, and brings the arm
        to rest on its path.
        """
        by_number = period * self._count
        if not gap > PERIODS_OF_GAP * by_number > 0.0:
            self._interrupted(sample, f"no state for {gap:.3g} s", (self._last_ns, self._position))
            return 0.0
        what = f"header.stamp: {gap:.3g} s after the last state, and {self._count - 1} states are missing"
        if not clock_jumped(sample.position - self._position, sample.velocity, by_number, gap):
            self._interrupted(sample, f"{what}: the source stood still, or its clock jumped")
            return 0.0
        self._jumped_ns += round(1e9 * (gap - by_number))
        self._period = period
        self._trajectory_reason = self._doubt = f"{what}: its clock jumped, for the joints went on"
        return by_number

    def _restarted(self, sample):
        """Why a new session of the source is a fault; empty if the arm rests where it was."""
        reference, names = self.reference, self.model.joint_names
        if reference.active or reference.pending or reference.stopping:
            return "the source of the states has restarted during a motion: is its zero the same?"
        moved, speed = np.abs(sample.position - self._position), np.abs(sample.velocity)
        if moved.max() > SAME_PLACE:
            i = int(np.argmax(moved))
            return (
                f"the source of the states has restarted, and {names[i]} is at {sample.position[i]:.4g} rad,"
                f" before at {self._position[i]:.4g}: is its zero the same?"
            )
        if speed.max() > AT_REST:
            i = int(np.argmax(speed))
            return f"the source of the states has restarted while {names[i]} moves ({speed[i]:.3g} rad/s)"
        return ""

    def _may_go_on(self, sample):
        """Whether a repeated state may give torque again; distrusts one repeated too often or with another stamp."""
        if not (self.enabled or self._waiting):
            if sample.stamp_ns != self._order.stamp_ns:
                self.distrust(f"state {sample.sequence} came again with another stamp")
                return False
            return sample.clock_stopped
        self._repeats = 0 if sample.clock_stopped else self._repeats + 1
        if self._repeats > MAX_REPEATS:
            self.distrust(
                f"state {sample.sequence} was sent again {self._repeats} times: the source repeats it, and measures"
                " nothing new"
            )
        return False

    def _left_behind(self, sample):
        """Why the trajectory that was offered while waiting can't be followed from here; empty if it can."""
        if self.reference.overdue(sample.stamp_ns):
            return "the trajectory was to start before the observer had converged: send it again"
        moved = np.abs(sample.position - self.reference.position)
        if moved.max() > self._start_tolerance:
            name = self.model.joint_names[int(np.argmax(moved))]
            return f"{name} moved {moved.max():.3g} rad while the observer converged: send it again"
        return ""


def _steady_velocity(sample, stamp_ns, position):
    """Joint velocities without noise and swings, (n,) [rad/s]: no faster than the mean since an earlier sample.

    An estimated velocity may not move the arm anywhere: the observer has just begun, or does not know that the safe
    action acts. Nor does the velocity of light joints, which bent links turn to and fro.
    """
    time = 1e-9 * (sample.stamp_ns - stamp_ns)
    mean = (sample.position - position) / max(time, 1e-9)
    along = np.sign(mean) == np.sign(sample.velocity)
    found = np.where(along, np.sign(mean) * np.minimum(np.abs(mean), np.abs(sample.velocity)), 0.0)
    return found if np.abs(found).max() > 0.5 * AT_REST else np.zeros_like(found)


def _moves(sample):
    """Whether a joint is faster than at rest."""
    return bool(np.abs(sample.velocity).max() > AT_REST)


def _refused_stamp(ns, problem, limit_ns=None, hint=""):
    """The error that refuses a state because of the time [ns] from its stamp to another one."""
    value = float(f"{1e-9 * ns:.3g}")
    limit = None if limit_ns is None else float(f"{1e-9 * limit_ns:g}")
    return MessageError(problem, field="header.stamp", value=value, limit=limit, hint=hint)
