# SPDX-License-Identifier: Apache-2.0
"""What the controller node declares, and which of its parameters belong to the limits and which to the design."""

from flexarm_dynamics.parameters import parameter
from flexarm_ros.node import ARM

from ..composite import assembly
from ..composite.design import PARAMETERS as DESIGN
from ..loop.arm_controller import PARAMETERS as CONTROLLER
from ..loop.arm_controller import START_TOLERANCE
from ..robust import default
from .trajectory_state import STATE_PUBLISH_RATE

STATE_TIMEOUT = parameter("state_timeout", 0.5, "s", 0.01, 3600.0, read_only=True).described(
    "Without a state for so long the torque is disabled: a fault."
)
DESIGN_PROCESS = parameter("design_process", True, read_only=True).described(
    "Whether laws are designed anew, and motions planned, in a process of their own, which takes memory, rather than"
    " in a thread, which may hold up a sample for some milliseconds."
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
    """Those of flat parameters that a change of the design is about."""
    return {k: v for k, v in values.items() if k in _DESIGN or k.split(".")[0] in assembly.CONTROL}


def of_limits(values):
    """Those of flat parameters that `ArmController` takes."""
    return {k: v for k, v in values.items() if k in LIMITS}
