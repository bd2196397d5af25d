# SPDX-License-Identifier: Apache-2.0
"""``flexarm check_driver``: tests a running driver, by listening and, if allowed, by pushing its arm."""

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
from .samples import Finding, Received, Verdict, samples

#: Half the duration of a jolt forward and backward; duration for which torques that must be refused are sent [s].
JOLT, REFUSED = 0.15, 0.15
#: Time for which states are answered with DISABLED before a push, so that they name this program [s].
CLAIM = 0.05
#: Attempts at a push, when too many samples were lost to judge it.
TRIES = 3
#: Wall time that a phase may take beyond its own duration: an addition [s], and a factor.
PATIENCE, SLOW = 2.0, 5.0


def add_arguments(parser):
    """Declare the command's options."""
    parser.description = (
        "Tests a running driver (or simulator): checks what it publishes; with --allow-motion "
        "also pushes each joint a little and compares its motion with the model of the arm "
        "file. Exit code 1 when a check fails."
    )
    parser.epilog = "example: flexarm check_driver R --rate 200 --allow-motion"
    add = parser.add_argument
    add("arm", help="arm file: a shipped name or a path")
    add("--allow-motion", action="store_true", help="push each joint a little; stand clear")
    add("--angle", type=_positive, default=0.05, help="how far to push [rad]")
    add("--duration", type=_positive, default=2.0, help="time to listen [s]")
    add("--rate", type=_positive, help="expected samples per second [Hz]")
    defaults = Tolerances()
    for name, unit, text in (
        ("rate_error", "", "relative error of the rate"),
        ("jitter", "periods", "deviation of stamps from their grid"),
        ("age", "s", "age of a stamp when it arrives"),
        ("gain", "", "relative error of the arm's response against its model"),
        ("torque_timeout", "s", "time within which the safe action must follow"),
    ):
        default = getattr(defaults, name)
        words = f"{text}{f' [{unit}]' if unit else ''} (default {default:g})"
        add("--" + name.replace("_", "-"), type=_positive, default=default, help=words)
    add("--namespace", default="", help="namespace of the driver's topics")
    add("--timeout", type=_positive, default=10.0, help="longest wait for a state [s]")
    add("--json", action="store_true", help="findings as JSON")


def _positive(text):
    value = float(text)
    if not (value > 0.0 and math.isfinite(value)):
        raise argparse.ArgumentTypeError(f"{text}: must be a finite number above 0")
    return value


class Conversation:
    """Receives a driver's states and answers them."""

    #: Id of this program; those of controllers are random.
    CONTROLLER_ID = 0xC4EC

    def __init__(self, arm, namespace=""):
        from flexarm_msgs.msg import ArmState, JointTorque
        from flexarm_ros import qos
        from flexarm_ros.session import Session

        self._arm, self._kind = arm, JointTorque
        # Woken by each state, which is answered at once.
        self.session = Session("check_driver", namespace=namespace, period=0.05)
        self.node = self.session.node
        self.received, self._answer = [], None
        self._publisher = self.session.publisher(
            JointTorque, "joint_torque", profile=qos.CONTROL_PATH
        )
        self.node.create_subscription(ArmState, "arm_state", self._on_state, qos.CONTROL_PATH)

    def _on_state(self, message):
        now = self.node.get_clock().now().nanoseconds
        self.received.append(Received(message, time.monotonic(), now))
        if self._answer is not None:
            self._answer(message)

    def listen(self, seconds, answer=None):
        """Return the states of `seconds` of the driver's time; call `answer` with the time and message of each.

        If the stamps stand still, wall time ends it.
        """
        start, first = len(self.received), None
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
        return self.received[start:]

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
        """Send DISABLED, so that the arm takes its safe action."""
        self.send(message, np.zeros(len(self._arm.joints)), mode=self._kind.DISABLED)

    def claim(self):
        """Answer states with DISABLED for a while, so the driver expects torque from here; return the states."""
        return self.listen(CLAIM, lambda _, message: self.disable(message))

    def alone(self):
        """Whether this program is the only one that publishes torque."""
        return self.node.count_publishers(self._publisher.topic_name) == 1

    def driver_listens(self):
        """Whether a driver subscribes to the torque."""
        return self._publisher.get_subscription_count() > 0

    def close(self):
        """Leave the domain."""
        self.session.close()


def not_alone():
    """The error for a controller that runs while the arm is to be pushed."""
    hint = "stop it before the arm is pushed"
    return FlexarmError("a controller sends it", field="joint_torque", hint=hint)


class Examination:
    """All checks of a driver, through a `Conversation` with it: listen, push each joint, stop."""

    def __init__(self, arm_model, driver, tolerances):
        self.model, self.arm = arm_model, arm_model.arm
        self.driver, self.tolerances = driver, tolerances
        self.findings = []

    def listen(self, seconds):
        """Check the samples without moving; return whether they can be read at all."""
        received = self.driver.listen(seconds)
        if len(received) < 5:
            text = f"{len(received)} states in at least {seconds:g} s: publish arm_state at a steady rate"
            self.findings.append(Finding("rate", Verdict.FAIL, text))
            return False
        layout = check_layout(self.arm, [h.message for h in received])
        self.findings += layout
        if any(f.verdict == Verdict.FAIL for f in layout):
            return False
        self.samples = samples(self.arm, received)
        self.findings += check_listening(self.model, self.samples, self.tolerances)
        return True

    def move(self, angle):
        """Push every joint by about `angle` [rad]; then check the driver without torque and with wrong torques.

        Raises
        ------
        FlexarmError
            When another controller sends torque.
        """
        if np.ptp(self.samples.position, axis=0).max() > 0.1 * angle:
            text = "the arm moves before it is pushed: bring it to rest where its brakes hold it, and try again"
            self.findings.append(Finding("response", Verdict.FAIL, text))
            return
        # Not at the start: other publishers have to be discovered first.
        if not self.driver.alone():
            raise not_alone()
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
        """Push a joint once; return the push, its samples and the sent torque."""
        position = np.array(self._samples(self.driver.claim()).position[-1])
        push = moving.plan(self.model, position, joint, angle)
        sequences, torques = [], []

        def answer(at, message):
            torque = push.torque(at)
            self.driver.send(message, torque)
            sequences.append(message.sequence)
            torques.append(torque)

        received = self.driver.listen(push.duration, answer)
        found = self._samples(received)
        self.driver.disable(received[-1].message)
        return push, found, moving.sent_torque(found, sequences, torques)

    def _stop(self, push):
        """Stop the torque in the middle of a jolt; then send torques that must be refused."""
        last = []

        def answer(at, message):
            torque = push.jolt(at, JOLT)
            self.driver.send(message, torque)
            last[:] = message.sequence, torque

        self.driver.claim()
        received = self.driver.listen(2.0 * JOLT, answer)
        received += self.driver.listen(5.0 * self.tolerances.torque_timeout + 0.2)
        self.findings.append(
            moving.check_stop(self._samples(received), *last, push.joint, self.tolerances)
        )
        back = math.ceil(4.0 * self.tolerances.torque_timeout / max(self.samples.period, 1e-4))
        for kind, changes in {
            "DISABLED": lambda m: {"mode": 0},
            "wrong session": lambda m: {"session": (m.session + 1) % 2**32},
            "old sequence": lambda m: {"sequence": (m.sequence - back) % 2**32},
        }.items():
            torque = push.jolt(0.0, JOLT)
            received = self.driver.listen(
                REFUSED, lambda _, m, c=changes, u=torque: self.driver.send(m, u, **c(m))
            )
            found = self._samples(received)
            self.findings.append(moving.check_refused(kind, found, torque, push.joint))
        self.driver.disable(received[-1].message)

    def _rest(self):
        """Wait under the safe action until the bending has decayed, at most 3 s."""
        for _ in range(10):
            last = self._samples(self.driver.listen(0.3))
            if np.ptp(last.position, axis=0).max() < 1e-4:
                return

    def _samples(self, received):
        if not received:
            raise FlexarmError("is no longer published by the driver", field="arm_state")
        return samples(self.arm, received)


def merged(findings):
    """The worst finding of each check, in the order of the first finding of each check."""
    rank = [Verdict.SKIPPED, Verdict.PASS, Verdict.WARN, Verdict.FAIL]
    out = {}
    for f in findings:
        if f.check not in out or rank.index(f.verdict) > rank.index(out[f.check].verdict):
            out[f.check] = f
    return list(out.values())


def check_driver(options):
    """Run the checks and print them; return the exit code, 1 when one fails.

    Raises
    ------
    FlexarmError
        When there is no driver, or when the arm is to be pushed while a controller runs.
    """
    arm_model = model.build(arm_file.load(options.arm).known)
    names = Tolerances.__dataclass_fields__
    tolerances = Tolerances(**{name: getattr(options, name) for name in names})
    driver = Conversation(arm_model.arm, options.namespace)
    try:
        driver.session.wait_for(
            "arm_state",
            lambda: driver.received,
            options.timeout,
            "start the driver, on this ROS_DOMAIN_ID",
        )
        if options.allow_motion:
            driver.session.wait_for(
                "a subscriber of joint_torque",
                driver.driver_listens,
                options.timeout,
                "the driver has to subscribe to it",
            )
            if not driver.alone():
                raise not_alone()
        examination = Examination(arm_model, driver, tolerances)
        if examination.listen(options.duration) and options.allow_motion:
            examination.move(options.angle)
    finally:
        if options.allow_motion and driver.received:
            driver.disable(driver.received[-1].message)
        driver.close()
    return report(merged(examination.findings), options.json)


def report(findings, as_json=False):
    """Print findings and return the exit code."""
    failed = sum(f.verdict == Verdict.FAIL for f in findings)
    if as_json:
        print(json.dumps([{**f._asdict(), "verdict": f.verdict.value} for f in findings], indent=1))
    else:
        width = max(len(f.check) for f in findings)
        for f in findings:
            print(f"{f.verdict.value:7}  {f.check:{width}}  {f.text}")
        print(f"{failed} of {len(findings)} checks failed" if failed else "the driver passes")
    return 1 if failed else 0
