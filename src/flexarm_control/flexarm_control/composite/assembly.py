# SPDX-License-Identifier: Apache-2.0
"""Builds slow law, fast law, manifold, feed-forward and observer from parameters, for nodes and the loop without ROS.

Parameters are flat, as in ROS (``{"slow.type": "model_following", "slow.kp": [6.25], "rate": 500.0}``); `flat` makes
them from nested ones. Parameters of components that are not chosen are ignored, so one file may hold those of several
laws. A name that no component of the group knows is refused.

Below, `name` is a key of `COMPONENTS`, and `values` are flat parameters. Missing ones have the node's defaults.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

from flexarm_dynamics import registry
from flexarm_dynamics.errors import ParameterError
from flexarm_dynamics.parameters import Parameter, merge, parameter

from ..observers import arm_observer
from .design import FAST, MANIFOLD, PARAMETERS, SLOW, design, typed


class Slot(NamedTuple):
    """A place in the control that one component of a group fills."""

    group: str  # of entry points
    type: Parameter  # the choice, with its default
    common: tuple = ()  # parameters that belong to no single component of the group


#: Slots by the prefix of their parameters.
COMPONENTS = {
    "slow": Slot(
        SLOW,
        parameter("type", "linear_model_following").described(
            "Slow law, by its name in the entry-point group flexarm.slow_laws; none: fast control alone."
        ),
    ),
    "fast": Slot(
        FAST,
        parameter("type", "lqr").described(
            "Fast law, by its name in the entry-point group flexarm.fast_laws; none: slow control alone."
        ),
    ),
    "manifold": Slot(
        MANIFOLD,
        parameter("type", "corrected").described(
            "Slow manifold to which the fast control holds the deflections, by its name in the entry-point group"
            " flexarm.manifolds; quasi_steady: the paper's."
        ),
    ),
    "observer": Slot(
        arm_observer.OBSERVERS,
        parameter("type", "filtered_derivative", read_only=True).described(
            "Observer, by its name in the entry-point group flexarm.observers."
        ),
        arm_observer.PARAMETERS,
    ),
}
#: The slots that the controller consists of.
CONTROL = ("slow", "fast", "manifold")


def flat(values, prefix=""):
    """Flat parameters from nested ones, ``{"slow": {"type": …}}``, or from a mixture; `prefix` before every name."""
    out = {}
    for name, value in values.items():
        if isinstance(value, Mapping):
            out.update(flat(value, f"{prefix}{name}."))
        else:
            out[prefix + name] = value
    return out


def under(values, name):
    """The flat parameters below ``name.``, without that prefix."""
    return {k[len(name) + 1 :]: v for k, v in values.items() if k.startswith(name + ".")}


def declarations(name):
    """Everything that a node declares below ``name.``: the choice, and the parameters of every component."""
    slot = COMPONENTS[name]
    kind = replace(slot.type, choices=registry.names(slot.group))
    return (kind, *slot.common, *_of_all(slot.group))


def _of_all(group):
    return merge(*(component.PARAMETERS for component in registry.importable(group).values()))


def type_of(name, values):
    """Name of the chosen component; a `ParameterError` for a type that is not a string."""
    kind = values.get(f"{name}.type", COMPONENTS[name].type.default)
    if not isinstance(kind, str):
        raise ParameterError("is not a name", field=f"{name}.type", value=kind)
    return kind


def declared(name, values):
    """Parameters of the chosen component, including the common ones of its group, as a tuple of `Parameter`."""
    slot = COMPONENTS[name]
    return (*slot.common, *registry.find(slot.group, type_of(name, values)).PARAMETERS)


def chosen(name, values):
    """The chosen component: ``{"type": …, its parameters}``, without parameters of other components of its group.

    Names that belong to no component of the group are kept, so that the design refuses them.
    """
    given = under(values, name) | {"type": type_of(name, values)}
    own = {p.name for p in declared(name, values)} | {"type"}
    if not set(given) <= own:
        others = {p.name for p in _of_all(COMPONENTS[name].group)} - own
        given = {k: v for k, v in given.items() if k not in others}
    return given


def choices(values):
    """The arguments of `design` except the model, from flat parameters: plain data that can go to another process."""
    of_design = {p.name for p in PARAMETERS}
    parts = {name: chosen(name, values) for name in CONTROL}
    return parts | {"settings": {k: v for k, v in values.items() if k in of_design}}


def control(model, values):
    """The checked `CompositeControl` that parameters describe; raises the errors of `design`."""
    return design(model, **choices(values))


def observer(model, given):
    """The `ArmObserver` that `given`, a result of `chosen`, describes; raises the errors of `arm_observer.observe`."""
    return arm_observer.observe(model, *typed(given, "observer"))
