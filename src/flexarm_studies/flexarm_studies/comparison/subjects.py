# SPDX-License-Identifier: Apache-2.0
"""The arms that are compared on, their motions, and the controller that flexarm ships for each."""

from dataclasses import dataclass, replace
from functools import lru_cache

from flexarm_control.trajectory import specs
from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.errors import FlexarmError
from flexarm_dynamics.models import model

from ..loop import scenario as scenarios

#: Structural damping of arms whose file states none, of every mode [-].
DAMPING = 0.005
#: Sensors where the arm file states no noise: rms strain of a gauge, encoder counts per turn.
STRAIN_NOISE, COUNTS = 5e-7, 2**16
#: Sixty degrees of every joint in two seconds; `long_reach` from where its torque limits let it.
SIXTY = "quintic:to=1.0472,duration=2"
LONG_WAY = "quintic:from=0;1.2;0.8;-0.8,to=1.0472;0.1528;1.8472;0.2472,duration=2"


@dataclass(frozen=True)
class Subject:
    """An arm and a motion.

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
        Simulations per contender.
    depth : str
        What is tried of the composite control's components: see `combinations.of`.
    window : float
        Over how long after the motion the rest is judged [s].
    """

    arm: str
    controller: str
    motion: str
    rate: float
    budget: int
    depth: str
    window: float = 2.0

    @property
    def duration(self):
        """Of the motion [s]."""
        return float(specs.parse(self.motion)[1].get("duration", "2"))

    def values(self):
        """Flat parameters of the shipped controller."""
        return scenarios.parameters(self.controller)


SUBJECTS = (
    Subject("R", "composite", "paper:duration=2", 500.0, 32, "full"),
    Subject("one_link", "composite", "paper:duration=2", 500.0, 32, "none"),
    Subject("two_link", "two_link", SIXTY, 1000.0, 16, "star"),
    Subject("long_reach", "long_reach", LONG_WAY, 500.0, 12, "star"),
)


def find(names):
    """Subjects by the arms' names.

    Raises
    ------
    FlexarmError
        For a name that there is none of.
    """
    known = {s.arm: s for s in SUBJECTS}
    unknown = [name for name in names if name not in known]
    if unknown:
        raise FlexarmError(f"--arms {','.join(unknown)}: there are {', '.join(known)}")
    return [known[name] for name in names]


@lru_cache
def arm_of(name, noisy=False):
    """The arm, damped a little where its file has no damping; with `noisy`, with noise where it states none."""
    arm = arm_file.load(name)
    arm = replace(arm, links=tuple(map(_damped, arm.links)))
    if not noisy:
        return arm
    gauges = tuple(replace(g, noise=g.noise or STRAIN_NOISE) for g in arm.gauges)
    joints = tuple(replace(j, encoder_counts=j.encoder_counts or COUNTS) for j in arm.joints)
    return replace(arm, gauges=gauges, joints=joints)


def _damped(link):
    flexible = {
        direction: f if any(f.damping) else replace(f, damping=(DAMPING,) * f.modes)
        for direction, f in link.flexible.items()
    }
    return replace(link, flexible=flexible)


@lru_cache
def model_of(name):
    """The arm's model: what contenders are designed on."""
    return model.build(arm_of(name))


def ends_of(subject):
    """Where the motion begins and ends, each (n,) [rad]."""
    profile = profile_of(subject)
    return profile.position(0.0), profile.position(profile.duration)


def profile_of(subject, duration=None):
    """The motion's profile, if asked for of another duration [s]."""
    family, settings = specs.parse(subject.motion)
    if duration is not None:
        settings = settings | {"duration": repr(float(duration))}
    arm = model_of(subject.arm)
    return specs.motion(family, settings, arm, [0.0] * arm.n_joints)
