# SPDX-License-Identifier: Apache-2.0
"""A random walk through the nodes' life: transitions, services, parameters and motions in any order, right and wrong.

Simulator, observer and controller are in this process, joined by a queue (`tests/in_process.py`), in lockstep. Between
two steps of the walk they exchange some messages. No exception may be raised, every request must be answered, a wrong
request must change nothing, and the torque must satisfy its invariants. At the end all nodes are activated again, and a
motion must reach its goal.
"""

import random
import sys
from collections import Counter
from pathlib import Path

import numpy as np
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from std_srvs.srv import SetBool, Trigger

from flexarm_dynamics.arm import arm_file
from flexarm_msgs.msg import ArmState, CompositeState, JointTorque

from .invariants import Invariants
from .run import CHANGES

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

import harness
import in_process

NODES = ("simulator", "observer", "controller")
#: State to its possible transitions and their target states. Shutdown is left out, because nothing can follow it.
POSSIBLE = {
    "unconfigured": {1: "inactive"},
    "inactive": {2: "unconfigured", 3: "active"},
    "active": {4: "inactive"},
}
#: More changes of parameters: (node, values).
OTHERS = (
    ("observer", {"observer__cutoff": 300.0}),
    ("observer", {"observer__cutoff": -1.0}),
    ("observer", {"observer__type": "no_such_observer"}),
    ("simulator", {"initial_position": [0.1]}),
    ("simulator", {"rate": 500.0}),
    ("controller", {"torque_limit": [5.0]}),
    ("controller", {"torque_limit": [0.0]}),
    ("controller", {"tracking_error_limit": 0.3}),
    ("controller", {"stop_deceleration": [2.0]}),
    ("controller", {"stop_deceleration": [0.0]}),
    ("controller", {"arm": "two_link"}),
)
#: Services: (name, type, fields of the request).
SERVICES = (
    ("controller/stop", Trigger, {}),
    ("controller/recover", Trigger, {}),
    ("controller/recover", Trigger, {}),
    ("controller/enable_fast", SetBool, {"data": False}),
    ("controller/enable_fast", SetBool, {"data": True}),
    ("observer/calibrate_gauges", Trigger, {}),
    ("simulator/reset", Trigger, {}),
    ("simulator/pause", SetBool, {"data": True}),
    ("simulator/pause", SetBool, {"data": False}),
)
#: Largest change of torque between samples, and largest first torque after none, as fractions of the limit [-].
KICKS = {"between torques": 0.02, "after none": 0.03}
#: How often each kind of step is taken, out of 100.
WEIGHTS = {"transition": 25, "wrong transition": 15, "service": 15, "parameters": 15, "motion": 30}


class Walk:
    """The three nodes on a queue, and what happens to them.

    Parameters
    ----------
    seed : int
    arm : str

    Attributes
    ----------
    counts : Counter
        Steps taken, by kind; refusals.
    steps : dict of str to float
        Largest change of the torque between two consecutive answers with torque, and largest first torque after none,
        as fractions of the limit.
    """

    def __init__(self, seed, arm="R"):
        self.random, self.counts = random.Random(seed), Counter()
        self.bench = bench = in_process.InProcess()
        self.description = arm_file.load(arm)
        self.joints = self.description.joint_names
        self.limit = self.description.torque_limits
        self.invariants = Invariants(self.limit, np.full(len(self.joints), np.inf))
        self.steps, self._last = dict.fromkeys(KICKS, 0.0), None
        simulator = {"lockstep": True, "pause_at": -1.0, "resend_period": 0.02}
        bench.start_loop(arm=arm, simulator=simulator)
        # With this timer the queue always has an event, even while no node is configured.
        bench.queue.add_timer(0.01, lambda: None)
        self.state = {name: "active" for name in NODES}
        self.taps = {
            bench.tap(ArmState, "arm_state_estimate"): self.invariants.estimate,
            bench.tap(JointTorque, "joint_torque"): self._torque,
            bench.tap(CompositeState, "controller/state"): self.invariants.state,
        }
        self.controller = bench.tap(CompositeState, "controller/state")

    def _torque(self, message):
        """Judge a torque, and note how much it differs from the one before."""
        self.invariants.torque(message)
        torque, key = np.array(message.torque), (message.session, message.sequence)
        if message.mode != JointTorque.ENABLED:
            self._last = None
            return
        follows = self._last is not None and self._last[0] == (key[0], key[1] - 1)
        again = self._last is not None and self._last[0] == key
        if not again:
            kind = "between torques" if follows else "after none"
            before = self._last[1] if follows else np.zeros_like(torque)
            step = float((np.abs(torque - before) / self.limit).max())
            self.steps[kind] = max(self.steps[kind], step)
            self.invariants._demand(
                step <= KICKS[kind], f"no kick {kind}", f"{step:.3g}, state {key}"
            )
        self._last = key, torque

    def serve(self, messages):
        """Deliver some messages, and judge what the nodes have published."""
        for _ in range(messages):
            self.bench.queue.serve()
        for tap, take in self.taps.items():
            for message in tap.messages:
                take(message)
            del tap.messages[:-1]
            if tap is not self.controller:
                tap.messages.clear()

    # Steps -------------------------------------------------------------------------------------

    def step(self):
        """Take one step of the walk, then go on for a while."""
        kind = self.random.choices(list(WEIGHTS), WEIGHTS.values())[0]
        self.counts[kind] += 1
        getattr(self, kind.replace(" ", "_"))()
        self.serve(self.random.choice((1, 5, 50, 300)))

    def transition(self):
        """Ask for a possible transition; those towards active are more frequent than those away from it."""
        away = [name for name in NODES if self.state[name] != "active"]
        back = bool(away) and self.random.random() < 0.8
        name = self.random.choice(away if back else NODES)
        here = self.state[name]
        number = max(POSSIBLE[here]) if back else self.random.choice(list(POSSIBLE[here]))
        assert self.change(name, number), f"{name}: transition {number} while {here}"
        self.state[name] = POSSIBLE[here][number]
        assert self.lifecycle(name) == self.state[name]

    def wrong_transition(self):
        """Ask for a transition that is not possible, by number or by name."""
        name = self.random.choice(NODES)
        here = self.state[name]
        if self.random.random() < 0.3:
            assert not self.change(name, 0, self.random.choice(("fly", "create", "configure ")))
        else:
            shutdown = {"unconfigured": 5, "inactive": 6, "active": 7}[here]
            wrong = set(range(256)) - set(POSSIBLE[here]) - {shutdown}
            number = self.random.choice(
                [n for n in wrong if n < 10] + [self.random.choice(sorted(wrong))]
            )
            assert not self.change(name, number), f"{name}: {number} while {here}"
        assert self.lifecycle(name) == here

    def change(self, name, number, label=""):
        """Ask for a transition; return whether it succeeded."""
        wanted = Transition(id=number, label=label)
        return self.bench.call(ChangeState, f"{name}/change_state", transition=wanted).success

    def lifecycle(self, name):
        """Label of the node's state."""
        return self.bench.call(GetState, f"{name}/get_state").current_state.label

    def service(self):
        """Call a service, if its node offers it now."""
        name, kind, fields = self.random.choice(SERVICES)
        if self.state[name.split("/")[0]] != "unconfigured":
            answer = self.bench.call(kind, name, **fields)
            self.counts["services refused"] += not answer.success

    def parameters(self):
        """Set parameters, good ones and bad ones."""
        changes = [("controller", values) for values in CHANGES]
        name, values = self.random.choice((*changes, *OTHERS))
        results = self.bench.set(name, **values)
        assert all(r.successful or r.reason for r in results)
        self.counts["parameters refused"] += sum(not r.successful for r in results)

    def motion(self):
        """Publish a motion that the torque limit allows, if the controller reads it.

        A motion that needs more torque makes the torque change as fast as its budget allows, which would hide a kick.
        """
        if self.state["controller"] != "unconfigured":
            goal, time = self.random.uniform(-0.8, 0.8), self.random.uniform(2.0, 4.0)
            n = len(self.joints)
            point = (time, [goal] * n, [0.0] * n, [0.0] * n)
            publisher = self.bench.publisher(harness.JointTrajectory, "joint_trajectory")
            publisher.publish(harness.trajectory(self.joints, point))

    # The end -------------------------------------------------------------------------------------

    def prove(self):
        """Bring all nodes back, and make a motion to its end."""
        for name in NODES:
            for number in {"unconfigured": (1, 3), "inactive": (3,), "active": ()}[
                self.state[name]
            ]:
                assert self.change(name, number)
            self.state[name] = "active"
        arm = harness.Arm(self.bench, joints=self.joints)
        for values in ({"torque_limit": [0.0]}, {"fast__type": "lqr"}, {"slow__kp": [6.25]}):
            assert self.bench.set("controller", **values)[0].successful
        assert self.bench.set("simulator", initial_position=[0.0])[0].successful
        arm.pause(False)
        self.bench.call(SetBool, "controller/enable_fast", data=True)
        self.bench.call(Trigger, "simulator/reset")
        self.serve(100)
        arm.recover()
        arm.wait_ready()
        # With velocity and acceleration: positions alone would demand jumps of velocity.
        n = len(self.joints)
        arm.offer(harness.trajectory(self.joints, (2.0, [0.3] * n, [0.0] * n, [0.0] * n)))
        self.bench.wait_for(
            "a motion to its end",
            lambda: self.serve(50) or arm.state.supervisor_state == CompositeState.HOLDING,
        )
        assert np.abs(np.array(arm.state.position_error)).max() < 0.05

    def close(self):
        """End the nodes."""
        self.bench.close()


def walk(seed, steps, say, arm="R", every=500):
    """Take a number of `steps`; return the lines of a report, and whether all is well."""
    life = Walk(seed, arm)
    try:
        for k in range(steps):
            try:
                life.step()
            except Exception as error:
                raise AssertionError(f"step {k + 1} of seed {seed}: {error}") from error
            if (k + 1) % every == 0:
                say(f"{k + 1} steps, {life.invariants.counts['enabled']} torques, {life.steps}")
        life.prove()
        judge = life.invariants
        lines = [
            f"{name:36}{count}" for name, count in sorted((life.counts + judge.counts).items())
        ]
        lines += [
            f"{'torque ' + name + ' [of its limit]':36}{x:.3g}" for name, x in life.steps.items()
        ]
        lines += [
            f"BROKEN {name}: {n} times; {judge.first[name]}" for name, n in judge.broken.items()
        ]
        return lines, not judge.broken
    finally:
        life.close()
