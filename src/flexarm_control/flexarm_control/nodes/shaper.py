# SPDX-License-Identifier: Apache-2.0
"""Shaper node: trajectories, goals and streams in, the same without vibration out, to a controller of positions.

It stands before a joint_trajectory_controller, or anything with its topics and actions, and needs no arm file.
"""

import math

import numpy as np
from builtin_interfaces.msg import Duration
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from flexarm_dynamics.errors import MessageError, ParameterError, TrajectoryError
from flexarm_dynamics.parameters import parameter
from flexarm_msgs.msg import ShaperState
from flexarm_ros import qos
from flexarm_ros.messages import set_stamp
from flexarm_ros.node import OK, WARN, ArmNode, run
from flexarm_ros.start import leave

from .. import trajectory
from ..shaping import modes, trajectory_shaper
from ..shaping.modes import Modes
from ..shaping.stream import StreamShaper
from ..shaping.trajectory_shaper import TrajectoryShaper
from . import stream_damping
from .shaper_goals import ShaperGoals
from .shaping_job import AHEAD, Job, ShapingJob, attempt
from .stream_damping import StreamDamping
from .trajectory_inbox import rows

POSITIONS, VELOCITIES = "positions", "velocities"
PARAMETERS = (
    parameter("joint_names", [""], read_only=True).described(
        "The joints of the controller that follows, in its order."
    ),
    parameter("output", "joint_trajectory_controller", read_only=True).described(
        "The controller that follows: shaped trajectories go to its topic joint_trajectory, goals to its actions."
    ),
    parameter("synchronised_clocks", True, read_only=True).described(
        "Whether the controller has the same clock as this node; false: stamps are 0, which means now."
    ),
    parameter(
        "time_law", trajectory_shaper.GIVEN, choices=trajectory_shaper.TIME_LAWS, read_only=True
    ).described(
        "Time law of trajectories before they are shaped. given: that of their points; otherwise the quickest within "
        "the limits, jerk_limited along a straight line, time_optimal through all points; points then need no times."
    ),
    parameter("stream_output", "", read_only=True).described(
        "Topic to which the shaped stream goes, such as forward_position_controller/commands; empty: no streams."
    ),
    parameter("play_trajectories", False, read_only=True).described(
        "Send shaped trajectories as positions to stream_output, with the damping's correction, instead of to output; "
        "the topic stream is then ignored."
    ),
    parameter("stream_kind", POSITIONS, choices=(POSITIONS, VELOCITIES), read_only=True).described(
        "Content of the stream: positions [rad] or velocities [rad/s] of all joints."
    ),
    parameter("stream_rate", 125.0, "Hz", 1.0, 2000.0, read_only=True).described(
        "Rate of the shaped stream."
    ),
    parameter("stream_timeout", 0.2, "s", 0.01, 60.0, read_only=True).described(
        "Without inputs for this long, velocities become 0, and a stream at rest is no longer published."
    ),
)
#: Prefix of the parameters that may change at run time.
GROUP = "shaper."
#: Time between two checks whether a motion has ended; maximum age of measured positions that are used [s].
LOOK, FRESH = 0.01, 1.0


def parameter_groups():
    """Declared parameters of this node, by prefix."""
    return {
        "": PARAMETERS,
        "shaper.": modes.PARAMETERS,
        "limits.": trajectory_shaper.PARAMETERS,
        "damping.": stream_damping.PARAMETERS,
    }


class ShaperNode(ArmNode):
    """Messages to arrays, one call of `TrajectoryShaper` or `StreamShaper`, arrays to messages."""

    def __init__(self):
        super().__init__("shaper", parameter_groups())

    def build(self):
        names = self.joint_names = joint_names(self.parameters["joint_names"])
        self.parameters.resolve({"joints": len(names)})
        self._bypass = self._wanted = self._changed = False
        #: When the last shaped motion began, or begins [ns].
        self.started_ns = 0
        own = self._make_shapers()
        self.core = self._shapers[False]
        self.job = self._keep(lambda job: job.close(), ShapingJob(self))
        self._workers = (self.job,)
        self.parameters.judged_by(self._refuse_unfit)
        self.parameters.on_change(self._on_change)
        self._measured, self._measured_at = None, -math.inf
        self._state = ShaperState(joint_names=names, shaper=own.kind, stretch=1.0)
        output, given = self.parameters["output"], qos.overridable()
        self._states = self.make_publisher(
            ShaperState, "shaper/state", qos.COMMAND, qos_overriding_options=given
        )
        self._trajectories = self.make_publisher(
            JointTrajectory, f"{output}/joint_trajectory", qos.COMMAND, qos_overriding_options=given
        )
        self.make_subscription(
            JointTrajectory,
            "joint_trajectory",
            self._on_trajectory,
            qos.COMMAND,
            qos_overriding_options=given,
        )
        self.make_subscription(
            JointState,
            "joint_states",
            self._on_joint_states,
            qos_profile_sensor_data,
            qos_overriding_options=given,
        )
        self.make_service(SetBool, "shaper/bypass", self._on_bypass)
        self.make_service(Trigger, "shaper/stop", self._on_stop)
        self._goals = ShaperGoals(self, output)
        self._build_stream()
        self.make_timer(LOOK, self._look)

    def _make_shapers(self):
        """Make the shapers of the parameters, with and without bypass; returns their `Modes`."""
        names, limits = self.joint_names, self.parameters.group("limits.")
        own = Modes(self.parameters.group(GROUP), len(names))
        none = Modes({**self.parameters.group(GROUP), "type": modes.NONE}, len(names))
        law = self.parameters["time_law"]
        both = {False: own, True: none}
        self._shapers = {k: TrajectoryShaper(m, names, limits, law) for k, m in both.items()}
        self._streams = {k: StreamShaper(m, names) for k, m in both.items()}
        return own

    def _refuse_unfit(self, values):
        """Refuse parameters of the shaper that do not fit together, before they are set."""
        wanted = {k.removeprefix(GROUP): v for k, v in values.items() if k.startswith(GROUP)}
        Modes(wanted, len(self.joint_names))

    def _on_change(self, names):
        self._changed = self._changed or any(name.startswith(GROUP) for name in names)
        if self.active:
            self._settle(self.now_ns())

    def start(self):
        self._publish_state()

    def stop(self):
        self.job.drop("the shaper was stopped")
        self._goals.close()

    def now_ns(self):
        """ROS time [ns]."""
        return self.get_clock().now().nanoseconds

    # Trajectories ----------------------------------------------------------------------------

    def _on_trajectory(self, msg):
        if self.active:
            self.shape(msg, self._passed_on, self._refused)

    def _passed_on(self, message):
        self._send(message)
        self._goals.replaced()

    def _refused(self, error):
        self.get_logger().warning(f"trajectory refused: {error}")

    def _send(self, message):
        """Pass a shaped trajectory on, unless it is played."""
        if not self.plays:
            self._trajectories.publish(message)

    def shape(self, msg, done, refused):
        """Shape a trajectory that replaces the present one; without points it is a stop, as for the controller.

        A new time law is computed in a thread, and the present motion goes on meanwhile.

        Parameters
        ----------
        msg : JointTrajectory
        done, refused : callable
            Called with the shaped message once it begins, or with a `TrajectoryError`; then nothing changes, except
            that the state has the reason.
        """
        now = self.now_ns()
        self._settle(now)
        if not msg.points:
            if not self.stopping("asked for by a trajectory without points", done):
                done(msg)
            return
        try:
            data = trajectory.validate(
                msg.joint_names,
                self.joint_names,
                msg.header.stamp.sec * 1_000_000_000 + msg.header.stamp.nanosec,
                self._rows(msg),
            )
            where = self._where()
        except TrajectoryError as error:
            self._reject(error, refused)
            return
        core = self.core.snapshot()
        self._work_on(
            lambda begin, quick: core.prepared(data, begin, where, quick),
            lambda plan: self._accept(plan, data.stamp_ns, done),
            lambda error: self._reject(error, refused),
        )

    def _work_on(self, prepare, done, refused):
        """Have ``prepare(begin_ns, quick)`` make a plan, in a thread if it may take long."""
        now, core = self.now_ns(), self.core
        due = now + AHEAD if core.takes_long and core.moving(now + AHEAD) else None
        begin = now if due is None else due
        job = Job(lambda: prepare(begin, False), lambda: prepare(begin, True), due, done, refused)
        if core.takes_long:
            self.job.begin(job)
        else:
            job.put(attempt(job.prepare))
            job.answer()

    def _reject(self, error, refused):
        self._state.rejected_reason = str(error)
        self._publish_state()
        refused(error)

    def _accept(self, plan, stamp_ns, done):
        """Take a plan of a trajectory with a stamp [ns], and pass it on by `done`."""
        shaped = self.core.take(plan, self.now_ns() if self.core.takes_long else 0)
        state = self._state
        state.trajectory_id += 1
        state.rejected_reason = state.stopped = ""
        state.added_time, state.stretch = float(shaped.added), float(shaped.stretch)
        self.started_ns = shaped.start_ns
        set_stamp(state.start, shaped.start_ns)
        self._moves_until(shaped)
        if shaped.stretch > 1.0:
            text = f"slowed down {shaped.stretch:.4g} times to keep its limits"
            self.report(f"trajectory {state.trajectory_id} {text}", info=True)
        done(self._message(shaped, stamp_ns))

    def _rows(self, msg):
        """Points of a trajectory; if the node makes the time law, they have no speeds and need no times."""
        given = rows(msg)
        if self.parameters["time_law"] == trajectory_shaper.GIVEN:
            return given
        untimed = not any(row[0] for row in given)
        return [
            (i * 1_000_000_000 if untimed else row[0], row[1], [], [], [])
            for i, row in enumerate(given)
        ]

    def stopping(self, reason, done):
        """Stop the motion under way, and drop one that is being prepared; returns whether there is any.

        Parameters
        ----------
        reason : str
            Reason for the state.
        done : callable
            Called with the trajectory that stops the motion under way, if there is one.
        """
        dropped, now = self.job.drop(f"stopped before it began: {reason}"), self.now_ns()
        if not self.core.moving(now):
            return dropped

        def stops(plan):
            if plan is None:  # the motion has ended meanwhile
                return
            shaped = self.core.take(plan)
            self._state.stopped = reason
            self._moves_until(shaped)
            done(self._message(shaped, 0))

        core = self.core.snapshot()
        self._work_on(
            lambda begin, quick: core.prepared_stop(begin, quick), stops, self._not_stopped
        )
        return True

    def _not_stopped(self, error):
        self.get_logger().warning(f"the motion does not stop: {error}")

    def lost(self):
        """Forget the motion, since the controller does not follow it and the joints are elsewhere."""
        self.job.drop("the motion before it was not followed to its end")
        self.core.forget()

    def _moves_until(self, shaped):
        set_stamp(self._state.end, shaped.end_ns)
        self._state.moving = True
        self._publish_state()

    def _message(self, shaped, stamp_ns):
        """A `Shaped` as a message; one that was to begin now, with the joints at rest, still begins now."""
        message = JointTrajectory(joint_names=self.joint_names)
        now = shaped.fresh and stamp_ns == 0
        if not now and self.parameters["synchronised_clocks"]:
            set_stamp(message.header.stamp, shaped.start_ns)
        empty = [[]] * len(shaped.times_ns)
        columns = [values.tolist() for values in shaped.fields]
        columns += [empty] * (3 - len(columns))
        for time_ns, *values in zip(shaped.times_ns.tolist(), *columns, strict=True):
            point = JointTrajectoryPoint(time_from_start=Duration())
            point.positions, point.velocities, point.accelerations = values
            set_stamp(point.time_from_start, time_ns)
            message.points.append(point)
        return message

    def _on_joint_states(self, msg):
        index = {name: i for i, name in enumerate(msg.name)}
        if not all(name in index for name in self.joint_names):
            return  # of other joints
        if len(msg.position) != len(msg.name):
            text = f"joint_states: {len(msg.position)} positions of {len(msg.name)} names"
            self.report(f"{text} are ignored")
            return
        found = np.array([msg.position[index[name]] for name in self.joint_names])
        if not np.isfinite(found).all():
            self.report("joint_states: a position is not finite: ignored")
            return
        self._measured, self._measured_at = found, self._steady_s()
        if len(msg.velocity) == len(msg.name):
            self._speeds = np.array([msg.velocity[index[name]] for name in self.joint_names])
        else:
            self._speeds = np.full(found.size, np.nan)

    def _where(self):
        """Where the joints are (n,), None if unknown; a played motion begins there, to avoid a step.

        Raises
        ------
        TrajectoryError
        """
        found = self._measurement()
        if not self.plays or found is not None:
            return found
        if self._played is None:
            raise TrajectoryError(
                "have not come: where the joints are is unknown",
                field="joint_states",
                hint="publish them, so that the first position played is no step",
            )
        return self._played

    def _measurement(self):
        return self._measured if self._steady_s() - self._measured_at < FRESH else None

    def _measured_state(self):
        """Positions and speeds of the joints (2, n); None if positions do not come, nan where speeds do not."""
        found = self._measurement()
        return None if found is None else np.stack([found, self._speeds])

    def _steady_s(self):
        return 1e-9 * self._steady.now().nanoseconds

    # Bypass, stop, state ---------------------------------------------------------------------

    def _on_bypass(self, request, response):
        self._wanted = request.data
        self._settle(self.now_ns())
        response.success = True
        if self._bypass == self._wanted:
            response.message = "bypassed" if self._bypass else "shaping"
        else:
            response.message = "taken once the motion that is under way has ended"
        return response

    def _settle(self, now_ns):
        """Take a bypass or new parameters when nothing moves, since a change during a motion would be a step."""
        stream = self._streams[self._bypass]
        if self._bypass == self._wanted and not self._changed:
            return
        if self.job.busy or self.core.moving(now_ns) or not stream.settled():
            return
        if self._changed:
            self._state.shaper = self._make_shapers().kind
            self._changed = False
        self._bypass = self._state.bypassed = self._wanted
        self.core = self._shapers[self._bypass]
        self.core.forget()
        if stream.started:
            self._streams[self._bypass].begin(stream.output)
        self._publish_state()

    def _on_stop(self, request, response):
        stops = self.stopping("asked for by the service stop", self._send_stop)
        response.success = True
        response.message = "stops" if stops else "nothing moves"
        return response

    def _send_stop(self, message):
        if not self._goals.replace(message):
            self._send(message)

    def _look(self):
        if not self.active:
            return
        now = self.now_ns()
        self.job.look(now)
        if self._state.moving and not self.core.moving(now):
            self._state.moving = False
            self._publish_state()
        if self.plays and not self.core.moving(now) and (state := self.core.state(now)) is not None:
            self._goals.look(now, state, self._measured_state())
        self._settle(now)

    def _publish_state(self):
        set_stamp(self._state.header.stamp, self.now_ns())
        self._states.publish(self._state)

    # Streams ---------------------------------------------------------------------------------

    def _build_stream(self):
        topic, rate = self.parameters["stream_output"], self.parameters["stream_rate"]
        self._wish, self._wished_at, self._step = None, -math.inf, 1.0 / rate
        self._damping = self._played = None
        self.plays = self.parameters["play_trajectories"]
        damping = self.parameters.group("damping.")
        if damping["joint"]:
            self._refuse_without_stream(topic, "damping.joint", (POSITIONS, VELOCITIES))
            velocities = self.parameters["stream_kind"] == VELOCITIES
            self._damping = StreamDamping(self, self.joint_names, damping, self._step, velocities)
        if self.plays:
            self._refuse_without_stream(topic, "play_trajectories", (POSITIONS,))
        if not topic:
            return
        self._commands = self.make_publisher(Float64MultiArray, topic)
        if self.plays:
            self.make_timer(self._step, self._on_play)
            return
        self.make_subscription(Float64MultiArray, "stream", self._on_stream)
        self.make_timer(self._step, self._on_tick)

    def _refuse_without_stream(self, topic, field, kinds):
        """Refuse a `field` that needs a stream of some `kinds`, if its `topic` or kind is missing."""
        if not topic or self.parameters["stream_kind"] not in kinds:
            named = " or ".join(kinds)
            hint = f"give stream_output, with stream_kind {named}"
            raise ParameterError(f"has no stream of {named}", field=field, hint=hint)

    def _on_play(self):
        """Send the present position of the shaped motion; nothing before the first trajectory."""
        now = self.now_ns()
        state = self.core.state(now) if self.active else None
        if state is not None:
            self._played = state[0]
            if self.core.moving(now):
                self._goals.tell(state, self._measured_state())
        if not self.active or self._played is None:
            return
        value = self._played
        if self._damping is not None:
            value = self._damping.corrected(value, 1e-9 * now)
        self._commands.publish(Float64MultiArray(data=value.tolist()))

    def _on_stream(self, msg):
        if not self.active:
            return
        stream = self._streams[self._bypass]
        try:
            wish = stream.check(msg.data)
            if self.parameters["stream_kind"] == POSITIONS and not stream.started:
                self._refuse_far(wish)
        except MessageError as error:
            self.report(f"stream: {error}: ignored")
            return
        self._wish, self._wished_at = wish, self._steady_s()

    def _refuse_far(self, wish):
        """Refuse a first position that is not where the joints are."""
        measured = self._measurement()
        if measured is None:
            return
        joint = int(np.argmax(np.abs(wish - measured)))
        if abs(wish[joint] - measured[joint]) > trajectory_shaper.START_TOLERANCE:
            raise MessageError(
                f"rad is not where the joint is: {measured[joint]:g}",
                field=f"data of joint {self.joint_names[joint]}",
                value=float(wish[joint]),
                limit=f"within {trajectory_shaper.START_TOLERANCE:g}",
            )

    def _on_tick(self):
        if not self.active or self._wish is None:
            return
        silent = self._steady_s() - self._wished_at > self.parameters["stream_timeout"]
        stream, velocities = (
            self._streams[self._bypass],
            self.parameters["stream_kind"] == VELOCITIES,
        )
        if silent and velocities:
            self._wish = np.zeros(len(self.joint_names))
        if not stream.started:
            stream.begin(np.zeros(len(self.joint_names)) if velocities else self._wish)
        stands = silent and stream.settled() and not stream.steps_to(self._wish)
        if stands and self._damping is None:
            return
        where = self._measurement() if velocities else None
        value = stream.step(self._wish, self._step, where)
        if self._damping is not None:
            value = self._damping.corrected(value, 1e-9 * self.now_ns())
        self._commands.publish(Float64MultiArray(data=value.tolist()))

    # -----------------------------------------------------------------------------------------

    def diagnose(self):
        state = self._state
        values = {
            "shaper": state.shaper,
            "bypassed": state.bypassed,
            "moving": state.moving,
            "trajectories": state.trajectory_id,
            "added time [s]": f"{state.added_time:.4g}",
            "last refused": state.rejected_reason,
        }
        if self._damping is not None:
            law = self._damping.law
            values["damping"] = f"{law.state}: {law.reason}" if law.reason else law.state
            if law.reason:
                return WARN, f"no damping: {law.reason}", values
        if self.plays:
            return OK, "bypassed" if state.bypassed else "", values
        if not self._trajectories.get_subscription_count() and not self._goals.served():
            topic = self._trajectories.topic_name
            return WARN, f"nothing listens on {topic}: is parameter output right?", values
        return OK, "bypassed" if state.bypassed else "", values


def joint_names(given):
    """The names of a parameter joint_names.

    Raises
    ------
    ParameterError
        If none is `given`, or one twice.
    """
    names = [name for name in given if name]
    hint = "give the joints of the controller that follows, in its order"
    if not names:
        raise ParameterError("is empty", field="joint_names", hint=hint)
    if len(set(names)) != len(names):
        raise ParameterError("has a name twice", field="joint_names", value=names, hint=hint)
    return names


def main(args=None):
    """Entry point of ``ros2 run flexarm_control shaper``."""
    leave(run(ShaperNode, args))
