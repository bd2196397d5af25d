# SPDX-License-Identifier: Apache-2.0
"""Damping in the shaper's stream: readings of a gauge or an IMU in, a correction of one joint's values out."""

from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Imu
from std_msgs.msg import Float64MultiArray

from flexarm_dynamics.errors import ParameterError
from flexarm_dynamics.parameters import parameter
from flexarm_ros import qos
from flexarm_ros.messages import stamp_ns

from ..shaping import strain_damping

PARAMETERS = (
    parameter("joint", "", read_only=True).described(
        "Joint whose streamed values are corrected to damp a mode that a sensor shows; empty: no damping."
    ),
    parameter("sensor", "strain", choices=("strain", "imu"), read_only=True).described(
        "Sensor that shows the mode: a reading in the topic strain, or an acceleration in the topic imu [m/s^2]."
    ),
    parameter("axis", "y", choices=("x", "y", "z"), read_only=True).described(
        "Axis of the IMU along which the mode moves it."
    ),
    parameter("gauge", 0, "-", 0, 1000, read_only=True).described(
        "Index of the reading in strain that shows the mode, counted from 0."
    ),
    *strain_damping.PARAMETERS,
)
#: Minimum full scale of an accelerometer [m/s^2].
MIN_SCALE = 1.0


class StreamDamping:
    """Holds the newest reading until the next position or velocity is sent.

    Parameters
    ----------
    node : ArmNode
    names : list of str
        Joints of the stream.
    settings : mapping
        Checked values of `PARAMETERS`.
    period : float
        Period of the stream [s].
    velocities : bool
        Whether the stream has velocities.

    Attributes
    ----------
    law : StrainDamping

    Raises
    ------
    ParameterError
        If the joint is not one of the stream's.
    DesignError
        As `StrainDamping`.
    """

    def __init__(self, node, names, settings, period, velocities):
        if settings["joint"] not in names:
            hint = f"one of {', '.join(names)}"
            field, value = "damping.joint", settings["joint"]
            raise ParameterError("is no joint of the stream", field=field, value=value, hint=hint)
        self.law = strain_damping.StrainDamping(settings, period)
        self._velocities = velocities
        self._node, self._joint = node, names.index(settings["joint"])
        self._gauge, self._reading = settings["gauge"], None
        self._stamp, self._axis = None, settings["axis"]
        imu = settings["sensor"] == "imu"
        if imu and settings["full_scale"] < MIN_SCALE:
            raise ParameterError(
                "m/s^2 is less than an accelerometer's",
                field="damping.full_scale",
                value=settings["full_scale"],
                limit=f"at least {MIN_SCALE:g}",
                hint="give the sensor's; at rest it shows gravity",
            )
        node.make_subscription(
            Imu if imu else Float64MultiArray,
            "imu" if imu else "strain",
            self._on_imu if imu else self._on_strain,
            qos_profile_sensor_data,
            qos_overriding_options=qos.overridable(),
        )

    def _on_imu(self, msg):
        self._reading = getattr(msg.linear_acceleration, self._axis)
        # A stamp of another clock says nothing about now, and 0 is no stamp.
        stamp = stamp_ns(msg.header.stamp)
        own = self._node.parameters["synchronised_clocks"] and stamp
        self._stamp = 1e-9 * stamp if own else None

    def _on_strain(self, msg):
        if len(msg.data) <= self._gauge:
            self._node.report(f"strain: no reading {self._gauge}, which is damping.gauge: ignored")
            return
        self._reading = msg.data[self._gauge]

    def corrected(self, values, now):
        """Positions [rad] or velocities [rad/s] (n,) with the correction at a time `now` [s]; call once a period."""
        reading, self._reading = self._reading, None
        out, correction = values.copy(), self.law.update(now, reading, self._stamp)
        out[self._joint] += self.law.rate if self._velocities else correction
        return out
