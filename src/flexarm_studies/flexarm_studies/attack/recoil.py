# SPDX-License-Identifier: Apache-2.0
"""Computes how fast bent links turn a joint that was held and is let go: a speed that no control prevents.

While a brake holds the joints, the links may be bent as much as in the motion. In the first 20 ms, returning torque may
be a tenth of its limit, in addition to the torque that holds the arm against gravity (*returning* of `run`). This is
too little to hold a light joint against its links.
"""

from dataclasses import replace

import numpy as np

from .. import markdown
from .cases import MOTION, START
from .run import CRITERIA, SOON, Honest, drive, driver_of

MARKERS = "<!-- recoil table: begin -->", "<!-- recoil table: end -->"
COLUMNS = (
    "arm, observer of its control",
    "joint",
    "let go",
    "with a tenth of the torque limit against it",
)


def recoil(honest, allowed=CRITERIA["returning"]):
    """Largest speed of each joint within `SOON` after it is let go, over its largest speed in the motion.

    The arm is at rest, bent as in the motion at its largest strain. Then two torques act: the static torque, and a
    fraction of the torque limit against each joint's first acceleration.

    Parameters
    ----------
    honest : Honest
    allowed : float
        This fraction [-].

    Returns
    -------
    ndarray, shape (n,)
        [-]
    """
    trace = honest.trace
    moving = np.flatnonzero((trace.time >= START) & (trace.time <= START + MOTION))
    most = moving[np.abs(trace.strain[moving]).max(axis=1, initial=0.0).argmax()]
    driver = driver_of(honest.scenario)
    drive(driver, until=trace.time[most])
    plant = driver.loop.simulator.plant
    q, delta = plant.q.copy(), plant.delta.copy()
    static, fastest = honest.static(q), np.zeros(q.size)
    plant.reset(q, delta)
    plant.advance(static)
    against = static - allowed * honest.limit * np.sign(plant.qd)
    plant.reset(q, delta)
    for _ in range(round(SOON / honest.period)):
        plant.advance(against)
        np.maximum(fastest, np.abs(plant.qd), out=fastest)
    return fastest / honest.speed


def table(cases):
    """Lines of the Markdown table: every joint of the cases' arms under each of their controls."""
    rows = []
    for case in dict.fromkeys(replace(case, velocity=True, noise=False) for case in cases):
        honest = Honest(case)
        name = f"{case.arm}, {case.observer}"
        if honest.problem:
            print(f"not measured: {name}: the honest motion: {honest.problem}", flush=True)
            continue
        free, held = recoil(honest, 0.0), recoil(honest)
        rows += zip([name] * free.size, honest.model.joint_names, free, held, strict=True)
    return markdown.table(COLUMNS, rows)


def report(cases, file=None):
    """Print the table, and write it into a document; return the exit code."""
    lines = table(cases)
    print("\n".join(lines))
    if file:
        markdown.write_between(file, *MARKERS, "\n".join(lines))
    return 0
