# SPDX-License-Identifier: Apache-2.0
"""Compiles the numba kernels into their cache: ``python -m flexarm_sim.precompile``.

Otherwise the first node that uses a kernel would wait for it.
"""

from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace

import numpy as np

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.arm.description import Transmission
from flexarm_dynamics.models import levels, model

from .integrators import METHODS
from .plant import Plant

#: One shipped arm of each structure.
ARMS = ("R", "one_link", "two_link", "long_reach", "rigid")


def main():
    """Run each kernel once, on two cores; numba caches what it compiles for this."""
    with ProcessPoolExecutor(2) as pool:
        jobs = [pool.submit(job, geared) for geared in (False, True) for job in (linearise, loops)]
        for job in [*jobs, pool.submit(arms)]:
            job.result()


def two_links(geared):
    """A chain of two links, with transmissions or without."""
    arm = arm_file.load("two_link")
    if geared:
        gear = {"rotor_inertia": 1e-4, "gear_ratio": 50.0, "transmission": Transmission(1e3)}
        arm = replace(arm, joints=tuple(replace(joint, **gear) for joint in arm.joints))
    return model.build(arm)


def linearise(geared):
    """The recursion on complex numbers."""
    chain = two_links(geared)
    chain.linearisation(np.zeros(2), np.zeros(2))


def loops(geared):
    """The recursion on real numbers, and the integrators around it."""
    chain = two_links(geared)
    state = np.zeros(2 * (chain.n_joints + chain.n_modes))
    evaluate(chain)
    for method in METHODS.values():
        chain.stepper(method, straight_line=False)(state, np.zeros(2), 1e-3)
    chain.driven_stepper(METHODS["dop853"])(state, np.zeros(2), 1e-3)


def arms():
    """The straight-line code of the shipped arms, at the level of their file and at that of their simulation."""
    for name in ARMS:
        arm = arm_file.load(name)
        for each in {levels.level_of(a): a for a in (arm, levels.simulated(arm))}.values():
            plant = Plant(model.build(each), 1e-3)
            plant.advance(np.zeros(plant.model.n_joints))
            evaluate(plant.model)


def evaluate(arm_model):
    """Equations of motion, energy and kinematics at rest."""
    n, m = arm_model.n_joints, arm_model.n_modes
    q, delta = np.zeros(n), np.zeros(m)
    if hasattr(arm_model, "mass_matrix"):
        arm_model.mass_matrix(q)
    arm_model.terms(q, q)
    arm_model.derivative(np.zeros(2 * (n + m)), q)
    arm_model.energy(np.zeros(2 * (n + m)))
    arm_model.tip_position(q, delta)
    arm_model.tip_velocity(q, q, delta, delta)


if __name__ == "__main__":
    main()
