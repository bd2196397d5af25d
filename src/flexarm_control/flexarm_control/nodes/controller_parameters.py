# SPDX-License-Identifier: Apache-2.0
"""Declared parameters of the controller node, and which of them belong to the limits and which to the design."""

from flexarm_dynamics.parameters import parameter
from flexarm_ros.node import ARM

from ..composite import assembly
from ..composite.design import PARAMETERS as DESIGN
from ..loop.arm_controller import PARAMETERS as CONTROLLER
from ..loop.arm_controller import START_TOLERANCE
from ..robust import default
from .trajectory_state import STATE_PUBLISH_RATE

STATE_TIMEOUT = parameter("state_timeout", 0.5, "s", 0.01, 3600.0, read_only=True).described(
    "If no state arrives for this long, the torque is disabled; this is a fault."
)
DESIGN_PROCESS = parameter("design_process", True, read_only=True).described(
    "Whether new designs and plans of motions are made in a separate process, which takes memory, rather than in a"
    " thread, which may delay a sample by some milliseconds."
)

#: Names of the parameters that take effect with the next sample.
LIMITS = frozenset(p.name for p in CONTROLLER)
_DESIGN = frozenset(p.name for p in DESIGN)


def groups():
    """Declared parameters of the controller node, by prefix."""
    return {
        "": (
            *(ARM, *CONTROLLER, START_TOLERANCE, STATE_TIMEOUT, STATE_PUBLISH_RATE, DESIGN_PROCESS),
            *(*DESIGN, *default.PARAMETERS),
        ),
        **{f"{name}.": assembly.declarations(name) for name in assembly.CONTROL},
    }


def of_design(values):
    """The flat parameters in `values` that belong to the design."""
    return {k: v for k, v in values.items() if k in _DESIGN or k.split(".")[0] in assembly.CONTROL}


def of_limits(values):
    """The flat parameters in `values` that `ArmController` takes."""
    return {k: v for k, v in values.items() if k in LIMITS}
