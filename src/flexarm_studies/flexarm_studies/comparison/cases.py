# SPDX-License-Identifier: Apache-2.0
"""Defines the benchmark cases: an arm, a motion, and the controller that flexarm ships for the arm."""

from dataclasses import dataclass, replace
from functools import lru_cache

from flexarm_control.trajectory import specs
from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.errors import FlexarmError
from flexarm_dynamics.models import model

from ..loop import scenario as scenarios
from ..uncertain.plants import NOMINAL, VARIANTS, with_noise
from ..uncertain.trial import ArmTask

#: Damping ratio of every mode of arms whose file states no damping [-].
DAMPING = 0.005
#: Sixty degrees of every joint in two seconds; `long_reach` starts where its torque limits allow it.
SIXTY = "quintic:to=1.0472,duration=2"
LONG_WAY = "quintic:from=0;1.2;0.8;-0.8,to=1.0472;0.1528;1.8472;0.2472,duration=2"
#: The plants for arms whose runs take ten seconds each.
FEW = (NOMINAL, "payload x0.7", "payload x1.3", "stiffness x0.9", "damping x0.3", "noisy")


@dataclass(frozen=True)
class Case:
    """An arm, a motion and the shipped controller.

    Attributes
    ----------
    arm : str
        Shipped name.
    controller : str
        Shipped controller file.
    motion : str
        As `specs.from_spec` takes it.
    rate : float
        [Hz]
    budget : int
        Simulations per controller.
    depth : str
        Which combinations of the composite control's parts are tried: see `combinations.of`.
    window : float
        How long the rest after the motion is judged [s].
    plants : tuple
        Those of `plants.VARIANTS` on which controllers are judged.
    """

    arm: str
    controller: str
    motion: str
    rate: float
    budget: int
    depth: str
    window: float = 2.0
    plants: tuple = tuple(VARIANTS)

    @property
    def duration(self):
        """Duration of the motion [s]."""
        return float(specs.parse(self.motion)[1].get("duration", "2"))

    def values(self):
        """Flat parameters of the shipped controller."""
        return scenarios.parameters(self.controller)


CASES = (
    Case("R", "composite", "paper:duration=2", 500.0, 32, "full"),
    Case("one_link", "composite", "paper:duration=2", 500.0, 32, "none"),
    Case("two_link", "two_link", SIXTY, 1000.0, 16, "star"),
    Case("long_reach", "long_reach", LONG_WAY, 500.0, 12, "star", plants=FEW),
)


def find(names):
    """The cases of the arms `names`."""
    known = {s.arm: s for s in CASES}
    unknown = [name for name in names if name not in known]
    if unknown:
        given, limit = ",".join(unknown), ", ".join(known)
        raise FlexarmError("is unknown", field="--arms", value=given, limit=limit)
    return [known[name] for name in names]


@lru_cache
def arm_of(name, noisy=False):
    """The arm, with a little damping if its file has none; with `noisy` also with noise if it states none."""
    arm = arm_file.load(name)
    arm = replace(arm, links=tuple(map(_damped, arm.links)))
    return with_noise(arm) if noisy else arm


def _damped(link):
    flexible = {
        direction: f if any(f.damping) else replace(f, damping=(DAMPING,) * f.modes)
        for direction, f in link.flexible.items()
    }
    return replace(link, flexible=flexible)


@lru_cache
def model_of(name):
    """The arm's model, for which controllers are designed."""
    return model.build(arm_of(name))


def task_of(case):
    """The case in the form that runs on uncertain plants need; controllers are designed for the noise of these runs."""
    return ArmTask(case.arm, arm_of(case.arm, noisy=True), case.motion)


def ends_of(case):
    """Start and end of the motion, each (n,) [rad]."""
    profile = profile_of(case)
    return profile.position(0.0), profile.position(profile.duration)


def profile_of(case, duration=None):
    """The motion's profile; with another duration if one is given [s]."""
    family, settings = specs.parse(case.motion)
    if duration is not None:
        settings = settings | {"duration": repr(float(duration))}
    arm = model_of(case.arm)
    return specs.motion(family, settings, arm, [0.0] * arm.n_joints)
