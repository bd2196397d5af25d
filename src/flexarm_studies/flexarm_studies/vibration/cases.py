# SPDX-License-Identifier: Apache-2.0
"""Makes the cases: random arms, an arm on an elastic base, one link with payloads, each with three motions.

Durations are drawn at random from the seed, in periods of the lowest mode with joints locked. Fixed durations could
flatter the trapezoid: it leaves nothing of a mode if its ramps happen to be whole periods. The drives compensate the
weight with the payload that they know.
"""

from dataclasses import dataclass
from functools import partial

import numpy as np

from flexarm_control.trajectory import specs
from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.arm.description import scaled
from flexarm_dynamics.models import model

from ..random_arms import generator
from .time_laws import trapezoid

#: Ranges of the durations of the three motions, in locked periods; start and end of each motion, as fractions of the
#: way between the two positions of the case.
DURATIONS = ((2.0, 2.4), (2.4, 3.0), (3.0, 4.0))
WAYS = ((0.0, 0.7), (0.0, 1.0), (1.0, 0.0))
#: Payloads of the arm with one link, as multiples of its own.
PAYLOADS = (0.0, 1.0, 2.0, 3.0)


@dataclass(frozen=True, eq=False)
class Case:
    """An arm and its motions.

    Attributes
    ----------
    name : str
    known, plant : Arm
        The arm as the drives know it, and as it is.
    period : float
        Period of the lowest mode with joints locked [s].
    motions : list of PiecewiseMotion
    """

    name: str
    known: object
    plant: object
    period: float
    motions: list


def motions(start, end, period, rng):
    """Three motions between the positions `start` and `end` (n,) [rad]; `rng` draws durations in each `period` [s]."""
    found = []
    for (low, high), (first, last) in zip(DURATIONS, WAYS, strict=True):
        ends = (start + part * (end - start) for part in (first, last))
        found.append(trapezoid(*ends, float(rng.uniform(low, high)) * period))
    return found


def random_arm(index, seed=0) -> Case:
    """Random arm number `index` of a `seed`, see `random_arms.generator`."""
    drawn = generator.arm(index, seed)
    arm = drawn.read()
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(index, 1)))
    own = specs.motion(*specs.parse(drawn.motion), None, np.zeros(len(arm.joints)))
    moves = motions(own.start, own.start + own.angle, drawn.period, rng)
    return Case(drawn.name, arm.known, arm, drawn.period, moves)


#: A column that bends under a rigid arm: the first joint, below the column, is held.
ELASTIC_BASE = """
name: elastic_base
description: A rigid arm on a column that bends
units: si
gravity: [0.0, 0.0, 0.0]
joints:
  - {name: base, axis: [0, 0, 1], hub_inertia: 5.0, limits: {torque: 2000.0}}
  - {name: shoulder, axis: [0, 0, 1], hub_inertia: 0.2, motor_mass: 6.0, limits: {torque: 200.0}}
links:
  - name: column
    length: 0.6
    section: {shape: tube, density: 7850.0, youngs_modulus: 205.0e9, shear_modulus: 80.0e9,
              outer_diameter: 0.03, wall: 0.002}
    flexible: {y: {modes: 2, shape: loaded, damping: [0.005]}}
  - {name: arm, length: 0.8, mass_per_length: 3.0}
payload: {mass: 2.0, inertia: 0.002}
"""


def elastic_base(seed=0) -> Case:
    """A rigid arm on an elastic base; durations by `seed`."""
    arm = arm_file.parse(ELASTIC_BASE, "elastic_base")
    start, end = np.array([0.0, -0.9]), np.array([0.0, 0.7])
    return _case("elastic base", arm, arm, start, end, seed)


#: An aluminium strip with a payload, on a hub with the low inertia of a direct drive.
ONE_LINK = """
name: one_link
description: A strip with a payload on a light hub
units: si
gravity: [0.0, 0.0, 0.0]
joints:
  - {name: shoulder, axis: [0, 0, 1], hub_inertia: 0.02, limits: {torque: 40.0}}
links:
  - name: strip
    length: 1.0
    section: {shape: rectangle, density: 2700.0, youngs_modulus: 70.0e9, shear_modulus: 26.0e9,
              size_y: 0.008, size_z: 0.05}
    flexible: {y: {modes: 2, shape: loaded, damping: [0.005]}}
payload: {mass: 0.5, inertia: 0.0005}
gauges:
  - {name: root, link: strip, position: 0.03, direction: y, surface_distance: 0.004}
observed_modes: [strip_y_mode1]
"""


def payload(factor, seed=0) -> Case:
    """One link with `factor` times the payload that the drives know; durations by `seed`."""
    arm = arm_file.parse(ONE_LINK, "one_link")
    ends = np.array([-0.6]), np.array([0.6])
    return _case(f"one link, payload x{factor:g}", arm, scaled(arm, payload=factor), *ends, seed)


def _case(name, known, plant, start, end, seed):
    built = model.build(plant)
    period = 2.0 * np.pi / min(built.frequencies(q, locked=True)[0] for q in (start, end))
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(1000,)))
    return Case(name, known.known, plant, period, motions(start, end, period, rng))


def all_of(count, seed=0):
    """Functions that make the cases, by name: `count` random arms of a `seed`, then the others."""
    found = {f"random arm {i}": partial(random_arm, i, seed) for i in range(count)}
    found["elastic base"] = partial(elastic_base, seed)
    for factor in PAYLOADS:
        found[f"payload x{factor:g}"] = partial(payload, factor, seed)
    return found
