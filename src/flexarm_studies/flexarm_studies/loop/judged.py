# SPDX-License-Identifier: Apache-2.0
"""Finds what a closed loop bears, by the linear loop of its observer and law: `flexarm analyze`, `flexarm simulate`."""

import numpy as np

from flexarm_control.robust import verdict
from flexarm_control.robust.verdict import Bears, Judge, Verdict
from flexarm_control.robust.whole import Source, linear_controller
from flexarm_dynamics.errors import FlexarmError


def judge_of(loop, places, delay):
    """The `Judge` of a `ClosedLoop` at rest in the `places` (k, n) [rad], with a `delay` [s].

    This runs the loop's law and observer; reset both before the loop is used again.
    """
    source = Source(*loop.source)
    period, law = 1e-9 * loop.simulator.period_ns, loop.controller.law
    controllers = [linear_controller(law, loop.observer, q, period, source) for q in places]
    return Judge(controllers, delay)


def verdict_of(loop, places, delay) -> Verdict:
    """The verdict on a loop, as `judge_of`; unknown if its observer or law can't be linearised."""
    try:
        return judge_of(loop, places, delay).verdict()
    except (FlexarmError, np.linalg.LinAlgError) as error:
        return verdict.unknown(error)


def bears_of(loop, place, delay) -> Bears:
    """What a loop bears at rest in one `place` (n,) [rad], quickly."""
    try:
        return judge_of(loop, [place], delay).bears(verdict.QUICK)
    except (FlexarmError, np.linalg.LinAlgError) as error:
        return Bears(reason=str(error))


def words(bears):
    """One line of text for people."""
    if bears.reason:
        return f"unknown: {bears.reason}"
    low, high = bears.payload
    payload = (
        f"payload x {low:.3g} to {high:.3g}" if high is not None else f"payload from x {low:.3g}"
    )
    if high is None and low == 0.0:
        payload = "any payload"
    delay = "any delay" if bears.delay is None else f"delay up to {1e3 * bears.delay:.3g} ms"
    return f"{payload}, {delay}"
