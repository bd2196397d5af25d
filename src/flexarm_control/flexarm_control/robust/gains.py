# SPDX-License-Identifier: Apache-2.0
"""Gains that a design has found, the loops with them, and the parameters that the nodes take."""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from flexarm_dynamics.errors import DesignError
from flexarm_dynamics.models import levels
from flexarm_dynamics.models.fixed_step import substeps
from flexarm_dynamics.models.model import build

from ..feedforward.model import METHOD
from .held import held_loops
from .loop import ARM, Sampling
from .recovery import Recovery
from .settings import Settings
from .uncertain import Uncertainty
from .words import in_the_way, what_helps

#: A `stability_margin` so low that the controller's own check passes: it has neither the filters nor the delay.
UNCHECKED = -1000.0
#: The model with finite slopes takes long to compute. The feed-forward uses it only if the number of steps per sample,
#: times the number of modes, is at most this.
QUICK = 12
#: The feed-forward has one mode more than the file if its fastest frequency is then at most this many times the lowest
#: one, with the joints locked. The fastest frequency sets the steps in which a plan is integrated [-].
SPREAD = 2000.0


class SlowPole(NamedTuple):
    """The slowest pole of a loop, relative to what is asked of it."""

    name: str  # of the loop
    pole: complex  # [1/s]
    value: float  # minus its decay over what is asked of it [-]
    kind: str = ARM  # of the loop


@dataclass(frozen=True)
class Design:
    """Gains, and the properties of the loops with them.

    Attributes
    ----------
    K : ndarray, shape (n, 3n + 2m)
        u = -K (q, qd, -w, delta, delta_d); scheduled gains: those of the first configuration.
    decay : float
        Decay of the slowest pole that gains move, over the decay that is asked of it [-]; negative: unstable.
    omega_1 : float
        Lowest bending frequency with the joints locked [rad/s].
    omega_c : float
        Frequency up to which torque reaches a mode [rad/s].
    configurations : ndarray, shape (k, n)
        [rad]
    slowest : tuple of SlowPole
        Of each loop.
    left : tuple of float
        Frequencies of modes that no gain moves, at the first configuration [rad/s].
    noise : tuple of float
        Of each joint: rms torque due to the sensors' noise over the torque limit [-].
    slope : float
        Length of the gradient of the slowest pole's value by the scaled gains [-].
    sets : ndarray, shape (k, n, 3n + 2m)
        One set of gains for all configurations, or one for each; see `flexarm_control.schedule`.
    recovery : Recovery or None
        From motions that take as much torque as a plan; None: not computed.
    slowed : bool
        Whether the speed is lower than requested, because the arm would not come back from its torque limits with
        faster gains.
    hunts : bool
        Whether a vibration grows fast while some joints stick and others slide (`task.GROWS_FAST`), and no gains were
        found with which it does not.
    """

    arm: object
    settings: Settings
    uncertainty: Uncertainty
    sampling: Sampling
    K: np.ndarray
    decay: float
    omega_1: float
    omega_c: float
    configurations: np.ndarray
    slowest: tuple = ()
    left: tuple = ()
    evaluations: int = 0
    noise: tuple = field(default=())
    slope: float = np.inf
    sets: np.ndarray | None = None
    recovery: Recovery | None = None
    slowed: bool = False
    hunts: bool = False

    def __post_init__(self):
        if self.sets is None:
            object.__setattr__(self, "sets", self.K[None])

    @property
    def reached(self):
        """The least decay over what is asked, of the loops of kind `ARM` only [-]."""
        return -max(row.value for row in self.slowest if row.kind == ARM)

    @property
    def worst(self):
        """The `SlowPole` of the slowest loop, relative to what is asked of it."""
        return max(self.slowest, key=lambda row: row.value)

    @property
    def scheduled(self):
        """Whether there is a set of gains for each configuration."""
        return len(self.sets) > 1

    def gains_at(self, number):
        """K of a configuration, (n, 3n + 2m); its number counts from 0."""
        return self.sets[number if self.scheduled else 0]

    def loops(self):
        """The loops of the design, each with its gains: pairs of `Loop` and K."""
        loops, weights = held_loops(
            build(self.arm.known),
            self.configurations,
            self.sampling,
            self.uncertainty,
            len(self.sets),
        )
        return [
            (loop, np.tensordot(w, self.sets, 1)) for loop, w in zip(loops, weights, strict=True)
        ]

    @property
    def holds(self):
        """Whether all loops are stable."""
        return self.decay > 0.0

    @property
    def comes_back(self):
        """Whether the arm comes back from its torque limits; True if that was not computed."""
        return self.recovery is None or self.recovery.comes_back

    def check(self):
        """Refuse a design of which a loop is unstable.

        Raises
        ------
        DesignError
            Names the loop and the pole that are unstable, and what would help.
        """
        if not self.holds:
            problem = in_the_way(self)
            raise DesignError(
                problem, field=f"controller of {self.arm.name}", hint=what_helps(self)
            )

    def parameters(self):
        """Flat parameters of the three nodes."""
        n = len(self.arm.joints)
        K = self.sets
        finite = np.isfinite(self.sampling.torque_corner)
        corner = numbers([self.sampling.torque_corner])[0] if finite else 0.0
        at = {"schedule": numbers(self.configurations)} if self.scheduled else {}
        friction = {}
        if any(self.sampling.friction):
            friction["slow.friction"] = numbers(self.sampling.friction)
            friction["slow.return_rate"] = numbers([self.sampling.return_rate])[0]
            friction["slow.breakaway"] = numbers(self.sampling.breakaway)
            friction["slow.breakaway_rate"] = numbers([self.sampling.breakaway_rate])[0]
        out = {
            "rate": self.settings.rate,
            "stability_margin": UNCHECKED,
            "feedforward": self.settings.feedforward,
            **of_feedforward(self.arm.known, self.settings.rate),
            "feedforward_torque": self.uncertainty.torque_share,
            "motion_delay": numbers([self.settings.delay])[0],
            "saturation": "together",
            "motion_velocity_bandwidth": numbers([self.sampling.joint_corner])[0],
            "motion_rate_bandwidth": numbers([self.sampling.modal_corner])[0],
            "slow.type": "joint_pid",
            "slow.stiffness": numbers([np.diag(one[:, :n]) for one in K]),
            "slow.damping": numbers([np.diag(one[:, n : 2 * n]) for one in K]),
            "slow.integral": numbers([np.diag(one[:, 2 * n : 3 * n]) for one in K]),
            **{f"slow.{name}": values for name, values in at.items()},
            "slow.bandwidth": corner,
            **friction,
            "fast.type": "none",
        }
        if K.shape[2] > 3 * n:
            out["fast.type"] = "fixed_gain"
            out["fast.gain"] = numbers(-K[:, :, 3 * n :])
            out |= {f"fast.{name}": values for name, values in at.items()}
            out["fast.configuration"] = numbers(self.configurations[0])
            out["fast.bandwidth"] = corner
        return out | {"manifold.type": "reference"} | observer_parameters(self.sampling)


def numbers(values):
    """A flat list of numbers, rounded to six digits as in a parameter file."""
    return [float(f"{v:.6g}") for v in np.ravel(values)]


def of_feedforward(arm, rate):
    """Flat parameters that give the feed-forward a better model than the arm file's.

    It has one mode more per direction, for the compliance of the links that the file's modes leave out: for several
    links with one mode each, the next frequencies are 10 to 20 % too high. It leaves that mode out if the mode is too
    fast (`SPREAD`). It has as much of the kinematics of bending as the arm's loads need, within `levels.TOLERANCE` of
    the arm's reach.
    """
    if not arm.most_modes:
        return {"feedforward_modes": 0, "feedforward_level": "file"}
    modes = arm.most_modes + 1
    model = build(arm.fuller(modes, False, False))
    omega = model.frequencies(np.zeros(model.n_joints), locked=True)
    if omega[-1] > SPREAD * omega[0]:
        modes = 0
    level = levels.level_of(levels.simulated(arm, negligible=levels.TOLERANCE * arm.reach))
    if level == levels.FINITE_SLOPE:
        model = build(arm.fuller(modes, True, True))
        if model.n_modes * substeps(model, 1.0 / rate, METHOD) > QUICK:
            level = levels.STIFFENING
    if level == levels.level_of(arm):
        level = "file"
    return {"feedforward_modes": modes, "feedforward_level": level}


def observer_parameters(sampling):
    """Flat parameters of the observer that belongs to a `Sampling`."""
    modal, joint = numbers([sampling.modal_corner, sampling.joint_corner])
    return {
        "observer.type": "filtered_derivative",
        "observer.bandwidth": modal,
        "observer.joint_velocity_bandwidth": joint,
        "observer.measured_velocity": False,
    }
