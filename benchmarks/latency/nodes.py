# SPDX-License-Identifier: Apache-2.0
"""The control path's nodes with a stopwatch, as `latency` starts them: ``python -m benchmarks.latency.nodes ROLE …``.

The nodes are the shipped ones. The simulator notes the time of each published state and of each received torque, on the
steady clock of its process. Observer and controller time their one call of mathematics. Each prints its results as a
line of JSON: the simulator at the end of each window, the others at the end of the process.
"""

import json
import sys
from time import perf_counter

from flexarm_control.composite.law import CompositeControl
from flexarm_control.loop.arm_controller import ArmController
from flexarm_control.observers.arm_observer import ArmObserver
from flexarm_msgs.msg import JointTorque
from flexarm_sim.nodes import simulator


class TimedSimulator(simulator.SimulatorNode):
    """The simulator in real time. It runs for each window and is paused between windows."""

    def build(self):
        super().build()
        self._pending, self._latencies, self._latencies_enabled, self._lost_before = {}, [], 0, 0
        self.paused = True

    def publish(self, sample):
        if not self.paused:
            self._pending[sample.number] = perf_counter()
        super().publish(sample)

    def _on_torque(self, raw):
        now = perf_counter()
        msg = self.torques(raw)
        if msg.session == self.gate.session:
            sent = self._pending.pop(msg.sequence, None)
            if sent is not None:
                self._latencies.append(now - sent)
                self._latencies_enabled += msg.mode == JointTorque.ENABLED
        super()._on_torque(msg)

    def pause(self, paused):
        path = self.control_path
        if paused:
            late = sum(wait > path.period for wait in self._latencies) if path else 0
            found = {
                "latencies": self._latencies,
                "enabled": self._latencies_enabled,
                # Samples without a torque when the next period began: late ones and lost ones, except the newest one.
                "missed": late + max(len(self._pending) - 1, 0),
                "lost": path.lost - self._lost_before if path else 0,
            }
            print(json.dumps(found), flush=True)
        self._pending, self._latencies, self._latencies_enabled = {}, [], 0
        self._lost_before = path.lost if path else 0
        return super().pause(paused)


def timed(kind, key):
    """Time `kind.step` for new samples. Returns a function that prints the times as JSON under `key`."""
    step, times, last = kind.step, [], [None]

    def stepping(self, sample, *more, **named):
        begin = perf_counter()
        result = step(self, sample, *more, **named)
        took = perf_counter() - begin
        if sample.key != last[0]:  # a sample that was sent again is answered from the cache
            last[0] = sample.key
            if result:  # a waiting controller or a converging observer does less work
                times.append(took)
        return result

    kind.step = stepping
    return lambda: print(json.dumps({key: times}), flush=True)


def timed_law():
    """Time `CompositeControl.step`, the mathematics of a controller. Returns a function that prints the times."""
    step, times = CompositeControl.step, []

    def stepping(self, *state):
        begin = perf_counter()
        torque = step(self, *state)
        times.append(perf_counter() - begin)
        return torque

    CompositeControl.step = stepping
    return lambda: print(json.dumps({"law": times}), flush=True)


def main():
    """Entry point of one process; its arguments are ROLE, then those of the node."""
    role = sys.argv.pop(1)
    if role == "simulator":
        simulator.SimulatorNode = TimedSimulator
        return simulator.main()
    says = [timed_law(), timed(ArmController, "controller")] if "controller" in role else []
    says += [timed(ArmObserver, "observer")] if "observer" in role else []
    from flexarm_control.nodes import controller, observer, observer_controller

    module = {
        "observer": observer,
        "controller": controller,
        "observer_controller": observer_controller,
    }[role]

    def leave(code, and_then=module.leave):
        for say in says:
            say()
        and_then(code)

    module.leave = leave
    return module.main()


if __name__ == "__main__":
    from flexarm_ros.start import leave_after

    leave_after(main)
