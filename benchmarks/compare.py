# SPDX-License-Identifier: Apache-2.0
"""The reference cases in all codes, and the generated code beside hand-written loops."""

import importlib
from dataclasses import dataclass

import numpy as np

from flexarm_sim.integrators import METHODS

from . import cases, own
from .peers import RATE, Torque, errors, steps_per_sample
from .timing import least, paired, round_robin

#: Module of each code, its class, and its kind: this project, a peer, or loops that were written by
#: hand for these arms only.
CODES = (
    (".own", "Flexarm", "own"),
    (".own", "FlexarmLoops", "own"),
    (".peers.hand_loops", "HandLoops", "hand"),
    (".peers.mujoco_chain", "MujocoChain", "peer"),
    (".peers.mujoco_chain", "MujocoChainEuler", "peer"),
    (".peers.mujoco_tubes", "MujocoTubes", "peer"),
    (".peers.exudyn_cable", "ExudynCable", "peer"),
    (".peers.numpy_equations", "NumpyRk4", "peer"),
    (".peers.numpy_equations", "NumpyDop853", "peer"),
    (".peers.control_ior", "ControlResponse", "peer"),
)

#: The project's entry in the results.
OWN = own.Flexarm.name

#: Cases whose equations are also written by hand, and whether the links stiffen in them.
BY_HAND = {
    "one link": ("one_link_pulse", False),
    "two links": ("two_link_torque_x0p1", False),
    "one link that stiffens": ("one_link_pulse", True),
}

#: Step sizes of the comparison with the hand-written loops [s].
SAME_STEPS = (1e-3, 1e-2)


@dataclass(frozen=True)
class Effort:
    """How long to measure.

    Attributes
    ----------
    rounds : int
        Number of turns of each task.
    turn : float
        Minimum duration of a turn [s].
    """

    rounds: int
    turn: float


def all_codes(case, effort):
    """Run one case in all codes, each with its own best settings.

    The time is that of `Peer.integrate`: torques and integration, without kinematics. Codes that miss
    the case's target are not timed.

    Returns ``target`` [m] and ``codes``: name to kind, settings and errors. A code that meets the target also has its
    time in ms per simulated second (best turn, and all turns) and the ratio of its time to this project's time (median
    of the ratios of neighbouring turns).
    """
    parameters, found, tasks = cases.parameters(case), {}, {}
    for module, name, kind in CODES:
        module = importlib.import_module(module, __package__)
        settings = module.BEST[name].get(case)
        if settings is None:
            continue
        code = getattr(module, name)(case, parameters, **settings)
        result = {"kind": kind, "settings": settings}
        found[code.name] = result | {
            f"{what}_error": value
            for what, value in errors(code.run(cases.DURATION)[1], cases.reference(case)).items()
        }
        if found[code.name]["tip_error"] <= cases.TARGETS[case]:
            tasks[code.name] = lambda code=code: code.integrate(cases.DURATION)
    times = round_robin(tasks, effort.rounds, effort.turn)
    for name, turns in times.items():
        per_second = 1e3 * turns / cases.DURATION
        found[name]["ms_per_s"] = least(per_second)
        found[name]["turns"] = per_second.tolist()
        if OWN in times:
            found[name]["ratio"] = paired(turns, times[OWN])
    return {"target": cases.TARGETS[case], "codes": found}


def same_step(name, effort, steps=4000):
    """Time the compiled loops alone: RK4, the same step size, `steps` steps in one call, torques computed beforehand.

    `name` is in `BY_HAND`, `effort` is an `Effort`. For each of `SAME_STEPS`: ``step`` [s], ``generated`` and ``hand``
    [ms per simulated second] of the best turns, and ``ratio``, the median of the ratios of neighbouring turns.
    """
    case, stiffens = BY_HAND[name]
    parameters, result = cases.parameters(case), []
    torque, chain = Torque(case, parameters), cases.chain(parameters, foreshortening=stiffens)
    run, constants = _by_hand(chain, parameters, stiffens)
    stepper, size = chain.stepper(METHODS["rk4"]), 2 * (chain.n_joints + chain.n_modes)
    for step in SAME_STEPS:
        every = steps_per_sample(step)
        rows = steps // every
        stages = torque.stages(steps, step)
        starts, ends = own.linear_torque(torque, rows, 1.0 / RATE)
        states = np.zeros((2, rows + 1, size))
        tasks = {
            "generated": lambda a=(states[0], starts, ends, step, every): stepper.trajectory(*a),
            "hand": lambda a=(constants, step, every, stages, states[1]): run(*a),
        }
        times = round_robin(tasks, effort.rounds, effort.turn)
        entry = {name: 1e3 * least(t) / (steps * step) for name, t in times.items()}
        result.append({"step": step, **entry, "ratio": paired(times["generated"], times["hand"])})
    return result


def _by_hand(chain, parameters, stiffens):
    """The hand-written loops for the equations of a chain, and their constants."""
    from .peers import hand_loops, hand_stiffening
    from .peers.numpy_equations import links

    if stiffens:
        return hand_stiffening.run, hand_stiffening.constants(chain.data, parameters)
    if chain.n_joints == 2:
        return hand_loops.run_two, hand_loops.two_links_constants(*links(parameters))
    return hand_loops.run_one, hand_loops.one_link_constants(*links(parameters))
