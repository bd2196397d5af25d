# SPDX-License-Identifier: Apache-2.0
"""``flexarm replay``: publishes a recording as a driver does, until it is over."""

import json

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.errors import FlexarmError
from flexarm_studies.recordings import mapping as mappings


def add_arguments(parser):
    """Arguments of ``replay``."""
    parser.description = (
        "Publishes a bag or CSV file as arm_state, so that observer, view and report run on it as on the arm. The "
        "torque that a controller sends is kept beside what was measured, and never applied."
    )
    parser.epilog = "example: flexarm replay run.csv my_arm.yaml --mapping my_mapping.yaml"
    add = parser.add_argument
    add("recording", metavar="RECORDING", help="a bag's directory, or a CSV file")
    add("arm", metavar="ARM", help="arm file: a shipped name or a path")
    mappings.add_option(parser)
    add("--begin", type=float, default=0.0, help="where to begin, after the first sample [s] (0)")
    add("--duration", type=float, default=0.0, help="how long to play [s] (to the end)")
    add(
        "--lockstep",
        choices=("none", "observer", "controller"),
        default="none",
        help="each sample waits for the observer's estimate, or for the controller's torque; none: real time",
    )
    add(
        "--factor",
        type=float,
        default=1.0,
        help="seconds of the recording per second of wall time (1)",
    )
    add("--namespace", default="", help="of the arm's topics")
    add(
        "--out",
        metavar="FILE.csv",
        help="measured angles and torques, and the torques that were sent",
    )
    add("--json", action="store_true", help="print what was played as JSON")


def replay(options):
    """Run ``replay``; return the exit code.

    Raises
    ------
    FlexarmError
        For a recording, an arm or an option that can't be used.
    """
    from flexarm_ros.node import run

    from ..running.processes import arguments
    from .node import ReplayNode

    arm = arm_file.load(options.arm)  # refuse it here, and not in the node's log
    for name, low in (("begin", 0.0), ("duration", 0.0), ("factor", 1e-3)):
        if not low <= getattr(options, name) <= 1e9:
            value, limit = getattr(options, name), f"at least {low:g}"
            raise FlexarmError("is out of range", field=f"--{name}", value=value, limit=limit)
    values = {
        "arm": str(arm_file.find(options.arm)),
        "recording": str(options.recording),
        "mapping": options.mapping or "",
        "begin": options.begin,
        "duration": options.duration,
        "lockstep": options.lockstep,
        "real_time_factor": options.factor,
    }
    space = options.namespace.strip("/")
    made = []

    def node():
        made.append(ReplayNode())
        return made[0]

    code = run(node, arguments(values, None, [f"__ns:=/{space}"] if space else []))
    playback = made[0].playback if made else None
    if code or playback is None:
        return code or 1
    found = {"recording": str(options.recording), "arm": arm.name} | playback.summary()
    if options.out:
        playback.write(options.out, arm.joint_names)
        found["out"] = str(options.out)
    print(json.dumps(found) if options.json else _text(found))
    return code


def _text(found):
    text = f"{found['played']} of {found['samples']} samples played, {found['answered']} answered with a torque"
    apart = found["sent_less_measured_rms_Nm"]
    if apart is not None:
        text += f"; sent less measured: {', '.join(f'{v:.3g}' for v in apart)} N m rms"
    return text + (f"; {found['out']}" if "out" in found else "")
