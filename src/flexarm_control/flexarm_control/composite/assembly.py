# SPDX-License-Identifier: Apache-2.0
"""Slow law, fast law, manifold, feed-forward and observer from parameters, for nodes and for the loop without ROS.

Parameters are flat, as in ROS (``{"slow.type": "model_following", "slow.kp": [6.25], "rate": 500.0}``); `flat` makes
them so from nested ones. Parameters of components that are not chosen are left out: one file may hold those of several
laws. A name that no component of the group knows is refused.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

from flexarm_dynamics import registry
from flexarm_dynamics.errors import ParameterError
from flexarm_dynamics.parameters import Parameter, merge, parameter

from ..observers import arm_observer
from .design import FAST, MANIFOLD, PARAMETERS, SLOW, design, typed


@dataclass(frozen=True)
class Slot:
    """A place in the control that one component of a group fills.

    Attributes
    ----------
    group : str
        Entry-point group.
    type : Parameter
        The choice, with its default.
    common : tuple of Parameter
        Parameters that belong to no single component of the group.
    """

    group: str
    type: Parameter
    common: tuple = ()


def _slot(group, default, description, common=(), read_only=False):
    kind = parameter("type", default, read_only=read_only).described(description)
    return Slot(group, kind, common)


#: By the prefix of their parameters.
COMPONENTS = {
    "slow": _slot(
        SLOW,
        "linear_model_following",
        "Slow law, by its name in the entry-point group flexarm.slow_laws; none: fast control alone.",
    ),
    "fast": _slot(
        FAST,
        "lqr",
        "Fast law, by its name in the entry-point group flexarm.fast_laws; none: slow control alone.",
    ),
    "manifold": _slot(
        MANIFOLD,
        "corrected",
        "Slow manifold that the fast control holds the deflections to, by its name in the entry-point group"
        " flexarm.manifolds; quasi_steady: the paper's.",
    ),
    "observer": _slot(
        arm_observer.OBSERVERS,
        "filtered_derivative",
        "Observer, by its name in the entry-point group flexarm.observers.",
        arm_observer.PARAMETERS,
        read_only=True,
    ),
}
#: Those that the controller is made of.
CONTROL = ("slow", "fast", "manifold")


def flat(values, prefix=""):
    """Flat parameters from nested ones, or from a mixture of both.

    Parameters
    ----------
    values : mapping
        ``{"slow": {"type": …, "kp": …}}`` or ``{"slow.type": …, "slow.kp": …}``.
    prefix : str
        Put before every name.

    Returns
    -------
    dict
    """
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
    """Name of the chosen component; the node's default where `values` make no choice.

    Parameters
    ----------
    name : str
        A key of `COMPONENTS`.
    values : mapping
        Flat parameters.

    Returns
    -------
    str

    Raises
    ------
    ParameterError
        For a type that is not a string.
    """
    kind = values.get(f"{name}.type", COMPONENTS[name].type.default)
    if not isinstance(kind, str):
        raise ParameterError("is not a name", field=f"{name}.type", value=kind)
    return kind


def declared(name, values):
    """Parameters of the chosen component, the common ones of its group among them.

    Parameters and errors as for `type_of`.

    Returns
    -------
    tuple of Parameter
    """
    slot = COMPONENTS[name]
    return (*slot.common, *registry.find(slot.group, type_of(name, values)).PARAMETERS)


def chosen(name, values):
    """The chosen component: ``{"type": …, its parameters}``, without those of the others of its group.

    Names that belong to no component of the group stay: the design refuses them.

    Parameters
    ----------
    name : str
        A key of `COMPONENTS`.
    values : mapping
        Flat parameters.

    Returns
    -------
    dict
    """
    given = under(values, name) | {"type": type_of(name, values)}
    own = {p.name for p in declared(name, values)} | {"type"}
    if not set(given) <= own:
        others = {p.name for p in _of_all(COMPONENTS[name].group)} - own
        given = {k: v for k, v in given.items() if k not in others}
    return given


def choices(values):
    """The arguments of `design` beside the model, from flat parameters: plain data, ready for another process."""
    of_design = {p.name for p in PARAMETERS}
    parts = {name: chosen(name, values) for name in CONTROL}
    return parts | {"settings": {k: v for k, v in values.items() if k in of_design}}


def control(model, values):
    """The composite control that parameters describe, checked.

    Parameters
    ----------
    model : ArmModel
    values : mapping
        Flat parameters; what is missing takes the node's default.

    Returns
    -------
    CompositeControl

    Raises
    ------
    UnknownComponentError, ParameterError, DesignError
    """
    return design(model, **choices(values))


def observer(model, given):
    """The `ArmObserver` that ``{"type": …, parameters}`` describes; see `chosen`.

    Parameters
    ----------
    model : ArmModel
    given : mapping

    Returns
    -------
    ArmObserver

    Raises
    ------
    UnknownComponentError, ParameterError, DesignError, ModelError
    """
    return arm_observer.observe(model, *typed(given, "observer"))
