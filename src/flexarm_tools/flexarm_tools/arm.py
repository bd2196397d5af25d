# SPDX-License-Identifier: Apache-2.0
"""An arm in a few lines of Python, over ROS: starts the nodes of a simulated arm, or joins nodes that run.

    from flexarm_tools.arm import Arm

    with Arm("two_link") as arm, arm.recording() as run:
        arm.move([0.8, 0.4], 2.0)
    print(arm.state.tip, abs(run.record.reference - run.record.position).max())

`flexarm_studies.loop.arm.SimulatedArm` has the same methods without ROS.
"""

import contextlib
import tempfile
import time
from pathlib import Path

import numpy as np
from rcl_interfaces.srv import GetParameters
from rclpy.action import ActionClient
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.models import model
from flexarm_msgs.action import FollowJointTrajectory
from flexarm_msgs.msg import ArmState, CompositeState
from flexarm_ros.messages import set_stamp, stamp_ns
from flexarm_ros.session import Latest, Session, WaitError, plain
from flexarm_studies.loop import parameter_files
from flexarm_studies.loop.arm import Arrival, BaseArm, MotionError, Reading, Recording

from .recording.recorder import Recorder, keep_for_recording, to_record
from .running.processes import Processes, own_domain

#: Timeout for finding a loop that may run, and for one that must run [s].
JOIN, MUST_JOIN = 2.0, 15.0
#: A goal without an answer is sent again after this time; the arm has this long to stop after Ctrl-C [s].
AGAIN, STOPPING = 3.0, 10.0
#: Longer than any motion: there is no timeout for the end of a motion as long as the nodes run [s].
FOR_EVER = 1e9
STATES = {
    getattr(CompositeState, name): name
    for name in ("INACTIVE", "READY", "TRACKING", "HOLDING", "STOPPING", "FAULT")
}


class Arm(BaseArm):
    """An arm whose nodes run as processes: `BaseArm`'s methods, over topics, services and the action server.

    Parameters
    ----------
    arm : str, optional
        Arm file: shipped name or path. Not given: that of the controller that runs.
    join : bool, optional
        True: join nodes that already run. False: start a separate simulator, observer, controller and action server.
        Not given: join if something runs, otherwise start.
    namespace : str
        Namespace of the nodes that run.
    file : str or Path, optional
        Parameter file of nodes to start; not given: the arm's shipped one, for another arm a design.
    parameters : mapping, optional
        Parameters of nodes to start, beyond the file: name to value.
    real_time : bool
        Whether nodes to start run in real time; otherwise they run in lockstep, as fast as the machine allows, so a
        busy machine loses no sample.
    progress : callable, optional
        Called with the seconds since a motion began.

    Raises
    ------
    WaitError
        If nothing runs that can be joined, or if a started node does not come up.
    """

    def __init__(
        self,
        arm=None,
        *,
        join=None,
        namespace="",
        file=None,
        parameters=None,
        real_time=False,
        progress=lambda seconds: None,
    ):
        self._stack, self._progress = contextlib.ExitStack(), progress
        self._state = self._estimate = None
        self._own = False
        try:
            if join is not False:
                self._connect(Session("flexarm_arm", namespace=namespace))
                found = self.session.serve(MUST_JOIN if join else JOIN, self._look)
                if not found and join:
                    hint = "start them, or leave out join=True"
                    raise WaitError("there is no controller/state to join", hint=hint)
                if not found:
                    self._stack.close()
                    self._stack = contextlib.ExitStack()
            if self._state is None:
                if arm is None:
                    raise WaitError("there is no arm to join", hint="name an arm file to start one")
                self._start(arm, file, {"lockstep": not real_time, **(parameters or {})})
            self._name = arm or self._running_arm()
            self.arm = arm_file.load(self._name)
            self.model = model.build(self.arm.known)
            self._goals = ActionClient(
                self.session.node, FollowJointTrajectory, "controller/follow_trajectory"
            )
            self._stack.callback(self._goals.destroy)
            hint = "start it: ros2 run flexarm_control goals"
            self.session.wait_for("the action server", self._goals.server_is_ready, hint=hint)
            self.session.wait_for("torque", lambda: self._look() and self._has_torque())
        except BaseException:
            self._stack.close()
            raise

    def _connect(self, session):
        self.session = self._stack.enter_context(session)
        create = session.node.create_subscription
        self._states = Latest(create, CompositeState, "controller/state")
        self._estimates = Latest(create, ArmState, "arm_state_estimate")

    def _start(self, arm, file, parameters):
        """Start the nodes of a simulated arm, on a domain of their own."""
        logs = self._stack.enter_context(tempfile.TemporaryDirectory(prefix="flexarm-"))
        domain = self._stack.enter_context(own_domain())
        processes = self._stack.enter_context(Processes(domain, Path(logs)))
        file = file or parameter_files.of_arm(arm)
        file = file and parameter_files.find(file)
        common = {"arm": arm, **parameters}
        for name in ("simulator", "observer", "controller", "goals"):
            own = {"pause_at": -1.0} if name == "simulator" else {}
            kept = {} if name == "goals" else keep_for_recording(name)
            processes.start_node(name, common | own | kept, file)
        self._own = True
        self._connect(Session("flexarm_arm", domain=domain, processes=processes, patience=600.0))
        self.session.wait_for("the controller", self._look)

    def _running_arm(self):
        answer = self.session.call(GetParameters, "controller/get_parameters", names=["arm"])
        return plain(answer.values[0])

    def _look(self):
        """Take the newest messages; return whether there is one of each."""
        self._state = self._states.take() or self._state
        self._estimate = self._estimates.take() or self._estimate
        return self._state is not None and self._estimate is not None

    def _has_torque(self):
        without = (CompositeState.INACTIVE, CompositeState.FAULT)
        return self._state.supervisor_state not in without

    @property
    def state(self):
        """As `BaseArm.state`."""
        self.session.serve(0.0)
        self._look()
        state, estimate = self._state, self._estimate
        position, amplitude = _array(estimate.joint_position), _array(estimate.modal_amplitude)
        return Reading(
            time=1e-9 * stamp_ns(state.header.stamp),
            position=position,
            velocity=_array(estimate.joint_velocity),
            reference=_array(state.reference_position),
            torque=_array(state.torque),
            amplitude=amplitude,
            tip=self.model.tip_position(position, amplitude),
            supervisor=STATES[state.supervisor_state],
            reason=state.rejected_reason,
        )

    def _follow(self, data):
        session, begun, goals = self.session, None, []
        wanted = FollowJointTrajectory.Goal(trajectory=_message(data))
        again = 0.0

        def note(message):
            nonlocal begun
            now = stamp_ns(message.feedback.header.stamp)
            begun = begun or now
            self._progress(1e-9 * (now - begun))

        def answered():
            nonlocal again
            if time.monotonic() > again:  # a server that has not found us yet drops its answer
                again = time.monotonic() + AGAIN
                goals.append(self._goals.send_goal_async(wanted, feedback_callback=note))
            return next((g.result() for g in goals if g.done()), None)

        handle = session.wait_for("the answer to the goal", answered)
        if not handle.accepted:
            raise MotionError("the action server is not active", field="goals")
        self._look()
        start = stamp_ns(self._state.header.stamp)
        future = handle.get_result_async()
        try:
            session.wait_for("the motion's end", future.done, patience=FOR_EVER)
        except KeyboardInterrupt:
            handle.cancel_goal_async()
            session.serve(STOPPING, future.done)
            raise
        result = future.result().result
        if result.error_code != FollowJointTrajectory.Result.SUCCESSFUL:
            raise MotionError(result.error_string)
        self._look()
        return Arrival(1e-9 * (stamp_ns(self._state.header.stamp) - start), result.tip_swing)

    def wait(self, seconds):
        """Wait for `seconds` of wall time [s], and receive messages meanwhile."""
        self.session.serve(seconds)

    def stop(self):
        """As `BaseArm.stop`."""
        self.session.call(Trigger, "controller/stop")
        moving = ("TRACKING", "STOPPING")
        self.session.wait_for("rest", lambda: self.state.supervisor not in moving)

    def recover(self):
        """As `BaseArm.recover`."""
        return self.session.call(Trigger, "controller/recover").success

    @contextlib.contextmanager
    def recording(self):
        """As `BaseArm.recording`; samples that one of the topics has lost are left out."""
        found, recorder = Recording(), Recorder(self.session)
        self.session.wait_for("all topics", recorder.complete)
        begin = recorder.latest_ns
        try:
            yield found
        finally:
            self.session.poll()
            samples = recorder.between(begin, recorder.latest_ns)
            stamps = set.intersection(*(set(rows) for rows in samples.values()))
            for topic in samples:
                samples[topic] = {s: raw for s, raw in samples[topic].items() if s in stamps}
                self.session.untap(topic)
            if stamps:
                found.record = to_record(samples, min(stamps), self._name)

    def close(self):
        """Leave the nodes that run, and end those that were started."""
        self._stack.close()


def _array(values):
    return np.asarray(values, float)


def _message(data):
    """A `JointTrajectoryData` as a message that starts now."""
    message = JointTrajectory(joint_names=list(data.joint_names))
    names = ("positions", "velocities", "accelerations")
    for k, moment in enumerate(data.times_ns):
        point = JointTrajectoryPoint()
        set_stamp(point.time_from_start, int(moment))
        for name, values in zip(names, data.fields, strict=False):
            setattr(point, name, values[k].tolist())
        message.points.append(point)
    return message
