# SPDX-License-Identifier: Apache-2.0
"""Publishes a motion, or writes it to a file: ``ros2 run flexarm_bringup publish_trajectory``."""

import argparse
import json
import math
import sys

import numpy as np

from flexarm_control.motions import shapers
from flexarm_control.trajectory import files, specs
from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.errors import FlexarmError
from flexarm_dynamics.models import model
from flexarm_studies.commands.options import numbers

#: Number of points of the message. Few suffice: quintics between them follow these families exactly or nearly so.
POINTS = {"paper": 101, "quintic": 101}
#: Options that are settings of the families: lists of numbers, and options that are passed on as written.
_LISTS = ("from", "to", "tip", "via", "torque-limit", "velocity-limit")
_PLAIN = ("duration", "smoothness", "shaper", "shape-modes")


def add_arguments(parser):
    """Arguments of the command, without ROS."""
    parser.description = (
        "Publishes a motion on joint_trajectory once, and waits until it is received."
    )
    parser.epilog = "example: flexarm publish quintic --to 1.57 --duration 3"
    add = parser.add_argument
    add("profile", choices=tuple(specs.FAMILIES), help="which motion")
    add("--arm", default="R", help="arm file, for the joint names (default R)")
    add(
        "--from",
        dest="start",
        help="joint angles where the motion starts, comma separated [rad] (default: where the reference is)",
    )
    add("--to", help="joint angles where it ends, comma separated [rad] (default 90 deg)")
    add("--tip", metavar="x,y,z", help="line, arc: where the tip ends [m]")
    add("--via", metavar="x,y,z", help="arc: a point on the way [m]")
    add("--duration", type=float, default=2.0, help="[s] (default 2)")
    add(
        "--smoothness",
        type=int,
        help="smooth, line, arc: derivatives that vanish at the ends, from 2 (default 3)",
    )
    each = "one or one per joint"
    add(
        "--torque-limit",
        help=f"least-exciting: largest slow torque, {each} [N m] (default: the arm file's)",
    )
    add(
        "--velocity-limit",
        help=f"least-exciting: largest speed, {each} [rad/s] (default: the arm file's)",
    )
    add("--shaper", choices=tuple(shapers.SHAPERS), help="shape the motion; it gets longer")
    add(
        "--shape-modes",
        type=int,
        help=f"how many of the lowest modes the shaper is for (default {specs.SHAPE_MODES}, or all there are)",
    )
    add(
        "--points",
        type=int,
        help=f"points of the message (default 101 for paper and quintic, else {specs.POINTS})",
    )
    add(
        "--dry-run",
        action="store_true",
        help="say what the motion is and excites, publish nothing; it starts at zero unless --from is given",
    )
    add(
        "--out",
        metavar="FILE",
        help="write it to a .csv or .yaml file for later, publish nothing; starts as --dry-run does",
    )
    add("--json", action="store_true", help="say it as JSON")
    add("--topic", default="joint_trajectory", help="topic to publish on")
    add(
        "--timeout",
        type=float,
        default=10.0,
        help="longest wait for a controller [s] (default 10)",
    )


def settings_of(options):
    """The settings in the options, in the form that `specs.motion` takes."""
    given = {key: getattr(options, key.replace("-", "_"), None) for key in (*_LISTS, *_PLAIN)}
    given["from"] = options.start
    out = {key: str(given[key]) for key in _PLAIN if given[key] is not None}
    for key in _LISTS:
        if given[key] is not None:
            out[key] = ";".join(map(repr, numbers(f"--{key}", given[key])))
    return out


def profile_of(options, reference, arm=None):
    """The motion that the options describe; it starts at `reference` unless they give a start.

    Parameters
    ----------
    options : Namespace
    reference : sequence of n float
        [rad]
    arm : ArmModel, optional
        Built from the options if it is needed and not given.
    """
    settings = settings_of(options)
    if arm is None and specs.needs_model(options.profile, settings):
        arm = model.build(arm_file.load(options.arm).known)
    return specs.motion(options.profile, settings, arm, list(reference))


def points_of(options):
    """Number of points of the message."""
    return POINTS.get(options.profile, specs.POINTS) if options.points is None else options.points


def prepare(options):
    """Write the motion to a file, describe it and what it excites, or both; without ROS.

    Raises
    ------
    FlexarmError
        If there is no such motion, or it is beyond the arm's limits.
    """
    arm = model.build(arm_file.load(options.arm).known)
    profile = profile_of(options, np.zeros(arm.n_joints), arm)
    trajectory = specs.sampled(profile, arm, points_of(options))
    found = {"profile": options.profile, "duration_s": profile.duration}
    if options.dry_run:
        found |= effects(profile, arm)
        if not options.json:
            print(description(found))
    if options.out:
        files.write(options.out, trajectory)
        found |= {"out": options.out, "points": len(trajectory.times_ns)}
        if not options.json:
            print(f"{options.out}: {found['points']} points, {profile.duration:g} s")
    if options.json:
        print(json.dumps(found, allow_nan=False))


def effects(profile, arm):
    """Peaks of a motion and of its slow torque, and the vibrations that it leaves without fast control; plain data."""
    from flexarm_control.motions import excitation

    excited = excitation.along(arm, profile)
    speed = np.abs(profile.velocity(excited.times)).max(axis=0)
    joints = [
        {
            "name": joint.name,
            "from_rad": float(profile.start[i]),
            "to_rad": float(profile.start[i] + profile.angle[i]),
            "peak_speed_rad_s": float(speed[i]),
            "speed_limit_rad_s": _limit(joint.limits.velocity),
            "peak_slow_torque_Nm": float(excited.peak_torque[i]),
            "torque_limit_Nm": _limit(joint.limits.torque),
        }
        for i, joint in enumerate(arm.arm.joints)
    ]
    if not arm.n_modes:
        return {"joints": joints}
    energies = {"mean": float(excited.transient), "left_at_the_end": float(excited.residual)}
    return {"joints": joints, "vibration_energy_J": energies}


def description(found):
    """The result of `prepare` as text for people."""
    lines = [f"{found['profile']}: {found['duration_s']:.6g} s"]
    for joint in found["joints"]:
        torque, limit = joint["peak_slow_torque_Nm"], joint["torque_limit_Nm"]
        lines.append(
            f"  {joint['name']}: {joint['from_rad']:.4g} to {joint['to_rad']:.4g} rad, at most"
            f" {joint['peak_speed_rad_s']:.4g} rad/s{_of(joint['speed_limit_rad_s'])}, slow torque"
            f" {torque:.4g} N m{_of(limit)}"
        )
        if limit is not None and torque > limit:
            lines[-1] += ": it will be clipped; give it more time"
    if "vibration_energy_J" in found:
        energy = found["vibration_energy_J"]
        lines.append(
            f"  vibration about the quasi-steady state, without fast control: {energy['mean']:.3g} J on"
            f" average, {energy['left_at_the_end']:.3g} J left at the end"
        )
    return "\n".join(lines)


def _limit(value):
    return float(value) if math.isfinite(value) else None


def _of(limit):
    return "" if limit is None else f" of {limit:g}"


def publish(options, ros_args=None):
    """Publish once, with stamp 0 (now), and report whether the controller accepted it.

    With ``--dry-run`` or ``--out`` nothing is published; `prepare` is called instead.

    `ros_args` go to rclpy as they are.

    Raises
    ------
    FlexarmError
        If there is no controller, or it refuses the trajectory.
    """
    if options.dry_run or options.out:
        prepare(options)
        return
    from trajectory_msgs.msg import JointTrajectory

    from flexarm_msgs.msg import CompositeState
    from flexarm_ros.session import Session

    from .running.lockstep import trajectory_message

    arm = arm_file.load(options.arm).known
    names = arm.joint_names
    built = model.build(arm) if specs.needs_model(options.profile, settings_of(options)) else None
    if options.profile not in ("line", "arc"):  # their path depends on where the arm is
        profile_of(options, [0.0] * len(names), built)  # refuse wrong options before waiting
    with Session("publish_trajectory", args=ros_args or (), patience=options.timeout) as session:
        states = session.tap(CompositeState, "controller/state")
        publisher = session.publisher(JointTrajectory, options.topic)
        session.wait_for(
            f"a controller on {publisher.topic_name} and controller/state",
            lambda: states.newest is not None and publisher.get_subscription_count(),
            hint="start simulator, observer and controller, on this ROS_DOMAIN_ID",
        )
        before = states.newest
        profile = profile_of(options, before.reference_position, built)
        message = trajectory_message(names, profile, points_of(options))
        if options.profile == "quintic" and not options.start and not options.shaper:
            # The controller's own quintic to the last point begins at its reference, moving or not.
            message.points = message.points[-1:]
        publisher.publish(message)

        def answered():
            now = states.newest
            del states.messages[:-1]
            refused = now.rejected_reason not in ("", before.rejected_reason)
            return now.accepted_trajectory_id != before.accepted_trajectory_id or refused

        last = f"; it last refused: {before.rejected_reason}" if before.rejected_reason else ""
        session.wait_for(
            "the controller to accept or refuse the trajectory",
            answered,
            hint=f"is it a repeat of the one that is followed?{last}",
        )
        after = states.newest
    if after.accepted_trajectory_id == before.accepted_trajectory_id:
        raise FlexarmError(after.rejected_reason, field="the controller refused the trajectory")
    found = {
        "profile": options.profile,
        "trajectory_id": after.accepted_trajectory_id,
        "points": len(message.points),
        "duration_s": profile.duration,
    }
    text = f"{options.profile}: accepted as trajectory {found['trajectory_id']}, {found['points']} points"
    print(json.dumps(found) if options.json else f"{text}, {profile.duration:g} s")


def main(args=None):
    """Entry point of the executable."""
    words = list(sys.argv[1:] if args is None else args)
    at = words.index("--ros-args") if "--ros-args" in words else len(words)
    parser = argparse.ArgumentParser(
        prog="publish_trajectory",
        description="Publishes a motion on joint_trajectory once.",
        epilog="example: ros2 run flexarm_bringup publish_trajectory paper --arm R",
    )
    add_arguments(parser)
    try:
        publish(parser.parse_args(words[:at]), words[at:])
    except FlexarmError as error:
        print(f"publish_trajectory: {error}", file=sys.stderr)
        sys.exit(1)
    sys.exit(0)


def entry():
    """Entry point of the process."""
    from flexarm_ros.start import leave_after

    leave_after(main)


if __name__ == "__main__":
    entry()
