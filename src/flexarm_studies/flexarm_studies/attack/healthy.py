# SPDX-License-Identifier: Apache-2.0
"""False alarms: samples in which nothing is wrong but what is usual, and how often something was reported.

In each run the arm moves and holds, with noise and counts, with 20 % of its samples lost and stamps off by up to 40 %
of the period; its payload is off by up to 30 %, and its joints have friction that the controller does not know.
"""

import os
from concurrent.futures import as_completed
from dataclasses import replace
from pathlib import Path

import numpy as np

from flexarm_control.loop.supervisor import State
from flexarm_dynamics.arm.description import Friction
from flexarm_dynamics.errors import FlexarmError

from ..progress import Progress
from ..workers import processes
from .cases import START, arm_of
from .run import drive, driver_of

#: What is usual: lost samples [-], error of a stamp over the period [-], of the payload [-], friction over the
#: torque limit: Coulomb's [-], and viscous at 1 rad/s [-].
LOSS, JITTER, PAYLOAD, COULOMB, VISCOUS = 0.2, 0.4, 0.3, 0.005, 0.005
#: A run lasts so long [s].
LASTS = 6.0


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


def healthy_run(case, seed):
    """One run: number of samples, and what was reported; empty: nothing."""
    random = np.random.default_rng([seed, 7])
    arm, payload = plant(case, random)
    own = replace(case.scenario(), plant_arm=arm, payload_scale=payload, seed=seed)
    faults = (
        f"state drop share={LOSS} seed={seed}",
        f"state jitter by={JITTER / own.rate} seed={seed}",
    )
    driver = driver_of(own, faults, START)
    try:
        trace = drive(driver, until=LASTS)
    except (
        FlexarmError
    ) as error:  # the motion is refused: a finding about this arm, not the end of the study
        return round(START / driver.period), str(error)
    alarms = [text for time, text in trace.texts if text and time > START]
    if trace.lost or trace.state != State.HOLDING:
        alarms.append(trace.lost or f"ends in {trace.state.name}")
    return trace.time.size, "; ".join(dict.fromkeys(alarms))


def healthy(options, cases):
    """Run `--healthy`; the exit code."""
    progress, done, alarms = Progress(), 0, []
    workers = options.workers or os.cpu_count() or 1
    progress.step(f"{options.healthy} healthy samples")
    counts = dict.fromkeys(map(str, cases), 0)
    with processes(workers) as executor:
        number, running = 0, {}
        while done < options.healthy or running:
            while done < options.healthy and len(running) < 2 * workers:
                case, seed = cases[number % len(cases)], options.seed * 1_000_000 + number
                running[executor.submit(healthy_run, case, seed)] = case, seed
                number += 1
            future = next(as_completed(running))
            case, seed = running.pop(future)
            samples, text = future.result()
            done, counts[str(case)] = done + samples, counts[str(case)] + samples
            if text:
                alarms.append((case, seed, text))
            progress.fraction(min(1.0, done / options.healthy))
    progress.done()
    lines = [f"{done} healthy samples in {number} runs, {len(alarms)} of them with an alarm"]
    lines += [f"{case}: {count} samples" for case, count in counts.items() if count]
    lines += [f"{case}, seed {seed}: {text}" for case, seed, text in alarms]
    print("\n".join(lines))
    if options.note:
        Path(options.note).write_text("\n".join(lines) + "\n", encoding="utf-8")
    return int(bool(alarms))
