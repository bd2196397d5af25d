# SPDX-License-Identifier: Apache-2.0
"""Defines the lies: what the driver does wrong, when, and what must follow from it.

A lie consists of lines of `flexarm_sim.fault_injector`, which the simulator's node can use as well
(docs/fault_injection.md), or of an action on driver and controller, see `actions`. In a line ``{at}`` is the moment of
the lie, ``{one}`` the time of one sample, ``{jitter}`` 40 % of it; ``{joint}``, ``{gauge}`` and ``{mode}`` are an entry
of the arm.
"""

from dataclasses import dataclass

import numpy as np

#: Moments, as fractions of the motion: at its fastest, and while its end is held.
MOVING, HOLDING = (0.5,), (1.15,)
#: Moments of `~/stop` and of exceeded limits.
MANY = (0.05, 0.25, 0.5, 0.75, 0.95, 1.0)
#: Moments at which the links are bent: in the middle they are not, and the limit would be at the level of noise.
BENT = (0.25, 0.75, 0.95)

#: Kinds of lies, by what must follow from them.
LASTING, SINGLE, INTERRUPTION, STOP, HEALTHY = (
    "lasting",
    "single",
    "interruption",
    "stop",
    "healthy",
)


@dataclass(frozen=True)
class Lie:
    """One lie.

    Attributes
    ----------
    name : str
    kind : str
        LASTING: it does not end, and must be named; SINGLE: one sample, which must have hardly any effect;
        INTERRUPTION: torque ends and returns; STOP: the controller must bring the arm to rest; HEALTHY: no lie, no
        alarm.
    faults : tuple of str
    action : str
        Name of a function of `actions`.
    says : str
        Regular expression of the text that names the lie, in lower case; empty if nothing has to be named.
    ends : str
        Required state of the supervisor at the end, if any.
    moments : tuple of float
    velocity : bool
        It needs measured joint velocities.
    gauges : int
        Number of gauges that it needs.
    amplitude, rates : bool
        It needs a driver that sends modal amplitudes, modal rates.
    visible : float
        Smallest error of the false reading at which the lie can be seen, in the reading's unit; 0: it can be seen from
        its first sample.
    """

    name: str
    kind: str
    faults: tuple = ()
    action: str = ""
    says: str = ""
    ends: str = ""
    moments: tuple = MOVING + HOLDING
    velocity: bool = False
    gauges: int = 0
    amplitude: bool = False
    rates: bool = False
    visible: float = 0.0

    def lines(self, arm, at, period, pick=0):
        """The lines of the lie for an `arm`, at a time `at` [s]; `pick` chooses the entry."""
        entries = {"joint": arm.joint_names, "gauge": arm.gauge_names, "mode": arm.observed_modes}
        words = {k: v[pick % len(v)] for k, v in entries.items() if v}
        return tuple(
            line.format(at=repr(at), one=0.5 * period, jitter=0.4 * period, **words)
            for line in self.faults
        )

    def suits(self, case, arm):
        """Whether it is possible in a case, on an arm."""
        return (case.velocity or not self.velocity) and len(arm.gauges) >= self.gauges


def _readings():
    """Lasting lies about one reading, and lies of one sample."""
    position, velocity = r"position|encoder", r"velocity"
    strain = r"strain|gauge"
    far, fast, bent = 0.01, 0.1, 2e-5
    return (
        Lie(
            "encoder stuck",
            LASTING,
            ("joint_position.{joint} stick from={at}",),
            says=position,
            visible=far,
        ),
        Lie(
            "encoder jumps by 0.2 rad",
            LASTING,
            ("joint_position.{joint} bias by=0.2 from={at}",),
            says=position,
        ),
        Lie(
            "encoder drifts by 0.1 rad/s",
            LASTING,
            ("joint_position.{joint} drift by=0.1 from={at}",),
            says=position,
            visible=far,
            moments=MOVING,
        ),
        Lie(
            "velocity of the wrong sign",
            LASTING,
            ("joint_velocity.{joint} scale by=-1 from={at}",),
            says=velocity,
            velocity=True,
            visible=fast,
        ),
        Lie(
            "velocity doubled",
            LASTING,
            ("joint_velocity.{joint} scale by=2 from={at}",),
            says=velocity,
            velocity=True,
            visible=fast,
        ),
        Lie(
            "velocity stuck",
            LASTING,
            ("joint_velocity.{joint} stick from={at}",),
            says=velocity,
            velocity=True,
            visible=fast,
        ),
        Lie(
            "one gauge stuck",
            LASTING,
            ("strain.{gauge} stick from={at}",),
            says=strain,
            gauges=1,
            visible=bent,
        ),
        Lie(
            "all gauges stuck",
            LASTING,
            ("strain stick from={at}",),
            says=strain,
            gauges=1,
            visible=bent,
        ),
        Lie(
            "strains of the wrong sign",
            LASTING,
            ("strain scale by=-1 from={at}",),
            says=strain,
            gauges=1,
            visible=bent,
        ),
        Lie(
            "two gauges exchanged",
            LASTING,
            ("strain.{gauge} exchange from={at}",),
            says=strain,
            gauges=2,
            visible=bent,
        ),
        Lie(
            "gauge drifts by 100 microstrain/s",
            LASTING,
            ("strain.{gauge} drift by=1e-4 from={at}",),
            says=strain,
            gauges=1,
            visible=bent,
        ),
        Lie(
            "modal amplitude scaled by -1",
            LASTING,
            ("modal_amplitude scale by=-1 from={at}",),
            says=r"amplitude|strain|gauge",
            amplitude=True,
            moments=MOVING,
            gauges=1,
        ),
        Lie(
            "modal rate 900",
            LASTING,
            ("modal_rate bias by=900 from={at}",),
            says=r"modal_rate",
            rates=True,
            gauges=1,
        ),
        Lie(
            "one encoder sample off by 0.02 rad",
            SINGLE,
            ("joint_position.{joint} bias by=0.02 from={at} for={one}",),
        ),
        Lie(
            "one velocity sample off by 1 rad/s",
            SINGLE,
            ("joint_velocity.{joint} bias by=1 from={at} for={one}",),
            velocity=True,
        ),
        Lie(
            "one gauge sample off by 200 microstrain",
            SINGLE,
            ("strain.{gauge} bias by=2e-4 from={at} for={one}",),
            gauges=1,
        ),
        Lie(
            "one modal rate of 900",
            SINGLE,
            ("modal_rate.{mode} bias by=900 from={at} for={one}",),
            rates=True,
            gauges=1,
        ),
    )


def _messages():
    """Lies about messages, sessions and clocks."""
    clock, session = r"stamp|clock", r"session|source|restart"
    return (
        Lie(
            "message repeated for ever",
            LASTING,
            ("state repeat from={at}",),
            says=r"no arm_state|repeat|new s|again",
            ends="FAULT",
        ),
        Lie(
            "message repeated, gate renewed by it",
            LASTING,
            ("state repeat from={at}",),
            action="credulous_gate",
            says=r"no arm_state|repeat|new s|again",
            ends="FAULT",
        ),
        Lie(
            "frozen frame",
            LASTING,
            ("state freeze from={at}",),
            says=r"frozen|freez|stuck|unchang|same|identical|still",
        ),
        Lie(
            "two drivers in turn",
            LASTING,
            ("session alternate from={at}",),
            says=session,
            ends="FAULT",
        ),
        Lie(
            "new session, the same zero",
            LASTING,
            ("session change at={at}",),
            says=session,
            ends="FAULT",
            moments=MOVING,
        ),
        Lie(
            "new session, zero off by 0.5 rad",
            LASTING,
            ("session change at={at}", "joint_position.{joint} bias by=0.5 from={at}"),
            says=session,
            ends="FAULT",
            moments=MOVING,
        ),
        Lie("clock back by 1 s", LASTING, ("clock jump by=-1 at={at}",), says=clock, ends="FAULT"),
        Lie(
            "clock ahead by 10 s", LASTING, ("clock jump by=10 at={at}",), says=clock, ends="FAULT"
        ),
        Lie("clock ahead by 0.3 s", LASTING, ("clock jump by=0.3 at={at}",), says=clock),
        Lie("stall of 100 ms", INTERRUPTION, ("state drop from={at} for=0.1",)),
        Lie("stall of 40 ms", INTERRUPTION, ("state drop from={at} for=0.04",)),
        Lie(
            "20 % lost, stamps 40 % off",
            HEALTHY,
            ("state drop share=0.2 seed=5 from={at}", "state jitter by={jitter} seed=6 from={at}"),
            moments=(-0.05,),
        ),
        Lie("nothing wrong", HEALTHY, moments=(-0.05,)),
    )


def _actions():
    """Actions of users, other senders and drives."""
    refused = r"refus|report|not appl|applied|safe action|driver"
    return (
        Lie("torque refused for good", LASTING, action="refuse", says=refused, ends="FAULT"),
        Lie("torque refused for 1 s", INTERRUPTION, action="refuse_a_second", says=refused),
        Lie(
            "torque spoofed for 20 ms",
            LASTING,
            action="spoof",
            says=r"torque",
            moments=MOVING + HOLDING,
        ),
        Lie("a fault, and recover 20 ms later", INTERRUPTION, action="recover_moving"),
        Lie("controller restarted after 20 ms", INTERRUPTION, action="restart_soon"),
        Lie("controller restarted after 200 ms", INTERRUPTION, action="restart_later"),
        Lie("observer restarted", INTERRUPTION, action="restart_observer"),
        Lie("a fault: the safe action alone", INTERRUPTION, action="fail"),
        Lie("~/stop", STOP, action="stop", moments=MANY),
        Lie("stop at the limit of tracking", STOP, action="limit_tracking", moments=MANY[1:-1]),
        Lie("stop at the limit of strain", STOP, action="limit_strain", moments=BENT, gauges=1),
        Lie(
            "stop at the limit of deflection",
            STOP,
            action="limit_deflection",
            moments=BENT,
            gauges=1,
        ),
        Lie("the observer asks for a stop", STOP, action="asked_to_stop", moments=MANY),
    )


LIES = {lie.name: lie for lie in (*_readings(), *_messages(), *_actions())}


def random_lies(count, seed):
    """`count` lies drawn at random, each with a moment of its own: outliers, biases, scales, windows of any length.

    They are judged only by what the arm does: if several sensors lie, it is unknown which one must be named.
    """
    random = np.random.default_rng(seed)
    signals = {
        "joint_position.{joint}": (0.5, "rad"),
        "joint_velocity.{joint}": (2.0, "rad/s"),
        "strain.{gauge}": (5e-4, "m/m"),
        "strain": (5e-4, "m/m"),
    }
    lies = []
    for number in range(count):
        faults = []
        for _ in range(random.integers(1, 3)):
            signal = str(random.choice(list(signals)))
            size = signals[signal][0] * random.uniform(-1.0, 1.0)
            window = f"from={{at}} for={10.0 ** random.uniform(-3.0, 0.5):.4g}"
            factor = random.uniform(-1.5, 2.5)
            kinds = ("stick", f"bias by={size:.4g}", f"scale by={factor:.3g}")
            kind = random.choice([*kinds, f"drift by={2.0 * size:.4g}"])
            faults.append(f"{signal} {kind} {window}")
        moment = float(round(random.uniform(0.05, 1.4), 3))
        lies.append(Lie(f"random {seed}.{number}", LASTING, tuple(faults), moments=(moment,)))
    return {lie.name: lie for lie in lies}
