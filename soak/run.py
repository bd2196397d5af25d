# SPDX-License-Identifier: Apache-2.0
"""The soak itself: rounds of faults and changes, each followed by a healthy motion that must reach its end."""

import random
import sys
import time
from pathlib import Path

import numpy as np
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter as RosParameter
from std_srvs.srv import Trigger

from flexarm_dynamics.arm import arm_file
from flexarm_msgs.msg import CompositeState
from flexarm_tools.recording.recorder import keep_for_recording

from .invariants import RUNNING, Invariants

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

import harness

LIMIT, RATE = 20.0, 2e4  # [N m], [N m/s]
#: Every kind of fault that the simulator knows, with times and seeds filled in.
FAULTS = (
    "joint_position nan from={t} for=0.05",
    "joint_position huge from={t} for=0.01",
    "joint_velocity inf from={t} for=0.02",
    "joint_torque nan from={t} for=0.2",
    "strain.{gauge} stick from={t} for=0.5",
    "strain.{gauge} nan from={t} for=0.3",
    "strain.{gauge} bias by=1e-5 from={t}",
    "modal_amplitude drop from={t} for=0.1",
    "modal_amplitude long from={t} for=0.01",
    "joint_position short from={t} for=0.01",
    "state drop share=0.2 seed={seed} from={t} for=0.3",
    "state delay by=0.003 from={t} for=0.2",
    "state duplicate from={t} for=0.3",
    "state swap from={t} for=0.1",
    "state future by=0.5 from={t} for=0.1",
    "clock jump by=-0.5 at={t}",
    "names reorder from={t}",
    "names wrong from={t} for=0.02",
)
#: Parameters that may change while the arm moves: good values and bad ones.
CHANGES = (
    {"slow__kp": [6.25]},
    {"slow__kp": [9.0]},
    {"slow__kv": [6.0]},
    {"fast__alpha": 4.0},
    {"fast__alpha": 5.0},
    {"fast__type": "none"},
    {"fast__type": "lqr"},
    {"fast__q": [2.0]},
    {"slow__kp": [float("nan")]},
    {"slow__kp": [-1.0]},
    {"fast__alpha": 1e9},
    {"slow__type": "no_such_law"},
    {"torque_limit": [1.0, 2.0, 3.0]},
)
#: Parameters with which a healthy round starts.
HEALTHY = {
    "slow__kp": [6.25],
    "slow__kv": [5.0],
    "fast__alpha": 5.0,
    "fast__type": "lqr",
    "fast__q": [1.0],
}


def resident(pid):
    """Resident memory of a process [MiB]; 0 if it has ended."""
    try:
        pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    except OSError:
        return 0.0
    return pages * 4096 / 2**20


class Soak:
    """Three nodes in lockstep, with faults, changed parameters and motions.

    Parameters
    ----------
    bench : harness.Bench
    seed : int
        Seed of the motions, parameters and faults, and of their order.
    arm : str
    faults : bool
        Whether the simulator injects faults into its states.
    """

    def __init__(self, bench, seed, arm="R", faults=True):
        self.bench, self.random = bench, random.Random(seed)
        self.description = arm_file.load(arm)
        n = len(self.description.joints)
        self.invariants = Invariants([LIMIT] * n, [RATE] * n)
        self.faults = faults
        self.rounds = self.motions = self.recoveries = self.refusals = 0
        self.seconds = 0.0  # simulated
        self.memory, self.shared = [], []  # per look: {process: MiB}; files in shared memory
        keep = {name: keep_for_recording(name) for name in ("simulator", "observer", "controller")}
        bench.start_loop(
            arm=arm,
            simulator={
                "lockstep": True,
                "pause_at": -1.0,
                "allow_faults": faults,
                **keep["simulator"],
            },
            observer=keep["observer"],
            controller={
                "state_timeout": 60.0,
                "torque_limit": [LIMIT],
                "torque_rate_limit": [RATE],
                **keep["controller"],
            },
        )
        self.pids = {name: p.pid for name, p in bench.processes.running.items()}
        self.arm = harness.Arm(bench, joints=self.description.joint_names)
        # Nothing judges these: on a busy machine they would only keep this process from the others.
        for topic in ("arm_state", "observer/state"):
            bench.untap(topic)
        self.bench.wait_for("the controller to be ready", lambda: self.drain() and self.running())

    # Messages ----------------------------------------------------------------------------------

    def drain(self):
        """Check the messages that have arrived, and keep only the last one of each topic."""
        arm, judge = self.arm, self.invariants
        for tap, take in (
            (arm.estimated, judge.estimate),
            (arm.torques, judge.torque),
            (arm.states, judge.state),
        ):
            new = tap.messages[getattr(tap, "judged", 0) :]
            for msg in new:
                take(msg)
            del tap.messages[:-1]
            tap.judged = len(tap.messages)
        return True

    def wait(self, what, condition):
        """Check messages until a condition holds."""
        return self.bench.wait_for(what, lambda: self.drain() and condition())

    def running(self):
        """Whether the controller sends torque."""
        return self.arm.state.supervisor_state in RUNNING

    # Rounds --------------------------------------------------------------------------------------

    def begin(self, **parameters):
        """Start a new session of the arm, whatever its state, and wait for torque."""
        self.put([])
        for name, value in parameters.items():
            self.bench.set("controller", **{name: value})
        answer = self.bench.call(Trigger, "simulator/reset")
        session = int(answer.message.split()[-1])
        again = [0.0]

        def ready():
            state = self.arm.state
            if state.session == session and state.supervisor_state == CompositeState.FAULT:
                if time.monotonic() > again[0]:
                    again[0] = time.monotonic() + 1.0
                    self.recover()
                return False
            return state.session == session and self.running()

        self.wait(f"torque in session {session}", ready)

    def recover(self):
        """Call the controller's ~/recover."""
        self.recoveries += 1
        self.bench.call(Trigger, "controller/recover")

    def put(self, lines):
        """Set the simulator's faults."""
        if not self.faults:
            return
        # The type is given, because an empty list does not show it.
        value = RosParameter("faults", RosParameter.Type.STRING_ARRAY, lines).to_parameter_msg()
        answer = self.bench.call(SetParameters, "simulator/set_parameters", parameters=[value])
        result = answer.results[0]
        assert result.successful, f"faults {lines} refused: {result.reason}"

    def move(self, to, duration):
        """Publish a motion, which the controller may refuse."""
        n = len(self.description.joints)
        point = (duration, [to] * n, [0.0] * n, [0.0] * n)
        self.arm.publish_trajectory(harness.trajectory(self.description.joint_names, point))

    def trouble(self):
        """One round: a random motion with random parameters and faults."""
        rng, names = self.random, self.description.gauge_names
        self.begin()
        lines = [
            rng.choice(FAULTS).format(
                t=round(rng.uniform(0.2, 1.5), 3), seed=rng.randrange(99), gauge=rng.choice(names)
            )
            for _ in range(rng.randint(0, 3))
        ]
        self.put(lines)
        self.move(rng.uniform(-0.8, 0.8), rng.uniform(0.8, 2.0))
        for change in rng.sample(CHANGES, rng.randint(0, 2)):
            for result in self.bench.set("controller", **change):
                self.refusals += not result.successful
        self.run_for(rng.uniform(0.5, 2.0))
        if rng.random() < 0.3:
            self.bench.call(Trigger, "controller/stop")
        self.run_for(0.3)
        self.rounds += 1

    def run_for(self, seconds):
        """Let the loop run for some seconds of simulated time, counted in samples."""
        first, session = self.arm.state.sequence, self.arm.state.session
        samples = round(1000 * seconds)

        def done():
            state = self.arm.state
            return state.session != session or state.sequence >= first + samples

        self.wait(f"{samples} samples more than {first}", done)
        self.seconds += seconds

    def prove(self):
        """Check that a healthy motion reaches its end."""
        self.begin(**HEALTHY)
        to, before = self.random.uniform(0.2, 0.4), self.arm.state.accepted_trajectory_id
        again = [0.0]

        def arrived():
            state = self.arm.state
            if state.accepted_trajectory_id == before and time.monotonic() > again[0]:
                again[0] = time.monotonic() + 1.0
                self.move(to, 1.0)
            there = np.allclose(state.reference_position, to, atol=1e-9)
            return there and state.supervisor_state == CompositeState.HOLDING

        self.wait(f"a motion to {to:.3f} rad to end", arrived)
        self.run_for(0.2)
        self.motions += 1
        self.seconds += 1.0
        error = np.abs(np.array(self.arm.state.position_error)).max()
        self.invariants._demand(error < 0.05, "a healthy arm follows", f"{error:.3g} rad off")

    # Resources -------------------------------------------------------------------------------------

    def look(self):
        """Record the memory of each process, and the number of files in shared memory."""
        self.memory.append({name: resident(pid) for name, pid in self.pids.items()})
        self.shared.append(len(set().union(*(harness.segments(p) for p in self.pids.values()))))

    def growth(self):
        """Growth from the run's second third to its last: median memory of each process [MiB]; number of files."""
        if len(self.memory) < 6:
            return {}, 0
        third = len(self.memory) // 3
        early, late = self.memory[third : 2 * third], self.memory[2 * third :]

        def median(looks, name):
            return float(np.median([look[name] for look in looks]))

        grown = {name: median(late, name) - median(early, name) for name in self.pids}
        return grown, max(self.shared[2 * third :]) - max(self.shared[third : 2 * third])
