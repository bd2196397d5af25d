# SPDX-License-Identifier: Apache-2.0
"""Defines the compared controllers: shipped composite control and baselines, with the tuned numbers of each.

The ranges of the tuned numbers are wide, and each baseline starts with the bandwidth of the shipped controller's slow
poles. A joint's PID gains follow from the inertia m_i that it turns at the motion's end: p = m w^2, d = 2 zeta m w,
i = kappa m w^3. So one bandwidth w is tuned in place of a gain per joint. For several joints, the ratios of the last
joint's bandwidth and damping to those of the first joint are tuned, too.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial

import numpy as np

from flexarm_control.motions import shapers
from flexarm_control.trajectory import specs
from flexarm_dynamics.errors import DesignError
from flexarm_dynamics.linear import linear_plant, sampled
from flexarm_dynamics.singular_perturbation import frequencies_and_damping

from . import cases, trial
from .baselines import FullStateLqr, JointPid, lqr_gain, slowest
from .tuning import Free

#: Limit of the PID's integral, as a fraction of the joint's torque limit [-].
MAX_INTEGRAL = 0.3
#: Number of modes that a shaper cancels, and the damping ratio above which a mode needs none.
SHAPED, DAMPED = 2, 0.5
#: Shortest profile that is shaped, as a fraction of the motion's duration [-].
MIN_PROFILE = 0.4

#: Stability margin that lets rigid control pass the full-order check, whatever its poles [1/s].
UNCHECKED = -1e3

SHIPPED, PREVIEW, TUNED = (f"composite ({kind})" for kind in ("shipped", "preview", "tuned"))
#: The composite controllers; all others are baselines.
OWN = (SHIPPED, PREVIEW, TUNED)
PID = "joint PID"

#: The supervisor's limits are off: the comparison has its own limit for a lost arm, the same for all controllers. A
#: motion that needs more torque than a baseline may use is not refused either: the baseline lags behind, and is judged
#: by this.
UNWATCHED = dict.fromkeys(
    (
        "tracking_error_limit",
        "velocity_margin",
        "position_margin",
        "saturation_time",
        "trajectory_torque_margin",
    ),
    0.0,
)

#: A composite control that does nothing, for controllers that replace it by a law of their own.
IDLE = {
    "slow.type": "none",
    "fast.type": "none",
    "manifold.type": "quasi_steady",
    "feedforward": "none",
}


@dataclass(frozen=True)
class Setup:
    """A controller with its numbers, ready to run.

    Attributes
    ----------
    controller : dict
        Flat parameters, as `Scenario.controller`.
    law : callable or None
        Makes, from the arm's model, the law that replaces the composite control.
    motion : callable or None
        Makes, from the arm's model, the trajectory that is sent in place of the motion.
    found : dict
        Properties of its design, stored with every run: plain data.
    """

    controller: dict = field(default_factory=dict)
    law: Callable | None = None
    motion: Callable | None = None
    found: dict = field(default_factory=dict)


@dataclass(frozen=True)
class Candidate:
    """A controller that takes part in the comparison, and its tuned numbers.

    Attributes
    ----------
    name : str
    free : callable
        From a `Case`: tuple of `Free`.
    setup : callable
        From a `Case` and the values: `Setup`; raises a FlexarmError if there is no such design.
    screen : callable or None
        From a `Case` and the values: the number by which `tuning.tune` sorts before it simulates.
    """

    name: str
    free: Callable
    setup: Callable
    screen: Callable | None = None


# The composite control ---------------------------------------------------------------------------


def _shipped_setup(case, values):
    return Setup(case.values())


def _composite_free(case):
    alpha = float(case.values().get("fast.alpha", 5.0))
    return (
        Free("slow poles, times", 0.3, 3.0, 1.0, log=True),
        Free("fast.q, times", 1e-2, 1e2, 1.0, log=True),
        Free("fast.alpha [1/s]", 0.0, max(2.0 * alpha, 2.0), alpha),
    )


def _composite_setup(case, values):
    speed, weight, alpha = values
    shipped = case.values()
    kp = np.array(shipped.get("slow.kp", [6.25]))
    kv = np.array(shipped.get("slow.kv", [5.0]))
    q = np.array(shipped.get("fast.q", [1.0]))
    tuned = {"slow.kp": (speed**2 * kp).tolist(), "slow.kv": (speed * kv).tolist()}
    return Setup(shipped | tuned | {"fast.q": (weight * q).tolist(), "fast.alpha": alpha})


def bandwidth(case):
    """Bandwidth of the shipped controller's slow poles, with which the baselines start [rad/s]."""
    return float(max(case.values().get("slow.kp", [6.25]))) ** 0.5


def _inertia(case):
    """Inertia of the rigid arm about each joint at the motion's end, (n,) [kg m^2]."""
    arm = cases.model_of(case.arm)
    n = arm.n_joints
    return np.diag(arm.terms(cases.ends_of(case)[1], np.zeros(n)).M)[:n]


# PID ---------------------------------------------------------------------------------------------


def _pid_free(case):
    ratio = (
        Free("w_last/w_first", 0.2, 20.0, 1.0, log=True),
        Free("zeta_last/zeta_first", 1e-2, 10.0, 1.0, log=True),
    )
    return (
        Free("w [rad/s]", 0.3, 60.0, bandwidth(case), log=True),
        Free("zeta", 0.1, 5.0, 1.0, log=True),
        Free("kappa", 0.0, 0.3, 0.02),
        Free("velocity/d", 0.0, 1.0, 0.0),
        Free("acceleration/m", 0.0, 1.5, 1.0),
        *(ratio if cases.model_of(case.arm).n_joints > 1 else ()),
    )


def pid_gains(case, values):
    """Gains of `JointPid` from the tuned numbers."""
    w, zeta, kappa, velocity, acceleration, *ratio = values
    arm = cases.model_of(case.arm)
    inertia, limit = _inertia(case), arm.arm.torque_limits
    outwards = np.linspace(0.0, 1.0, arm.n_joints)
    faster, stiffer = ratio or (1.0, 1.0)
    w, zeta = w * faster**outwards, zeta * stiffer**outwards
    d = 2.0 * zeta * w * inertia
    return {
        "p": w**2 * inertia,
        "i": kappa * w**3 * inertia,
        "d": d,
        "i_clamp": MAX_INTEGRAL * limit,
        "velocity": velocity * d,
        "acceleration": acceleration * inertia,
    }


def _observer(case):
    """Parameters of the shipped controller's observer, which all controllers use."""
    return {k: v for k, v in case.values().items() if k.startswith("observer.")}


@lru_cache
def _seen(case, law):
    """Store for what a baseline's law computes along the motion, which is the same in every simulation."""
    return {}


@lru_cache
def _plants(case):
    """The sampled arm, linearised at rest, at the motion's start and end."""
    arm = cases.model_of(case.arm)
    ends = cases.ends_of(case)
    return [sampled(*linear_plant(arm, q, coulomb=False), 1.0 / case.rate) for q in ends]


def _pid_screen(case, values):
    """Real part of the slowest pole [1/s]: its time constant bounds the time that the arm takes to come to rest."""
    law = JointPid(cases.model_of(case.arm), pid_gains(case, values))
    return slowest(_plants(case), law.K, 1.0 / case.rate)


def _pid_setup(case, values):
    gains = pid_gains(case, values)
    return Setup(IDLE | _observer(case), lambda model: JointPid(model, gains, _seen(case, PID)))


# PID with a shaper -------------------------------------------------------------------------------


def _shaped_free(case):
    return (Free("shaper's time taken from the motion, share", 0.0, 1.0, 0.0), *_pid_free(case))


def _shaped_setup(kind):
    def setup(case, values):
        shortened, *rest = values
        gains = pid_gains(case, rest)
        motion = shaped_motion(case, gains, kind, shortened)
        return Setup(
            IDLE | _observer(case), lambda model: JointPid(model, gains), lambda model: motion
        )

    return setup


def _shaped_screen(case, values):
    return _pid_screen(case, values[1:])


def shaper_for(case, gains, kind):
    """Shaper of the lowest modes that ring under the PID law with these `gains` at the motion's end.

    `kind` is zv or zvd. It is refused if no mode rings, or if the law alone is unstable.
    """
    end = cases.ends_of(case)[1]
    poles = JointPid(cases.model_of(case.arm), gains).poles(end)
    omega, zeta = frequencies_and_damping(poles)
    if poles.real.max() > 0.0:
        raise DesignError("the joints' PID alone is unstable", field=case.arm)
    rings = zeta < DAMPED
    if not rings.any():
        raise DesignError("nothing rings under the joints' PID: no shaper", field=case.arm)
    return shapers.for_modes(kind, omega[rings][:SHAPED], np.maximum(zeta[rings][:SHAPED], 0.0))


def shaped_motion(case, gains, kind, shortened):
    """The shaped motion. Its profile is shorter by `shortened` times the shaper's length, which shaping adds again."""
    shaper = shaper_for(case, gains, kind)
    whole = case.duration
    profile = cases.profile_of(case, max(whole - shortened * shaper.duration, MIN_PROFILE * whole))
    return specs.sampled(shaper.apply(profile), cases.model_of(case.arm))


# Full-state LQR ----------------------------------------------------------------------------------


def _lqr_free(case):
    # The error at which a PD law of the same bandwidth reaches the torque limit.
    w, limit = bandwidth(case), cases.model_of(case.arm).arm.torque_limits
    error = float(np.clip((limit / _inertia(case)).min() / w**2, 1e-2, 100.0))
    return (
        Free("joint error [rad]", 1e-3, 1e3, error, log=True),
        Free("joint rate [rad/s]", 1e-2, 1e3, 0.5 * error * w, log=True),
        Free("modal rate [m/s]", 1e-3, 1e2, 1.0, log=True),
        Free("alpha [1/s]", 0.0, 8.0, 0.5 * w),
        Free("acceleration, share", 0.0, 1.5, 1.0),
    )


def _lqr_setup(case, values):
    *sizes, decay, feedforward = values
    end = cases.ends_of(case)[1]
    law = partial(
        FullStateLqr,
        q=end,
        rate=case.rate,
        sizes=sizes,
        decay=decay,
        feedforward=feedforward,
        seen=_seen(case, "LQR"),
    )
    return Setup(IDLE | _observer(case), law)


def _lqr_screen(case, values):
    end = cases.ends_of(case)[1]
    try:
        K = lqr_gain(cases.model_of(case.arm), end, case.rate, values[:3], values[3])
    except DesignError:
        return float("inf")
    return slowest(_plants(case), K, 1.0 / case.rate)


# Adaptive rigid control --------------------------------------------------------------------------


def _adaptive_free(case):
    return (
        Free("kp [1/s^2]", 0.1, 100.0, bandwidth(case) ** 2, log=True),
        Free("kv/(2 sqrt kp)", 1.0, 3.0, 1.0),
        Free("adaptation_gain [s^2]", 1e-2, 20.0, 2.0, log=True),
    )


def _adaptive_setup(case, values):
    kp, damping, gain = values
    law = {
        "slow.type": "adaptive_model_following",
        "slow.kp": [kp],
        # Slightly larger: rounding makes a double pole complex, which would be refused.
        "slow.kv": [2.0 * damping * kp**0.5 * (1.0 + 1e-9)],
        "slow.adaptation_gain": gain,
        "stability_margin": UNCHECKED,
    }
    return Setup(IDLE | law | _observer(case))


CONTROLLERS = {
    c.name: c
    for c in (
        Candidate(SHIPPED, lambda case: (), _shipped_setup),
        Candidate(
            PREVIEW,
            lambda case: (),
            lambda case, values: Setup(case.values() | {"feedforward": "preview"}),
        ),
        Candidate(TUNED, _composite_free, _composite_setup),
        Candidate(PID, _pid_free, _pid_setup, _pid_screen),
        Candidate("joint PID, ZV shaper", _shaped_free, _shaped_setup("zv"), _shaped_screen),
        Candidate("joint PID, ZVD shaper", _shaped_free, _shaped_setup("zvd"), _shaped_screen),
        Candidate("full-state LQR", _lqr_free, _lqr_setup, _lqr_screen),
        Candidate("adaptive rigid", _adaptive_free, _adaptive_setup),
    )
}


@lru_cache
def allowed(case):
    """Peak torque of the shipped controller on the case's motion, per joint [N m]; empty if it fails."""
    row = trial.run(case, _shipped_setup(case, ()))
    return tuple(row.get("peak_torque_Nm", ()))


def prepared(case, name, values):
    """Setup of the controller `name` with its tuned numbers; if there is no such design, it is refused.

    A baseline gets no more torque than the shipped controller uses in this motion.
    """
    setup = CONTROLLERS[name].setup(case, values)
    if name in OWN:
        return setup
    torque = allowed(case)
    limit = {"torque_limit": list(torque)} if torque else {}
    return replace(setup, controller=setup.controller | UNWATCHED | limit)
