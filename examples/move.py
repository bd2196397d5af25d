# SPDX-License-Identifier: Apache-2.0
"""Moves an arm and draws what its joints and its tip did: ``. tools/env.sh && python examples/move.py [ARM]``.

It joins the nodes that run, or starts those of a simulated arm (R, if none is named).
"""

import sys

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

from flexarm_tools.arm import Arm

name = sys.argv[1] if len(sys.argv) > 1 else "R"
with Arm(name) as arm, arm.recording() as run:
    arrival = arm.move(0.5)
print(f"at rest after {arrival.seconds:.2f} s: the tip swings by {1e3 * arrival.tip_swing:.2g} mm")

record = run.record
figure, (joints, bending) = plt.subplots(2, sharex=True, layout="constrained")
joints.plot(record.time, record.position, label=arm.model.joint_names)
joints.plot(record.time, record.reference, "k--", linewidth=1)
joints.set_ylabel("joint position [rad]\nreference dashed")
joints.legend()
bending.plot(record.time, record.amplitude, label=arm.model.mode_names)
bending.legend()
bending.set(xlabel="time [s]", ylabel="modal amplitudes [m, rad]")
figure.savefig("move.png")
print("move.png")
