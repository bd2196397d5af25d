# SPDX-License-Identifier: Apache-2.0
"""Runs the loop without ROS, with the same objects that the nodes call, sample by sample; and the continuous loop."""

from collections import deque

import numpy as np

from flexarm_control.composite import assembly
from flexarm_control.composite.design import PARAMETERS as DESIGN_PARAMETERS
from flexarm_control.composite.design import design
from flexarm_control.loop.arm_controller import PARAMETERS as CONTROLLER_PARAMETERS
from flexarm_control.loop.arm_controller import START_TOLERANCE, ArmController
from flexarm_control.loop.samples import ArmSample
from flexarm_control.loop.supervisor import State
from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.arm.description import Arm
from flexarm_dynamics.errors import DesignError, FlexarmError, MessageError, ModelError
from flexarm_dynamics.parameters import check_all
from flexarm_sim.integrators import integrate
from flexarm_sim.simulator import PARAMETERS as SIMULATOR_PARAMETERS
from flexarm_sim.simulator import Simulator

from .metrics import Record, SimulatedRecord

#: Start of a recorded trajectory on the simulator's clock [ns]: the observer has converged by then.
TRAJECTORY_START_NS = Simulator.START_NS + 100_000_000


class ClosedLoop:
    """Simulator, observer and controller in one process, in lockstep.

    Parameters
    ----------
    arm : str or Arm
        Arm file of all three, shipped name or path; or the `Arm` that was read from one.
    slow, fast, observer : mapping
        ``{"type": …, parameters…}``.
    simulator, controller : mapping, optional
        Further parameters of the simulator and of the controller; without `feedforward` and the like in the latter, the
        design is that of the paper, unchecked.
    manifold : mapping, optional
        ``{"type": …, parameters…}``; not given: that of the paper.
    plant_arm : Arm, optional
        The simulated arm, if it does not come from a file: see `arm.scaled`.
    delay : float
        Time from a measurement until its torque begins to act [s]: whole periods and a part of one.

    Attributes
    ----------
    lost : str
        Why the last run of `follow` ended early; empty if it did not.
    unprepared : str
        Requested features that its trajectory did not get, for example preview, and why; empty: it got all.
    bag : LoopBag or None
        Bag to which every sample and its answer are written.
    designed : Default or None
        The design of the control; None: its parameters were given.
    """

    def __init__(
        self,
        arm,
        slow,
        fast,
        observer,
        simulator=None,
        controller=None,
        manifold=None,
        plant_arm=None,
        delay=0.0,
    ):
        known = arm if isinstance(arm, Arm) else arm_file.load(arm)
        sizes = {"joints": len(known.joints), "modes": len(known.known.modes)}
        settings = check_all(SIMULATOR_PARAMETERS, {"arm": known.name, **(simulator or {})}, sizes)
        settings["arm"] = known
        if plant_arm is not None:
            settings["plant_arm"] = plant_arm
        self.simulator = Simulator(settings)
        model = self.model = self.simulator.nominal
        self.observer = assembly.observer(model, observer)
        given, whole = dict(controller or {}), {p.name for p in DESIGN_PARAMETERS}
        chosen = {name: given.pop(name) for name in whole & set(given)}
        if chosen:
            chosen.setdefault("rate", 1e9 / self.simulator.period_ns)
        declared = (*CONTROLLER_PARAMETERS, START_TOLERANCE)
        limits = check_all(declared, given, sizes)

        def law_for(payload):
            settings = chosen if payload is None else {**chosen, "payload_scale": payload}
            return design(model, slow, fast, manifold, settings or None)

        self._law_for, law = law_for, law_for(None)
        self.controller = ArmController(model, law, limits, limits.pop("start_tolerance"))
        n, m, g = model.n_joints, model.n_modes, len(model.arm.gauges)
        self._measured, self._estimate = ArmSample(n, m, g), ArmSample(n, m)
        self._publish_rates = settings["publish_rates"]
        self._publish_velocity = settings["publish_joint_velocity"]
        self._publish_amplitude = settings["publish_modal_amplitude"]
        self._set_delay(delay)
        self._reach = model.arm.reach
        self.lost = self.unprepared = ""
        self.bag = self.designed = None

    @property
    def source(self):
        """Whether joint speeds, and rates of the deflections, are measured."""
        return self._publish_velocity, self._publish_rates

    @property
    def estimated(self):
        """The last sample that the observer passed on."""
        return self._estimate

    def _set_delay(self, delay):
        if not 0.0 <= delay <= self.MAX_DELAY:
            limit = f"from 0 to {self.MAX_DELAY:g} s"
            raise FlexarmError("s is no usable delay", field="delay", value=delay, limit=limit)
        whole, rest = divmod(round(delay * 1e9), self.simulator.period_ns)
        self._share = rest / self.simulator.period_ns
        # Torques on their way, the oldest first; until the first arrives, safe actions.
        self._on_the_way = deque([None] * (whole + 1))

    def measure(self):
        """The present sample in the form of `arm_state`."""
        s, sim = self._measured, self.simulator
        s.stamp_ns, s.session, s.sequence = sim.stamp_ns, 1, sim.sequence
        s.position[:] = sim.position
        s.velocity_known = self._publish_velocity
        s.velocity[:] = sim.velocity
        s.torque[:] = sim.torque
        has_gauges = sim.strain_map is not None
        s.strain = sim.strain if has_gauges else None
        s.amplitude = sim.amplitude if has_gauges and self._publish_amplitude else None
        s.rate = sim.rate if self._publish_rates else None
        s.trust, s.doubt = s.TRUSTED, ""
        if self.bag is not None:
            self.bag.measured(s)
        return s

    def estimate(self, measured):
        """The sample in the form of `arm_state_estimate`; rates are None until the observer has converged."""
        e, observer = self._estimate, self.observer
        converged = observer.step(measured)
        e.stamp_ns, e.session, e.sequence = measured.stamp_ns, measured.session, measured.sequence
        e.position[:] = observer.position
        e.velocity[:], e.torque[:] = observer.velocity, measured.torque
        e.amplitude = observer.amplitude
        e.rate = observer.rate if converged else None
        e.controller_id, e.trust, e.doubt = measured.controller_id, measured.trust, measured.doubt
        e.clock_stopped = measured.clock_stopped
        return e

    #: Max. time in which the observer must converge [s].
    MAX_START = 10.0
    #: A longer delay is refused as a mistake [s].
    MAX_DELAY = 1.0
    #: The loop counts as lost when a joint is farther than this from its reference [rad].
    MAX_ERROR = 2.0 * np.pi

    def step(self):
        """One sample: measure, estimate, control, and advance the plant; returns the sent torque or None."""
        torque = self.controller.torque if self._answer() else None
        self._advance(torque)
        return torque

    def recorded_step(self):
        """As `step`; returns the sample's stamp [ns] and a row for `record_of`.

        Raises
        ------
        ModelError
            If the plant leaves the range of its model.
        """
        enabled = self._answer()
        stamp, row = self.simulator.stamp_ns, self._row()
        self._advance(self.controller.torque if enabled else None)
        return stamp, row

    def record_of(self, steps):
        """A `SimulatedRecord` of results of `recorded_step`; its time begins with the first."""
        stamps, rows = zip(*steps, strict=True)
        time = 1e-9 * (np.array(stamps) - stamps[0])
        return self._record(np.column_stack([time, rows]))

    def _answer(self):
        """Measure, estimate, control; return whether torque is enabled. A repeated sample gets the same answer."""
        return self._answer_to(self.measure())

    def _answer_to(self, measured):
        """Estimate and control; as `_answer`."""
        try:
            enabled = self.controller.step(self.estimate(measured))
        except MessageError as error:
            self.controller.distrust(str(error))
            enabled = False
        self._learn()
        if self.bag is not None:
            self.bag.answered(measured, enabled)
        return enabled

    def _learn(self):
        """Do what the controller node does when the torque is sent."""
        controller = self.controller
        controller.learn()
        if (payload := controller.payload_wanted) is not None:
            try:
                controller.carry(self._law_for(payload))
            except DesignError as error:
                controller.payload.discard(str(error))

    def _advance(self, torque):
        """Advance the plant by one period under the torques that have arrived by then."""
        way = self._on_the_way
        way.append(None if torque is None else torque.copy())
        before = way.popleft()
        self.simulator.advance(way[0], before, self._share)

    def run(self, trajectory, duration):
        """Offer a trajectory, its stamp on the simulator's clock, and record `duration` seconds from its start.

        Raises
        ------
        MessageError
            If the trajectory is refused, or not followed to its end.
        ModelError
            If the plant leaves the range of its model.
        """
        record = self.follow(trajectory, duration)
        if isinstance(self._failure, ModelError):
            raise self._failure
        if self.lost:
            raise MessageError(f"the trajectory was not followed: {self.lost}")
        return record

    def follow(self, trajectory, duration):
        """As `run`, but a loop that loses the arm is a result, too: the record ends there, and `lost` has the reason.

        Raises
        ------
        MessageError
            If the trajectory is refused or does not start.
        """
        self.lost, self._failure = "", None
        self._answer()
        verdict = self.controller.offer(trajectory, self.prepared(trajectory))
        if not verdict.accepted:
            raise MessageError(f"trajectory refused: {verdict.reason}")
        simulator, length = self.simulator, round(duration * 1e9)
        begin, start, stamps, rows = simulator.time, trajectory.stamp_ns or None, [], []
        while start is None or simulator.stamp_ns <= start + length:
            if start is None and simulator.time > begin + self.MAX_START:
                raise MessageError(f"the trajectory does not start: {self.controller.reason}")
            enabled = self._answer()
            stamps.append(simulator.stamp_ns)
            rows.append(self._row())
            reference = self.controller.reference
            if start is None and (reference.active or reference.finished):
                start = stamps[-1]  # "now": with the first torque
            if start is not None and stamps[-1] >= start:
                self.lost = self._why_lost()
            if self.lost or not self._moved(enabled):
                break
        time = 1e-9 * (np.array(stamps) - (stamps[0] if start is None else start))
        return self._record(np.column_stack([time, rows]))

    def prepared(self, trajectory):
        """What the feed-forward prepares for the trajectory before it is offered; None if it can't."""
        controller = self.controller
        self.unprepared = ""
        if controller.plans:
            try:
                plan = controller.prepare(trajectory)
                self.unprepared = getattr(plan, "note", "")
                return plan
            except FlexarmError as error:
                self.unprepared = str(error)
        return None

    def _moved(self, enabled):
        """Advance the plant; False if it left the range of its model."""
        try:
            self._advance(self.controller.torque if enabled else None)
        except ModelError as error:
            self._failure, self.lost = error, str(error)
        return self._failure is None

    def _why_lost(self):
        """Why the arm no longer follows the trajectory; empty if it does."""
        controller, plant = self.controller, self.simulator.plant
        reference = controller.reference
        if controller.state in (State.INACTIVE, State.FAULT) or not (
            reference.active or reference.finished or reference.stopping
        ):
            return controller.reason or f"supervisor in state {controller.state.name}"
        if np.abs(plant.delta).max(initial=0.0) > self._reach:
            return f"{self.model.arm.name} is bent by more than it is long"
        error = np.abs(plant.q - reference.position)
        if error.max() > self.MAX_ERROR:
            i = int(np.argmax(error))
            return f"{self.model.joint_names[i]} is {error[i]:.3g} rad off its reference"
        return ""

    def _row(self):
        """The row of a `SimulatedRecord` for the sample that was just answered, without the time."""
        controller, law = self.controller, self.controller.law
        estimate, plant = self._estimate, self.simulator.plant
        rate = np.full(self.model.n_modes, np.nan) if estimate.rate is None else estimate.rate
        return np.concatenate(
            [
                controller.reference.position,
                controller.reference.velocity,
                self._measured.position,
                estimate.velocity,
                estimate.amplitude,
                rate,
                law.quasi_steady,
                law.slow_torque,
                law.fast_torque,
                controller.torque,
                plant.q,
                plant.delta,
                (controller.saturated, controller.state),
            ]
        )

    def _record(self, rows):
        """A record from rows of time and results of `_row`."""
        n, m = self.model.n_joints, self.model.n_modes
        widths = [1, n, n, n, n, m, m, m, n, n, n, n, self.simulator.plant.delta.size, 1, 1]
        time, *vectors, saturated, state = np.split(rows, np.cumsum(widths)[:-1], axis=1)
        return SimulatedRecord(time[:, 0], *vectors, saturated[:, 0] > 0.0, state[:, 0].astype(int))


class _ProfileReference:
    """A one-joint motion profile as the reference of a slow law."""

    def __init__(self, profile):
        self._profile = profile

    def at(self, t):
        """Set position, velocity and acceleration to those of time t; held after the end."""
        p = self._profile
        t = self._t = min(max(t, 0.0), p.duration)
        self.position = np.atleast_1d(p.position(t))
        self.velocity = np.atleast_1d(p.velocity(t))
        self.acceleration = np.atleast_1d(p.acceleration(t))
        return self

    def near(self, offset):
        """State (3, n) at an offset [s] from the time of `at`: the motion's formula, continued beyond its ends."""
        p, out = self._profile, np.zeros((3, self.position.size))
        if self._t >= p.duration:
            out[0] = self.position
            return out
        s = np.asarray((self._t + offset) / p.duration)
        for order in range(3):
            out[order] = p.shape[order](s) * p.angle / p.duration**order
        out[0] += p.start
        return out


def continuous_loop(model, law, profile, times):
    """The composite loop in continuous time with full state, integrated with error control, as in the paper.

    Parameters
    ----------
    model : ArmModel
        Both the plant and the controller's model.
    law : CompositeControl
    profile : Profile
    times : ndarray, shape (k,)
        Times of the record's samples, from 0 [s].
    """
    n, m = model.n_joints, model.n_modes
    reference = _ProfileReference(profile)

    def torque(t, state):
        q, delta, qd, delta_d = np.split(state, [n, n + m, 2 * n + m])
        return law.step(q, qd, delta, delta_d, reference.at(t))

    # The profile's jerk jumps at its end: integrate the two smooth pieces separately.
    end = profile.duration
    moving = np.union1d(times[times < end], end)
    resting = np.union1d(times[times > end], end)
    # Seven digits of every metric, at half the time of the default.
    tolerance = {"rtol": 1e-8, "atol": 1e-10}
    states = integrate(model, np.zeros(2 * (n + m)), torque, moving, **tolerance)
    rest = integrate(model, states[-1], torque, resting, **tolerance)
    states = np.vstack([states, rest[1:]])
    states = states[np.searchsorted(np.union1d(moving, resting), times)]
    rows = []
    for t, s in zip(times, states, strict=True):
        u = torque(t, s)
        q, delta, qd, delta_d = np.split(s, [n, n + m, 2 * n + m])
        control = [
            law.quasi_steady.copy(),
            law.slow_torque.copy(),
            law.fast_torque.copy(),
            u.copy(),
        ]
        rows.append([t, reference.position, reference.velocity, q, qd, delta, delta_d, *control])
    return Record(*map(np.array, zip(*rows, strict=True)))
