# SPDX-License-Identifier: Apache-2.0
"""Parameters from recorded motions: intervals cover the truth, what is not determined is named, files are read back."""

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from flexarm_bringup import cli
from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.errors import FlexarmError
from flexarm_dynamics.models import model
from flexarm_sim.plant import Plant
from flexarm_studies.identification import coverage, recording
from flexarm_studies.identification.arm_text import rewritten
from flexarm_studies.identification.derived import derived, values_of
from flexarm_studies.identification.fit import Problem, bandwidth, identify
from flexarm_studies.identification.predictor import Predictor
from flexarm_studies.identification.quantities import changed, quantities
from flexarm_tools.identification import excite

ARMS, RATE = 4, 100.0
SHORT = {**coverage.SETTINGS, "duration": 3.0, "rest": 1.0}


@pytest.fixture(scope="module")
def given():
    return coverage.nominal()


@pytest.fixture(scope="module")
def shaken(given):
    """A drawn arm, what was measured of it, and the fit."""
    truth = coverage.drawn(given, np.random.default_rng(7))
    measured = coverage.measured(truth, SHORT, RATE, seed=7, drive=given)
    return truth, measured, identify(given, measured)


@pytest.mark.long
@pytest.mark.slow
def test_intervals_cover_the_truth_and_are_narrow_but_not_too_wide():
    table = coverage.run(ARMS, seed=1, rate=RATE, settings=SHORT)
    assert not any(row["left_out"] for row in table.values())
    # In half-widths: 1.96 deviations each.
    errors = np.array([row["errors"] for row in table.values()])
    assert np.mean(np.abs(errors) <= 1.0) >= 0.85
    assert 0.6 < 1.96 * np.sqrt(np.mean(errors**2)) < 1.4
    for name, row in table.items():
        least = 0.005 if "frequency" in name else 0.2 if "damping" in name else 0.06
        assert np.median(row["widths"]) < least, name


def test_the_noise_is_found_in_the_residuals(shaken):
    _, _, found = shaken
    count = 2.0 * np.pi / coverage.COUNTS / np.sqrt(12.0)
    np.testing.assert_allclose(found.noise[1:], coverage.NOISE, rtol=0.15)
    np.testing.assert_allclose(found.noise[0], count, rtol=0.3)


def test_the_prediction_is_the_plants_motion(given):
    measured = coverage.measured(given, SHORT, RATE)
    predictor = Predictor(given, measured)
    predicted = predictor.predict(given, np.zeros(6))
    plant = Plant(model.build(given), measured.period)
    for k in range(1, len(predicted)):
        plant.advance(measured.torque[k])
    assert predicted[-1, 0] == pytest.approx(plant.q[0], abs=2e-8)
    # Steps four times as short move nothing by a thousandth of the noise.
    predictor.substeps *= 4
    finer = predictor.predict(given, np.zeros(6))
    assert np.abs(predicted - finer)[:, 1:].max() < 1e-3 * coverage.NOISE


def test_the_jacobian_is_that_of_central_differences(given):
    measured = coverage.measured(given, SHORT, RATE).part(150)
    problem = Problem(given, measured)
    x = problem._unknowns()
    J = problem.jacobian(x, 150)
    for j in range(x.size):
        step = np.zeros(x.size)
        step[j] = 1e-5
        central = (problem.residuals(x + step, 150) - problem.residuals(x - step, 150)) / 2e-5
        scale = np.abs(J[:, :, j]).max()
        np.testing.assert_allclose(J[:, :, j], central, rtol=0, atol=2e-3 * scale)


def test_coloured_residuals_widen_the_intervals(given):
    """A mean of slow noise, samples alike for 1/(1 - rho) of them, is known less well than one of white noise."""
    measured = coverage.measured(given, SHORT, RATE, seed=3)
    clean = Predictor(given, measured).predict(given, np.zeros(6))[:, 1:]
    random, rho = np.random.default_rng(3), 0.8
    white = random.standard_normal(clean.shape)
    slow = white.copy()
    for k in range(1, len(slow)):
        slow[k] = rho * slow[k - 1] + np.sqrt(1 - rho**2) * white[k]
    widths = {}
    for name, noise in (("white", white), ("slow", slow)):
        # At the truth: only the covariance is in question.
        problem = Problem(given, replace(measured, strain=clean + 2e-6 * noise))
        problem.initial[:] = 0.0
        problem._measure_noise()
        widths[name] = np.sqrt(np.diag(problem.covariance()))
    biases = [i for i, q in enumerate(problem.found) if q.kind == "bias"]
    # Three times, for ever so many samples.
    ratio = widths["slow"][biases] / widths["white"][biases]
    assert (ratio > 1.7).all() and (ratio < 4.5).all()
    assert bandwidth(white) < 0.5 * bandwidth(slow)


def test_what_a_motion_does_not_tell_keeps_the_files_value(given):
    """A rigid arm: hub and payload turn as one."""
    link = replace(given.links[0], flexible={})
    rigid = replace(given, links=(link,), gauges=(), observed_modes=(), model="chain")
    truth = replace(rigid, joints=(replace(rigid.joints[0], hub_inertia=1.6),))
    measured = coverage.measured(truth, {"kind": "pulse", "amplitude": 3.0, "duration": 1.0}, RATE)
    found = identify(rigid, measured)
    assert set(found.undetermined) == {"payload.mass", "payload.inertia"}
    values = dict(zip([q.name for q in found.quantities], found.values, strict=True))
    widths = dict(zip(values, found.half_widths, strict=True))
    assert values["payload.mass"] == rigid.payload.mass and np.isnan(widths["payload.mass"])
    assert abs(values["joints[0].hub_inertia"] - 1.6) < widths["joints[0].hub_inertia"] < 0.02
    assert any(
        "payload.mass is not determined" in w and "joints[0].hub_inertia" in w
        for w in found.warnings
    )


def test_a_still_arm_tells_nothing(given):
    n = 200
    still = recording.Recording(0.01, np.zeros((n, 1)), np.zeros((n, 1)), np.full((n, 2), np.nan))
    found = identify(given, still)
    assert len(found.undetermined) == len(found.quantities)
    assert found.arm == given


def test_held_quantities_stay_and_unknown_names_are_refused(given, shaken):
    _, measured, _ = shaken
    problem = Problem(given, measured, ["gauges[*].gain", "payload.mass"])
    assert set(problem.held) == {"gauges[0].gain", "gauges[1].gain", "payload.mass"}
    with pytest.raises(FlexarmError, match=r"--hold: 'payload\.mas' matches no parameter"):
        Problem(given, measured, ["payload.mas"])


def test_a_model_that_does_not_explain_the_motion_is_reported(given, shaken):
    _, measured, _ = shaken
    backwards = replace(measured, torque=-measured.torque)
    problem = Problem(given, backwards, ["*friction*", "links*", "*gain", "payload*"])
    problem.fit()
    assert any("joint1: the fit leaves more than 5 %" in w for w in problem.warnings)


def test_derived_frequencies_are_the_models(given):
    names, values = values_of(given, np.zeros(1))
    by_name = dict(zip([n for n, _ in names], values, strict=True))
    built = model.build(given)
    for kind, locked in (("locked", True), ("free", False)):
        expected = built.frequencies(locked=locked) / (2.0 * np.pi)
        got = [by_name[f"{kind} frequency {i}"] for i in (1, 2)]
        # Damping moves a free mode's pole along the circle of its frequency, but for second order.
        np.testing.assert_allclose(got, expected, rtol=1e-3)
    np.testing.assert_allclose([by_name[f"locked damping {i}"] for i in (1, 2)], 0.005, rtol=1e-9)
    # What the modes take of the inertia that the joint moves is what is lost when the joint runs free.
    terms = built.terms(np.zeros(1), np.zeros(1))
    coupling = np.array([by_name[f"coupling joint1 mode {i}"] for i in (1, 2)])
    taken = terms.M[0, 1:] @ np.linalg.solve(terms.M[1:, 1:], terms.M[1:, 0])
    assert np.sum(coupling**2) == pytest.approx(taken, rel=1e-9)
    assert all(np.isnan(d.half_width) for d in derived(given, np.zeros(1)))


# Files -----------------------------------------------------------------------------------------


def test_every_quantity_is_where_it_says(given):
    found = quantities(given, coverage._still(given))
    values = np.array([1.1 * q.get(given) + 1e-3 * q.scale for q in found])
    arm = changed(given, found, values)
    np.testing.assert_allclose([q.get(arm) for q in found], values, rtol=1e-12)


@pytest.mark.parametrize("name", ["one_link", "R", "R_lab", "two_link", "long_reach"])
def test_the_written_file_reads_as_the_arm_found_and_keeps_every_comment(name):
    """In either system of units, with a section or stiffnesses, with and without friction in the file."""
    arm = arm_file.load(name)
    found = quantities(arm, coverage._still(arm))
    values = np.array([1.1 * q.get(arm) + 1e-3 * q.scale for q in found])
    made = SimpleNamespace(
        arm=changed(arm, found, values),
        quantities=found,
        values=values,
        half_widths=0.01 * values,
    )
    text = arm_file.find(name).read_text()
    new = rewritten(text, made, ["Identified."])
    assert new.startswith("# Identified.\n")
    assert re.findall("#.*", new)[1:] == re.findall("#.*", text)
    again = arm_file.parse(new)
    np.testing.assert_allclose([q.get(again) for q in found], values, rtol=1e-6, atol=1e-12)
    assert again.observed_modes == arm.observed_modes


def test_a_written_file_keeps_its_layout_and_refuses_what_it_can_not_hold():
    arm = arm_file.load("one_link")
    (mass,) = (q for q in quantities(arm, coverage._still(arm)) if q.name == "payload.mass")
    one = {"quantities": [mass], "values": np.array([0.05]), "half_widths": np.array([0.01])}
    text = arm_file.find("one_link").read_text()
    made = rewritten(text, SimpleNamespace(arm=mass.put(arm, 0.05), **one))
    pairs = zip(text.splitlines(), made.splitlines(), strict=True)
    assert [new for old, new in pairs if new != old] == ["  mass: 0.05                     # [kg]"]
    with pytest.raises(FlexarmError) as refused:
        rewritten(text, SimpleNamespace(arm=mass.put(arm, 0.06), **one))
    assert (refused.value.field, refused.value.value) == ("payload.mass", 0.05)


def test_csv_and_commands(tmp_path, flexarm, result):
    table, plot, out = tmp_path / "run.csv", tmp_path / "fit.png", tmp_path / "new.yaml"
    file = tmp_path / "arm.yaml"
    text = arm_file.find("one_link").read_text().replace("model: chain ", "model: one_link ")
    file.write_text(text)
    arm = arm_file.load(file)
    assert arm.model == "one_link"
    heavier = replace(arm, payload=replace(arm.payload, mass=1.2 * arm.payload.mass))
    measured = coverage.measured(heavier, SHORT, RATE, drive=arm).part(150)
    columns = [measured.time, measured.position, measured.torque, measured.strain]
    names = ",".join(recording.columns(arm))
    np.savetxt(table, np.column_stack(columns), "%.17g", ",", header=names, comments="")
    again = recording.read_csv(table, arm)
    np.testing.assert_array_equal(again.position, measured.position)
    np.testing.assert_array_equal(again.torque[1:], measured.torque[1:])
    np.testing.assert_array_equal(again.strain, measured.strain)
    assert again.period == pytest.approx(measured.period, rel=1e-12)
    words = ("identify", table, file, "--hold", "joints*", "gauges*", "links*", "--plot", plot)
    reported = result(*words, "--out", out)
    found = {r["name"]: r for r in reported["parameters"]}
    mass = found["payload.mass"]
    assert mass["value"] == pytest.approx(1.2 * arm.payload.mass, rel=1e-3)
    assert mass["half_width"] > 0.0
    assert found["links[0].EI_y"]["kept"] == "held" and not reported["warnings"]
    written = arm_file.load(out)
    assert written.payload.mass == pytest.approx(mass["value"], rel=1e-6)
    assert replace(written, payload=arm.payload) == arm
    line = next(x for x in out.read_text().splitlines() if "payload.mass" in x)
    assert line.startswith("#") and "+-" in line
    # The file's own comments are still there.
    assert text.splitlines()[0] in out.read_text()
    assert plot.stat().st_size > 10_000
    assert "is the arm file itself" in flexarm(*words, "--out", file)[2]


@pytest.mark.parametrize(("namespace", "topic"), [("", ""), ("/left/", "/left"), ("a/b", "/a/b")])
def test_the_node_that_excites_keeps_its_torques_for_the_recorder(tmp_path, namespace, topic):
    words = ["excite", "one_link", "--out", str(tmp_path / "bag"), "--namespace", namespace]
    values = excite.node_parameters(cli.parser().parse_args(words))
    assert values[f"qos_overrides.{topic}/joint_torque.publisher.depth"] >= 1000
    assert (values["readers"], values["recorder"]) == (2, excite.RECORDER)


def test_only_the_stretch_under_enabled_torque_counts(given):
    """Safe action before and after, a lost sample in the middle, samples sent twice, another session's state."""

    def table(sequence, session=5, **columns):
        k = np.array(sequence)
        session = np.broadcast_to(session, k.shape)
        return SimpleNamespace(stamp=10_000_000 * k, session=session, sequence=k, columns=columns)

    k = np.array([*(k for k in range(100) if k != 40), 50, 7])
    states = table(
        k, np.where(np.arange(k.size) == k.size - 1, 4, 5), joint_position=1e-3 * k[:, None],
        joint_torque=1.0 * k[:, None], strain=np.outer(k, [1e-6, 2e-6]),
    )  # fmt: skip
    torques = table(range(100), mode=np.array([float(10 <= k < 90) for k in range(100)]))
    found = recording.from_tables(states, torques, given)
    # From the gap to the last enabled answer, less two samples at that end; row k holds its torque.
    np.testing.assert_allclose(found.position[:, 0], 0.001 * np.arange(41, 89))
    np.testing.assert_allclose(found.torque[1:, 0], np.arange(42, 89))
    np.testing.assert_allclose(found.strain[0], [41e-6, 82e-6])
    assert found.period == pytest.approx(0.01)
    assert found.notes


def test_an_encoder_that_stays_on_a_count_tells_one_thing(given):
    position = np.repeat([0.0, 1e-3, 2e-3], [8, 1, 16])[:, None]
    strain = np.zeros((25, 2))
    strain[3, 0] = np.nan
    r = recording.Recording(0.01, position, np.zeros((25, 1)), strain)
    weight = Problem(given, r).weight
    np.testing.assert_allclose(
        [np.sum(weight[s, 0] ** 2) for s in (slice(8), 8, slice(9, 25))], 1.0
    )
    assert weight[3, 1] == 0.0 and weight[:, 1].sum() == 24.0
