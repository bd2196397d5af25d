# SPDX-License-Identifier: Apache-2.0
"""Readers of messages: states, torques, and the gate of a driver."""

import copy
from array import array
from types import SimpleNamespace

import numpy as np

from flexarm_control.loop.samples import ArmSample
from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.errors import MessageError
from flexarm_msgs.msg import ArmState, JointTorque
from flexarm_ros.messages import StateReader, TorqueReader, set_stamp, stamp_ns
from flexarm_ros.torque_gate import TorqueGate

from . import odd
from .reader import Reader, demand

#: Names of arrays, and the arrays that they name.
STATE_FIELDS = {
    "joint_names": ("joint_position", "joint_velocity", "joint_torque"),
    "gauge_names": ("strain",),
    "mode_names": ("modal_amplitude", "modal_rate"),
}


def arm_names(arm):
    """Names of an arm by field."""
    return {
        "joint_names": list(arm.joint_names),
        "gauge_names": list(arm.gauge_names),
        "mode_names": list(arm.observed_modes),
    }


def good_state(rng, arm):
    """A state message that can be read, with random values."""
    msg = ArmState()
    for field, given in arm_names(arm).items():
        setattr(msg, field, given)
        for values in STATE_FIELDS[field]:
            setattr(msg, values, array("d", [rng.uniform(-1.0, 1.0) for _ in given]))
    msg.session, msg.sequence = 7, rng.getrandbits(16)
    set_stamp(msg.header.stamp, rng.getrandbits(50))
    return msg


def spoil_state(rng, msg):
    """Change a few fields of a state message, in place."""
    for _ in range(rng.choice((1, 1, 2, 3))):
        kind = rng.randrange(10)
        field = rng.choice(tuple(STATE_FIELDS))
        if kind < 3:
            setattr(msg, field, odd.names(rng, getattr(msg, field)))
        elif kind < 7:
            values = rng.choice(STATE_FIELDS[field])
            setattr(msg, values, odd.floats(rng, getattr(msg, values)))
        elif kind == 7:
            msg.header.stamp.sec = odd.unsigned(rng) - 2**31
            msg.header.stamp.nanosec = odd.unsigned(rng)
        elif kind == 8:
            msg.session = odd.unsigned(rng)
        else:
            msg.sequence = odd.unsigned(rng)
    return msg


def good_torque(rng, arm):
    """A torque message that can be read."""
    joints = list(arm.joint_names)
    msg = JointTorque(joint_names=joints, session=7, sequence=rng.getrandbits(8), controller_id=1)
    msg.mode = JointTorque.ENABLED
    msg.torque = array("d", [rng.uniform(-1.0, 1.0) for _ in joints])
    return msg


def spoil_torque(rng, msg):
    """Change a few fields of a torque message, in place."""
    for _ in range(rng.choice((1, 1, 2))):
        kind = rng.randrange(8)
        if kind < 3:
            msg.torque = odd.floats(rng, msg.torque)
        elif kind < 5:
            msg.joint_names = odd.names(rng, msg.joint_names)
        elif kind == 5:
            msg.mode = rng.choice((0, 1, 2, 255))
        elif kind == 6:
            msg.controller_id = odd.unsigned(rng)
        else:
            msg.session, msg.sequence = odd.unsigned(rng), odd.unsigned(rng)
    return msg


def in_order(names, values, wanted):
    """Values in the arm's order, read by name."""
    return [dict(zip(names, values, strict=True))[name] for name in wanted]


def same(array_, values):
    """Whether values are equal; NaN equals NaN."""
    return np.array_equal(array_, np.asarray(values), equal_nan=True)


class States(Reader):
    """`StateReader`: names in any order, lengths, and all other fields."""

    name, weight, error = "state message", 18.0, MessageError
    words = (
        "header.stamp",
        *STATE_FIELDS,
        *(field for fields in STATE_FIELDS.values() for field in fields),
    )

    def __init__(self):
        self.arm = arm_file.load("two_link")
        self.names = arm_names(self.arm)
        self.reader = StateReader(self.arm)
        self.sample = ArmSample(*(len(v) for v in self.names.values()))

    def make(self, rng):
        return spoil_state(rng, good_state(rng, self.arm))

    def read(self, given):
        self.reader.read(given, self.sample)
        return self.sample

    def check(self, given, result):
        demand(result.stamp_ns == stamp_ns(given.header.stamp), "stamp")
        demand(result.key == (given.session, given.sequence), "session and sequence")
        arrays = {
            "joint_position": result.position,
            "joint_velocity": result.velocity if result.velocity_known else None,
            "joint_torque": result.torque if len(given.joint_torque) else None,
            "strain": result.strain,
            "modal_amplitude": result.amplitude,
            "modal_rate": result.rate,
        }
        for field, fields in STATE_FIELDS.items():
            for name in fields:
                values, got = getattr(given, name), arrays[name]
                if not len(values):
                    demand(got is None and name != "joint_position", f"{name} from nowhere")
                    continue
                wanted = in_order(getattr(given, field), values, self.names[field])
                demand(same(got, wanted), f"{name} is not what was sent")

    def run(self, rng):
        refused = super().run(rng)
        # Whatever came before, the next good message is read correctly.
        good = good_state(rng, self.arm)
        self.check(good, self.read(good))
        return refused


class Torques(Reader):
    """`TorqueReader`: what may move an arm."""

    name, weight, error = "torque message", 18.0, MessageError
    words = ("joint_names", "torque", "mode")

    def __init__(self):
        self.arm = arm_file.load("two_link")
        self.reader = TorqueReader(self.arm)

    def make(self, rng):
        return spoil_torque(rng, good_torque(rng, self.arm))

    def read(self, given):
        return self.reader.read(given)

    def check(self, given, result):
        demand((result is None) == (given.mode == JointTorque.DISABLED), "mode")
        if result is not None:
            demand(np.isfinite(result).all(), f"a torque of {result}")
            wanted = in_order(given.joint_names, given.torque, self.arm.joint_names)
            demand(same(result, wanted), "torque is not what was sent")

    def run(self, rng):
        refused = super().run(rng)
        good = good_torque(rng, self.arm)
        self.check(good, self.read(good))
        return refused


class Gate(Reader):
    """`TorqueGate`: a driver's life with any controllers."""

    name, weight, batch = "torque gate", 6.0, 20
    TIMEOUT = 0.05

    def __init__(self):
        self.arm = arm_file.load("two_link")
        self.limit = np.array([j.limits.torque for j in self.arm.joints])

    def run(self, rng):
        gate, now, refused = TorqueGate(self.arm, self.TIMEOUT), 0.0, 0
        gate.begin(7)
        sequence = rng.choice((0, 5, 2**32 - 5))
        sent = {}  # sequence -> when
        self.given = history = []
        names = {}  # sequence -> the controller that the state names
        accepted = None  # when the state was sent whose torque was accepted
        for _ in range(self.batch):
            now += rng.choice((0.0, 0.001, 0.01, 0.1, 2.0))
            if rng.random() < 0.7:
                sequence = (sequence + rng.choice((1, 1, 1, 2))) % 2**32
                sent[sequence] = now
            if sequence in sent:  # sometimes it is sent again
                names[sequence] = gate.sent(sequence, now)
            msg = good_torque(rng, self.arm)
            msg.sequence = sequence
            if rng.random() < 0.7:
                msg = spoil_torque(rng, msg)
            history.append((now, sequence, SimpleNamespace(**_fields(msg))))
            reason = gate.offer(msg, now)
            demand(isinstance(reason, str), "a verdict that is no text")
            demand(len(reason) <= self.MAX_LENGTH, f"a reason of {len(reason)} characters")
            refused += bool(reason)
            if not reason:
                demand(msg.session == 7 and msg.mode == JointTorque.ENABLED, "let through")
                demand(names[msg.sequence] == msg.controller_id != 0, "a stranger let through")
                accepted = sent[msg.sequence]
            torque = gate.torque(now)
            demand(torque is not None or gate.reason, "the safe action for no reason")
            if torque is not None:
                demand((np.abs(torque) <= self.limit).all(), f"{torque} is beyond {self.limit}")
                fresh = accepted is not None and now - accepted <= self.TIMEOUT
                demand(fresh, "a torque older than the timeout")
        return refused


def _fields(msg):
    """Fields of a message as plain data."""
    return {
        f: copy.copy(getattr(msg, f))
        for f in ("session", "sequence", "mode", "joint_names", "torque")
    }
