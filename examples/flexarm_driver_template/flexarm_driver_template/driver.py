# SPDX-License-Identifier: Apache-2.0
"""The driver: frames of the device to `arm_state`, `joint_torque` to the device, the safe action when in doubt.

To make it yours: put your line's protocol into `protocol.py`, and the scales of your electronics into a
parameter file (see `config/driver.yaml`). Then ``flexarm check_driver`` says whether the arm understands you.
"""

import os
import threading
import time

import numpy as np

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.parameters import Parameter
from flexarm_msgs.msg import ArmState, JointTorque
from flexarm_ros import qos
from flexarm_ros.messages import StateWriter
from flexarm_ros.node import ARM, ERROR, OK, WARN, ArmNode, run
from flexarm_ros.start import leave
from flexarm_ros.torque_gate import TorqueGate

from .device import Device, DeviceError, MeasurementTime


def _array(name, default, description, unit, length, **limits):
    return Parameter(
        name, "float_array", [default], description, unit, length=length, read_only=True, **limits
    )


PARAMETERS = (
    ARM,
    Parameter("port", "string", "/dev/ttyUSB0", "Serial line of the device.", read_only=True),
    Parameter(
        "torque_timeout",
        "float",
        0.05,
        "A torque that answers a state older than this is too late; the safe action follows.",
        unit="s",
        low=0.001,
        high=1.0,
        read_only=True,
    ),
    # A negative scale turns a sign round: an encoder mounted the other way, a bridge with its wires exchanged.
    _array("position_per_count", 5.9921124526782858e-06, "Joint angle per count.", "rad", "joints"),
    _array("encoder_zero", 0.0, "Counts where the arm file has its zero.", "-", "joints"),
    _array("strain_per_count", 1e-9, "Surface strain per count of the bridge.", "-", "gauges"),
    _array("bridge_zero", 0.0, "Counts of the straight link.", "-", "gauges"),
    _array("torque_per_count", 1e-3, "Joint torque per count of the drive.", "N m", "joints"),
)


class DriverNode(ArmNode):
    """Counts to SI, one message a frame; one line to the device a torque."""

    #: A device that sends nothing for so long is reported [s].
    SILENT = 0.5

    def __init__(self):
        super().__init__("driver", {"": PARAMETERS})

    def build(self):
        self.arm = arm_file.load(self.parameters["arm"])
        joints, gauges = len(self.arm.joints), len(self.arm.gauges)
        self.parameters.resolve({"joints": joints, "gauges": gauges})
        p = {d.name: self.parameters[d.name] for d in PARAMETERS}
        self._scale = {k: np.array(v) for k, v in p.items() if isinstance(v, list)}
        self._gate = TorqueGate(self.arm, p["torque_timeout"])
        self._lock = threading.Lock()  # of the gate: frames come in a thread of their own
        self._writer = StateWriter(self.arm)
        self._device = Device(p["port"], joints, gauges)
        self._time, self._frames, self._before, self._fault = None, 0, 0, ""
        options = qos.overridable()
        self._state_pub = self.make_publisher(
            ArmState, "arm_state", qos.LINE, qos_overriding_options=options
        )
        self.make_line(
            self.make_subscription(
                JointTorque,
                "joint_torque",
                self._on_torque,
                qos.LINE,
                qos_overriding_options=options,
            )
        )
        # Should the frames stop as well, the torque ends all the same.
        self.make_timer(p["torque_timeout"] / 2.0, self._watch)

    def start(self):
        self._thread = threading.Thread(target=self._read, name="device", daemon=True)
        self._reading = True
        self._thread.start()
        self.get_logger().info(f"arm {self.arm.name}, device at {self.parameters['port']}")

    def stop(self):
        self._reading = False
        self._thread.join()
        with self._lock:
            self._gate.begin(self._gate.session)
            self._to_device(None)

    def on_cleanup(self, state):
        self._device.close()
        return super().on_cleanup(state)

    # Device to topic -------------------------------------------------------------------------

    def _read(self):
        """In a thread: publish each frame as it comes."""
        while self._reading:
            try:
                frames = self._device.frames(self.SILENT)
            except DeviceError as error:
                self._fault = str(error)
                return
            self._fault = "" if frames else f"the device sends nothing for {self.SILENT:g} s"
            for frame in frames:
                self._publish(frame)

    def _publish(self, frame):
        if self._time is None or frame.number <= self._number:  # the device, or we, began anew
            self._first, self._time = None, MeasurementTime()
        self._number = frame.number
        stamp = self._time.stamp(1000 * frame.microseconds, self.get_clock().now().nanoseconds)
        if stamp is None:
            return
        if self._first is None:
            self._first = frame.number
            with self._lock:
                self._gate.begin(int.from_bytes(os.urandom(4), "little"))
        sequence = (frame.number - self._first) % 2**32  # frames lost on the line are gaps
        s, writer = self._scale, self._writer
        writer.head(stamp, self._gate.session, sequence)
        position = s["position_per_count"] * (frame.encoder - s["encoder_zero"])
        writer.write("joint_position", position)
        writer.write("joint_velocity", None)  # not measured: the observer filters it
        writer.write("joint_torque", s["torque_per_count"] * frame.drive)
        writer.write("strain", s["strain_per_count"] * (frame.bridge - s["bridge_zero"]))
        writer.write("modal_amplitude", None)  # the observer's business
        with self._lock:
            self._gate.sent(sequence, time.monotonic())
            self._state_pub.publish(writer.message)
        self._frames += 1
        self._watch()

    # Topic to device -------------------------------------------------------------------------

    def _on_torque(self, msg):
        if not self.active:
            return
        now = time.monotonic()
        with self._lock:
            refused = self._gate.offer(msg, now)
            self._to_device(self._gate.torque(now))
        if refused:
            self.report(refused)

    def _watch(self):
        """The torque has become too old: the safe action."""
        if self.active:
            with self._lock:
                if self._gate.torque(time.monotonic()) is None:
                    self._to_device(None)

    def _to_device(self, torque):
        try:
            if torque is None:
                self._device.safe()
            else:
                self._device.torque(np.rint(torque / self._scale["torque_per_count"]).astype(int))
        except DeviceError as error:
            self._fault = str(error)

    def diagnose(self):
        done, self._before = self._frames - self._before, self._frames
        gate = self._gate
        values = {
            "frames per second": done,
            "frames damaged": self._device.damaged,
            "torques refused": gate.refused,
            "torques clipped": gate.clipped,
        }
        if self._fault:
            return ERROR, self._fault, values
        if gate.reason:
            return WARN, f"{gate.reason}: the safe action is applied", values
        return OK, "", values


def main(args=None):
    """Entry point of ``ros2 run flexarm_driver_template driver``."""
    leave(run(DriverNode, args))


if __name__ == "__main__":
    main()
