# SPDX-License-Identifier: Apache-2.0
"""Example driver: counts of the device to SI units and back. **Make it yours**; the base class `Driver` does the rest.

That is: the node's life cycle, `arm_state` and `joint_states`, which torque of `joint_torque` may be applied and for
how long, sessions, diagnostics. Try it with the fake device, then let ``flexarm check_driver`` judge it on the arm.
"""

import numpy as np

from flexarm_dynamics.parameters import parameter
from flexarm_ros import driver
from flexarm_ros.node import run
from flexarm_ros.start import leave

from .device import Device, MeasurementTime


def scale(name, default, unit, length):
    """A read-only parameter with a value for each joint or gauge (`length` says which)."""
    return parameter(name, [default], unit, length=length, read_only=True)


SCALES = (  # A negative one reverses a sign: an encoder mounted the other way, a bridge with its wires exchanged.
    scale("position_per_count", 5.9921124526782858e-06, "rad", "joints").described("Joint angle."),
    scale("encoder_zero", 0.0, "-", "joints").described("Counts where the arm file has its zero."),
    scale("strain_per_count", 1e-9, "-", "gauges").described("Surface strain at the gauge."),
    scale("bridge_zero", 0.0, "-", "gauges").described("Counts of the straight link."),
    scale("torque_per_count", 1e-3, "N m", "joints").described("Joint torque of the drive."),
)
PORT = parameter("port", "/dev/ttyUSB0", read_only=True).described("Serial line of the device.")


class DriverNode(driver.Driver):
    """The four methods that a driver has to write, and `open`."""

    def __init__(self):
        super().__init__("driver", (*driver.PARAMETERS, PORT, *SCALES))

    def open(self):
        self.scale = {s.name: np.array(self.parameters[s.name]) for s in SCALES}
        self.device = Device(self.parameters["port"], len(self.arm.joints), len(self.arm.gauges))
        self.time = MeasurementTime()

    def read(self):
        """Wait for frames of the device; each becomes a `Sample` in SI units, in the arm file's order."""
        for frame in self.device.frames(wait=driver.SILENT):
            arrival = self.get_clock().now().nanoseconds
            s = self.scale
            yield driver.Sample(
                number=frame.number,  # a gap: frames were lost
                stamp_ns=self.time.stamp(1000 * frame.microseconds, arrival),  # of measurement
                position=s["position_per_count"] * (frame.encoder - s["encoder_zero"]),
                torque=s["torque_per_count"] * frame.drive,  # as applied, not as sent
                strain=s["strain_per_count"] * (frame.bridge - s["bridge_zero"]),
            )  # No velocity is measured: the observer finds it.

    def apply(self, torque):
        """Send torque (n,) [N m], which `Driver` has checked and clipped, to the drives."""
        self.device.torque(np.rint(torque / self.scale["torque_per_count"]).astype(int))

    def make_safe(self):
        """Have the device brake, damp or let go: whatever `safe_action` in the arm file says."""
        self.device.safe()

    def close(self):
        self.device.close()

    def details(self):
        """What else `/diagnostics` is to show."""
        return {"frames damaged": self.device.damaged}


def main(args=None):
    """Entry point of ``ros2 run flexarm_driver_template driver``."""
    leave(run(DriverNode, args))


if __name__ == "__main__":
    main()
