# SPDX-License-Identifier: Apache-2.0
"""The control of an arm if no law is given: a design for that arm, read from the cache or made now.

Each parameter that is given by hand stays as it is. No design is used if a law is given by hand (`LAWS`) or if the arm
is one of the paper's, by its name (`PAPER_ARMS`). Both choose the control as a whole: the parameters' own defaults are
the paper's control, which is made for these arms.
"""

from typing import NamedTuple

from flexarm_dynamics.errors import DesignError, ParameterError
from flexarm_dynamics.parameters import check_all, parameter

from ..composite.design import PARAMETERS as DESIGN
from . import cache
from .card import card
from .design import design
from .gains import observer_parameters
from .settings import Settings, places, sampling_for
from .uncertain import Uncertainty

#: Names of the shipped arms for which the parameters' defaults are made.
PAPER_ARMS = ("R", "P3", "R_lab", "one_link")
#: Parameters that choose the control by hand.
LAWS = ("slow.type", "fast.type")
#: Types that a design uses; the design of a rigid arm has no fast law.
TYPES = {
    "slow.type": "joint_pid",
    "fast.type": "fixed_gain",
    "manifold.type": "reference",
    "observer.type": "filtered_derivative",
}
AUTO, ROBUST, NONE = "auto", "robust", "none"
PREFIX = "design."

RATE = next(p for p in DESIGN if p.name == "rate")


def _factors(name, what):
    return parameter(
        f"{PREFIX}{name}",
        list(getattr(Uncertainty, name)),
        "-",
        1e-3,
        1e3,
        length=2,
        read_only=True,
    ).described(f"Least and greatest factor of {what} that the design holds for.")


#: Parameters of controller and observer, by their full names. Both need the same values.
PARAMETERS = (
    parameter("design.type", AUTO, choices=(AUTO, ROBUST, NONE), read_only=True).described(
        "Where gains come from that are not given. robust: from a design for this arm, as flexarm design makes it;"
        " none: from the parameters' own defaults; auto: from a design, unless slow.type or fast.type is given, or the"
        " arm is R, P3, R_lab or one_link by its name."
    ),
    parameter("design.delay", 0.0, "s", 0.0, 0.1, read_only=True).described(
        "From a measurement until its torque acts, for which the design is made; 0.0: one period and a millisecond."
    ),
    _factors("payload", "the arm file's payload"),
    _factors("stiffness", "the links' stiffness"),
    _factors("damping", "the links' damping"),
    _factors("gain", "the torque on its way to the arm"),
    parameter("design.speed", 1.0, "-", 0.0, 1.0, read_only=True).described(
        "How fast the design is at most: less asks less decay, and makes less noise; a design that would not come back"
        " from its torque limits is slower."
    ),
    parameter("design.effort", 1.0, "-", 0.1, 100.0, read_only=True).described(
        "Of the search for gains: 5.0 takes five times as long."
    ),
    parameter(
        "design.configurations", [], "rad", -100.0, 100.0, kind="float_array", read_only=True
    ).described(
        "Configurations to design for, one after the other, a number per joint each; empty: drawn from the position"
        " limits."
    ),
)
NAMES = frozenset(p.name for p in PARAMETERS)


class Default(NamedTuple):
    """The parts of a design that nodes need."""

    parameters: dict  # flat
    delay: float  # for which it is made [s]
    bears_delay: float  # longest delay with which it is stable [s]
    reached: float  # `Design.reached` [-]
    speed: float  # of the design [-]
    slowed: bool  # `Design.slowed`
    comes_back: bool  # `Design.comes_back`
    hunts: bool  # `Design.hunts`


def is_wanted(name, given, kind=AUTO):
    """Whether the control comes from a design.

    Parameters
    ----------
    name : str
        Of the arm, as it was given: a shipped name or a path. It is empty for an arm without a file. Such an arm gets
        no design unless `kind` is robust.
    given : collection of str
        Names of the parameters that are given by hand.
    kind : str
        Value of `design.type`.
    """
    if kind != AUTO:
        return kind == ROBUST
    return name not in ("", *PAPER_ARMS) and not any(law in given for law in LAWS)


def task(arm, values):
    """`Settings` and `Uncertainty` from checked values of `PARAMETERS` and `rate`.

    Raises
    ------
    ParameterError
        If a range of factors does not contain 1, or if the angles give no whole number of configurations.
    """
    n, at = len(arm.joints), values["design.configurations"]
    if len(at) % n:
        raise ParameterError(
            "is no whole number of configurations",
            field="design.configurations",
            value=at,
            hint=f"write {n} joint angles for each",
        )
    factors = {k: values[PREFIX + k] for k in ("payload", "stiffness", "damping", "gain")}
    for name, (low, high) in factors.items():
        if not low <= 1.0 <= high:
            hint = "write [least, greatest] with 1.0 between them"
            field = PREFIX + name
            raise ParameterError(
                "is no range of factors", field=field, value=[low, high], hint=hint
            )
    settings = Settings(
        rate=values["rate"],
        delay=values["design.delay"] or None,
        speed=values["design.speed"],
        effort=values["design.effort"],
        configurations=tuple(tuple(at[k : k + n]) for k in range(0, len(at), n)),
    )
    return settings, Uncertainty(**{k: tuple(v) for k, v in factors.items()})


def find(arm, settings, uncertainty):
    """Make a design, and return the plain data that the cache keeps of it. This takes seconds to minutes."""
    found = design(arm, settings, uncertainty)
    try:
        found.check()
    except DesignError as error:
        return {"refused": {"problem": error.problem, "hint": error.hint}}
    return {
        "parameters": found.parameters(),
        "bears_delay": float(card(found).delay),
        "reached": float(found.reached),
        "speed": float(found.settings.speed),
        "slowed": bool(found.slowed),
        "comes_back": bool(found.comes_back),
        "hunts": bool(found.hunts),
    }


def default(arm, settings, uncertainty, make=find):
    """The `Default` for an arm with these `settings` and `uncertainty`, from the cache, or made by `make` and kept.

    Raises
    ------
    DesignError
        If no stable gains are found; names the loop and the pole that are unstable.
    """
    name = cache.key(arm, settings, uncertainty)
    entry = cache.read(name)
    if entry is None:
        entry = make(arm, settings, uncertainty)
        cache.write(name, entry)
    if "refused" in entry:
        raise DesignError(field=f"controller of {arm.name}", **entry["refused"])
    return Default(delay=settings.delay, **entry)


def is_cached(arm, settings, uncertainty):
    """Whether the design is in the cache, so that `default` need not make it."""
    return cache.read(cache.key(arm, settings, uncertainty)) is not None


def for_observer(model, settings):
    """Flat parameters of the observer that a design for a `model` has; computed without a search."""
    return observer_parameters(sampling_for(model, places(model, settings), settings)[0])


def wanted_task(name, arm, values):
    """The `task` of the design for given flat parameters; None if no design `is_wanted`.

    Parameters
    ----------
    name : str
        As in `is_wanted`.
    arm : Arm
    values : mapping
        Flat parameters, those of `PARAMETERS` among them.
    """
    declared = (*PARAMETERS, RATE)
    names = {p.name for p in declared}
    checked = check_all(declared, {k: v for k, v in values.items() if k in names})
    return task(arm, checked) if is_wanted(name, values, checked["design.type"]) else None


def complete(name, arm, values):
    """The given flat parameters, completed by those of a design if one `is_wanted`; and its `Default` or None.

    `name`, `arm` and `values` are those of `wanted_task`. Given values take precedence over those of the design. The
    result does not contain `PARAMETERS`.
    """
    rest = {k: v for k, v in values.items() if k not in NAMES}
    wanted = wanted_task(name, arm, values)
    if wanted is None:
        return rest, None
    made = default(arm, *wanted)
    return made.parameters | rest, made
