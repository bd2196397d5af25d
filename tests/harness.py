# SPDX-License-Identifier: Apache-2.0
"""A bench for the nodes: processes on a DDS domain of their own, and what a user's programs do beside them.

Nothing here sleeps: every wait is `Session.wait_for`, which ends when its condition holds, fails at once when a process
has died, and fails after a bounded time with what it waited for and the end of the nodes' logs.
"""

import contextlib
import os
import re
import time
from pathlib import Path

import numpy as np
import preloaded
from builtin_interfaces.msg import Duration
from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.srv import GetParameters, SetParameters, SetParametersAtomically
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from flexarm_dynamics.parameters import check_all
from flexarm_msgs.msg import ArmState, CompositeState, JointTorque, ObserverState
from flexarm_ros.messages import SECOND, StateWriter, set_stamp, stamp_ns
from flexarm_ros.session import Session, WaitError, parameter_messages, plain
from flexarm_sim import simulator
from flexarm_tools.running.processes import NODES, Processes, arguments, executable, own_domain

SHM = Path("/dev/shm")
#: Of a controller that a loaded machine may hold up for seconds; in real time, too.
PATIENT = {"state_timeout": 60.0, "max_gap": 60.0}
#: Number of each transition, and the state it leads to.
TRANSITIONS = {
    "configure": (Transition.TRANSITION_CONFIGURE, "inactive"),
    "activate": (Transition.TRANSITION_ACTIVATE, "active"),
    "deactivate": (Transition.TRANSITION_DEACTIVATE, "inactive"),
    "cleanup": (Transition.TRANSITION_CLEANUP, "unconfigured"),
}


def answers(tap, session, sequence):
    """The messages of a tap that belong to one sample."""
    return [m for m in tap.messages if (m.session, m.sequence) == (session, sequence)]


class Nodes:
    """Nodes as tests use them, whether they are processes or not; `start`, `call` and `tap` are the subclass's."""

    def start_loop(self, simulator=None, observer=None, controller=None, **common):
        """Start the three nodes."""
        for name, own in (
            ("simulator", simulator),
            ("observer", observer),
            ("controller", controller),
        ):
            self.start(name, {**common, **(own or {})})

    def diagnostics(self, name):
        """What a node says on /diagnostics, newest last."""
        arrays = self.tap(DiagnosticArray, "/diagnostics").messages
        return [s for a in arrays for s in a.status if s.name == name]

    def set(self, node, **values):
        """Set parameters one by one; dots as double underscores. The results, in order."""
        return self.call(
            SetParameters, f"{node}/set_parameters", parameters=_messages(values)
        ).results

    def set_atomically(self, node, **values):
        """Set parameters all or none; the result."""
        name = f"{node}/set_parameters_atomically"
        return self.call(SetParametersAtomically, name, parameters=_messages(values)).result

    def get(self, node, name):
        """Value of a parameter, arrays as lists; None where there is no such parameter."""
        answer = self.call(GetParameters, f"{node}/get_parameters", names=[name])
        if not answer.values:
            return None
        return plain(answer.values[0])

    def change(self, node, transition):
        """Call a lifecycle transition; whether the node is where it leads."""
        number, goal = TRANSITIONS[transition]
        self.call(ChangeState, f"{node}/change_state", transition=Transition(id=number))
        return self.lifecycle(node) == goal

    def lifecycle(self, node):
        """Label of a node's lifecycle state."""
        return self.call(GetState, f"{node}/get_state").current_state.label


class Bench(Nodes, Session):
    """Processes, and a session of this process beside them.

    Parameters
    ----------
    directory : Path
        For log files.
    """

    #: Timeout of one wait [s]; generous, so that a loaded machine fails no test.
    PATIENCE = float(os.environ.get("FLEXARM_TEST_PATIENCE", "60"))

    def __init__(self, directory):
        self._stack = contextlib.ExitStack()
        self.domain = self._stack.enter_context(own_domain())
        self.processes = self._stack.enter_context(Processes(self.domain, directory))
        super().__init__(
            "bench",
            domain=self.domain,
            processes=self.processes,
            patience=self.PATIENCE,
            period=0.002,
        )
        self._killed = set()

    # Processes -------------------------------------------------------------------------------

    def start(self, name, parameters=None, *, key=None, file=None, remaps=()):
        """Start a node as its installed executable does, by `preloaded`; `key` names its log and process."""
        command = [executable(NODES[name], name), *arguments(parameters, file, remaps)]
        return self.processes.start(key or name, command, preloaded.start)

    def log(self, key):
        """What a process has printed."""
        return self.processes.log(key)

    def check(self):
        """Fail if a process has ended unexpectedly."""
        self.processes.check()

    def kill(self, key):
        """End a process as kill -9 does, and note what it leaves in shared memory."""
        process = self.processes.running.pop(key)
        self._killed |= segments(process.pid)
        process.kill()
        process.wait()

    def end_of(self, key, patience=None):
        """Wait until a process has ended by itself; its exit code."""
        process = self.processes.expect_end(key)
        self.wait_for(f"{key} to end", lambda: process.poll() is not None, patience)
        del self.processes.running[key]
        return process.returncode

    def stop(self, key, number):
        """Signal one process and wait for its end; its exit code."""
        self.processes.expect_end(key).send_signal(number)
        return self.end_of(key)

    # Topics ----------------------------------------------------------------------------------

    def publisher(self, kind, topic, readers=1):
        """A publisher (reliable, volatile, as ``ros2 topic pub``) that `readers` have discovered."""
        return super().publisher(kind, topic, readers)

    # End -------------------------------------------------------------------------------------

    def close(self):
        """Leave the graph and end all processes; remove what killed ones left behind.

        In this order: a process that has to be killed may hold a lock in shared memory, for which the middleware of
        this one would wait for ever.
        """
        super().close()
        self.processes.stop()
        self._stack.close()
        for path in abandoned(self._killed):
            path.unlink(missing_ok=True)


def _messages(values):
    return parameter_messages({name.replace("__", "."): v for name, v in values.items()})


class Arm:
    """Topics and services of one arm, in one namespace.

    Parameters
    ----------
    bench : Bench
    namespace : str
        With a slash at its end, or empty.
    joints : sequence of str
    pauses_at : int, optional
        The sample at which the simulator pauses by itself.

    Attributes
    ----------
    trajectories : str
        Topic of the controller's trajectories.
    """

    #: Type of the service ~/reset.
    reset_kind = Trigger

    def __init__(self, bench, namespace="", joints=("joint1",), pauses_at=None):
        self.bench, self.namespace, self.joints = bench, namespace, list(joints)
        self.pauses_at, self.trajectories = pauses_at, f"{namespace}joint_trajectory"
        self.measured = bench.tap(ArmState, f"{namespace}arm_state")
        self.estimated = bench.tap(ArmState, f"{namespace}arm_state_estimate")
        self.torques = bench.tap(JointTorque, f"{namespace}joint_torque")
        self.states = bench.tap(CompositeState, f"{namespace}controller/state")
        self.observer_states = bench.tap(ObserverState, f"{namespace}observer/state")

    @property
    def state(self):
        """The newest controller/state; an empty one before the first."""
        return self.states.newest or CompositeState()

    @property
    def now(self):
        """Stamp of the newest controller/state [ns]."""
        return stamp_ns(self.state.header.stamp)

    def ready(self):
        """Whether the controller sends torque."""
        return self.state.supervisor_state not in (CompositeState.INACTIVE, CompositeState.FAULT)

    def _confirmed(self):
        return self.measured.newest and self.measured.newest.controller_id

    def wait_ready(self):
        """Until the driver applies the controller's torque, and every topic of the line has been found."""
        self.bench.wait_for("the controller to be ready", self.ready)
        self.bench.wait_for("the driver to apply the controller's torque", self._confirmed)
        line = (self.measured, self.estimated, self.torques)
        self.bench.wait_for("something on every topic", lambda: all(t.messages for t in line))

    def wait_until(self, stamp):
        """Until the loop has come to a stamp [ns]."""
        self.bench.wait_for(f"the loop to come to {stamp * 1e-9:.3f} s", lambda: self.now >= stamp)

    def pause(self, paused):
        """Call the simulator's ~/pause."""
        answer = self.bench.call(SetBool, f"{self.namespace}simulator/pause", data=paused)
        assert answer.success, answer.message

    def stand(self):
        """Pause, and wait until the last sample before it has been answered; its stamp [ns]."""
        answer = self.bench.call(SetBool, f"{self.namespace}simulator/pause", data=True)
        assert answer.success, answer.message
        return self.wait_standing(int(answer.message.split()[-1]))

    def run(self, seconds):
        """Run on for exactly so long, then stand; the samples of the session by stamp [ns]."""
        end = self.now + round(seconds * 1e9)
        node = f"{self.namespace}simulator"
        before = self.bench.get(node, "pause_at")
        at = 1e-9 * (end - simulator.Simulator.START_NS)
        assert self.bench.set(node, pause_at=at)[0].successful
        self.pause(False)
        self.wait_until(end)
        self.stand()
        assert self.now == end, (self.now, end)
        # Where it pauses after a reset.
        assert self.bench.set(node, pause_at=before)[0].successful
        return self.samples()

    def wait_standing(self, sequence=None, session=None):
        """Until the loop stands, ready, at a sample (`pauses_at`) of a session (any); its stamp [ns]."""
        sequence = self.pauses_at if sequence is None else sequence

        def stands():
            state = self.state
            return state.sequence == sequence and session in (None, state.session) and self.ready()

        self.bench.wait_for(f"the loop to stand at sample {sequence}", stands)
        return self.now

    def reset(self):
        """Reset the simulator and recover, if need be, until the controller answers in the new session; its number."""
        answer = self.bench.call(Trigger, f"{self.namespace}simulator/reset")
        assert answer.success, answer.message
        session = int(answer.message.split()[-1])
        self.bench.wait_for("the new session", lambda: self.state.session == session)
        self.recover()
        self.wait_standing(session=session)
        return session

    def recover(self):
        """Call ~/recover; whether there was a fault."""
        return self.bench.call(Trigger, f"{self.namespace}controller/recover").success

    def wait_applied(self, measured=None):
        """Wait until the driver has applied the torque for a while: a motion that begins before that may be given up.

        `measured` is the tap of the driver's states, if their topic is not arm_state.
        """
        tap = self.measured if measured is None else measured

        def applied():  # The newest state that came may still be one of a driver that was killed.
            newest = tap.newest
            return newest and newest.controller_id and newest.session == self.state.session

        self.bench.wait_for("the driver to apply the torque", applied)
        seen = len(self.torques.messages)
        self.bench.wait_for(
            "the controller to know", lambda: len(self.torques.messages) > seen + 20
        )

    def publish_trajectory(self, message):
        """Publish a trajectory, once."""
        self.bench.publisher(JointTrajectory, self.trajectories).publish(message)

    def offer(self, message):
        """Publish a trajectory, once a second, until it is accepted; its number.

        As ``ros2 topic pub`` does: the first one may be lost on a controller that has just started.
        """
        before = self.state.accepted_trajectory_id
        again = 0.0

        def accepted():
            nonlocal again
            if self.state.accepted_trajectory_id > before:
                return True
            if time.monotonic() > again:
                again = time.monotonic() + 1.0
                self.publish_trajectory(message)
            return False

        try:
            self.bench.wait_for("the trajectory to be accepted", accepted)
        except WaitError as error:
            raise AssertionError(f"refused: {self.state.rejected_reason}\n{error}") from None
        return self.state.accepted_trajectory_id

    def refused(self, message):
        """Publish a trajectory and wait until its refusal is shown; the reason."""
        before = self.state.rejected_reason
        self.publish_trajectory(message)
        self.bench.wait_for(
            "a new refusal in controller/state",
            lambda: self.state.rejected_reason not in ("", before),
        )
        return self.state.rejected_reason

    def samples(self, session=None):
        """controller/state by stamp [ns], what was sent again once; of one session."""
        session = self.state.session if session is None else session
        return {stamp_ns(m.header.stamp): m for m in self.states.messages if m.session == session}


def trajectory(joints, *points, stamp=0):
    """A trajectory; each point is (time [s], positions, velocities, accelerations)."""
    message = JointTrajectory(joint_names=list(joints))
    set_stamp(message.header.stamp, stamp)
    for at, *fields in points:
        sec, nanosec = divmod(round(at * 1e9), SECOND)
        names = ("positions", "velocities", "accelerations", "effort")
        filled = dict(zip(names, fields, strict=False))
        at = Duration(sec=sec, nanosec=nanosec)
        message.points.append(JointTrajectoryPoint(time_from_start=at, **filled))
    return message


class Source:
    """A driver of one's own: a simulated arm in this process, which publishes `arm_state`.

    Parameters
    ----------
    bench : Bench
    arm : str
    settings : mapping
        Of `flexarm_sim.simulator.PARAMETERS`.
    """

    def __init__(self, bench, arm="R", **settings):
        self.bench = bench
        self.sim = self.simulator(arm, **settings)
        self.session, self.sequence = int.from_bytes(os.urandom(4), "little"), 0
        self._publisher = bench.publisher(ArmState, "arm_state")
        self.torques = bench.tap(JointTorque, "joint_torque")
        self.states = bench.tap(CompositeState, "controller/state")

    @staticmethod
    def simulator(arm, **settings):
        """A `flexarm_sim.simulator.Simulator` of this process."""
        values = {"arm": arm, **settings}
        return simulator.Simulator(check_all(simulator.PARAMETERS, values, {"joints": 1}))

    def recover(self):
        """Call the controller's ~/recover; whether there was a fault."""
        return self.bench.call(Trigger, "controller/recover").success

    def restart(self):
        """A new session from rest, its first state answered, without a fault."""
        self.begin_session()
        self.step()
        self.recover()

    def begin_session(self):
        """A new session from rest."""
        self.sim.reset()
        self.session, self.sequence = (self.session + 1) % 2**32, 0

    def state(self, **changes):
        """The present sample as a message; `changes` replace fields."""
        writer, sim = StateWriter(self.sim.arm), self.sim
        writer.head(sim.stamp_ns, self.session, sim.sequence)
        writer.write("joint_position", sim.position)
        writer.write("joint_velocity", sim.velocity)
        writer.write("joint_torque", sim.torque)
        writer.write("strain", sim.strain)
        writer.write("modal_amplitude", sim.amplitude)
        for field, value in changes.items():
            setattr(writer.message, field, value)
        return writer.message

    def exchange(self, message):
        """Publish a state and wait for the torque that answers it, and its controller/state."""
        key = (message.session, message.sequence)
        seen, reported = len(self.torques.messages), len(self.states.messages)

        def of(messages):
            return [m for m in messages if (m.session, m.sequence) == key]

        again = 0.0

        def answered():
            nonlocal again
            if of(self.torques.messages[seen:]) and of(self.states.messages[reported:]):
                return True
            if (
                time.monotonic() > again
            ):  # as the simulator does: a node may not have been found yet
                again = time.monotonic() + 0.5
                self._publisher.publish(message)
            return False

        self.bench.wait_for(f"a torque that answers state {message.sequence}", answered)
        return of(self.torques.messages[seen:])[-1], of(self.states.messages[reported:])[-1]

    def step(self, **changes):
        """Exchange the present sample, and advance by the answer; a change may be a function of this."""
        now = {k: v(self) if callable(v) else v for k, v in changes.items()}
        torque, state = self.exchange(self.state(**now))
        enabled = torque.mode == JointTorque.ENABLED
        self.sim.advance(np.array(torque.torque) if enabled else None)
        return torque, state

    def until_enabled(self, most=30, **changes):
        """Step until the torque is enabled; the last answer."""
        for _ in range(most):
            torque, state = self.step(**changes)
            if torque.mode == JointTorque.ENABLED:
                return torque, state
        raise AssertionError(f"not enabled after {most} samples: {state.rejected_reason}")


class Drive:
    """Answers the simulator's states with torques, as a controller does."""

    def __init__(self, bench, namespace=""):
        self.bench, self.namespace = bench, namespace
        self.states = bench.tap(ArmState, f"{namespace}arm_state")
        self._publisher = bench.publisher(JointTorque, f"{namespace}joint_torque")
        bench.wait_for("a state", lambda: self.states.newest)
        self.first()

    def first(self):
        """The present state."""
        seen = len(self.states.messages)
        self.bench.wait_for("the state again", lambda: len(self.states.messages) > seen)
        self.state = self.states.newest
        return self.state

    def reset(self):
        """Reset the simulator and take the first state of its new session."""
        answer = self.bench.call(Trigger, f"{self.namespace}simulator/reset")
        assert answer.success, answer.message
        session = int(answer.message.split()[-1])
        self.bench.wait_for("the session", lambda: self.states.newest.session == session)
        self.state = self.states.newest
        assert self.state.sequence == 0

    def send(self, **fields):
        """Publish a torque, whatever it is."""
        self._publisher.publish(JointTorque(**{"controller_id": 1, **fields}))

    def claim(self, **changes):
        """Answer one state with DISABLED, so that the next one names this controller."""
        return self.step(0.0, mode=JointTorque.DISABLED, **changes)

    def step(self, torque, /, **changes):
        """Answer the state; the next one."""
        fields = {
            "session": self.state.session,
            "sequence": self.state.sequence,
            "mode": JointTorque.ENABLED,
            "joint_names": ["joint1"],
            "torque": [torque],
        }
        self.send(**{**fields, **changes})
        wanted = self.state.sequence + 1
        self.bench.wait_for(f"state {wanted}", lambda: self.states.newest.sequence == wanted)
        self.state = self.states.newest
        return self.state


# Shared memory -------------------------------------------------------------------------------


def segments(pid):
    """Files of FastDDS in shared memory that a process has open."""
    found = set()
    with contextlib.suppress(OSError):
        for line in Path(f"/proc/{pid}/maps").read_text().splitlines():
            match = re.search(r"(/dev/shm/\S*fastrtps\S*)", line)
            if match:
                found.add(Path(match[1]))
        for link in Path(f"/proc/{pid}/fd").iterdir():
            with contextlib.suppress(OSError):
                target = os.readlink(link)
                if target.startswith("/dev/shm/") and "fastrtps" in target:
                    found.add(Path(target))
    return found


#: FastDDS gives these ports to all processes of the machine, whatever their domain: not one node's to leave.
SHARED_PORTS = tuple(f"fastrtps_port{number}" for number in range(7000, 7400))


def abandoned(paths):
    """Those of `paths` that still exist and that no living process has open."""
    paths = {p for p in paths if p.exists() and not p.name.startswith(SHARED_PORTS)}
    for entry in Path("/proc").iterdir():
        if paths and entry.name.isdigit():
            paths -= segments(entry.name)
    return paths
