"""Quality of service on the line: reliable, volatile, the newest sample only; overridable by parameters."""

from rclpy.qos import QoSDurabilityPolicy, QoSHistoryPolicy, QoSProfile, QoSReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions

LINE = QoSProfile(
    history=QoSHistoryPolicy.KEEP_LAST,
    depth=1,
    reliability=QoSReliabilityPolicy.RELIABLE,
    durability=QoSDurabilityPolicy.VOLATILE,
)

#: For trajectories: none of several sent at once is to be lost.
COMMAND = QoSProfile(
    history=QoSHistoryPolicy.KEEP_LAST,
    depth=10,
    reliability=QoSReliabilityPolicy.RELIABLE,
    durability=QoSDurabilityPolicy.VOLATILE,
)


def overridable():
    """Lets a user change the policies by ``qos_overrides.<topic>.<publisher|subscription>.…``."""
    return QoSOverridingOptions.with_default_policies()
