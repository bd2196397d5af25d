# SPDX-License-Identifier: Apache-2.0
r"""Runs a lie, and measures its effects.

A run is compared with the run of the same case without a lie, `Honest`, whose motion sets the scale:

- *speed*: the largest speed of a joint over its largest speed in the motion, :math:`\max|\dot q_i|/\max|\dot q_i^h|`;
- *strain*: the largest strain on a gauge over the largest strain in the motion; both also *under torque*: before the
  safe action;
- *excursion*: how far a joint leaves the range of the motion [rad];
- *step*: the largest change of torque between two samples, over the largest one in the motion. Start and end of the
  motion are included, because a motion whose jerk jumps changes its torque most there, and so does a run that is
  stopped after the motion. Steps of the motion beyond `KICK` of the torque limit do not enlarge the scale;
- *outlier*: distance of the torque from that of the honest run, as a fraction of its limit; if this is too large and
  sensors have noise, the distance that different noise alone causes is subtracted;
- *returning*: the largest torque in the first `SOON` after an interruption, minus the torque that holds the arm against
  gravity, as a fraction of its limit;
- *silent*: time for which a torque acts without a new sample [s];
- *safe*: time from the lie until the safe action acts or the arm rests [s];
- *named*: time from when the lie can be seen until the controller's reason or the observer's doubt names it [s].
"""

import re
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from flexarm_control.loop.supervisor import State
from flexarm_dynamics.errors import FlexarmError, ModelError
from flexarm_dynamics.singular_perturbation import slow_torque
from flexarm_sim.sensors import Sensors

from ..loop import scenario as scenarios
from . import actions, lies
from .cases import MOTION, START
from .driver import LyingDriver

#: Max. time from the lie to the end of a run, and from a lie of a single sample [s].
AFTER, AT_ONCE = 3.0, 0.6
#: A joint rests below this fraction of its largest speed in the motion [-]; duration of rest that ends a run [s].
RESTS, RESTED = 0.03, 0.3
#: A joint's or gauge's own peak counts for at least this fraction of the largest one [-].
MIN_SCALE = 0.1
#: Largest change of torque between two samples that a motion may set as the scale, relative to the limit [-].
KICK = 0.02
#: Duration for which returning torque is judged [s].
SOON = 0.02
#: The arm is lost if a joint angle is not below this [rad].
LOST = 20.0
#: A joint swings if it is this many times as fast as the motion requires: the loop fails even without a lie [-].
SWINGS = 3.0
#: Largest speed of a quintic motion over its mean speed [-].
QUINTIC = 1.875

#: Relative tolerance, because a measure may be equal to its criterion [-].
ROUNDING = 1e-9
#: Largest permissible value of each measure, in the units of the module; those with "stop" are for lies of kind STOP.
#: `OF_KIND` has the measures of each kind.
CRITERIA = {
    "speed": 1.5,
    "strain": 2.0,
    "excursion": 0.1,
    "named": 0.3,
    "outlier": 0.05,
    "returning": 0.1,
    "silent": 0.05,
    "stop step": 2.0,
    "stop strain": 1.5,
}
#: Runs of these kinds also end when the arm rests under a torque.
RESTING = (lies.SINGLE, lies.INTERRUPTION, lies.STOP)
_MOTION = ("speed", "strain", "excursion", "silent")
OF_KIND = {
    lies.LASTING: (*_MOTION, "named"),
    lies.SINGLE: (*_MOTION, "outlier"),
    lies.INTERRUPTION: (*_MOTION, "returning"),
    lies.STOP: ("speed", "excursion", "stop step", "stop strain"),
    lies.HEALTHY: _MOTION,
}


@dataclass
class Trace:
    """Samples of a run, one per row: k rows.

    Attributes
    ----------
    time : ndarray, shape (k,)
        Since the start of the session [s].
    position, velocity : ndarray, shape (k, n)
        True values [rad], [rad/s].
    strain : ndarray, shape (k, gauges)
        True values [-].
    torque : ndarray, shape (k, n)
        Sent by the controller; NaN where it is DISABLED [N m].
    acts : ndarray of bool, shape (k,)
        Whether a torque acts after the sample, or the safe action.
    age : ndarray, shape (k,)
        Time since the last new sample was answered [s].
    texts : list of (float, str)
        Time and text whenever reason or doubt change.
    state : State
        At the end.
    lost : str
        Why the arm is lost; empty if it is not.
    """

    time: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    strain: np.ndarray
    torque: np.ndarray
    acts: np.ndarray
    age: np.ndarray
    texts: list
    state: State
    lost: str = ""

    def since(self, time):
        """Slice of the samples from `time` on [s]."""
        return slice(int(np.searchsorted(self.time, time - 1e-9)), None)


def drive(
    driver,
    events=(),
    until=START + MOTION + AFTER,
    begin=np.inf,
    rest=0.0,
    holds=False,
    prepare=None,
):
    """Run a `LyingDriver` through the case's motion.

    Parameters
    ----------
    driver : LyingDriver
    events : sequence of (float, callable)
        Actions and their times; sorted [s].
    until : float
        End of the run [s].
    begin, rest : float
        After `begin` the run is over when no torque acts and all joints have been slower than `rest` for `RESTED`.
    holds : bool
        Whether a run also ends when the arm rests under a torque.
    prepare : callable, optional
        Gives the preparation of a trajectory, or None; not given: the loop's own.

    Returns
    -------
    Trace

    Raises
    ------
    FlexarmError
        If the motion is refused, for example because the arm does not rest before it.
    """
    loop, scenario, rows, texts = driver.loop, driver.scenario, [], []
    plant, events = loop.simulator.plant, list(events)
    gauges = Sensors(loop.simulator.plant_model).rows
    rested, lost, last, offered = 0.0, "", "", False
    while driver.time <= until + 1e-9:
        time = driver.time
        if not offered and time >= START - 2e-9:
            _offer(driver, scenario, prepare or loop.prepared)
            offered = True
        while events and events[0][0] <= time + 1e-9:
            events.pop(0)[1]()
        torque = driver.answer()
        controller = loop.controller
        sent = controller.torque if controller.enabled else np.full(plant.q.size, np.nan)
        age = time - driver.last_new
        rows.append(
            np.concatenate(
                [[time, torque is not None, age], plant.q, plant.qd, gauges @ plant.delta, sent]
            )
        )
        text = " | ".join(t for t in (controller.reason, driver.doubt) if t)
        if text != last:
            last = text
            texts.append((time, text))
        slow = (holds or torque is None) and np.abs(plant.qd).max() < rest
        rested = rested + driver.period if slow and time > begin else 0.0
        if rested > RESTED:
            break
        try:
            driver.advance(torque)
        except ModelError as error:
            lost = str(error)
            break
        if not np.abs(plant.q).max() < LOST:
            lost = "turned beyond all sense"
            break
    n, g = plant.q.size, gauges.shape[0]
    rows = np.array(rows)
    time, acts, age, q, qd, strain, sent = np.split(
        rows, np.cumsum([1, 1, 1, n, n, g]).tolist(), axis=1
    )
    return Trace(
        time[:, 0],
        q,
        qd,
        strain,
        sent,
        acts[:, 0] > 0,
        age[:, 0],
        texts,
        loop.controller.state,
        lost,
    )


def _offer(driver, scenario, prepare):
    """Offer the motion; it begins at the next sample."""
    loop = driver.loop
    motion = scenarios.trajectory_of(scenario.trajectory, loop.model, loop.simulator.position)
    plan = prepare(motion) if loop.controller.plans else None
    verdict = loop.controller.offer(motion, plan)
    if not verdict.accepted:
        raise FlexarmError(f"the motion is refused: {verdict.reason}", field=scenario.arm.name)


def driver_of(scenario, *args, kind=LyingDriver, **others):
    """A `LyingDriver`, or another `kind`, whose arm is at the start of the motion."""
    driver = kind(scenario, *args, **others)
    loop = driver.loop
    motion = scenarios.trajectory_of(scenario.trajectory, loop.model, loop.simulator.position)
    if motion.times_ns[0] == 0:
        loop.simulator.reset(motion.positions[0])
    return driver


class Honest:
    """The honest run of a case, that is, the run without a lie, and the scales that it sets."""

    def __init__(self, case):
        self.case, self.scenario = case, case.scenario()
        driver = driver_of(self.scenario)
        self.model, self.period = driver.loop.model, driver.period
        trace = self.trace = drive(driver)
        self.problem = trace.lost
        if trace.state != State.HOLDING:
            self.problem = f"{trace.state.name}: {trace.texts[-1][1] if trace.texts else ''}"
        moving = (trace.time >= START) & (trace.time <= START + MOTION)
        speed = np.abs(trace.velocity[moving]).max(axis=0)
        self.speed = np.maximum(speed, MIN_SCALE * speed.max())
        self.strain = np.abs(trace.strain[moving]).max(initial=0.0)
        self.low, self.high = trace.position[moving].min(axis=0), trace.position[moving].max(axis=0)
        asked = QUINTIC * (self.high - self.low) / MOTION
        if not self.problem and (swings := self.speed > SWINGS * asked).any():
            names = ", ".join(np.array(self.model.joint_names)[swings])
            self.problem = f"{names} swings, up to {(self.speed / asked).max():.2g} times as fast as the motion"
        limit = self.model.arm.torque_limits
        self.limit = np.where(np.isfinite(limit), limit, np.nanmax(np.abs(trace.torque[moving])))
        steps = np.abs(np.diff(trace.torque[trace.since(START)], axis=0)).max(axis=0)
        self.step = np.minimum(np.maximum(steps, MIN_SCALE * steps.max()), KICK * self.limit)

    @cached_property
    def other(self):
        """`Trace` of an honest run with other noise."""
        return drive(driver_of(replace(self.scenario, seed=self.scenario.seed + 1)))

    def static(self, position):
        """Torque that holds the arm against gravity, (n,) [N m]."""
        still = np.zeros(self.model.n_joints)
        return slow_torque(self.model.terms(position, still), still)


def attack(honest, lie, moment, pick=0):
    """Run one lie in the case of an `Honest` run; return a row of numbers, ready for JSON.

    Parameters
    ----------
    honest : Honest
    lie : Lie
    moment : float
        Time of the lie, as a fraction of the motion.
    pick : int
        Index of the joint, gauge or mode.

    Returns
    -------
    dict
        The case's and the lie's names; the measures of the module, None where one does not apply; ``torque``, the
        largest sent torque over its limit; ``text``, the text that named the lie, or the last text; ``state``;
        ``failed``, the criteria that do not hold.
    """
    period = honest.period
    at = START + round(moment * MOTION / period) * period
    lines = lie.lines(honest.model.arm, at, period, pick)
    driver = driver_of(honest.scenario, lines, at)
    events = getattr(actions, lie.action)(driver) if lie.action else []
    events = sorted(((at + after, call) for after, call in events), key=lambda e: e[0])
    over = events[-1][0] if events else at
    after = AT_ONCE if lie.kind == lies.SINGLE else AFTER
    rest = RESTS * honest.speed.min()
    trace = drive(driver, events, at + after, over + 0.3, rest, lie.kind in RESTING)
    row = {"arm": honest.case.arm, "observer": honest.case.observer}
    row |= {"velocity": honest.case.velocity, "lie": lie.name, "kind": lie.kind, "moment": moment}
    return judged(row | measured(honest, lie, trace, driver, at), lie)


def measured(honest, lie, trace, driver, at):
    """The measures of a run."""
    part = trace.since(at)
    speed = np.abs(trace.velocity[part])
    strain = np.abs(trace.strain[part]) / (honest.strain or 1.0)
    acting = np.flatnonzero(trace.acts[part])
    under = slice(acting[-1] + 2 if acting.size else 1)
    q = trace.position[part]
    steps = np.abs(np.diff(trace.torque[part], axis=0)) / honest.step
    steps = steps[np.isfinite(steps).all(axis=1)]
    fraction = np.abs(trace.torque[part]) / honest.limit
    named, text = _named(lie, trace, at, _seen(honest, lie, trace, driver, at))
    return {
        "speed": float((speed / honest.speed).max()),
        "speed under torque": float((speed / honest.speed)[under].max()),
        "strain": float(strain.max(initial=0.0)),
        "strain under torque": float(strain[under].max(initial=0.0)),
        "excursion": float(np.maximum(honest.low - q, q - honest.high).max(initial=0.0)),
        "step": float(steps.max(initial=0.0)),
        "torque": float(np.nanmax(fraction, initial=0.0)),
        "outlier": _outlier(honest, trace, at) if lie.kind == lies.SINGLE else None,
        "returning": _returning(honest, trace, part),
        "silent": float(np.where(trace.acts[part], trace.age[part], 0.0).max()),
        "safe": _safe(honest, trace, at, part),
        "named": named,
        "text": text,
        "state": trace.state.name,
        "lost": trace.lost,
    }


def _outlier(honest, trace, at):
    """Distance of the torque from that of the honest run, over its limit; 1 where only one of them has a torque."""
    part = slice(trace.since(at).start, min(trace.time.size, honest.trace.time.size))
    difference = _apart(honest, trace, part)
    if difference > CRITERIA["outlier"] and honest.case.noise:
        difference = max(0.0, difference - _apart(honest, honest.other, part))
    return difference


def _apart(honest, trace, part):
    """Largest distance of a trace's torque from that of the honest run in a part, over the limit; see `_outlier`."""
    difference = np.abs(trace.torque[part] - honest.trace.torque[part]) / honest.limit
    return float(np.where(np.isfinite(difference), difference, 1.0).max())


def _returning(honest, trace, part):
    """Largest torque just after each interruption; None without an interruption."""
    acts = trace.acts[part]
    starts = np.flatnonzero(acts[1:] & ~acts[:-1]) + 1 + (part.start or 0)
    found = []
    for start in starts:
        end = start + round(SOON / honest.period)
        torque = trace.torque[start:end] - honest.static(trace.position[start])
        found.append(float(np.nanmax(np.abs(torque) / honest.limit, initial=0.0)))
    return max(found) if found else None


def _safe(honest, trace, at, part):
    """From the lie until the safe action acts for good or the arm rests for good; None if it never does."""
    slow = (np.abs(trace.velocity[part]) < RESTS * honest.speed).all(axis=1)
    safe = slow | ~trace.acts[part]
    if not safe[-1]:
        return None
    wrong = np.flatnonzero(~safe)
    first = wrong[-1] + 1 if wrong.size else 0
    return float(trace.time[part][first] - at)


def _seen(honest, lie, trace, driver, at):
    """First time when the false reading differs from the true one by `visible` [s]; infinite if it never does."""
    if not lie.visible:
        return at
    name = lie.faults[0].split()[0].split(".")[0]
    off = driver.off.get(name, [])
    return next((time for time, size in off if size >= lie.visible), np.inf)


def _named(lie, trace, at, seen):
    """Time from when it could be `seen` [s] until the lie of the time `at` was named, and the text that named it.

    None if it could not be seen or if nothing has to be named; infinite if it was not named.
    """
    texts = [(time, text) for time, text in trace.texts if text and time >= at - 1e-9]
    late = texts[-1][1] if texts else ""
    if not lie.says:
        return None, late
    for time, text in texts:
        if re.search(lie.says, text.lower()):
            return max(0.0, float(time - min(seen, time))), text
    return (None, late) if seen == np.inf else (np.inf, late)


def judged(row, lie):
    """The row with the criteria that it fails."""
    failed = []
    for name in OF_KIND[lie.kind]:
        value = row[name.removeprefix("stop ")]
        if value is not None and value > CRITERIA[name] * (1.0 + ROUNDING):
            under = row.get(f"{name} under torque", np.inf)
            failed.append(f"the safe action's {name}" if under <= CRITERIA[name] else name)
    if row["lost"]:
        failed.append("arm lost")
    if lie.ends and row["state"] != lie.ends:
        failed.append(f"ends in {row['state']}")
    if lie.kind == lies.HEALTHY and row["state"] != "HOLDING":
        failed.append(f"alarm: {row['text']}")
    if lie.kind == lies.STOP and row["state"] == "FAULT":
        failed.append("ends in FAULT")
    row = {
        k: round(v, 9) + 0.0 if isinstance(v, float) and v != np.inf else v for k, v in row.items()
    }
    row = {k: None if v == np.inf else v for k, v in row.items()}
    return row | {"failed": failed}


def case_of(lie, case):
    """The case for a lie: with ideal sensors for stops, with what the lie needs published."""
    noise = case.noise and lie.kind != lies.STOP
    observer = "true_rates" if lie.rates else case.observer
    return replace(case, noise=noise, amplitude=lie.amplitude, rates=lie.rates, observer=observer)
