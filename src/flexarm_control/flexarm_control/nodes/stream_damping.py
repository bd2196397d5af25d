# SPDX-License-Identifier: Apache-2.0
"""Damping by strain in the shaper's stream: readings of one gauge in, a correction of one joint's positions out."""

from rclpy.qos import qos_profile_sensor_data
from std_msgs.msg import Float64MultiArray

from flexarm_dynamics.errors import ParameterError
from flexarm_dynamics.parameters import parameter
from flexarm_ros import qos

from ..shaping import strain_damping

PARAMETERS = (
    parameter("joint", "", read_only=True).described(
        "Joint whose streamed positions are corrected to damp a mode that strain shows; empty: no damping."
    ),
    parameter("gauge", 0, "-", 0, 1000, read_only=True).described(
        "Which of the readings in strain sees the mode, counted from 0."
    ),
    *strain_damping.PARAMETERS,
)


class StreamDamping:
    """Holds the newest reading until the next position is sent.

    Parameters
    ----------
    node : ArmNode
    names : list of str
        Joints of the stream.
    settings : mapping
        Checked values of `PARAMETERS`.
    period : float
        Of the stream [s].

    Attributes
    ----------
    law : StrainDamping

    Raises
    ------
    ParameterError
        Where the joint is not one of the stream's.
    DesignError
        As `StrainDamping`.
    """

    def __init__(self, node, names, settings, period):
        if settings["joint"] not in names:
            hint = f"one of {', '.join(names)}"
            field, value = "damping.joint", settings["joint"]
            raise ParameterError("is no joint of the stream", field=field, value=value, hint=hint)
        self.law = strain_damping.StrainDamping(settings, period)
        self._node, self._joint = node, names.index(settings["joint"])
        self._gauge, self._reading = settings["gauge"], None
        node.make_subscription(
            Float64MultiArray,
            "strain",
            self._on_strain,
            qos_profile_sensor_data,
            qos_overriding_options=qos.overridable(),
        )

    def _on_strain(self, msg):
        if len(msg.data) <= self._gauge:
            self._node.report(f"strain: no reading {self._gauge}, which is damping.gauge: ignored")
            return
        self._reading = msg.data[self._gauge]

    def corrected(self, positions, now):
        """Positions (n,) [rad] with the correction of a time `now` [s]; call once in each period."""
        reading, self._reading = self._reading, None
        out = positions.copy()
        out[self._joint] += self.law.update(now, reading)
        return out
