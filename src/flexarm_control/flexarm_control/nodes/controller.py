# SPDX-License-Identifier: Apache-2.0
"""Controller node: `arm_state_estimate` and `joint_trajectory` in, `joint_torque` and `controller/state` out."""

import os
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from time import perf_counter

from rclpy.duration import Duration
from rclpy.parameter import Parameter as RosParameter
from rclpy.serialization import deserialize_message
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import JointTrajectory

from flexarm_dynamics import registry
from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.errors import FlexarmError, MessageError, TrajectoryError
from flexarm_dynamics.models import model
from flexarm_dynamics.parameters import parameter, sizes
from flexarm_msgs.msg import ArmState, CompositeState, JointTorque
from flexarm_ros import qos, scheduling
from flexarm_ros.messages import (
    CompositeStateWriter,
    StateReader,
    TorqueWriter,
    stamp_ns,
    trajectory_points,
)
from flexarm_ros.node import ARM, ERROR, OK, WARN, ArmNode, run
from flexarm_ros.parameters import merge
from flexarm_ros.start import leave
from flexarm_ros.statistics import Latency

from .. import trajectory
from ..composite import design as composite
from ..composite.design import FAST, MANIFOLD, PREFIX, SLOW
from ..composite.design_process import AwayError, DesignProcess
from ..loop import arm_controller
from ..loop.arm_controller import ArmController
from ..loop.samples import ArmSample
from ..loop.supervisor import State

SLOW_TYPE = parameter("type", "linear_model_following").described(
    "Slow law, by its name in the entry-point group flexarm.slow_laws; none: fast control alone."
)
FAST_TYPE = parameter("type", "lqr").described(
    "Fast law, by its name in the entry-point group flexarm.fast_laws; none: slow control alone."
)
MANIFOLD_TYPE = parameter("type", "corrected").described(
    "Slow manifold that the fast control holds the deflections to, by its name in the entry-point group"
    " flexarm.manifolds; quasi_steady: the paper's."
)
STATE_TIMEOUT = parameter("state_timeout", 0.5, "s", 0.01, 3600.0, read_only=True).described(
    "Without a state for so long the torque is disabled: a fault."
)
DESIGN_PROCESS = parameter("design_process", True, read_only=True).described(
    "Whether laws are designed anew, and motions planned, in a process of their own, which takes memory, rather than"
    " in a thread, which may hold up a sample for some milliseconds."
)

#: Longer trajectories are refused: their points are read in one go.
MOST_POINTS = 10_000
#: How long the last torque, DISABLED, is waited for to arrive.
LAST_WORD = Duration(seconds=0.2)


def parameter_groups():
    """Declared parameters of this node, by prefix."""

    def laws(group):
        return merge(*(law.PARAMETERS for law in registry.importable(group).values()))

    common = (
        *arm_controller.PARAMETERS,
        arm_controller.START_TOLERANCE,
        STATE_TIMEOUT,
        DESIGN_PROCESS,
    )
    kinds = {SLOW: SLOW_TYPE, FAST: FAST_TYPE, MANIFOLD: MANIFOLD_TYPE}
    return {
        "": (ARM, *common, *composite.PARAMETERS),
        **{
            PREFIX[group]: (replace(kind, choices=registry.names(group)), *laws(group))
            for group, kind in kinds.items()
        },
    }


class ControllerNode(ArmNode):
    """Messages to arrays, one call of `ArmController`, arrays to messages."""

    def __init__(self):
        super().__init__("controller", parameter_groups())
        # Redesign (Riccati) happens here, off the control path; one at a time, in order. The interpreter's lock
        # goes back to the control path within this time, where 5 ms are usual.
        sys.setswitchinterval(1e-4)
        self._designer = ThreadPoolExecutor(max_workers=1, thread_name_prefix="design")
        self._design_process, self._ending = None, False
        self._receiver = ThreadPoolExecutor(max_workers=1, thread_name_prefix="trajectory")

    def build(self):
        parameters = self.parameters
        self.arm = arm_file.load(parameters["arm"])
        self.model = model.build(self.arm)
        parameters.resolve(sizes(self.model))
        self._design_process = None
        if parameters["design_process"]:
            self._design_process = DesignProcess(self.model, cpus=scheduling.spare())
        self._good = self._law_parameters()
        law = self._design(self.model, self._good)
        settings = parameters.group("", {p.name for p in arm_controller.PARAMETERS})
        self.core = ArmController(self.model, law, settings, parameters["start_tolerance"])
        self.core.rehearse()
        self._limits_in_force = settings
        parameters.on_change(self._changed)
        arm = self.arm
        self._reader = StateReader(arm)
        self._sample = ArmSample(len(arm.joints), len(arm.modes))
        # Drawn afresh at each start: two controllers on one arm are told apart by it.
        self._torque = TorqueWriter(arm, int.from_bytes(os.urandom(4), "little"))
        self._state = CompositeStateWriter(self.model)
        self._limits = self._trajectory_limits()
        self._samples, self._samples_before = 0, 0
        self._saturations, self._saturations_before = 0, 0
        self._latency = Latency()
        self._synchronised = parameters["synchronised_clocks"]
        self._told = self.core.state
        self._ticks, self._seen = 0, False
        self._make_topics()

    def _make_topics(self):
        options = qos.overridable()
        self._torque_pub = self.make_publisher(
            JointTorque, "joint_torque", qos.LINE, qos_overriding_options=options
        )
        self._state_pub = self.make_publisher(
            CompositeState, "controller/state", qos.LINE, qos_overriding_options=options
        )
        self.make_line(
            self.make_subscription(
                ArmState,
                "arm_state_estimate",
                self._on_state,
                qos.LINE,
                qos_overriding_options=options,
            )
        )
        self.make_subscription(
            JointTrajectory,
            "joint_trajectory",
            self._on_trajectory,
            qos.COMMAND,
            qos_overriding_options=options,
            raw=True,
        )
        self.make_service(Trigger, "~/stop", self._on_stop)
        self.make_service(Trigger, "~/recover", self._on_recover)
        self.make_service(SetBool, "~/enable_fast", self._on_enable_fast)
        self._tick = self.parameters["state_timeout"] / 5.0
        self.make_timer(self._tick, self._watch)

    def _trajectory_limits(self):
        joints = self.arm.joints
        low, high = zip(*(j.limits.position for j in joints), strict=True)
        return list(low), list(high), [j.limits.velocity for j in joints]

    # Control path ----------------------------------------------------------------------------

    def _on_state(self, msg):
        if not self.active:
            return
        started = perf_counter()
        sample, core = self._sample, self.core
        try:
            self._reader.read(msg, sample)
            now = self.get_clock().now().nanoseconds if self._synchronised else None
            enabled = core.step(sample, now)
        except MessageError as error:
            core.distrust(str(error))
            enabled = False
        if enabled is None:
            return
        self._ticks, self._seen = 0, True
        self._torque_pub.publish(self._torque.answer(sample, enabled, core.torque))
        took = perf_counter() - started
        self._latency.add(took)
        self._samples += 1
        self._saturations += core.saturated
        if self._state_pub.get_subscription_count():
            self._state_pub.publish(self._state.fill(sample, core, took))
        if core.state != self._told:
            self._tell()
        if enabled:
            core.answered_by.look_ahead()

    def _tell(self):
        """Log what the supervisor has come to, where a user is to know it."""
        state, was, reason = self.core.state, self._told, self.core.supervisor.reason
        self._told = state
        log = self.get_logger()
        if state == State.FAULT:
            log.error(f"fault, torque disabled until ~/recover is called: {reason}")
        elif state == State.INACTIVE and was != State.FAULT:
            log.error(f"torque disabled: {reason}")
        elif state == State.STOPPING:
            log.warning(f"stopping: {reason}")

    def _watch(self):
        """Steady clock: the states have stopped."""
        self._ticks += 1
        if self._ticks < 6 or not self._seen or not self.active:
            return
        self._seen = False
        timeout = self.parameters["state_timeout"]
        self.core.distrust(
            f"no arm_state_estimate for {timeout:g} s: are the driver (or simulator) and the observer"
            " running?"
        )
        self._answer_again()

    def _answer_again(self):
        """What has changed between two states: torque and controller/state, as answers to the last one."""
        sample, core = self._sample, self.core
        self._torque_pub.publish(self._torque.answer(sample, core.enabled, core.torque))
        self._state_pub.publish(self._state.fill(sample, core, 0.0))
        self._tell()

    # Services --------------------------------------------------------------------------------

    def _on_stop(self, request, response):
        core = self.core
        response.success = True
        if core.brake("~/stop was called"):
            response.message = f"{core.state.name}: the arm is brought to rest and held"
        else:
            response.message = f"{core.state.name}: there is no torque, the safe action acts"
        return response

    def _on_recover(self, request, response):
        was = self.core.supervisor.reason
        response.success = self.core.recover()
        if response.success:
            response.message = f"left the fault ({was}): torque with the next valid state"
            self.get_logger().info(response.message)
            self._answer_again()
        else:
            response.message = f"not in fault: {self.core.state.name}"
        return response

    def _on_enable_fast(self, request, response):
        self.core.enable_fast(request.data)
        response.success = True
        response.message = f"fast control {'on' if request.data else 'off: the arm rings'}"
        self.get_logger().info(response.message)
        return response

    # Trajectories ----------------------------------------------------------------------------

    def _on_trajectory(self, raw):
        """A serialised message: to turn thousands of points into objects is no work for the control path."""
        if self.active:
            self._receiver.submit(self._receive, raw, self.core.law)

    def _receive(self, raw, law):
        """In a thread of its own: the trajectory, and what the feed-forward wants to know before it is offered."""
        try:
            data = self._read_trajectory(raw)
        except TrajectoryError as error:
            self.hand_over(self._refuse, str(error))
            return
        except Exception as error:  # anybody's bytes
            self.hand_over(self._refuse, f"no JointTrajectory: {type(error).__name__}: {error}")
            return
        plan = None
        try:
            if self.core.plans:
                plan = self.core.prepare(data, law, self._prepare)
        except Exception as error:
            if self._ending:
                return
            what = "" if isinstance(error, FlexarmError) else f"{type(error).__name__}: "
            self.get_logger().warning(f"trajectory without preview: {what}{error}")
        self.hand_over(self._offer, data, plan)

    def _read_trajectory(self, raw):
        count = trajectory_points(raw)
        if count > MOST_POINTS:
            raise TrajectoryError(
                f"{count} points, at most {MOST_POINTS} are taken: send fewer, a quintic polynomial joins them, or"
                " one trajectory after another"
            )
        msg = deserialize_message(raw, JointTrajectory)
        low, high, velocity = self._limits
        points = [
            (stamp_ns(p.time_from_start), p.positions, p.velocities, p.accelerations, p.effort)
            for p in msg.points
        ]
        return trajectory.validate(
            msg.joint_names,
            self.arm.joint_names,
            stamp_ns(msg.header.stamp),
            points,
            position_low=low,
            position_high=high,
            velocity_max=velocity,
        )

    def _refuse(self, reason):
        self.core.refuse(reason)
        self.get_logger().warning(f"trajectory refused: {reason}")

    def _offer(self, data, plan=None):
        verdict = self.core.offer(data, plan)
        if verdict.accepted:
            self.get_logger().info(f"trajectory {verdict.trajectory_id} accepted: {verdict.reason}")
        elif not verdict.repeat:
            self.get_logger().warning(f"trajectory refused: {verdict.reason}")

    # Design ----------------------------------------------------------------------------------

    def _law_parameters(self):
        """Parameters of the whole design: by prefix, the top level's under an empty one."""
        top = self.parameters.group("", {p.name for p in composite.PARAMETERS})
        return {"": top} | {prefix: self.parameters.group(prefix) for prefix in PREFIX.values()}

    def _design(self, arm_model, values):
        """The control that parameters describe, each law with those that it declares."""
        made = composite.design(arm_model, *self._chosen(values))
        self._warn(made)
        return made

    def _chosen(self, values):
        """What `composite.design` wants to know."""
        chosen = []
        for group in (SLOW, FAST, MANIFOLD):
            given = values[PREFIX[group]]
            law = registry.find(group, given["type"])
            declared = {"type", *(p.name for p in law.PARAMETERS)}
            chosen.append({k: v for k, v in given.items() if k in declared})
        return *chosen, values[""]

    def _warn(self, made):
        for part in (made.slow, made.fast, made.feedforward):
            for warning in part.warnings() if part is not None else ():
                self.get_logger().warning(warning)

    def _changed(self, names):
        if names & {p.name for p in arm_controller.PARAMETERS}:
            self._take_limits()
        whole = {p.name for p in composite.PARAMETERS}
        if any(n in whole or n.startswith(tuple(PREFIX.values())) for n in names):
            self._designer.submit(self._redesign, self._law_parameters())

    def _take_limits(self):
        """Limits are in force from the next sample on, or go back to what they were."""
        settings = self.parameters.group("", {p.name for p in arm_controller.PARAMETERS})
        try:
            self.core.configure(settings)
        except FlexarmError as error:
            self.get_logger().error(f"limits refused, the old ones stay: {error}")
            self._put_back({"": settings}, {"": self._limits_in_force})
            return
        self._limits_in_force = settings

    def _put_back(self, values, good):
        """Set what differs back to what is in force."""
        old = [
            RosParameter(prefix + name, value=value)
            for prefix, group in good.items()
            for name, value in group.items()
            if values[prefix][name] != value
        ]
        self.hand_over(self.set_parameters_atomically, old)

    def _redesign(self, values):
        """In the design thread: a new law swaps whole, or the parameters go back to what they were."""
        try:
            law = self._designed_anew(values)
            self.hand_over(self._swap, law)
            self._good = values
        except Exception as error:
            if self._ending:
                return
            # A law may be anybody's, and this thread would drop its error without a word.
            what = "" if isinstance(error, FlexarmError) else f"{type(error).__name__}: "
            self.get_logger().error(f"design refused, the old law goes on: {what}{error}")
            self._put_back(values, self._good)

    def _designed_anew(self, values):
        chosen = self._chosen(values)
        law = self._elsewhere(
            lambda process: process.design(*chosen),
            # A model of its own: the loop goes on with the old one meanwhile.
            lambda: composite.design(model.build(self.arm), *chosen),
        )
        self._warn(law)
        return law

    def _prepare(self, feedforward, trajectory, start):
        return self._elsewhere(
            lambda process: process.prepare(feedforward, trajectory, start),
            lambda: feedforward.prepare(trajectory, start),
        )

    def _elsewhere(self, away, here):
        """What is made in the process for designs, or in this thread where that can't be."""
        if self._design_process is not None:
            try:
                return away(self._design_process)
            except AwayError as error:
                if self._ending:
                    raise
                self.get_logger().warning(f"{error}; it is made in a thread of the controller")
        return here()

    def _warm_up(self):
        try:
            self._design_process.begin()
        except AwayError as error:
            if not self._ending:
                self.get_logger().warning(str(error))

    def _swap(self, law):
        """Between two samples: the new law goes on from where the old one is."""
        law.resume(self.core.law)
        self.core.law = law

    # Life cycle ------------------------------------------------------------------------------

    def start(self):
        if self.core.plans and self._design_process is not None:
            self._receiver.submit(self._warm_up)  # or the first motion would wait for it
        slow, fast = self.parameters["slow.type"], self.parameters["fast.type"]
        self.get_logger().info(
            f"arm {self.arm.name}, slow {slow}, fast {fast}: torque with the first valid state"
        )

    def stop(self):
        self.core.disable("the controller was stopped")
        self._torque_pub.publish(self._torque.answer(self._sample, False, self.core.torque))
        # A node that ends takes with it what has not been read yet.
        self._torque_pub.wait_for_all_acked(LAST_WORD)

    def destroy_node(self):
        """End the threads and the process of the designs, then the node."""
        self._ending = True
        for worker in (self._designer, self._receiver):
            worker.shutdown(wait=False, cancel_futures=True)
        if self._design_process is not None:
            self._design_process.close()
        super().destroy_node()

    def diagnose(self):
        rate, self._samples_before = self._samples - self._samples_before, self._samples
        saturated = self._saturations - self._saturations_before
        self._saturations_before = self._saturations
        core = self.core
        values = {
            "state": core.state.name,
            "slow law": self.parameters["slow.type"],
            "fast law": self.parameters["fast.type"],
            "slow manifold": self.parameters["manifold.type"],
            "feed-forward": self.parameters["feedforward"],
            "samples per second": rate,
            **self._latency.values(),
            "states lost": core.missed,
            "states too late": core.late,
            "stops": core.supervisor.stops,
            "faults": core.supervisor.faults,
            "fast control": "on" if core.fast_enabled else "off",
            "saturated samples": self._saturations,
            "trajectory": core.trajectory_id,
        }
        if not self.active:
            return OK, "not active", values
        if core.state == State.FAULT:
            return ERROR, f"{core.supervisor.reason}: mend it, then call ~/recover", values
        if core.state == State.INACTIVE:
            return ERROR, core.reason or "no arm_state_estimate yet: start the observer", values
        if saturated:
            return WARN, f"torque at its limit in {saturated} of {rate} samples", values
        if core.reason:
            return WARN, core.reason, values
        if not core.fast_enabled:
            return WARN, "the fast control is off: call ~/enable_fast with data true", values
        return OK, "", values


def main(args=None):
    """Entry point of ``ros2 run flexarm_control controller``."""
    leave(run(ControllerNode, args))


if __name__ == "__main__":
    main()
