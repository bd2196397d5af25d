# SPDX-License-Identifier: Apache-2.0
"""Counts false alarms: reports about samples with only the usual disturbances.

In each run the arm moves, rests, moves back part of the way and holds, with random distances and speeds. Encoders and
gauges have their noise and counts, 20 % of the samples are lost, and stamps are off by up to 40 % of the period. The
payload is off by up to 30 %, and the joints have friction that the controller does not know.
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

#: The usual disturbances: lost samples [-], error of a stamp over the period [-], error of the payload [-], friction
#: over the torque limit: Coulomb [-], and viscous at 1 rad/s [-].
LOSS, JITTER, PAYLOAD, COULOMB, VISCOUS = 0.2, 0.4, 0.3, 0.005, 0.005
#: Ranges of a motion's distance and duration, relative to those of the case's motion [-]; duration of a rest [s].
WAY, PACE, RESTS = (0.3, 1.0), (0.9, 1.5), 0.4
#: Duration for which an arm holds after its last motion [s].
HOLDS = 1.0
#: Number of successive runs of a case with the same motion: with many links, its plan takes longer than the run.
ALIKE = 5
#: Number of an arm's runs in each round, by default one. A sample of these arms costs less.
OFTEN = {"R": 6, "two_link": 2}


def plant(case, random):
    """The simulated arm: the case's, with additional random friction; and a random factor of its payload."""
    arm = arm_of(case.arm, case.noise)
    joints = []
    for joint in arm.joints:
        coulomb, viscous = random.uniform(0.0, (COULOMB, VISCOUS)) * joint.limits.torque
        known = joint.friction
        friction = Friction(known.viscous + viscous, known.coulomb + coulomb, known.smoothing)
        joints.append(replace(joint, friction=friction))
    return replace(arm, joints=tuple(joints)), random.uniform(1.0 - PAYLOAD, 1.0 + PAYLOAD)


def bears(case):
    """Whether a case's control withstands the usual disturbances; if not, its real errors would count as false alarms.

    Under gravity only a control designed for unknown payloads does. On two_link a joint swings by itself under
    `motion_kalman` without measured velocity.
    """
    if case.arm == "long_reach":
        return case.observer == DESIGNED
    return case.arm != "two_link" or case.observer != "motion_kalman" or case.velocity


def motion(case, random):
    """A motion there and part of the way back, as a scenario's trajectory; and the time of its end [s]."""
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
    """A driver that loses samples and stamps them at other times, to the usual extent.

    `state drop` and `state jitter` of the fault injector do the same. Here one generator makes all random numbers,
    which takes a tenth of the time.
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
    """Keeps what controllers have prepared for the last motions, for loops that begin them in the same place."""

    #: Number of preparations that are kept.
    KEPT = 4

    def __init__(self):
        self._kept = {}

    def prepared(self, case, number, loop, trajectory):
        """What the controller of a case's `loop` prepares for its motion of this `number`; None if it can't."""
        key = str(case), number, loop.controller.reference.resting.tobytes()
        if key not in self._kept:
            while len(self._kept) >= self.KEPT:
                del self._kept[next(iter(self._kept))]
            self._kept[key] = loop.prepared(trajectory)
        return copy(self._kept[key])


PLANS = Plans()


def healthy_run(case, seed):
    """One run: number of samples, and what was reported; empty: nothing. `ALIKE` seeds share the same motion."""
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
        # The motion is refused: this is a finding about the arm, not the end of the study.
        return round(START / driver.period), str(error)
    alarms = [text for time, text in trace.texts if text and time > START]
    if trace.lost or trace.state != State.HOLDING:
        alarms.append(trace.lost or f"ends in {trace.state.name}")
    return trace.time.size, "; ".join(dict.fromkeys(alarms))


def planned(cases, seed):
    """Yield (case, seed) without end, in rounds: each arm comes as often as `OFTEN` states, with its cases in turn.

    Each case comes `ALIKE` times in succession. Cases that can't withstand the usual disturbances are left out.
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
    """Rows of the runs that an earlier study wrote to a file, one per line; none if there is no file.

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
    """Yield a row per run, in processes, until this number of `samples` is done."""
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
    """Lines about the runs: number of samples of each case, and each alarm."""
    total, alarms = sum(row["samples"] for row in rows), [row for row in rows if row["alarm"]]
    lines = [f"{total} healthy samples in {len(rows)} runs, {len(alarms)} of them with an alarm"]
    for case in dict.fromkeys(row["case"] for row in rows):
        own = [row["samples"] for row in rows if row["case"] == case]
        lines.append(f"{case}: {sum(own)} samples in {len(own)} runs")
    return lines + [f"{row['case']}, seed {row['seed']}: {row['alarm']}" for row in alarms]


def healthy(options, cases):
    """Run `--healthy`; return the exit code. With `--json` it goes on where the file ends: interrupted runs count."""
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
