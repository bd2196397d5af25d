# SPDX-License-Identifier: Apache-2.0
"""Makes runs that show whether the nonlinear loop is stable, with its sensors, observer and limits."""

from dataclasses import replace

import numpy as np

from flexarm_dynamics.errors import FlexarmError, MessageError

from ..loop import scenario as scenarios

#: Size and duration of a small motion that excites all modes, like a step but within the limits: [rad], [s].
SIZE, RISE = 0.02, 0.15
#: Shortest and longest time over which it is watched [s].
WATCHED, MAX_WATCHED = 3.0, 10.0
#: A motion dies out if its size in the last third of the time is at most this fraction of that in the third before [-].
DECAYED = 0.95
#: Anything smaller than this is at rest [rad], [m], [N m].
REST = 1e-7


def long_enough(pole):
    """Time for which to watch a loop with this critical pole [s].

    Each third of it contains a whole oscillation, unless the time would exceed `MAX_WATCHED`.
    """
    period = 2.0 * np.pi / abs(pole.imag) if pole.imag else 0.0
    return float(min(max(WATCHED, 3.0 * period), MAX_WATCHED))


def small_motion(q):
    """A short quintic to q, for `Scenario.trajectory`."""
    q = np.asarray(q, float)
    s = np.linspace(0.0, 1.0, 16)
    shape = s**3 * (10.0 - 15.0 * s + 6.0 * s * s)
    positions = q - SIZE * (1.0 - shape[:, None])
    return {"times": (RISE * s).tolist(), "positions": positions.tolist()}


def dies_out(scenario, q, gain=1.0, watched=WATCHED):
    """Whether the vibration that remains after a small motion to q dies out, while it is `watched` [s].

    The `scenario` has its trajectory replaced; `gain` is a factor on the torque between controller and arm [-]. False
    if joints and deflections, or the torque, move in the last third of the time as much as in the third before; if the
    torque is at its limit in the last third; if the loop loses the arm or is refused.
    """
    # The motion is quick on purpose; what is judged comes after it.
    values = scenario.controller | {"trajectory_torque_margin": 0.0}
    trial = replace(scenario, controller=values, trajectory=small_motion(q), repeat=1)
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
    if record.saturated[last].any():  # a limit cycle: it has grown up to the limit
        return False
    state = np.hstack([record.plant_position, record.plant_amplitude])
    moves = lambda values, when: np.linalg.norm(values[when].std(0))  # noqa: E731
    return bool(
        all(moves(v, last) < max(DECAYED * moves(v, middle), REST) for v in (state, record.torque))
    )


def weaken(simulator, gain):
    """Let the simulated drives apply `gain` times the commanded torque."""
    advance = simulator.advance

    def scaled(torque, before=None, share=0.0):
        times = lambda u: None if u is None else gain * u  # noqa: E731
        advance(times(torque), times(before), share)

    simulator.advance = scaled
