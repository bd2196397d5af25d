# SPDX-License-Identifier: Apache-2.0
"""An arm from strains without torque: play and the rest are found, and what strains can't tell is named."""

from dataclasses import replace

import numpy as np
import pytest

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.errors import FlexarmError
from flexarm_studies.identification import recording as recordings
from flexarm_studies.identification import strain_fit
from flexarm_studies.identification.prescribed import MotionPredictor
from flexarm_studies.identification.strain_fit import (
    Options,
    StrainProblem,
    identify_strains,
    predict,
)
from flexarm_studies.identification.strain_quantities import Setup, changed, value_of

pytestmark = pytest.mark.long

ARM = """
name: geared
gravity: [0.0, -9.81, 0.0]
joints:
- {name: shoulder, axis: [0, 0, 1], hub_inertia: 0.03, rotor_inertia: 1.0e-4, gear_ratio: 50.0,
   transmission: {stiffness: 700.0, damping: 2.0, play: 0.010, load_damping: 0.1, rounding: 0.002}}
links:
- {name: beam, length: 0.6, mass_per_length: 0.4, EI_y: 30.0,
   flexible: {y: {modes: 1, shape: loaded, damping: [0.01]}}}
payload: {mass: 1.0}
gauges:
- {name: root, link: beam, position: 0.05, direction: y, surface_distance: 0.003}
- {name: middle, link: beam, position: 0.3, direction: y, surface_distance: 0.003}
"""
RATE = 100.0
HOLD = ("joints[0].hub_inertia", "payload.mass")
TRUTH = {
    "links[0].EI_y": 24.0,
    "links[0].flexible.y.damping[0]": 0.015,
    "joints[0].transmission.stiffness": 520.0,
    "joints[0].transmission.play": 0.014,
    "gauges[0].gain": 0.9,
    "gauges[1].gain": 1.1,
    "gauges[0].bias": 2.0e-5,
    "shoulder offset": 0.03,
    "root delay": -0.006,
    "middle delay": -0.006,
    "middle drift": 1.5e-5,
}


def driven(seconds=10.0):
    """Moves through the upper position, where the weight changes the flank, with rests between."""
    time = np.arange(0.0, seconds, 1.0 / RATE)
    position = np.full(time.size, 0.4)
    for at, long, size in ((0.6, 0.6, 1.2), (2.6, 0.5, 1.0), (4.6, 0.7, -1.4), (7.0, 0.5, 0.9)):
        s = np.clip((time - at) / long, 0.0, 1.0)
        position = position + size * s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
    return recordings.uniform(
        time,
        {"position": position[:, None], "strain": np.zeros((time.size, 2))},
        joint_names=("shoulder",),
        gauge_names=("root", "middle"),
    )


def measured(arm, seed=0):
    """The recording of an arm with the true values; noise 0.6 microstrain, of which 0.5 is common to both gauges."""
    recording = driven()
    problem = StrainProblem(arm, recording, Options())
    values = problem.file.copy()
    for j, q in enumerate(problem.found):
        values[j] = TRUTH.get(q.name, values[j])
    setup = changed(Setup.of(arm), problem.found, values)
    strain = problem.strains(setup, problem.states(setup))
    random = np.random.default_rng(seed)
    noise = 0.5e-6 * random.standard_normal((len(strain), 1)) + 0.3e-6 * random.standard_normal(
        strain.shape
    )
    return replace(recording, strain=strain + noise)


@pytest.fixture(scope="module")
def arm():
    return arm_file.parse(ARM)


@pytest.fixture(scope="module")
def fitted(arm):
    recording = measured(arm)
    return recording, identify_strains(arm, recording, Options(hold=HOLD, starts=1))


def test_play_and_the_other_numbers_are_found_within_their_intervals(fitted):
    _, found = fitted
    rows = {
        q.name: (v, w)
        for q, v, w in zip(found.quantities, found.values, found.half_widths, strict=True)
    }
    for name, true in TRUTH.items():
        value, width = rows[name]
        assert abs(value - true) < 2.0 * width, name
    play, width = rows["joints[0].transmission.play"]
    assert play == pytest.approx(TRUTH["joints[0].transmission.play"], rel=0.1) and width < 0.0007
    assert set(HOLD) <= set(found.held) and "links[0].mass_per_length" in found.held
    assert all(np.isnan(rows[name][1]) for name in found.held)


def test_the_noise_and_its_correlation_are_found(fitted):
    _, found = fitted
    np.testing.assert_allclose(found.noise, np.hypot(0.5, 0.3) * 1e-6, rtol=0.15)
    assert found.correlation[0, 1] == pytest.approx(0.25 / 0.34, abs=0.1)


def test_the_scale_of_masses_is_named_as_what_strains_do_not_tell(fitted):
    _, found = fitted
    wanted = {"links[0].mass_per_length", "links[0].EI_y", "payload.mass"}
    assert any(wanted <= set(names) for names in found.alike), found.alike


def test_the_fitted_arm_has_the_offset_in_its_joint(arm, fitted):
    recording, found = fitted
    assert found.arm.joints[0].origin_rpy[2] == pytest.approx(0.03, abs=0.01)
    other = MotionPredictor(found.arm, recording)
    strain = other.strains(found.arm, *other.states(found.arm), found.setup.delay)
    drift = np.outer(recording.time / recording.time[-1] - 0.5, found.setup.drift)
    np.testing.assert_allclose(strain + drift, found.predicted, atol=2e-7)
    middle = 0.5 * recording.time[-1]
    np.testing.assert_allclose(
        predict(found, recording, Options(), middle), found.predicted, atol=2e-7
    )


class State:
    """Keeps in memory what a fit has found, and fails after so many snapshots."""

    def __init__(self, left):
        self.starts, self.best, self.left = {}, None, left

    def keep_start(self, number, cost, values):
        self.starts[number] = cost, list(values)

    def keep_best(self, snapshot):
        self.best, self.left = snapshot, self.left - 1
        if self.left < 0:
            raise KeyboardInterrupt


def test_an_interrupted_fit_goes_on_to_the_same_end(arm, fitted):
    recording, whole = fitted
    options = Options(hold=HOLD, starts=2)
    state = State(2)
    near = whole.values.copy()
    near[[q.kind == "EI" for q in whole.quantities]] *= 1.01
    for number in range(2):
        state.keep_start(number, 1.0 + number, near)
    with pytest.raises(KeyboardInterrupt):
        identify_strains(arm, recording, options, state=state)
    reached = np.array(state.best["values"])
    assert np.abs(reached - near).max() > 0.0
    state.left, steps = 1000, []
    found = identify_strains(arm, recording, options, state=state, report=steps.append)
    assert not any("start" in step for step in steps)
    assert np.abs(found.predicted - whole.predicted).max() < whole.noise.min()
    assert not found.warnings


def test_a_fit_that_has_not_settled_says_so_and_keeps_its_starts(arm, fitted, monkeypatch):
    recording, whole = fitted
    assert not whole.warnings
    for name in ("START_STEPS", "PASS_STEPS", "PASSES"):
        monkeypatch.setattr(strain_fit, name, 1)
    state = State(1000)
    found = identify_strains(arm, recording, Options(hold=HOLD, starts=2), state=state)
    assert any("has not settled after 1 passes" in text for text in found.warnings)
    assert [state.starts[k][0] for k in (0, 1)] == list(found.starts)


def test_the_jacobian_is_that_of_central_differences(arm):
    problem = StrainProblem(arm, measured(arm), Options())
    which = np.arange(len(problem.found))
    J = problem.jacobian(problem.values, which)
    for column, j in enumerate(which):
        step = np.zeros(problem.values.size)
        step[j] = 1e-4 * problem.scale[j]
        both = [problem.residuals(problem.values + s * step) for s in (1.0, -1.0)]
        central = (both[0] - both[1]) / 2e-4
        # Play has kinks: a sample at one has another derivative on either side.
        close = np.abs(J[:, :, column] - central) < 1e-2 * np.abs(central).max() + 1e-9
        assert close.mean() > 0.97, problem.found[j].name


def test_samples_of_the_lead_and_missing_ones_do_not_count(arm):
    recording = measured(arm)
    strain = recording.strain.copy()
    strain[:100] += 1.0
    strain[300:310, 0] = np.nan
    problem = StrainProblem(arm, replace(recording, strain=strain), Options(lead=100))
    r = problem.residuals(problem.values)
    assert np.isfinite(r).all() and not r[:100].any() and not r[300:311, 0].any()
    assert r[300:311, 1].all() and problem.used == 2 * (1000 - 100) - 10


def test_what_cannot_be_fitted_is_refused(arm):
    recording = driven()
    with pytest.raises(FlexarmError, match="matches no parameter"):
        StrainProblem(arm, recording, Options(hold=("links[9].EI_y",)))
    with pytest.raises(FlexarmError, match="has no gauges"):
        StrainProblem(replace(arm, gauges=()), recording, Options())
    assert value_of(Setup.of(arm), StrainProblem(arm, recording, Options()).found[0]) == 0.03


@pytest.mark.parametrize(("rate", "named"), [(100.0, True), (2000.0, False)])
def test_residuals_that_do_not_end_are_named_and_their_memory_is_bounded_in_seconds(
    arm, rate, named
):
    """A random walk of a gauge: with a memory of one its level would not count."""
    recording = measured(arm).part(400)
    walk = np.cumsum(1e-6 * np.random.default_rng(8).standard_normal(400))
    strain = recording.strain + np.column_stack([walk, np.zeros(400)])
    problem = StrainProblem(arm, replace(recording, strain=strain, period=1.0 / rate), Options())
    problem.made = lambda values: recording.strain
    problem.weigh()
    raw = (walk[1:] @ walk[:-1]) / (walk[:-1] @ walk[:-1])
    assert 0.98 < raw < 0.999
    assert problem.memory[0] == pytest.approx(min(raw, np.exp(-1.0 / rate / 0.5)), rel=1e-12)
    assert problem.memory[1] == 0.0  # nothing is left of the other one
    level = problem.new_part(np.ones((400, 2)))[-1, 0]
    assert level == pytest.approx(1.0 - problem.memory[0]) and level > 0.0009
    problem.warn_of_endless()
    assert named == any("root changes slower than in 0.5 s" in w for w in problem.warnings)


def test_derivatives_do_not_depend_on_the_number_of_threads(arm):
    recording = measured(arm).part(200)
    one, two = (StrainProblem(arm, recording, Options(), threads=k) for k in (1, 2))
    which = np.flatnonzero(one.free)
    np.testing.assert_array_equal(one.jacobian(one.file, which), two.jacobian(one.file, which))
    moved = one.file.copy()
    moved[which[0]] += 1e-3 * one.scale[which[0]]
    change = one.residuals(moved) - one.residuals(one.file)
    slope = one.jacobian(one.file, which[:1])[:, :, 0]
    np.testing.assert_allclose(change, 1e-3 * slope, atol=2e-2 * np.abs(change).max())


def test_secants_are_exact_for_a_linear_function_and_are_renewed():
    """Broyden's update turns wrong derivatives into right ones along the steps that were made."""
    A = np.array([[2.0, 1.0], [0.5, 3.0]])
    asked = []

    def derivatives(x):
        asked.append(x)
        return (A if len(asked) > 1 else A + 0.3)[:, None, :]

    secant = strain_fit.Secant(lambda x: (A @ x)[:, None], derivatives, 5)
    x = np.zeros(2)
    assert np.abs(secant.derivative(x)[:, 0] - A).max() > 0.2 and secant.fresh
    for step in ([1.0, 0.0], [0.0, 1.0]):
        x = x + step
        found = secant.derivative(x)[:, 0]
        np.testing.assert_allclose(found @ step, A @ step)
    np.testing.assert_allclose(found, A)
    assert len(asked) == 1 and not secant.fresh
    for k in range(5):
        secant.value(x + k + 1.0)
    secant.derivative(x + 0.5)
    assert len(asked) == 2 and secant.fresh
