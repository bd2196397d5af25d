# SPDX-License-Identifier: Apache-2.0
"""Takes trajectories from a raw message to the controller: reads and prepares them, and offers or refuses them."""

from concurrent.futures import CancelledError, ThreadPoolExecutor
from functools import partial

import numpy as np
from rclpy.serialization import deserialize_message
from trajectory_msgs.msg import JointTrajectory

from flexarm_dynamics.errors import FlexarmError, TrajectoryError
from flexarm_ros.messages import stamp_ns, trajectory_name, trajectory_points

from .. import trajectory

#: Longer trajectories are refused, since their points are read in one go.
MAX_POINTS = 10_000
#: Trajectories that come within this time of each other, by the arm's clock, are a stream [ns].
STREAMED = 500_000_000
#: Work on a plan ends this long before the motion's own start; what is not ready by then is left out [ns].
IN_TIME = 30_000_000


def rows(msg):
    """Points of a `JointTrajectory` as `trajectory.validate` takes them."""
    return [
        (stamp_ns(p.time_from_start), p.positions, p.velocities, p.accelerations, p.effort)
        for p in msg.points
    ]


def read(raw, arm, held=None, streaming=trajectory.streams.PLAIN):
    """Read a serialised `JointTrajectory`, `raw`, as `JointTrajectoryData`; raises a `TrajectoryError` if it can't.

    `held` and `streaming` are as for `validate`.
    """
    try:
        count = trajectory_points(raw)
        if count > MAX_POINTS:
            raise TrajectoryError(
                "are too many",
                field="points",
                value=count,
                limit=f"at most {MAX_POINTS}",
                hint="send fewer: a quintic polynomial joins them; or send one trajectory after another",
            )
        msg = deserialize_message(raw, JointTrajectory)
        return trajectory.validate(
            msg.joint_names,
            arm.joint_names,
            stamp_ns(msg.header.stamp),
            rows(msg),
            *arm.position_limits.T,
            arm.velocity_limits,
            held,
            streaming,
        )
    except TrajectoryError:
        raise
    except Exception as error:  # untrusted bytes
        problem = f"can't be read: {type(error).__name__}: {error}"
        raise TrajectoryError(problem, field="JointTrajectory") from error


class TrajectoryInbox:
    """Takes raw messages off the control path: a thread reads and prepares them, the node's own thread offers them.

    Parameters
    ----------
    node : ArmNode
    core : ArmController
    designer : Designer
    """

    def __init__(self, node, core, designer):
        self._node, self._core, self._designer = node, core, designer
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="trajectory")
        self._last_came = None  # [ns]

    def warm_up(self):
        """Have the designer ready before the first motion comes."""
        if self._core.plans:
            self._thread.submit(self._designer.warm_up)

    def receive(self, raw):
        """Take a serialised message, since turning thousands of points into objects would delay the control path."""
        if self._node.active:
            self._thread.submit(self._read_and_prepare, raw, self._core.law.feedforward)

    def _read_and_prepare(self, raw, feedforward):
        """In a thread: make a message ready to be offered."""
        name = trajectory_name(raw)
        try:
            data = read(raw, self._core.model.arm, self._core.held, self._core.streaming)
            self._judge_torque(data)
        except TrajectoryError as error:
            self._node.hand_over(self._refuse, str(error), name)
            return
        except CancelledError:
            return
        reference = self._core.reference
        plan, start = None, reference.resting
        ahead = reference.ahead(data)
        whole = ahead.stamp_ns == data.stamp_ns  # a plan covers the whole trajectory
        try:
            if feedforward is not None and feedforward.plans and start is not None and whole:
                plan = self._designer.prepare(
                    feedforward, ahead, start, partial(self._in_time, data)
                )
                note = getattr(plan, "note", "")
                if note:
                    self._node.get_logger().warning(f"feed-forward of a trajectory: {note}")
        except CancelledError:
            return
        except Exception as error:
            if self._designer.closed:
                return
            kind = "" if isinstance(error, FlexarmError) else f"{type(error).__name__}: "
            self._node.get_logger().warning(f"trajectory on the slow manifold alone: {kind}{error}")
        self._node.hand_over(self._offer, data, plan, name)

    def _in_time(self, data):
        """Whether a plan is still of use: a trajectory with stamp 0 waits for it, one with a stamp does not."""
        now = self._core.reference.stamp_ns
        return now is None or not data.stamp_ns or now < data.stamp_ns - IN_TIME

    def _judge_torque(self, data):
        """Raise a `TrajectoryError` for a trajectory that needs more torque than is allowed."""
        reference, limit = self._core.reference, self._core.torque_allowed
        if not (np.isinf(limit).all() or reference.repeats(data)):
            ahead = reference.ahead(data)
            self._designer.judge(ahead, reference.start_of(ahead.stamp_ns), limit)

    def _refuse(self, reason, name):
        self._core.refuse(reason, name)
        self._log(f"trajectory refused: {reason}")

    def _offer(self, data, plan, name):
        verdict = self._core.offer(data, plan, judged=True, name=name)
        if verdict.accepted:
            text = f"trajectory {verdict.trajectory_id} accepted: {verdict.reason}"
            self._log(text, info=True)
        elif not verdict.repeat:
            self._log(f"trajectory refused: {verdict.reason}")

    def _log(self, text, info=False):
        """Log the result of a trajectory; in a stream, texts that differ only in numbers at most every ten seconds."""
        last, now = self._last_came, self._core.reference.stamp_ns
        log, self._last_came = self._node.get_logger(), now
        if last is not None and now is not None and now - last < STREAMED:
            self._node.report(text, info)
        elif info:
            log.info(text)
        else:
            log.warning(text)

    def close(self):
        """Take no more messages; work under way is not waited for."""
        self._thread.shutdown(wait=False, cancel_futures=True)
