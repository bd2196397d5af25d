# SPDX-License-Identifier: Apache-2.0
"""Defines what is attacked: arms with motion and controller, observers, with and without measured joint velocity."""

from dataclasses import dataclass, replace
from functools import cache

from flexarm_control.observers.arm_observer import OBSERVERS
from flexarm_control.robust.default import TYPES
from flexarm_dynamics import registry
from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.errors import FlexarmError

from ..loop import scenario as scenarios
from ..uncertain.plants import COUNTS, STRAIN_NOISE

#: Arm to its motion.
ARMS = {
    "R": "quintic:to=1,duration=2",
    "two_link": "quintic:to=1.0472,duration=2",
    "long_reach": "quintic:from=0;1.2;0.8;-0.8,to=0.4;0.9;1.2;-0.4,duration=2",
}
#: The observer for which a design is made.
DESIGNED = TYPES["observer.type"]
#: Arm to its control under `DESIGNED`, and under other observers: shipped file (empty: the nodes' defaults), rate [Hz].
#: The nodes' default control for R is that of the paper. For other arms it is a design, whose gains are made for its
#: own observer. The gains of the other file are for observers that have a model.
CONTROLS = {
    "R": (("", 1000.0), ("", 1000.0)),
    "two_link": (("two_link_designed", 500.0), ("two_link", 1000.0)),
    "long_reach": (("long_reach_designed", 500.0), ("long_reach", 500.0)),
}
#: Bits of the gauges' converters if an arm file states none.
BITS = 16
#: Observers with the noise levels of `kalman`.
FILTERS = ("kalman", "extended_kalman")
#: Duration of the motions [s].
MOTION = 2.0
#: The motion starts at this time of the session: the observer has converged by then [s].
START = 0.2


@dataclass(frozen=True)
class Case:
    """One arm under one observer.

    Attributes
    ----------
    arm, observer : str
    velocity : bool
        Whether joint velocities are measured.
    noise : bool
        Whether encoders and gauges round to counts, and gauges have noise.
    amplitude : bool
        Whether the driver sends modal amplitudes beside the strains.
    rates : bool
        Whether it sends modal rates.
    """

    arm: str
    observer: str
    velocity: bool
    noise: bool = True
    amplitude: bool = False
    rates: bool = False

    def __str__(self):
        return f"{self.arm}, {self.observer}, {'with' if self.velocity else 'without'} velocity"

    def scenario(self):
        """The `Scenario` without lies."""
        file, rate = CONTROLS[self.arm][self.observer != DESIGNED]
        values = scenarios.parameters(file) if file else {}
        own = values.get("observer.type")
        if own != self.observer and not {own, self.observer} <= set(FILTERS):
            values = {k: v for k, v in values.items() if not k.startswith("observer.")}
        values |= {
            "observer.type": self.observer,
            "publish_joint_velocity": self.velocity,
            "publish_modal_amplitude": self.amplitude,
            "publish_rates": self.rates,
        }
        return scenarios.Scenario(
            arm_of(self.arm, self.noise),
            values,
            trajectory=ARMS[self.arm],
            rate=rate,
            noise=self.noise,
        )


@cache
def arm_of(name, noise):
    """The shipped arm; with `noise`, it has that of the comparison's sensors where its file states none."""
    arm = arm_file.load(name)
    if not noise:
        return arm
    gauges = tuple(
        replace(g, noise=g.noise or STRAIN_NOISE, bits=g.bits or BITS) for g in arm.gauges
    )
    joints = tuple(replace(j, encoder_counts=j.encoder_counts or COUNTS) for j in arm.joints)
    return replace(arm, gauges=gauges, joints=joints)


def observers():
    """All registered observers that an arm without measured rates can have."""
    return tuple(n for n in registry.names(OBSERVERS) if n != "true_rates")


def chosen(arms=None, names=None):
    """The cases of some `arms` and of the observers `names`, None for all; each with and without velocity.

    Raises
    ------
    FlexarmError
        For an unknown arm or observer.
    """
    for option, given, known in (("--arms", arms, ARMS), ("--observers", names, observers())):
        unknown = [name for name in given or () if name not in known]
        if unknown:
            raise FlexarmError(
                "is unknown", field=option, value=",".join(unknown), limit=", ".join(known)
            )
    return [
        Case(arm, observer, velocity)
        for arm in arms or ARMS
        for observer in names or observers()
        for velocity in (False, True)
    ]
