# SPDX-License-Identifier: Apache-2.0
"""Designs the composite control: finds its components by name, and checks their parameters and the whole."""

from flexarm_dynamics import registry
from flexarm_dynamics.arm.description import MAX_MODES
from flexarm_dynamics.errors import NOT_GIVEN, ParameterError
from flexarm_dynamics.models.levels import FINITE_SLOPE, LEVELS
from flexarm_dynamics.parameters import check_all, parameter

from ..component import make
from ..feedforward.base import SHARE, Settings
from . import full_order
from .law import CompositeControl
from .seen import shown

SLOW, FAST, MANIFOLD = "flexarm.slow_laws", "flexarm.fast_laws", "flexarm.manifolds"
FEEDFORWARD = "flexarm.feedforwards"

#: Prefix of the parameters of each group.
PREFIX = {SLOW: "slow.", FAST: "fast.", MANIFOLD: "manifold."}

#: Parameters of the whole design.
PARAMETERS = (
    parameter("feedforward", "model").described(
        "Motion that the arm is held to. none: the reference and the slow manifold; model: the nominal arm, simulated"
        " alongside, which bends without ringing; preview: a motion planned when a trajectory is received, which ends"
        " at rest; or another name of the entry-point group flexarm.feedforwards."
    ),
    parameter("feedforward_modes", 0, "-", 0, MAX_MODES).described(
        "Bending modes per direction in the feed-forward's model, if more than in the arm file. The control receives"
        " what the gauges show of them; 0: those of the file."
    ),
    parameter("feedforward_level", "file", choices=("file", *LEVELS[2:])).described(
        "Kinematics of bending in the feed-forward's model, if more than the arm file states: stiffening (links keep"
        " their length), finite_slope (large slopes, too); for model chain only."
    ),
    parameter("feedforward_spread", 0.15, "-", 0.0, 0.5).described(
        "With preview, for modes that the joints hardly move, such as the vertical bending of an arm that only yaws: a"
        " planned motion excites them little even if their frequencies differ from the model's by up to this fraction;"
        " 0.0: they are left as they are."
    ),
    parameter("feedforward_torque", SHARE, "-", 0.1, 1.0).described(
        "With preview: a planned motion takes no more than about this fraction of the torque limits, if it can. The"
        " rest is left to the feedback, for what the model does not know, such as a heavier payload."
    ),
    parameter("motion_velocity_bandwidth", 0.0, "rad/s", 0.0, 1e6).described(
        "Corner of the observer's filter of joint speeds (observer.joint_velocity_bandwidth, if"
        " observer.measured_velocity is false). The speeds of the feed-forward's motion pass the same filter, so that"
        " its lag is no error; 0.0: no filter."
    ),
    parameter("motion_rate_bandwidth", 0.0, "rad/s", 0.0, 1e6).described(
        "The same for the rates of deflections, if the observer filters them (observer.bandwidth of"
        " filtered_derivative); 0.0: no filter."
    ),
    parameter("motion_delay", 0.0, "s", 0.0, 0.1).described(
        "Longest delay of the torque that is taken into account. The arm follows the feed-forward's motion as late as"
        " its torque acts, so slow.type joint_pid and the fast law see the motion that late, and the feed-forward is"
        " ahead of the reference. The controller measures the delay; 0.0: it is not taken into account."
    ),
    parameter("saturation", "each", choices=("each", "together")).described(
        "Effect of the torque limit on the feedback about a feed-forward. each: every joint is clipped by itself;"
        " together: the feedback to all joints is scaled until none is beyond its limit, which keeps its direction."
    ),
    parameter("rate", 1000.0, "Hz", 1.0, 20000.0).described(
        "Samples per second that the driver or simulator sends; designs are checked at this rate."
    ),
    parameter("stability_margin", 0.0, "1/s", -1e6, 1e3).described(
        "A design is refused unless all poles of the sampled full-order closed loop lie left of minus this value."
    ),
    parameter("payload_scale", 1.0, "-", 0.0, 100.0).described(
        "Payload that feed-forward, manifold and slow law are designed for, as a multiple of the arm file's;"
        " payload_estimate sets it. The fast law stays that of the arm file."
    ),
)


def design_law(group, name, model, values, *known):
    """As `component.make`, for a law of the `group` `SLOW`, `FAST` or `MANIFOLD`; `known` is for a manifold."""
    return make(group, name, model, values, PREFIX[group], *known)


def design(model, slow, fast, manifold=None, settings=None):
    """Design a composite control from mappings with the key `type` and the component's parameters.

    Parameters
    ----------
    model : ArmModel
    slow, fast, manifold : mapping
        ``{"type": "linear_model_following", "kp": [6.25], …}``; without a manifold, the paper's.
    settings : mapping, optional
        Values of `PARAMETERS`; if not given, the paper's design, without feed-forward and unchecked.

    Returns
    -------
    CompositeControl

    Raises
    ------
    UnknownComponentError, ParameterError, DesignError
        Nothing is designed then.
    """

    def law(group, model, given, *known):
        name, values = typed(given, PREFIX[group][:-1])
        return design_law(group, name, model, values, *known)

    chosen = None if settings is None else check_all(PARAMETERS, settings)
    fast_law = law(FAST, model, fast)
    if chosen is not None and chosen["payload_scale"] != 1.0:
        model = model.with_payload(chosen["payload_scale"])
    slow_law = law(SLOW, model, slow)
    given = {"type": "quasi_steady"} if manifold is None else manifold
    surface = law(MANIFOLD, model, given, slow_law)
    control = CompositeControl(model, slow_law, fast_law, surface)
    if chosen is None:
        return control
    wanted = chosen["feedforward"]
    kind = None if wanted == "none" else registry.find(FEEDFORWARD, wanted)
    if slow_law.drifts:  # joints that no law holds have poles at zero, which the check would refuse
        return control
    q = fast_law.configuration
    full_order.check(control, q, chosen["rate"], chosen["stability_margin"])
    if kind is None or slow_law.learns:
        return control
    seen = {
        "joint_corner": chosen["motion_velocity_bandwidth"],
        "rate_corner": chosen["motion_rate_bandwidth"],
        "longest": chosen["motion_delay"],
    }
    level = chosen["feedforward_level"]
    modes = model.fuller(chosen["feedforward_modes"])
    fuller = modes.fuller(0, level != "file", level == FINITE_SLOPE)
    if modes is not model:
        seen["shown"] = shown(model, fuller)
    elif not any(seen.values()):
        seen = None
    # The manifold keeps the file's kinematics: the regulator of the fuller arm follows it and removes the difference.
    known = None if fuller is model else model
    # The fraction is for the payload of the arm file. A heavier one that is known needs no torque in reserve.
    known_part = chosen["feedforward_torque"] * max(1.0, chosen["payload_scale"])
    share = max(chosen["feedforward_torque"], min(known_part, SHARE))
    planning = Settings(1.0 / chosen["rate"], q, known, chosen["feedforward_spread"], share)
    motion = kind(fuller, surface.of(modes), planning)
    together = chosen["saturation"] == "together"
    return CompositeControl(model, slow_law, fast_law, surface, motion, seen, together)


def typed(given, prefix):
    """The `type` and the parameters of `given`; a `ParameterError` names them with `prefix`."""
    values = dict(given)
    name = values.pop("type", None)
    if isinstance(name, str):
        return name, values
    raise ParameterError(
        "missing" if name is None else "is not a name",
        field=f"{prefix}.type",
        value=NOT_GIVEN if name is None else name,
        hint="write the name of a law, none for no control",
    )
