# SPDX-License-Identifier: Apache-2.0
"""Runs the three nodes as three processes in lockstep, and records them."""

import time
from dataclasses import dataclass

from builtin_interfaces.msg import Duration
from rclpy.serialization import deserialize_message
from std_srvs.srv import SetBool
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from flexarm_msgs.msg import CompositeState
from flexarm_ros.messages import set_stamp
from flexarm_ros.session import Session, WaitError
from flexarm_studies.loop.closed_loop import TRAJECTORY_START_NS

from ..recording.recorder import Recorder, raw_stamp_ns
from .processes import ProcessError


def trajectory_message(joint_names, profile, points=101, stamp_ns=0):
    """A `JointTrajectory` of a motion profile, with velocities and accelerations.

    Parameters
    ----------
    joint_names : sequence of str
    profile : Profile
    points : int
    stamp_ns : int
        Start; 0: now.
    """
    from flexarm_control.motions.profiles import sample

    s = sample(profile, points)
    msg = JointTrajectory(joint_names=list(joint_names))
    set_stamp(msg.header.stamp, stamp_ns)
    for t, p, v, a in zip(s.times, s.positions, s.velocities, s.accelerations, strict=True):
        sec, nanosec = divmod(round(t * 1e9), 10**9)
        msg.points.append(
            JointTrajectoryPoint(
                time_from_start=Duration(sec=sec, nanosec=nanosec),
                positions=p.tolist(),
                velocities=v.tolist(),
                accelerations=a.tolist(),
            )
        )
    return msg


@dataclass(frozen=True)
class Timing:
    """How long a run took."""

    wall_seconds: float
    simulated_seconds: float
    samples: int

    @property
    def seconds_per_sample(self):
        """Wall time per sample [s]."""
        return self.wall_seconds / self.samples


class LockstepRun(Session):
    """A session with three running nodes: it sends a trajectory, starts the run and records it.

    Parameters
    ----------
    processes : Processes
        With simulator (``lockstep``), observer and controller started.
    """

    #: Time between two checks of the recording [s].
    POLL_PERIOD = 0.005

    def __init__(self, processes):
        domain = processes.domain
        super().__init__("case_study", domain=domain, processes=processes, period=0.02)
        self.processes, self.recorder = processes, Recorder(self)

    def controller_state(self):
        """The newest `controller/state`."""
        raw = self.recorder.raw["controller/state"]
        return deserialize_message(raw[-1], CompositeState) if raw else CompositeState()

    def paused_at(self):
        """Stamp of the sample that is being sent again [ns]; 0 while the loop runs."""
        raw = self.recorder.raw["controller/state"][-2:]
        stamps = {raw_stamp_ns(r) for r in raw}
        return stamps.pop() if len(raw) == 2 and len(stamps) == 1 else 0

    def ready(self):
        """Whether the controller sends torque."""
        without = (CompositeState.INACTIVE, CompositeState.FAULT)
        return self.controller_state().supervisor_state not in without

    def takes_trajectories(self):
        """Whether the controller sends torque, or reports why its first torque waits.

        Right after `~/recover` it does neither: it refuses trajectories until the next state comes.
        """
        state = self.controller_state()
        return self.ready() or (
            state.supervisor_state == CompositeState.INACTIVE and bool(state.rejected_reason)
        )

    def accepted(self):
        """Number of the last accepted trajectory."""
        return self.controller_state().accepted_trajectory_id

    def offer(self, message):
        """Publish a trajectory and wait until it is accepted."""
        before = self.accepted()
        self.publisher(JointTrajectory, "joint_trajectory", readers=1).publish(message)
        try:
            self.wait_for("the trajectory to be accepted", lambda: self.accepted() > before)
        except WaitError as error:
            reason = self.controller_state().rejected_reason
            field = "the trajectory was not accepted"
            raise ProcessError(f"{reason}\n{error}", field=field) from None

    def pause(self, paused):
        """Call the simulator's `~/pause`."""
        answer = self.call(SetBool, "simulator/pause", data=paused)
        if not answer.success:
            raise ProcessError(answer.message, field="simulator/pause")

    def run(self, message, duration, progress=lambda fraction: None):
        """Offer a trajectory at `TRAJECTORY_START_NS`, run `duration` seconds beyond its start, and record.

        Returns
        -------
        samples : dict
            See `Recorder.samples`.
        timing : Timing
        """
        self.wait_for("the nodes (simulator, observer, controller)", self.recorder.complete)
        self.wait_for("the simulator's pause", self.paused_at)
        self.wait_for("the controller to take trajectories", self.takes_trajectories)
        self.offer(message)
        begin = self.paused_at()
        end = TRAJECTORY_START_NS + round(duration * 1e9)
        started = time.perf_counter()
        self.pause(False)
        recorder = self.recorder
        last_check = deadline = time.monotonic()
        newest = 0
        while recorder.latest_ns < end:
            time.sleep(self.POLL_PERIOD)
            self.poll()
            now = time.monotonic()
            if now - last_check > 0.2:
                last_check = now
                self.processes.check()
                self._check_fault()
                stamp = recorder.latest_ns
                progress(max(0.0, (stamp - TRAJECTORY_START_NS) / (end - TRAJECTORY_START_NS)))
                if stamp > newest:
                    newest, deadline = stamp, now + self.patience
                if now > deadline:
                    raise ProcessError(f"the loop stands still at {newest * 1e-9:.3f} s")
        wall = time.perf_counter() - started
        reached = recorder.latest_ns
        complete = lambda: all(raw_stamp_ns(m[-1]) >= end for m in recorder.raw.values())  # noqa: E731
        self.wait_for("the last sample on every topic", complete)
        samples = recorder.samples(begin, end)
        period = (end - begin) / (len(samples["arm_state"]) - 1)
        return samples, Timing(wall, 1e-9 * (reached - begin), round((reached - begin) / period))

    def _check_fault(self):
        state = self.controller_state()
        if state.supervisor_state == CompositeState.FAULT:
            raise ProcessError(state.rejected_reason, field="the controller is in fault")
