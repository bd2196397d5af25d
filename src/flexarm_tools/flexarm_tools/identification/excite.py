# SPDX-License-Identifier: Apache-2.0
"""``flexarm excite``: shakes a running arm with the node `excite` and records a bag of it."""

import json
import os
import signal
import subprocess
import tempfile

from flexarm_control.motions import excitation_run
from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.errors import FlexarmError
from flexarm_studies.commands.options import new_path
from flexarm_studies.progress import Progress

from .live import PATIENCE, START_DRIVER

#: Timeout for the next state; after this time the arm counts as lost [s].
SILENCE = 10.0
#: This process's node.
RECORDER = "excite_recorder"


def add_arguments(parser):
    """Arguments of ``excite``: the node's parameters, and where the bag goes."""
    parser.description = (
        "Runs the node `excite` on a running driver or simulator; records while its torque "
        "is applied."
    )
    parser.epilog = (
        "example: flexarm excite my_arm.yaml --kind sweep --amplitude 2 --out results/sweep "
        "--allow-motion"
    )
    add = parser.add_argument
    add("arm", metavar="ARM", help="arm file: a shipped name or a path")
    add("--out", required=True, metavar="BAG", help="directory of the bag, a new one")
    add("--allow-motion", action="store_true", help="stand clear: the arm will move")
    for p in excitation_run.PARAMETERS:
        unit = f" [{p.unit}]" if p.unit != "-" else ""
        default = f" (default {p.default:g})" if p.kind == "float" else ""
        add(
            "--" + p.name.replace("_", "-"),
            type=float if p.kind == "float" else str,
            choices=p.choices or None,
            default=p.default,
            help=f"{p.description}{unit}{default}".replace("%", "%%"),
        )
    add("--namespace", default="", help="of the arm's topics")
    add("--json", action="store_true", help="say what was recorded as JSON")


def excite(options):
    """Run ``excite``; return the bag's path.

    Raises
    ------
    FlexarmError
        If the arm must not move, no driver answers, or the excitation was stopped; what came before is kept.
    """
    from rclpy.serialization import deserialize_message

    from flexarm_msgs.msg import JointTorque
    from flexarm_ros.messages import stamp_ns
    from flexarm_ros.session import Session

    from ..recording.recorder import Recorder, write_bag

    if not options.allow_motion:
        raise FlexarmError("this moves the arm", hint="stand clear, and give --allow-motion")
    out = new_path(options.out, "--out")
    out.parent.mkdir(parents=True, exist_ok=True)
    arm_file.load(options.arm)  # refuse it here, and not in another process's log
    with Session(RECORDER, namespace=options.namespace) as session:
        recorder = Recorder(session, ("arm_state", "joint_torque"))
        session.wait_for("arm_state", lambda: recorder.raw["arm_state"], PATIENCE, START_DRIVER)
        if session.taps["joint_torque"].publishers():
            raise FlexarmError("a controller sends joint_torque", hint="stop it")
        progress = Progress()
        progress.step(f"shake {options.arm}")
        output = _run(options, session)
        progress.done()
        torques = [deserialize_message(raw, JointTorque) for raw in recorder.raw["joint_torque"]]
        enabled = [stamp_ns(m.header.stamp) for m in torques if m.mode == m.ENABLED]
        if not enabled:
            raise FlexarmError(f"no torque was sent:\n{output}")
        # Before and after these the safe action moves the arm, and no message contains its torque.
        kept = recorder.between(min(enabled), max(enabled))
    write_bag(out, kept, options.arm)
    count = len(kept["arm_state"])
    recorded = {"out": str(out), "states": count}
    print(json.dumps(recorded) if options.json else f"{count} states in {out}")
    if "excitation complete" not in output:
        hint = f"what came before is in {out}"
        raise FlexarmError(_ending(output) or output, field="excite", hint=hint)
    return out


def node_parameters(options):
    """Parameters of the node, from the options; name to value."""
    from ..recording.recorder import KEPT

    # The driver, and this recorder, which must get every torque even if the machine is busy.
    values = {"arm": str(arm_file.find(options.arm)), "readers": 2, "recorder": RECORDER}
    topic = "/".join(("", options.namespace.strip("/"), "joint_torque")).replace("//", "/")
    values |= {f"qos_overrides.{topic}.publisher.depth": KEPT}
    values |= {p.name: getattr(options, p.name) for p in excitation_run.PARAMETERS}
    return {k: v for k, v in values.items() if v != ""}


def _run(options, session):
    """Run the node until it reports its end; return its output."""
    from ..running.processes import arguments, executable

    values = node_parameters(options)
    remaps = [f"__ns:=/{options.namespace.strip('/')}"] if options.namespace.strip("/") else []
    command = [executable("flexarm_control", "excite"), *arguments(values, None, remaps)]
    with tempfile.TemporaryFile() as log:
        process = subprocess.Popen(
            command, stdout=log, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL,
            env={**os.environ, "RCUTILS_LOGGING_USE_STDOUT": "0"},
        )  # fmt: skip

        def output():
            return os.pread(log.fileno(), 1_000_000, 0).decode(errors="replace")

        def ended():
            return (
                process.poll() is not None or "excitation complete" in output() or _ending(output())
            )

        states = session.taps["arm_state"].messages
        try:
            while not ended():
                seen = len(states)
                if not session.serve(SILENCE, lambda seen=seen: len(states) > seen or ended()):
                    problem = f"none came for {SILENCE:g} s\n{output()}"
                    raise FlexarmError(problem, field="arm_state")
            session.poll()
        finally:
            process.send_signal(signal.SIGINT)
            try:
                process.wait(5.0)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        return output()


def _ending(output):
    """The line that gives the reason why it was stopped."""
    lines = [x for x in output.splitlines() if "excitation stopped" in x or "not configured" in x]
    return lines[0].split("]: ")[-1] if lines else ""
