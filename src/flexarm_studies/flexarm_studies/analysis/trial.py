# SPDX-License-Identifier: Apache-2.0
"""Runs that tell whether the nonlinear loop, sensors, observer and limits included, is stable."""

from dataclasses import replace

import numpy as np

from flexarm_dynamics.errors import FlexarmError, MessageError

from ..loop import scenario as scenarios

#: A small motion that excites all modes, as a step would without a limit: [rad], [s].
SIZE, RISE = 0.02, 0.15
#: How long it is watched, at least and at most [s].
WATCHED, LONGEST = 3.0, 10.0
#: What dies out is in the last third of the time no more than this share of what it was in the one before.
SHARE = 0.95
#: What has come to rest to this is at rest [rad], [m], [N m].
REST = 1e-7


def long_enough(pole):
    """How long to watch a loop whose critical pole this is [s]: a whole oscillation in each third of the time."""
    period = 2.0 * np.pi / abs(pole.imag) if pole.imag else 0.0
    return float(min(max(WATCHED, 3.0 * period), LONGEST))


def small_motion(q):
    """A short quintic to q, for `Scenario.trajectory`."""
    q = np.asarray(q, float)
    s = np.linspace(0.0, 1.0, 16)
    shape = s**3 * (10.0 - 15.0 * s + 6.0 * s * s)
    positions = q - SIZE * (1.0 - shape[:, None])
    return {"times": (RISE * s).tolist(), "positions": positions.tolist()}


def dies_out(scenario, q, gain=1.0, watched=WATCHED):
    """Whether what a small motion to q leaves behind dies out.

    Parameters
    ----------
    scenario : Scenario
        Its trajectory is replaced.
    q : ndarray, shape (n,)
        [rad]
    gain : float
        Of the torque on its way to the arm [-].
    watched : float
        [s]

    Returns
    -------
    bool
        False for a loop whose joints and deflections, or whose torque, move no less in the last third of the time
        than in the one before, that still meets a torque limit in the last third, that loses the arm or is
        refused.
    """
    trial = replace(scenario, trajectory=small_motion(q), repeat=1)
    try:
        loop = scenarios.loop_of(trial)
        motion = scenarios.trajectory_of(trial.trajectory, loop.model, loop.simulator.position)
        loop.simulator.reset(motion.positions[0])
        if gain != 1.0:
            weaken(loop.simulator, gain)
        record = loop.follow(motion, RISE + watched)
    except (MessageError, FlexarmError):
        return False
    if loop.lost:
        return False
    third = watched / 3.0
    middle = (record.time > RISE + third) & (record.time <= RISE + 2.0 * third)
    last = record.time > RISE + 2.0 * third
    if record.saturated[last].any():  # a limit cycle: what grows has come to the limit
        return False
    state = np.hstack([record.plant_position, record.plant_amplitude])
    moves = lambda values, when: np.linalg.norm(values[when].std(0))  # noqa: E731
    return bool(
        all(moves(v, last) < max(SHARE * moves(v, middle), REST) for v in (state, record.torque))
    )


def weaken(simulator, gain):
    """Let the simulated drives give `gain` times the torque that they are told."""
    advance = simulator.advance

    def scaled(torque, before=None, share=0.0):
        times = lambda u: None if u is None else gain * u  # noqa: E731
        advance(times(torque), times(before), share)

    simulator.advance = scaled
