# SPDX-License-Identifier: Apache-2.0
"""Action servers of the shaper: they shape goals, send them on to the controller's own server, and return the results.

A cancelled goal ends in a shaped stop. The stop goes to the controller as a goal that replaces the one that it follows,
and the result is sent once that is done. If the node plays trajectories itself, there is no controller to ask: a goal
has succeeded once its motion has ended and the joints are within the goal's tolerances.
"""

from types import MappingProxyType

import numpy as np
from action_msgs.msg import GoalStatus
from rclpy.action import ActionClient, CancelResponse, GoalResponse

from flexarm_dynamics.errors import TrajectoryError
from flexarm_ros.messages import set_stamp

from ..trajectory.goal import Code, GoalCheck, tolerances
from .goals import Server, kinds, refuse_what_is_not_served

#: A played goal is judged only by the tolerances that it gives itself.
NOT_JUDGED = MappingProxyType({
    "constraints.trajectory": 0.0,
    "constraints.goal": 0.0,
    "constraints.stopped_velocity_tolerance": 0.0,
    "constraints.goal_time": 0.0,
    "constraints.tip": -1.0,
})  # fmt: skip


class Goal:
    """A goal under way.

    Parameters
    ----------
    server : Server
    handle : ServerGoalHandle
    client : ActionClient
        Client of the controller's server of the same type.
    """

    def __init__(self, server, handle, client):
        self.server, self.handle, self.client = server, handle, client
        self.sent = 0  # goals sent to the controller; only the last one's result counts
        self.over = False
        self.reason = ""
        self.tolerances = self.check = None  # if the node plays it


class ShaperGoals:
    """Serves goals for a node with `shape` and `stopping`.

    Parameters
    ----------
    node : ShaperNode
    output : str
        Name of the controller that follows.
    """

    def __init__(self, node, output):
        self._node, self._clients = node, {}
        self._current = self._preparing = (
            None  # the goal under way; the one whose trajectory is being shaped
        )
        for kind, name in kinds():
            client = ActionClient(node, kind, f"{output}/{name}")
            self._clients[kind] = node._keep(lambda c: c.destroy(), client)
            server = Server(node, kind, f"shaper/{name}", self)
            node._keep(lambda s: s.destroy(), server)

    def served(self):
        """Whether the controller has an action server."""
        return any(client.server_is_ready() for client in self._clients.values())

    def close(self):
        """End the goal under way, since the node stops."""
        if self._current is not None:
            self._end(self._current, Code.INVALID_GOAL, "the shaper was stopped")

    def may_begin(self, request):
        """Accept any goal while active; its result states what is wrong with it."""
        return GoalResponse.ACCEPT if self._node.active else GoalResponse.REJECT

    def take(self, server, handle):
        """Shape an accepted goal, and send it on."""
        kind, request = server.action_type, handle.request
        goal = Goal(server, handle, self._clients[kind])
        if not self._node.plays and not goal.client.server_is_ready():
            text = f"no action server {goal.client._action_name}: is parameter output right?"
            self._end(goal, Code.INVALID_GOAL, text)
            return
        if self._node.plays:
            try:
                _refuse_empty(request.trajectory)
                goal.tolerances = self._tolerances(request)
            except TrajectoryError as error:
                self._refuse(goal, error)
                return
        self._node.shape(
            request.trajectory,
            lambda shaped: self._begin(goal, shaped),
            lambda error: self._refuse(goal, error),
        )
        if not goal.over and self._current is not goal:
            self._preparing = goal

    def _tolerances(self, request):
        """Tolerances that a played goal asks for."""
        refuse_what_is_not_served(request)
        if getattr(request, "tip_tolerance", 0.0) > 0.0:
            hint = "leave it 0: the shaper has no arm file"
            value = request.tip_tolerance
            raise TrajectoryError("can't be judged", field="tip_tolerance", value=value, hint=hint)
        rows = (
            [(t.name, t.position, t.velocity) for t in own]
            for own in (request.path_tolerance, request.goal_tolerance)
        )
        wait = request.goal_time_tolerance
        time = wait.sec + 1e-9 * wait.nanosec
        return tolerances(self._node.joint_names, 0.0, NOT_JUDGED, *rows, time, -1.0)

    def _refuse(self, goal, error):
        """End a goal whose trajectory can't be shaped."""
        if self._preparing is goal:
            self._preparing = None
        code = Code.INVALID_JOINTS if "name" in error.field else Code.INVALID_GOAL
        self._end(goal, code, str(error))

    def _begin(self, goal, shaped):
        """Begin a goal whose trajectory is shaped; it replaces the one before."""
        if self._preparing is goal:
            self._preparing = None
        before, self._current = self._current, goal
        if before is not None:
            self._end(before, Code.INVALID_GOAL, "replaced by a newer goal")
        if shaped.points:
            self._announce(goal, shaped.points[-1])
        goal.handle.request.trajectory = shaped
        if self._node.plays:
            goal.check = GoalCheck(self._node.joint_names, goal.tolerances, 0, 0.0)
        else:
            self._send(goal, goal.handle.request)

    def _announce(self, goal, last):
        """Publish the first feedback: its stamp is the shaped motion's start, `desired` its last point."""
        feedback = goal.server.action_type.Feedback(joint_names=self._node.joint_names)
        set_stamp(feedback.header.stamp, self._node.started_ns)
        feedback.desired = last
        goal.handle.publish_feedback(feedback)

    def may_cancel(self, handle):
        """Stop smoothly for a goal that is under way; it is cancelled once the stop is done."""
        goal = self._preparing
        if goal is not None and goal.handle == handle:
            # The goal can end only after this answer: the node's thread ends it later. The motion under way goes on.
            self._preparing = None
            self._node.job.forget()
            error = TrajectoryError("cancelled before it began", field="trajectory")
            self._node.hand_over(self._refuse, goal, error)
            return CancelResponse.ACCEPT
        goal = self._current
        if goal is None or goal.handle != handle:
            return CancelResponse.REJECT
        goal.reason = "cancelled: the arm was stopped"
        self._node.stopping("the goal was cancelled", self.replace)
        return CancelResponse.ACCEPT

    def replace(self, message):
        """Replace the trajectory of the goal under way (a played one notes a stop); returns whether there is a goal."""
        if self._current is None:
            return False
        if self._node.plays:
            self._current.reason = self._current.reason or "stopped"
            return True
        request = self._current.server.action_type.Goal(trajectory=message)
        self._send(self._current, request)
        return True

    def replaced(self):
        """End a played goal, since a trajectory has taken over from it."""
        if self._node.plays and self._current is not None:
            self._end(self._current, Code.INVALID_GOAL, "replaced by a trajectory")

    def look(self, now_ns, state, measured):
        """End a played goal after its motion has ended, once the joints are where it wants them.

        Parameters
        ----------
        now_ns : int
            [ns]
        state : (3, n) ndarray
            State of the motion [rad], [rad/s], [rad/s^2].
        measured : (2, n) ndarray or None
            Positions and speeds of the joints [rad], [rad/s]; nan where unknown.
        """
        goal = self._current
        if not self._node.plays or goal is None:
            return
        if goal.reason and not goal.handle.is_cancel_requested:
            self._end(goal, Code.PATH_TOLERANCE_VIOLATED, goal.reason)
            return
        if goal.reason:
            result = goal.server.action_type.Result(error_string=goal.reason)
            self._finish(goal, GoalStatus.STATUS_SUCCEEDED, result)
            return
        if self._blind(goal, measured):
            return
        error, speed = self._errors(state, measured)
        outcome = goal.check.at_the_end(now_ns, error, speed, None)
        if outcome is None:
            return
        if outcome.code != Code.SUCCESSFUL:
            self._end(goal, outcome.code, outcome.text)
            return
        self._finish(goal, GoalStatus.STATUS_SUCCEEDED, goal.server.action_type.Result())

    def tell(self, state, measured):
        """Publish the feedback of a played goal, and abort it if it leaves its tolerances; arguments as for `look`."""
        goal = self._current
        if goal is None:
            return
        feedback = goal.server.action_type.Feedback(joint_names=self._node.joint_names)
        now, point = self._node.now_ns(), feedback.desired
        set_stamp(feedback.header.stamp, now)
        set_stamp(point.time_from_start, max(now - self._node.started_ns, 0))
        point.positions, point.velocities, point.accelerations = state.tolist()
        if measured is not None:
            feedback.actual.positions = measured[0].tolist()
            feedback.error.positions = (state[0] - measured[0]).tolist()
        goal.handle.publish_feedback(feedback)
        if goal.reason or self._blind(goal, measured):
            return
        outcome = goal.check.on_the_way(*self._errors(state, measured))
        if outcome is not None:
            self._abort(goal, outcome.text)

    def _blind(self, goal, measured):
        """Abort a goal with tolerances if no joint positions are received; returns whether it did."""
        limits = goal.tolerances
        judged = np.isfinite(limits.path).any() or np.isfinite(limits.goal).any()
        if measured is not None or not judged:
            return False
        self._abort(goal, "joint_states do not come: its tolerances can't be judged")
        return True

    def _abort(self, goal, text):
        """End a played goal, and stop."""
        self._end(goal, Code.PATH_TOLERANCE_VIOLATED, text)
        self._node.stopping(text, lambda _: None)

    @staticmethod
    def _errors(state, measured):
        """Errors of positions and speeds, (n,) each [rad], [rad/s]; 0 where nothing is measured."""
        error = np.zeros_like(state[:2]) if measured is None else state[:2] - measured
        return tuple(np.nan_to_num(error))

    def _send(self, goal, request):
        goal.sent += 1
        number = goal.sent

        def answered(future):
            handle = future.result()
            if number != goal.sent or goal.over:
                return
            if not handle.accepted:
                self._node.lost()
                self._end(goal, Code.INVALID_GOAL, "the controller has rejected the shaped goal")
                return
            handle.get_result_async().add_done_callback(finished)

        def finished(future):
            if number == goal.sent and not goal.over:
                self._relay(goal, future.result())

        def feedback(message):
            if not goal.over and number == goal.sent:
                goal.handle.publish_feedback(message.feedback)

        future = goal.client.send_goal_async(request, feedback_callback=feedback)
        future.add_done_callback(answered)

    def _relay(self, goal, answer):
        """Send the controller's result as that of the goal."""
        result = answer.result
        if answer.status != GoalStatus.STATUS_SUCCEEDED:
            self._node.lost()
        if goal.reason and answer.status == GoalStatus.STATUS_SUCCEEDED:
            result.error_string = goal.reason
        self._finish(goal, answer.status, result)

    def _end(self, goal, code, text):
        """Send the shaper's own result."""
        result = goal.server.action_type.Result()
        result.error_code, result.error_string = int(code), text
        self._node.get_logger().warning(f"goal: {text}")
        self._finish(goal, GoalStatus.STATUS_ABORTED, result)

    def _finish(self, goal, status, result):
        goal.over = True
        if self._current is goal:
            self._current = None

        def end(handle):
            if handle.is_cancel_requested:
                handle.canceled()
            elif status == GoalStatus.STATUS_SUCCEEDED:
                handle.succeed()
            else:
                handle.abort()
            return result

        goal.server.finish(goal.handle, end)


def _refuse_empty(trajectory):
    """Refuse a trajectory without points."""
    if not trajectory.points:
        hint = "to stop, cancel the goal"
        raise TrajectoryError("are missing", field="trajectory.points", hint=hint)
