# SPDX-License-Identifier: Apache-2.0
"""What a sample takes each node, without the middleware.

``PYTHONPATH=tests:$PYTHONPATH python -m benchmarks.latency.parts``

The shipped nodes run in this process in lockstep, connected by a queue (`tests/in_process.py`), while the arm moves.
The times are medians over the samples. The caches are warm; with ``--cold``, they are filled with other data before
each node's call.
"""

import argparse
import os
import sys
from time import perf_counter

import numpy as np
from in_process import InProcess
from trajectory_msgs.msg import JointTrajectory

from flexarm_control.composite.law import CompositeControl
from flexarm_control.loop.arm_controller import ArmController
from flexarm_control.motions.profiles import quintic
from flexarm_control.nodes.controller import ControllerNode
from flexarm_control.nodes.observer import ObserverNode
from flexarm_control.observers.arm_observer import ArmObserver
from flexarm_dynamics.arm import arm_file
from flexarm_sim.nodes.simulator import SimulatorNode
from flexarm_sim.plant import Plant
from flexarm_studies import markdown
from flexarm_studies.loop import parameter_files
from flexarm_tools.running.lockstep import trajectory_message

from .measure import LONG_REACH, R

#: What is timed: a method, whether it is a whole node's, and its name in the table.
PARTS = (
    (SimulatorNode, "_on_torque", True, "simulator"),
    (Plant, "advance", False, "- integration"),
    (ObserverNode, "_on_state", True, "observer"),
    (ArmObserver, "step", False, "- before the estimate is sent"),
    (ControllerNode, "_on_state", True, "controller"),
    (ArmController, "step", False, "- before the torque is sent"),
    (CompositeControl, "step", False, "- of this the law"),
    (CompositeControl, "look_ahead", False, "- look_ahead, after it"),
)
#: Duration of the motion, of its beginning that is left out, and of the part that is measured [s].
MOTION, BEFORE, MEASURED = 4.0, 0.3, 1.5
#: Data that ``--cold`` updates: more than the caches of one core hold.
OTHERS = np.zeros(1 << 20)


class Stopwatch:
    """Replaces the methods of `PARTS` by versions that record their duration while it is `running`.

    Parameters
    ----------
    cold : bool
    """

    def __init__(self, cold):
        self.times, self.running, self._cold = {name: [] for *_, name in PARTS}, False, cold
        for kind, method, node, name in PARTS:
            setattr(kind, method, self._timed(getattr(kind, method), node, self.times[name]))

    def _timed(self, call, node, times):
        def timed(*args, **kwargs):
            if self.running and node and self._cold:
                np.add(OTHERS, 1.0, out=OTHERS)
            begin = perf_counter()
            result = call(*args, **kwargs)
            if self.running:
                times.append(perf_counter() - begin)
            return result

        return timed


def measure(case, rate, watch):
    """Medians of each part for an arm in motion, by name [us].

    Parameters
    ----------
    case : dict
        As `measure.R`.
    rate : float
        [Hz]
    watch : Stopwatch
    """
    for times in watch.times.values():
        times.clear()
    with InProcess() as bench:
        _move(bench, case, rate, watch)
    return {name: 1e6 * float(np.median(times)) for name, times in watch.times.items()}


def _move(bench, case, rate, watch):
    """Start the nodes, move the arm, and let the watch run meanwhile."""
    given, file = {"arm": case["arm"], "rate": rate}, None
    if case["file"]:
        file = parameter_files.find(case["file"])
    simulated = {"lockstep": True, "pause_at": -1.0, "initial_position": list(case["begin"])}
    sim = bench.start("simulator", {**given, **simulated}, file=file).sim
    bench.start("observer", given, file=file)
    core = bench.start("controller", {**given, "design_process": False}, file=file).core
    bench.wait_for("torque", lambda: sim.time > 1.0 and core.enabled)
    motion = quintic(np.array(case["begin"]), np.array(case["end"]), MOTION)
    message = trajectory_message(arm_file.load(case["arm"]).joint_names, motion)
    bench.publisher(JointTrajectory, "joint_trajectory").publish(message)
    bench.wait_for("the motion", lambda: core.reference.active)
    begin = sim.time + BEFORE
    bench.wait_for("its begin", lambda: sim.time > begin)
    watch.running = True
    bench.wait_for("its samples", lambda: sim.time > begin + MEASURED)
    watch.running = False


def main():
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rate", type=float, default=1000.0, help="[Hz] (default 1000)")
    parser.add_argument("--cold", action="store_true", help="with caches full of other data")
    options = parser.parse_args()
    watch, found = Stopwatch(options.cold), {}
    for case in (R, LONG_REACH):
        found[case["arm"]] = measure(case, options.rate, watch)
    rows = [[name, *(f"{of[name]:.0f}" for of in found.values())] for *_, name in PARTS]
    head = ("processor time of a sample [us]", *found)
    print("\n".join(markdown.table(head, rows)), flush=True)


if __name__ == "__main__":
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    main()
    sys.stdout.flush()
    os._exit(0)  # skip the clean-up of the nodes in this process
