# SPDX-License-Identifier: Apache-2.0
"""``flexarm check_driver``: listens to a running driver, pushes its arm where that is allowed, says what is wrong."""

import argparse
import json
import math
import time

import numpy as np

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.errors import FlexarmError
from flexarm_dynamics.models import model

from . import moving
from .listening import Tolerances, check_layout, check_listening
from .samples import Finding, Heard, Verdict, samples

#: A jolt forth and back lasts twice this, and so long something is sent that must not be applied [s].
JOLT, REFUSED = 0.15, 0.15
#: A push is tried so often, where too many samples were lost to judge it.
TRIES = 3
#: Wall time that a phase may take, beside its own [s] and as a factor.
PATIENCE, SLOW = 2.0, 5.0


def add_arguments(parser):
    """Declare the command's options."""
    parser.description = (
        "Listens to a running driver (or simulator) and judges what it sends; with "
        "--allow-motion pushes each joint a little and compares with the model of the arm "
        "file. Exit code 1 when a check fails."
    )
    parser.epilog = "example: flexarm check_driver R --rate 200 --allow-motion"
    parser.add_argument("arm", help="arm file: a shipped name or a path")
    parser.add_argument(
        "--allow-motion", action="store_true", help="push each joint a little; stand clear"
    )
    parser.add_argument("--angle", type=_positive, default=0.05, help="how far to push [rad]")
    parser.add_argument("--duration", type=_positive, default=2.0, help="time to listen [s]")
    parser.add_argument("--rate", type=_positive, help="samples per second it ought to have [Hz]")
    defaults = Tolerances()
    for name, unit, text in (
        ("rate_error", "", "relative error of the rate"),
        ("jitter", "periods", "deviation of stamps from their grid"),
        ("age", "s", "age of a stamp when it arrives"),
        ("gain", "", "relative error of the arm's response beside its model"),
        ("torque_timeout", "s", "when the safe action is due"),
    ):
        default = getattr(defaults, name)
        words = f"{text}{f' [{unit}]' if unit else ''} (default {default:g})"
        parser.add_argument(
            "--" + name.replace("_", "-"), type=_positive, default=default, help=words
        )
    parser.add_argument("--namespace", default="", help="namespace of the driver's topics")
    parser.add_argument("--timeout", type=_positive, default=10.0, help="wait for a state [s]")
    parser.add_argument("--json", action="store_true", help="findings as JSON")


def _positive(text):
    value = float(text)
    if not (value > 0.0 and math.isfinite(value)):
        raise argparse.ArgumentTypeError(f"{text}: a finite number above 0 is wanted")
    return value


class Conversation:
    """Hears a driver's states and answers them.

    Parameters
    ----------
    arm : Arm
    namespace : str
    """

    #: Torques of this program; not a controller's, which are drawn.
    CONTROLLER_ID = 0xC4EC

    def __init__(self, arm, namespace=""):
        from flexarm_msgs.msg import ArmState, JointTorque
        from flexarm_ros import qos
        from flexarm_ros.session import Session

        self._arm, self._kind = arm, JointTorque
        # Woken by each state, which is answered at once.
        self.session = Session("check_driver", namespace=namespace, period=0.05)
        self.node = self.session.node
        self.heard, self._answer = [], None
        self._publisher = self.session.publisher(JointTorque, "joint_torque", profile=qos.LINE)
        self.node.create_subscription(ArmState, "arm_state", self._on_state, qos.LINE)

    def _on_state(self, message):
        now = self.node.get_clock().now().nanoseconds
        self.heard.append(Heard(message, time.monotonic(), now))
        if self._answer is not None:
            self._answer(message)

    def listen(self, seconds, answer=None):
        """States of so many seconds of the driver's time; `answer` is called with time and message.

        Wall time ends it where the stamps stand still.
        """
        start, first = len(self.heard), None
        reached = 0.0

        def on_state(message):
            nonlocal first, reached
            stamp = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
            first = stamp if first is None else first
            reached = max(reached, stamp - first)
            if answer is not None and reached < seconds:
                answer(stamp - first, message)

        self._answer = on_state
        self.session.serve(PATIENCE + SLOW * seconds, lambda: reached >= seconds)
        self._answer = None
        return self.heard[start:]

    def send(self, message, torque, **changes):
        """Answer a state with torque (n,) [N m]; `changes` replace fields."""
        fields = {
            "header": message.header,
            "session": message.session,
            "sequence": message.sequence,
            "controller_id": self.CONTROLLER_ID,
            "mode": self._kind.ENABLED,
            "joint_names": list(self._arm.joint_names),
            "torque": [float(u) for u in torque],
        }
        self._publisher.publish(self._kind(**{**fields, **changes}))

    def disable(self, message):
        """Let go of the arm."""
        self.send(message, np.zeros(len(self._arm.joints)), mode=self._kind.DISABLED)

    def alone(self):
        """Whether nobody else sends torque."""
        return self.node.count_publishers(self._publisher.topic_name) == 1

    def driver_listens(self):
        """Whether somebody reads the torque."""
        return self._publisher.get_subscription_count() > 0

    def close(self):
        """Leave the domain."""
        self.session.close()


class Examination:
    """The whole of it: listen, push each joint, stop.

    Parameters
    ----------
    arm_model : ArmModel
    line : Conversation
    tolerances : Tolerances
    """

    def __init__(self, arm_model, line, tolerances):
        self.model, self.arm = arm_model, arm_model.arm
        self.line, self.tolerances = line, tolerances
        self.findings = []

    def listen(self, seconds):
        """Listen only; whether the samples can be read at all."""
        heard = self.line.listen(seconds)
        if len(heard) < 5:
            text = (
                f"{len(heard)} states in {seconds:g} s and more: publish arm_state at a steady rate"
            )
            self.findings.append(Finding("rate", Verdict.FAIL, text))
            return False
        layout = check_layout(self.arm, [h.message for h in heard])
        self.findings += layout
        if any(f.verdict == Verdict.FAIL for f in layout):
            return False
        self.samples = samples(self.arm, heard)
        self.findings += check_listening(self.model, self.samples, self.tolerances)
        return True

    def move(self, angle):
        """Push every joint; then see what the driver does without torque and with wrong ones.

        `angle` is about how far a push leads [rad].

        Raises
        ------
        FlexarmError
            When somebody else sends torque.
        """
        if np.ptp(self.samples.position, axis=0).max() > 0.1 * angle:
            text = "the arm moves before it is pushed: bring it to rest where its brakes hold it, try again"
            self.findings.append(Finding("response", Verdict.FAIL, text))
            return
        # Now, and not at the start: others have to be discovered first.
        if not self.line.alone():
            raise FlexarmError("a controller sends joint_torque: stop it before the arm is pushed")
        for joint in range(len(self.arm.joints)):
            if joint:
                self._rest()
            push = self._push(joint, angle)
        if not self._failed("response", "torque reported"):
            self._stop(push)

    def _failed(self, *checks):
        return any(f.check in checks and f.verdict == Verdict.FAIL for f in self.findings)

    def _push(self, joint, angle):
        for _ in range(TRIES):
            push, found, sent = self._pushed(joint, angle)
            if found.size >= 10 and not moving.unseen(push, found):
                break
            self._rest()
        self.findings += moving.check_push(self.model, push, found, sent, self.tolerances)
        return push

    def _pushed(self, joint, angle):
        """Push a joint once: the push, the samples of it, and the torque sent."""
        position = np.array(self._samples(self.line.listen(0.05)).position[-1])
        push = moving.plan(self.model, position, joint, angle)
        sequences, torques = [], []

        def answer(at, message):
            torque = push.torque(at)
            self.line.send(message, torque)
            sequences.append(message.sequence)
            torques.append(torque)

        heard = self.line.listen(push.duration, answer)
        found = self._samples(heard)
        self.line.disable(heard[-1].message)
        return push, found, moving.sent_torque(found, sequences, torques)

    def _stop(self, push):
        """Break off a jolt, then send what is to be refused."""
        last = []

        def answer(at, message):
            torque = push.jolt(at, JOLT)
            self.line.send(message, torque)
            last[:] = message.sequence, torque

        heard = self.line.listen(2.0 * JOLT, answer)
        heard += self.line.listen(5.0 * self.tolerances.torque_timeout + 0.2)
        self.findings.append(
            moving.check_stop(self._samples(heard), *last, push.joint, self.tolerances)
        )
        back = math.ceil(4.0 * self.tolerances.torque_timeout / max(self.samples.period, 1e-4))
        for kind, changes in {
            "DISABLED": lambda m: {"mode": 0},
            "wrong session": lambda m: {"session": (m.session + 1) % 2**32},
            "old sequence": lambda m: {"sequence": (m.sequence - back) % 2**32},
        }.items():
            torque = push.jolt(0.0, JOLT)
            heard = self.line.listen(
                REFUSED, lambda _, m, c=changes, u=torque: self.line.send(m, u, **c(m))
            )
            found = self._samples(heard)
            self.findings.append(moving.check_refused(kind, found, torque, push.joint))
        self.line.disable(heard[-1].message)

    def _rest(self):
        """Under the safe action, until the bending has died away or a while has passed."""
        for _ in range(10):
            last = self._samples(self.line.listen(0.3))
            if np.ptp(last.position, axis=0).max() < 1e-4:
                return

    def _samples(self, heard):
        if not heard:
            raise FlexarmError("the driver has stopped publishing arm_state")
        return samples(self.arm, heard)


def merged(findings):
    """One finding for each check: the worst, in the order of their first."""
    rank = [Verdict.SKIPPED, Verdict.PASS, Verdict.WARN, Verdict.FAIL]
    out = {}
    for f in findings:
        if f.check not in out or rank.index(f.verdict) > rank.index(out[f.check].verdict):
            out[f.check] = f
    return list(out.values())


def check_driver(options):
    """Run the checks, print them; exit code 1 when one fails.

    Raises
    ------
    FlexarmError
        When there is no driver, or a controller runs where motion is asked for.
    """
    arm_model = model.build(arm_file.load(options.arm))
    names = Tolerances.__dataclass_fields__
    tolerances = Tolerances(**{name: getattr(options, name) for name in names})
    line = Conversation(arm_model.arm, options.namespace)
    try:
        line.session.wait_for(
            "arm_state",
            lambda: line.heard,
            options.timeout,
            "start the driver, on this ROS_DOMAIN_ID",
        )
        if options.allow_motion:
            line.session.wait_for(
                "a reader of joint_torque",
                line.driver_listens,
                options.timeout,
                "the driver has to subscribe to it",
            )
            if not line.alone():
                raise FlexarmError(
                    "a controller sends joint_torque: stop it before the arm is pushed"
                )
        examination = Examination(arm_model, line, tolerances)
        if examination.listen(options.duration) and options.allow_motion:
            examination.move(options.angle)
    finally:
        if options.allow_motion and line.heard:
            line.disable(line.heard[-1].message)
        line.close()
    return report(merged(examination.findings), options.json)


def report(findings, as_json=False):
    """Print findings; the exit code."""
    failed = sum(f.verdict == Verdict.FAIL for f in findings)
    if as_json:
        print(json.dumps([{**f._asdict(), "verdict": f.verdict.value} for f in findings], indent=1))
    else:
        width = max(len(f.check) for f in findings)
        for f in findings:
            print(f"{f.verdict.value:7}  {f.check:{width}}  {f.text}")
        print(f"{failed} of {len(findings)} checks failed" if failed else "the driver passes")
    return 1 if failed else 0
