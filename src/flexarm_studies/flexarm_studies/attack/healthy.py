# SPDX-License-Identifier: Apache-2.0
"""False alarms: samples in which nothing is wrong but what is usual, and how often something was reported.

In each run the arm moves, rests, moves back part of the way and holds, each time as far and as fast as it happens, with
the noise and the counts of encoders and gauges, with 20 % of its samples lost and stamps off by up to 40 % of the
period; its payload is off by up to 30 %, and its joints have friction that the controller does not know.
"""

import json
import os
from concurrent.futures import FIRST_COMPLETED, wait
from copy import copy
from dataclasses import replace
from itertools import count
from pathlib import Path

import numpy as np

from flexarm_control.loop.supervisor import State
from flexarm_dynamics.arm.description import Friction
from flexarm_dynamics.errors import FlexarmError

from ..loop import scenario as scenarios
from ..progress import Progress
from ..workers import processes
from .cases import DESIGNED, MOTION, START, arm_of
from .driver import LyingDriver
from .run import drive, driver_of

#: What is usual: lost samples [-], error of a stamp over the period [-], of the payload [-], friction over the
#: torque limit: Coulomb's [-], and viscous at 1 rad/s [-].
LOSS, JITTER, PAYLOAD, COULOMB, VISCOUS = 0.2, 0.4, 0.3, 0.005, 0.005
#: A motion is this part of the case's own way, and takes this multiple of its time [-]; so long it rests [s].
WAY, PACE, RESTS = (0.3, 1.0), (0.9, 1.5), 0.4
#: After its last motion an arm holds for so long [s].
HOLDS = 1.0
#: So many runs of a case after each other are of one motion, whose plan takes longer than the run where links are many.
ALIKE = 5
#: Of each round of runs so many are an arm's; one where none is given. A sample of these costs less.
OFTEN = {"R": 6, "two_link": 2}


def plant(case, random):
    """The simulated arm: that of the case, with another payload's factor, and friction; and that factor."""
    arm = arm_of(case.arm, case.noise)
    joints = []
    for joint in arm.joints:
        coulomb, viscous = random.uniform(0.0, (COULOMB, VISCOUS)) * joint.limits.torque
        known = joint.friction
        friction = Friction(known.viscous + viscous, known.coulomb + coulomb, known.smoothing)
        joints.append(replace(joint, friction=friction))
    return replace(arm, joints=tuple(joints)), random.uniform(1.0 - PAYLOAD, 1.0 + PAYLOAD)


def bears(case):
    """Whether a case's control bears all of that: its real errors would count as false alarms.

    Under gravity only what was designed for unknown payloads does; on two_link a joint swings by itself under
    `motion_kalman` without measured velocity.
    """
    if case.arm == "long_reach":
        return case.observer == DESIGNED
    return case.arm != "two_link" or case.observer != "motion_kalman" or case.velocity


def motion(case, random):
    """There and back part of the way, as a scenario's trajectory; and when it is over [s]."""
    own = case.scenario()
    loop = scenarios.loop_of(own)
    way = scenarios.trajectory_of(own.trajectory, loop.model, loop.simulator.position)
    start, end = way.positions[0], way.positions[-1]
    there = start + random.uniform(*WAY, start.size) * (end - start)
    back = there - random.uniform(*WAY, start.size) * (there - start)
    first, second = MOTION * random.uniform(*PACE, 2)
    times = np.cumsum([0.0, first, RESTS, second]).tolist()
    still = np.zeros((4, start.size)).tolist()
    places = np.stack([start, there, there, back]).tolist()
    return {
        "times": times,
        "positions": places,
        "velocities": still,
        "accelerations": still,
    }, times[-1]


class UsualDriver(LyingDriver):
    """A driver whose samples are lost, and stamped at other times, as is usual.

    So do `state drop` and `state jitter` of the fault injector; numbers from one generator take a tenth of the time.
    """

    def __init__(self, *args, **others):
        super().__init__(*args, **others)
        self._random = np.random.default_rng([self.scenario.seed, 9])
        self._off = JITTER * self.loop.simulator.period_ns

    def _messages(self, true, time):
        if time < START:
            return [true]
        lost, off = self._random.random(), self._random.uniform(-self._off, self._off)
        true.stamp_ns += round(off)
        return [] if lost < LOSS else [true]


class Plans:
    """What controllers have prepared for the last motion of some cases, for those that begin it in the same place."""

    #: So many are kept.
    KEPT = 4

    def __init__(self):
        self._kept = {}

    def prepared(self, case, number, loop, trajectory):
        """What the controller of a case's `loop` prepares for its motion of this `number`; None where it can't."""
        key = str(case), number, loop.controller.reference.resting.tobytes()
        if key not in self._kept:
            while len(self._kept) >= self.KEPT:
                del self._kept[next(iter(self._kept))]
            self._kept[key] = loop.prepared(trajectory)
        return copy(self._kept[key])


PLANS = Plans()


def healthy_run(case, seed):
    """One run: number of samples, and what was reported; empty: nothing. Of `ALIKE` seeds the motion is the same."""
    number, random = seed // ALIKE, np.random.default_rng([seed, 7])
    arm, payload = plant(case, random)
    way, lasts = motion(case, np.random.default_rng([number, 8]))
    own = replace(case.scenario(), plant_arm=arm, payload_scale=payload, seed=seed, trajectory=way)
    driver = driver_of(own, kind=UsualDriver)

    def prepare(trajectory):
        return PLANS.prepared(case, number, driver.loop, trajectory)

    try:
        trace = drive(driver, until=START + lasts + HOLDS, prepare=prepare)
    except FlexarmError as error:
        # The motion is refused: a finding about this arm, not the end of the study.
        return round(START / driver.period), str(error)
    alarms = [text for time, text in trace.texts if text and time > START]
    if trace.lost or trace.state != State.HOLDING:
        alarms.append(trace.lost or f"ends in {trace.state.name}")
    return trace.time.size, "; ".join(dict.fromkeys(alarms))


def planned(cases, seed):
    """Yield (case, seed) without end: rounds in which each arm comes as often as `OFTEN` states, its cases in turn.

    Each case comes `ALIKE` times at once. Cases that can't bear what is usual are left out.
    """
    arms = {}
    for case in filter(bears, cases):
        arms.setdefault(case.arm, []).append(case)
    turns = dict.fromkeys(arms, 0)
    for _ in count():
        for arm, own in arms.items():
            for _ in range(OFTEN.get(arm, 1)):
                case = own[turns[arm] // ALIKE % len(own)]
                yield case, seed * 1_000_000 + turns[arm]
                turns[arm] += 1


def _row(case, seed, samples, alarm):
    return {"case": str(case), "seed": seed, "samples": samples, "alarm": alarm}


def stored(file):
    """Rows of the runs that an earlier study wrote to a file, one a line; none where there is no file.

    Raises
    ------
    FlexarmError
        If something else is in the file. A last line that was cut off is left out.
    """
    path = Path(file)
    if not path.exists():
        return []
    lines = path.read_text(encoding="utf-8").splitlines()
    rows = []
    for number, line in enumerate(lines, 1):
        try:
            row = json.loads(line)
            rows.append({k: row[k] for k in ("case", "seed", "samples", "alarm")})
        except (ValueError, LookupError, TypeError) as error:
            if number < len(lines) or number == 1:
                problem = f"line {number} is not of healthy runs: {error}"
                raise FlexarmError(problem, field=str(file), hint="give another file") from None
    return rows


def _results(calls, workers, samples):
    """Yield a row per run, in processes, until so many `samples` are done."""
    if workers == 1:
        while samples > 0:
            case, seed = next(calls)
            row = _row(case, seed, *healthy_run(case, seed))
            samples -= row["samples"]
            yield row
        return
    with processes(workers) as executor:
        running = {}
        while samples > 0 or running:
            while samples > 0 and len(running) < 2 * workers:
                case, seed = next(calls)
                running[executor.submit(healthy_run, case, seed)] = case, seed
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                row = _row(*running.pop(future), *future.result())
                samples -= row["samples"]
                yield row


def summary(rows):
    """Lines on the runs: how many samples of what, and each alarm."""
    total, alarms = sum(row["samples"] for row in rows), [row for row in rows if row["alarm"]]
    lines = [f"{total} healthy samples in {len(rows)} runs, {len(alarms)} of them with an alarm"]
    for case in dict.fromkeys(row["case"] for row in rows):
        own = [row["samples"] for row in rows if row["case"] == case]
        lines.append(f"{case}: {sum(own)} samples in {len(own)} runs")
    return lines + [f"{row['case']}, seed {row['seed']}: {row['alarm']}" for row in alarms]


def healthy(options, cases):
    """Run `--healthy`; the exit code. With `--json` it goes on where the file ends: an interrupted run counts."""
    rows = stored(options.json) if options.json else []
    known = {(row["case"], row["seed"]) for row in rows}
    calls = (call for call in planned(cases, options.seed) if (str(call[0]), call[1]) not in known)
    done = sum(row["samples"] for row in rows)
    progress = Progress()
    if not any(map(bears, cases)):
        raise FlexarmError("has no case whose control bears a payload of 30 %", field="--observers")
    progress.step(f"{options.healthy} healthy samples")
    workers = options.workers or os.cpu_count() or 1
    for row in _results(calls, workers, options.healthy - done):
        rows.append(row)
        done += row["samples"]
        if options.json:
            with Path(options.json).open("a", encoding="utf-8") as file:
                file.write(json.dumps(row) + "\n")
        progress.fraction(min(1.0, done / options.healthy))
    progress.done()
    text = "\n".join(summary(rows))
    print(text)
    if options.note:
        Path(options.note).write_text(text + "\n", encoding="utf-8")
    return int(any(row["alarm"] for row in rows))
