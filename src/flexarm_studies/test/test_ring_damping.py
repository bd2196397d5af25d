# SPDX-License-Identifier: Apache-2.0
"""Damping from ring-downs: right where the frequency is not, and left alone where there are none."""

from dataclasses import replace

import numpy as np
import pytest

from flexarm_dynamics.arm import arm_file
from flexarm_studies.identification import recording as recordings
from flexarm_studies.identification import ring_damping
from flexarm_studies.identification.strain_fit import Options, StrainProblem

ARM = """
name: clamped
gravity: [0.0, -9.81, 0.0]
joints:
- {name: shoulder, axis: [0, 0, 1], hub_inertia: 0.03}
links:
- {name: beam, length: 0.6, mass_per_length: 0.4, EI_y: 28.0,
   flexible: {y: {modes: 1, shape: loaded, damping: [0.01]}}}
payload: {mass: 1.0}
gauges:
- {name: root, link: beam, position: 0.05, direction: y, surface_distance: 0.003}
"""
HOLD = ("links*EI_y", "payload*", "gauges*", "* offset", "* delay", "* drift")


def problem(stiffer, damping, moves=((1.0, 0.8), (4.0, -0.6), (7.0, 0.5)), options=None):
    """A fit of an arm with a damping of 0.01 to a recording of a stiffer one with another damping."""
    arm, time = arm_file.parse(ARM), np.arange(0.0, 10.0, 0.01)
    position = np.full(time.size, 0.4)
    for at, size in moves:
        s = np.clip((time - at) / 0.3, 0.0, 1.0)
        position += size * s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
    run = recordings.uniform(
        time, {"position": position[:, None], "strain": np.zeros((time.size, 1))}
    )
    of = StrainProblem(arm, run, Options())
    values = of.values.copy()
    for j, q in enumerate(of.found):
        if q.kind in ("EI", "damping"):
            values[j] = stiffer * values[j] if q.kind == "EI" else damping
    setup = of.at(values)
    strain = of.strains(setup, of.states(setup))
    strain += 5e-7 * np.random.default_rng(0).standard_normal(strain.shape)
    made = StrainProblem(arm, replace(run, strain=strain), options or Options(hold=HOLD))
    made.weigh()
    return made


def damping_of(made):
    return next(v for v, q in zip(made.values, made.found, strict=True) if q.kind == "damping")


@pytest.mark.parametrize("true", [0.01, 0.02])
def test_strains_alone_overestimate_damping_where_the_frequency_is_off_and_ring_downs_do_not(true):
    made, labels = problem(1.03, true), []
    made.solve(8, 1e-6)
    alone = damping_of(made)
    (only,) = ring_damping.fit(made, labels.append)
    assert made.found[only].kind == "damping" and labels == ["damping from 3 ring-downs"]
    # The weight of the strains holds it a little above.
    assert alone > 1.15 * true
    assert damping_of(made) == pytest.approx(true, rel=0.15)
    others = np.arange(len(made.values)) != only
    assert (made.values[others] == made.file[others]).all()


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"moves": ((1.0, 0.8),)}, "1 were found, 3 are needed"),
        ({"options": Options(hold=(*HOLD, "links*"))}, "every damping is held"),
    ],
)
def test_without_ring_downs_or_free_dampings_nothing_changes(more, message):
    made = problem(1.0, 0.02, **more)
    assert ring_damping.fit(made, lambda label: None) == []
    assert damping_of(made) == 0.01
    assert message in made.warnings[-1]
