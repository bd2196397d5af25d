# SPDX-License-Identifier: Apache-2.0
"""Who is compared: the shipped composite control and its rivals, with the numbers of each that are tuned.

Every rival's first guess has the bandwidth of the shipped controller's slow poles, on ranges that are wide. A joint's
PID gains are written by the inertia m_i that it turns in the motion's end: p = m w^2, d = 2 zeta m w, i = kappa m w^3,
so that one bandwidth w (and for several joints the ratio of the last joint's to the first's, and of their damping) is
tuned, not a gain each.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np

from flexarm_control.motions import shapers
from flexarm_control.trajectory import specs
from flexarm_dynamics.errors import DesignError
from flexarm_dynamics.linear import linear_plant, sampled
from flexarm_dynamics.singular_perturbation import frequencies_and_damping

from . import subjects, trial
from .rivals import FullStateLqr, JointPid, lqr_gain, slowest
from .tuning import Free

#: Largest part of a joint's torque that the integral may hold.
INTEGRAL_SHARE = 0.3
#: Modes that a shaper is for, and the damping ratio above which one needs none.
SHAPED, DAMPED = 2, 0.5
#: Shortest profile that is shaped, in parts of the motion's duration.
SHORTEST = 0.4

#: Rigid control that the full-order check refuses is run all the same [1/s].
ANYHOW = -1e3

SHIPPED, PREVIEW, TUNED = (f"composite ({kind})" for kind in ("shipped", "preview", "tuned"))
#: Those that are no rivals.
OWN = (SHIPPED, PREVIEW, TUNED)
PID = "joint PID"

#: What would stop a rival that is far off; how far is too far, the comparison says itself.
UNWATCHED = dict.fromkeys(
    ("tracking_error_limit", "velocity_margin", "position_margin", "saturation_time"), 0.0
)

#: Where a law of its own answers: the composite control that is built around it does nothing.
IDLE = {
    "slow.type": "none",
    "fast.type": "none",
    "manifold.type": "quasi_steady",
    "feedforward": "none",
}


@dataclass(frozen=True)
class Setup:
    """One contender with its numbers, ready to be run.

    Attributes
    ----------
    controller : dict
        Flat parameters, as `Scenario.controller`.
    law : callable or None
        Of the arm's model: a law that answers instead of the composite control.
    motion : callable or None
        Of the arm's model: the trajectory that is sent instead of the motion.
    """

    controller: dict = field(default_factory=dict)
    law: Callable | None = None
    motion: Callable | None = None


@dataclass(frozen=True)
class Contender:
    """A name, what may be tuned, and what is made of it.

    Attributes
    ----------
    name : str
    free : callable
        Of a `Subject`: tuple of `Free`.
    setup : callable
        Of a `Subject` and the values: `Setup`; raises a FlexarmError where there is no such design.
    screen : callable or None
        Of a `Subject` and the values: what `tuning.tune` looks at before it simulates.
    """

    name: str
    free: Callable
    setup: Callable
    screen: Callable | None = None


# The composite control ---------------------------------------------------------------------------


def _shipped_setup(subject, values):
    return Setup(subject.values())


def _preview_setup(subject, values):
    return Setup(subject.values() | {"feedforward": "preview"})


def _composite_free(subject):
    alpha = float(_alpha(subject.values()))
    return (
        Free("slow poles, times", 0.3, 3.0, 1.0, log=True),
        Free("fast.q, times", 1e-2, 1e2, 1.0, log=True),
        Free("fast.alpha [1/s]", 0.0, max(2.0 * alpha, 2.0), alpha),
    )


def _alpha(values):
    return values.get("fast.alpha", 5.0)


def _composite_setup(subject, values):
    speed, weight, alpha = values
    shipped = subject.values()
    kp = np.array(shipped.get("slow.kp", [6.25]))
    kv = np.array(shipped.get("slow.kv", [5.0]))
    q = np.array(shipped.get("fast.q", [1.0]))
    tuned = {
        "slow.kp": (speed**2 * kp).tolist(),
        "slow.kv": (speed * kv).tolist(),
        "fast.q": (weight * q).tolist(),
        "fast.alpha": alpha,
    }
    return Setup(shipped | tuned)


def bandwidth(subject):
    """Of the shipped controller's slow poles: what the rivals begin with [rad/s]."""
    return float(max(subject.values().get("slow.kp", [6.25]))) ** 0.5


def _limits(arm):
    return np.array([joint.limits.torque for joint in arm.arm.joints])


def _inertia(subject):
    """What each joint turns in the motion's end, the arm rigid, (n,) [kg m^2]."""
    arm = subjects.model_of(subject.arm)
    n = arm.n_joints
    return np.diag(arm.terms(subjects.ends_of(subject)[1], np.zeros(n)).M)[:n]


# PID ---------------------------------------------------------------------------------------------


def _pid_free(subject):
    ratio = (
        Free("w_last/w_first", 0.2, 20.0, 1.0, log=True),
        Free("zeta_last/zeta_first", 1e-2, 10.0, 1.0, log=True),
    )
    return (
        Free("w [rad/s]", 0.3, 60.0, bandwidth(subject), log=True),
        Free("zeta", 0.1, 5.0, 1.0, log=True),
        Free("kappa", 0.0, 0.3, 0.02),
        Free("velocity/d", 0.0, 1.0, 0.0),
        Free("acceleration/m", 0.0, 1.5, 1.0),
        *(ratio if subjects.model_of(subject.arm).n_joints > 1 else ()),
    )


def pid_gains(subject, values):
    """Gains of `JointPid` from the numbers that are tuned."""
    w, zeta, kappa, velocity, acceleration, *ratio = values
    arm = subjects.model_of(subject.arm)
    inertia, limit = _inertia(subject), _limits(arm)
    share = np.linspace(0.0, 1.0, arm.n_joints)
    faster, stiffer = ratio or (1.0, 1.0)
    w, zeta = w * faster**share, zeta * stiffer**share
    d = 2.0 * zeta * w * inertia
    return {
        "p": w**2 * inertia,
        "i": kappa * w**3 * inertia,
        "d": d,
        "i_clamp": INTEGRAL_SHARE * limit,
        "velocity": velocity * d,
        "acceleration": acceleration * inertia,
    }


def _observer(subject):
    """The observer that the shipped controller has: everyone hears the same."""
    return {k: v for k, v in subject.values().items() if k.startswith("observer.")}


@lru_cache
def _seen(subject, law):
    """What a rival's law works out along the motion: the same in every simulation."""
    return {}


@lru_cache
def _plants(subject):
    """The sampled arm, linear at rest, in the motion's beginning and end."""
    arm = subjects.model_of(subject.arm)
    ends = subjects.ends_of(subject)
    return [sampled(*linear_plant(arm, q, coulomb=False), 1.0 / subject.rate) for q in ends]


def _pid_screen(subject, values):
    """Slowest pole: joints and bending come to rest within its time [1/s]."""
    law = JointPid(subjects.model_of(subject.arm), pid_gains(subject, values))
    return slowest(_plants(subject), law.K, 1.0 / subject.rate)


def _pid_setup(subject, values):
    gains = pid_gains(subject, values)
    return Setup(
        IDLE | _observer(subject), lambda model: JointPid(model, gains, _seen(subject, PID))
    )


# PID with a shaper -------------------------------------------------------------------------------


def _shaped_free(subject):
    return (Free("shaper's time taken from the motion, share", 0.0, 1.0, 0.0), *_pid_free(subject))


def _shaped_setup(kind):
    def setup(subject, values):
        share, *rest = values
        gains = pid_gains(subject, rest)
        motion = shaped_motion(subject, gains, kind, share)
        return Setup(
            IDLE | _observer(subject), lambda model: JointPid(model, gains), lambda model: motion
        )

    return setup


def _shaped_screen(subject, values):
    return _pid_screen(subject, values[1:])


def shaper_for(subject, gains, kind):
    """Shaper of the lowest modes that ring under the PID law, at the motion's end.

    `kind` is zv or zvd.

    Raises
    ------
    DesignError
        When none rings, or the law alone is unstable.
    """
    end = subjects.ends_of(subject)[1]
    poles = JointPid(subjects.model_of(subject.arm), gains).poles(end)
    omega, zeta = frequencies_and_damping(poles)
    if poles.real.max() > 0.0:
        raise DesignError(f"{subject.arm}: the joints' PID alone is unstable")
    rings = zeta < DAMPED
    if not rings.any():
        raise DesignError(f"{subject.arm}: nothing rings under the joints' PID: no shaper")
    return shapers.for_modes(kind, omega[rings][:SHAPED], np.maximum(zeta[rings][:SHAPED], 0.0))


def shaped_motion(subject, gains, kind, share):
    """The motion shaped; of its profile `share` times the shaper's length is taken, so that it ends as much earlier."""
    shaper = shaper_for(subject, gains, kind)
    whole = subject.duration
    profile = subjects.profile_of(subject, max(whole - share * shaper.duration, SHORTEST * whole))
    return specs.sampled(shaper.apply(profile), subjects.model_of(subject.arm))


# Full-state LQR ----------------------------------------------------------------------------------


def _lqr_free(subject):
    # As large as the error of which a PD law of the same bandwidth makes the largest torque.
    w, limit = bandwidth(subject), _limits(subjects.model_of(subject.arm))
    error = float(np.clip((limit / _inertia(subject)).min() / w**2, 1e-2, 100.0))
    return (
        Free("joint error [rad]", 1e-3, 1e3, error, log=True),
        Free("joint rate [rad/s]", 1e-2, 1e3, 0.5 * error * w, log=True),
        Free("modal rate [m/s]", 1e-3, 1e2, 1.0, log=True),
        Free("alpha [1/s]", 0.0, 8.0, 0.5 * w),
        Free("acceleration, share", 0.0, 1.5, 1.0),
    )


def _lqr_setup(subject, values):
    *sizes, decay, share = values
    end = subjects.ends_of(subject)[1]
    return Setup(
        IDLE | _observer(subject),
        lambda model: FullStateLqr(
            model, end, subject.rate, sizes, decay, share, _seen(subject, "LQR")
        ),
    )


def _lqr_screen(subject, values):
    end = subjects.ends_of(subject)[1]
    try:
        K = lqr_gain(subjects.model_of(subject.arm), end, subject.rate, values[:3], values[3])
    except DesignError:
        return float("inf")
    return slowest(_plants(subject), K, 1.0 / subject.rate)


# Adaptive rigid control --------------------------------------------------------------------------


def _adaptive_free(subject):
    return (
        Free("kp [1/s^2]", 0.1, 100.0, bandwidth(subject) ** 2, log=True),
        Free("kv/(2 sqrt kp)", 1.0, 3.0, 1.0),
        Free("adaptation_gain [s^2]", 1e-2, 20.0, 2.0, log=True),
    )


def _adaptive_setup(subject, values):
    kp, damping, gain = values
    law = {
        "slow.type": "adaptive_model_following",
        "slow.kp": [kp],
        # A trace above: a double pole that rounding makes complex is refused.
        "slow.kv": [2.0 * damping * kp**0.5 * (1.0 + 1e-9)],
        "slow.adaptation_gain": gain,
        "stability_margin": ANYHOW,
    }
    return Setup(IDLE | law | _observer(subject))


CONTENDERS = {
    c.name: c
    for c in (
        Contender(SHIPPED, lambda subject: (), _shipped_setup),
        Contender(PREVIEW, lambda subject: (), _preview_setup),
        Contender(TUNED, _composite_free, _composite_setup),
        Contender(PID, _pid_free, _pid_setup, _pid_screen),
        Contender("joint PID, ZV shaper", _shaped_free, _shaped_setup("zv"), _shaped_screen),
        Contender("joint PID, ZVD shaper", _shaped_free, _shaped_setup("zvd"), _shaped_screen),
        Contender("full-state LQR", _lqr_free, _lqr_setup, _lqr_screen),
        Contender("adaptive rigid", _adaptive_free, _adaptive_setup),
    )
}


@lru_cache
def allowed(subject):
    """Peak torque of the shipped controller on the subject's motion, per joint [N m]; empty where it fails."""
    row = trial.run(subject, _shipped_setup(subject, ()))
    return tuple(row.get("peak_torque_Nm", ()))


def prepared(subject, name, values):
    """Setup of a contender; a rival has no more torque than the shipped controller takes on this motion.

    `name` is the contender's, `values` its tuned numbers.

    Raises
    ------
    FlexarmError
        Where there is no such design.
    """
    setup = CONTENDERS[name].setup(subject, values)
    if name in OWN:
        return setup
    most = allowed(subject)
    limit = {"torque_limit": list(most)} if most else {}
    return replace(setup, controller=setup.controller | UNWATCHED | limit)
