# SPDX-License-Identifier: Apache-2.0
"""Defines the uncertain set: how a simulated arm differs from the model of its controller.

`compare`, `robustness` and `arms` judge controllers on these plants. A run on the controller's own model shows nothing
about the real arm: the *nominal* plant is there for comparison.

The accurate level has links that keep their length (geometric stiffening) and finite slope. Only the general model has
this level, so an arm file with the paper's equations is simulated as the chain of the same data.
"""

from dataclasses import dataclass, replace

from flexarm_dynamics.arm.description import scaled
from flexarm_dynamics.errors import ModelError

#: Samples per second of a variant with a low rate [Hz], and delay of the torque in a variant with delay [s].
SLOW_RATE, DELAY = 500.0, 0.002
#: Added friction: Coulomb, and viscous at 1 rad/s, as fractions of the joint's torque limit [-].
FRICTION = 0.02
#: Sensors of arms whose file states no noise: rms strain of a gauge, encoder counts per turn.
STRAIN_NOISE, COUNTS = 5e-7, 2**16


@dataclass(frozen=True)
class Variant:
    """How the plant differs from the model.

    Attributes
    ----------
    payload, stiffness, damping : float
        Factors [-].
    more_modes : int
        Modes beyond the model's in every direction of every link.
    accurate : bool
        Whether links keep their length, with finite slope.
    friction : float
        Added friction, see `FRICTION` [-].
    delay : float
        From the measurement until the torque acts [s].
    sensors : bool
        Whether sensors have noise and counts, and no velocity is measured; otherwise they are ideal.
    rate : float or None
        Samples per second; None: the controller's [Hz].
    """

    payload: float = 1.0
    stiffness: float = 1.0
    damping: float = 1.0
    more_modes: int = 1
    accurate: bool = True
    friction: float = 0.0
    delay: float = 0.0
    sensors: bool = False
    rate: float | None = None


#: The plant that equals the model; all others differ from it.
NOMINAL = "nominal"
VARIANTS = {
    NOMINAL: Variant(more_modes=0, accurate=False),
    "exact": Variant(),
    "payload x0.7": Variant(payload=0.7),
    "payload x1.3": Variant(payload=1.3),
    "stiffness x0.9": Variant(stiffness=0.9),
    "stiffness x1.1": Variant(stiffness=1.1),
    "damping x0.3": Variant(damping=0.3),
    "damping x3": Variant(damping=3.0),
    "one mode more": Variant(accurate=False),
    "two modes more": Variant(more_modes=2),
    "geometric stiffening": Variant(more_modes=0),
    "friction": Variant(friction=FRICTION),
    "delay 2 ms": Variant(delay=DELAY),
    "noise and counts": Variant(sensors=True),
    "noisy": Variant(sensors=True, delay=DELAY, rate=SLOW_RATE),
}


def plant_of(arm, variant):
    """The simulated arm of a `variant`.

    Raises
    ------
    ModelError
        If the arm can't differ in this way: friction needs finite torque limits, and more modes need their measured
        frequencies.
    """
    plant = scaled(arm, variant.payload, variant.stiffness, variant.damping)
    if arm.most_modes and variant.more_modes:
        plant = plant.with_modes(arm.most_modes + variant.more_modes)
    if variant.accurate:
        plant = replace(plant, model="chain", foreshortening=True, finite_slope=True)
    if variant.friction:
        plant = replace(plant, joints=tuple(_rubbing(j, variant.friction) for j in plant.joints))
    return with_noise(plant) if variant.sensors else _ideal(plant)


def names_for(arm, names=tuple(VARIANTS)):
    """Those of the `names` as which an arm can be simulated and that differ from it, in their order."""
    return tuple(name for name in names if _possible(arm, VARIANTS[name]))


def _possible(arm, variant):
    damped = any(any(f.damping) for link in arm.links for f in link.flexible.values())
    if variant.damping != 1.0 and not damped:
        return False  # a factor of no damping changes nothing
    try:
        plant_of(arm, variant)
    except ModelError:
        return False
    return True


def _rubbing(joint, fraction):
    limit = joint.limits.torque
    if limit == float("inf"):
        field = f"torque limit of {joint.name}"
        raise ModelError("is infinite: friction is a fraction of it", field=field, value=limit)
    own = joint.friction
    added = replace(
        own, viscous=own.viscous + fraction * limit, coulomb=own.coulomb + fraction * limit
    )
    return replace(joint, friction=added)


def with_noise(arm):
    """The arm with noise and counts if its file states none."""
    gauges = tuple(replace(g, noise=g.noise or STRAIN_NOISE) for g in arm.gauges)
    joints = tuple(replace(j, encoder_counts=j.encoder_counts or COUNTS) for j in arm.joints)
    return replace(arm, gauges=gauges, joints=joints)


def _ideal(arm):
    joints = tuple(replace(joint, encoder_counts=0) for joint in arm.joints)
    gauges = tuple(replace(gauge, bits=0) for gauge in arm.gauges)
    return replace(arm, joints=joints, gauges=gauges)
