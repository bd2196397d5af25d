# SPDX-License-Identifier: Apache-2.0
"""Action servers of the controller: trajectories as goals, with feedback, tolerances, cancelling and results.

This is a separate node, and so a separate process: rclpy turns a goal of thousands of points into objects in one go,
which would delay the control path. It publishes a goal on `joint_trajectory`, and follows it on `controller/state`.
"""

import importlib
import time

import numpy as np
from builtin_interfaces.msg import Duration
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.errors import TrajectoryError
from flexarm_dynamics.models import model
from flexarm_dynamics.parameters import parameter
from flexarm_msgs.action import FollowJointTrajectory
from flexarm_msgs.msg import ArmState, CompositeState
from flexarm_ros import qos
from flexarm_ros.messages import stamp_ns
from flexarm_ros.node import ARM, OK, WARN, ArmNode, run
from flexarm_ros.session import Latest
from flexarm_ros.start import leave

from ..loop.supervisor import longest_period
from ..trajectory import goal

PARAMETERS = (
    *goal.PARAMETERS,
    parameter("action_monitor_rate", 20.0, "Hz", 0.1, 1000.0, read_only=True).described(
        "Rate of a goal's feedback (wall time)."
    ),
    parameter("state_timeout", 1.0, "s", 0.05, 3600.0, read_only=True).described(
        "A goal is aborted if controller/state does not arrive for this long, or if nothing answers the goal within"
        " five times as long. A controller that sends its state has sixty times as long to judge a trajectory."
    ),
)
#: Time between two checks of the goals; time after which a trajectory without an answer is sent again (wall time) [s].
LOOK, AGAIN = 0.01, 1.0
#: A goal waits for its answer this many times as long as `state_timeout`: if the controller is silent, and if it sends
#: its state. In the latter case it may be judging the trajectory's torque, in a process that has just been started.
PATIENCE, JUDGING = 5.0, 60.0
#: Beginnings of refusals that have their own error code.
REFUSALS = {
    "joint_names": goal.Code.INVALID_JOINTS,
    "header.stamp": goal.Code.OLD_HEADER_TIMESTAMP,
}
RUNNING = (CompositeState.READY, CompositeState.TRACKING, CompositeState.HOLDING)


class Server(ActionServer):
    """An action server whose goals run on after their callback has returned.

    Parameters
    ----------
    node : Node
    kind : type
        Type of the action.
    name : str
    owner : object
        Has `may_begin`, `may_cancel` and `take`.
    """

    def __init__(self, node, kind, name, owner):
        self._taken = owner.take
        super().__init__(
            node, kind, name, None, goal_callback=owner.may_begin, cancel_callback=owner.may_cancel
        )

    def register_execute_callback(self, execute_callback):
        """Do nothing, since `notify_execute` takes the goal."""

    def notify_execute(self, goal_handle, execute_callback):
        """Take an accepted goal."""
        self._taken(self, goal_handle)

    def finish(self, goal_handle, end):
        """Have ``end(goal_handle)`` set the state, and send the result that it returns."""
        super().notify_execute(goal_handle, end)


class Goal:
    """A goal under way: offered to the controller, then followed until an `Outcome`.

    Parameters
    ----------
    server : Server
    handle : ServerGoalHandle
    tolerances : Tolerances
    message : JointTrajectory
        Trajectory to offer; its frame_id is the name of the goal.
    """

    def __init__(self, server, handle, tolerances, message):
        self.server, self.handle = server, handle
        self.tolerances, self.message = tolerances, message
        self.name = message.header.frame_id
        self.check = self.trajectory_id = self.stopping = None
        self.stopped = False
        self.began = self.asked = time.monotonic()


class GoalsNode(ArmNode):
    """Offers goals to the controller, follows them, and sends their results."""

    def __init__(self):
        super().__init__("goals", {"": (ARM, *PARAMETERS)})

    def build(self):
        parameters = self.parameters
        self.arm = arm_file.load(parameters["arm"])
        parameters.resolve({"joints": len(self.arm.joints)})
        self.model = model.build(self.arm.known)
        self._period = longest_period(self.model)
        self._goals, self._done, self._last = [], 0, ""
        self._state = self._estimate = None
        self._came = self._fed = 0.0
        self._states = Latest(self.make_subscription, CompositeState, "controller/state")
        self._estimates = Latest(self.make_subscription, ArmState, "arm_state_estimate")
        self._trajectories = self.make_publisher(
            JointTrajectory,
            "joint_trajectory",
            qos.COMMAND,
            qos_overriding_options=qos.overridable(),
        )
        self._stop = self._keep(self.destroy_client, self.create_client(Trigger, "controller/stop"))
        for kind, name in kinds():
            self._keep(
                lambda server: server.destroy(), Server(self, kind, f"controller/{name}", self)
            )
        self.make_timer(LOOK, self._look)

    def stop(self):
        for each in list(self._goals):
            self._end(each, goal.Outcome(goal.Code.INVALID_GOAL, "the action server was stopped"))

    # Goals in ----------------------------------------------------------------------------------

    def may_begin(self, request):
        """Accept any goal while active; its result states what is wrong with it."""
        return GoalResponse.ACCEPT if self.active else GoalResponse.REJECT

    def may_cancel(self, handle):
        """Accept if the goal is under way; it is cancelled once the arm has stopped."""
        known = any(each.handle == handle for each in self._goals)
        return CancelResponse.ACCEPT if known else CancelResponse.REJECT

    def take(self, server, handle):
        """Offer an accepted goal to the controller."""
        request = handle.request
        message = request.trajectory
        message.header.frame_id = f"goal {bytes(handle.goal_id.uuid).hex()}"
        try:
            refuse_what_is_not_served(request)
            tolerances = self._tolerances(request)
        except TrajectoryError as error:
            code = goal.Code.INVALID_JOINTS if "name" in error.field else goal.Code.INVALID_GOAL
            self._end(Goal(server, handle, None, message), goal.Outcome(code, str(error)))
            return
        self._goals.append(Goal(server, handle, tolerances, message))
        self._trajectories.publish(message)

    def _tolerances(self, request):
        names = [joint.name for joint in self.arm.joints]
        rows = (
            [(t.name, t.position, t.velocity) for t in own]
            for own in (request.path_tolerance, request.goal_tolerance)
        )
        wait = request.goal_time_tolerance
        return goal.tolerances(
            names,
            self.arm.reach,
            self.parameters.values(),
            *rows,
            wait.sec + 1e-9 * wait.nanosec,
            getattr(request, "tip_tolerance", 0.0),
        )

    # On the way --------------------------------------------------------------------------------

    def _look(self):
        state, estimate, now = self._states.take(), self._estimates.take(), time.monotonic()
        self._estimate = estimate or self._estimate
        if state is not None:
            self._state, self._came = state, now
        if not self._goals:
            return
        # New goals first: when the controller accepts one, the goal before it ends.
        for each in sorted(self._goals, key=lambda one: one.check is not None):
            if each in self._goals and (outcome := self._judge(each, state, estimate, now)):
                self._end(each, outcome)
        if now - self._fed >= 1.0 / self.parameters["action_monitor_rate"]:
            self._fed = now
            for each in self._goals:
                if each.check is not None:
                    each.handle.publish_feedback(self._feedback(each.server.action_type))

    def _judge(self, each, state, estimate, now):
        """The `Outcome` of a goal at this check; None while it is under way."""
        timeout = self.parameters["state_timeout"]
        if each.check is None:
            silent = now - max(self._came, each.began) > timeout
            return self._offered(each, state, now, (PATIENCE if silent else JUDGING) * timeout)
        if state is None:
            if now - self._came <= timeout:
                return None
            text = f"no controller/state for {timeout:g} s: is the controller running?"
            return goal.Outcome(goal.Code.PATH_TOLERANCE_VIOLATED, text)
        if each.handle.is_cancel_requested:
            return self._cancelled(each, state)
        if state.accepted_trajectory_id != each.trajectory_id:
            text = "replaced by a newer trajectory"
            return goal.Outcome(goal.Code.INVALID_GOAL, text)
        if state.supervisor_state not in RUNNING:
            text = state.rejected_reason or "the arm was stopped"
            return goal.Outcome(goal.Code.PATH_TOLERANCE_VIOLATED, text)
        if state.supervisor_state == CompositeState.TRACKING:
            outcome = each.check.on_the_way(state.position_error, state.velocity_error)
            if outcome is not None:
                self._stop.call_async(Trigger.Request())
            return outcome
        if state.supervisor_state != CompositeState.HOLDING or estimate is None:
            return None
        amplitude = estimate.modal_amplitude if self.model.n_modes else ()
        if len(amplitude) != self.model.n_modes:
            return None
        tip = self.model.tip_position(_array(estimate.joint_position), _array(amplitude))
        stamp = stamp_ns(estimate.header.stamp)
        return each.check.at_the_end(
            stamp, _array(state.position_error), _array(state.velocity_error), tip
        )

    def _offered(self, each, state, now, patience):
        """Check whether the controller has answered an offered goal; the `Outcome` if it is refused or not answered."""
        if state is not None and state.judged_trajectory == each.name:
            if state.judged_reason:
                field = state.judged_reason.partition(":")[0]
                code = REFUSALS.get(field, goal.Code.INVALID_GOAL)
                return goal.Outcome(code, state.judged_reason)
            for other in [g for g in self._goals if g is not each and g.check is not None]:
                text = "replaced by a newer goal"
                self._end(other, goal.Outcome(goal.Code.INVALID_GOAL, text))
            start = stamp_ns(each.message.header.stamp) or stamp_ns(state.header.stamp)
            points = each.message.points
            end = start + (stamp_ns(points[-1].time_from_start) if points else 0)
            names = [joint.name for joint in self.arm.joints]
            each.check = goal.GoalCheck(names, each.tolerances, end, self._period)
            each.trajectory_id = state.accepted_trajectory_id
            return None
        if now - each.began > patience:
            text = f"the controller has not answered for {patience:g} s: is it running?"
            return goal.Outcome(goal.Code.INVALID_GOAL, text)
        if now - each.asked > AGAIN:  # the controller may not have been connected yet
            each.asked = now
            self._trajectories.publish(each.message)
        return None

    def _cancelled(self, each, state):
        """Stop the arm for a goal that is to be cancelled, and wait until it has stopped."""
        if each.stopping is None:
            replaced = state.accepted_trajectory_id != each.trajectory_id
            if replaced or state.supervisor_state not in RUNNING:
                return goal.Outcome(goal.Code.SUCCESSFUL, "cancelled")
            each.stopping = self._stop.call_async(Trigger.Request())
        elif each.stopping.done():
            moving = (CompositeState.TRACKING, CompositeState.STOPPING)
            if each.stopped and state.supervisor_state not in moving:
                return goal.Outcome(goal.Code.SUCCESSFUL, "cancelled: the arm was stopped")
            each.stopped = True
        return None

    # Results out -------------------------------------------------------------------------------

    def _end(self, each, outcome):
        """Send the result of a goal."""
        self._goals = [other for other in self._goals if other is not each]
        self._done += 1
        self._last = outcome.text
        result = each.server.action_type.Result()
        result.error_code, result.error_string = int(outcome.code), outcome.text
        if hasattr(result, "tip_swing"):
            result.tip_swing = outcome.swing

        def end(handle):
            if handle.is_cancel_requested:
                handle.canceled()
            elif outcome.code == goal.Code.SUCCESSFUL:
                handle.succeed()
            else:
                handle.abort()
            return result

        each.server.finish(each.handle, end)
        log, text = self.get_logger(), f"{each.name[:13]}: {outcome.text}"
        if outcome.code == goal.Code.SUCCESSFUL:
            log.info(text)
        else:
            log.warning(text)

    def _feedback(self, kind):
        state, feedback = self._state, kind.Feedback()
        feedback.header.stamp, feedback.joint_names = state.header.stamp, state.joint_names
        position, velocity = _array(state.reference_position), _array(state.reference_velocity)
        error, error_rate = _array(state.position_error), _array(state.velocity_error)
        feedback.desired = _point(position, velocity, state.reference_acceleration)
        feedback.actual = _point(position - error, velocity - error_rate)
        feedback.error = _point(error, error_rate)
        return feedback

    def diagnose(self):
        values = {"goals": len(self._goals), "results": self._done, "last result": self._last}
        if self._came == 0.0:
            return WARN, "no controller/state: is the controller running?", values
        return OK, "", values


def kinds():
    """Types and names of the actions that are served: our own, and that of control_msgs if it is installed."""
    yield FollowJointTrajectory, "follow_trajectory"
    try:
        yield (
            importlib.import_module("control_msgs.action").FollowJointTrajectory,
            "follow_joint_trajectory",
        )
    except ImportError:
        return


def refuse_what_is_not_served(request):
    """Refuse fields of a `request` that no arm here has: those of joints with several degrees of freedom.

    Raises
    ------
    TrajectoryError
    """
    for field in ("component_path_tolerance", "component_goal_tolerance"):
        if getattr(request, field, ()):
            raise TrajectoryError("is not served", field=field, hint="leave it empty")
    several = getattr(request, "multi_dof_trajectory", None)
    if several is not None and several.points:
        raise TrajectoryError("is not served", field="multi_dof_trajectory", hint="leave it empty")


def _array(values):
    return np.asarray(values, float)


def _point(position, velocity, acceleration=()):
    return JointTrajectoryPoint(
        positions=list(position),
        velocities=list(velocity),
        accelerations=list(acceleration),
        time_from_start=Duration(),
    )


def main(args=None):
    """Entry point of ``ros2 run flexarm_control goals``."""
    leave(run(GoalsNode, args))
