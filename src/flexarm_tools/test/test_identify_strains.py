# SPDX-License-Identifier: Apache-2.0
"""`flexarm identify` without torque: what is fitted, what is scored, what is written, and going on where it stopped."""

import contextlib
import io
import json
import re
from types import SimpleNamespace

import numpy as np
import pytest

from flexarm_bringup import cli
from flexarm_dynamics.arm import arm_file
from flexarm_studies.identification import strain_fit

pytestmark = pytest.mark.long

ARM = """
name: geared
gravity: [0.0, -9.81, 0.0]
joints:
- name: shoulder
  axis: [0, 0, 1]
  hub_inertia: 0.03            # assumed
  rotor_inertia: 1.0e-4
  gear_ratio: 50.0
  transmission:
    stiffness: 700.0           # a guess
    damping: 2.0
    play: 0.010
    rounding: 0.002
links:
- name: beam
  length: 0.6
  mass_per_length: 0.4
  EI_y: {EI}                   # a guess
  flexible: {{y: {{modes: 1, shape: loaded, damping: [0.01]}}}}
payload: {{mass: 1.0}}
gauges:
- {{name: root, link: beam, position: 0.05, direction: y, surface_distance: 0.003}}
- {{name: middle, link: beam, position: 0.3, direction: y, surface_distance: 0.003}}
"""
MAPPING = """
columns:
- {column: t, quantity: time, unit: s}
- {column: shoulder, quantity: position, joint: shoulder, unit: rad}
- {column: root, quantity: strain, gauge: root, unit: microstrain}
- {column: middle, quantity: strain, gauge: middle, unit: microstrain}
"""
#: All that is as in the file, but for a number of a transmission, so that one is written.
HOLD = (
    "--hold", "payload.mass", "joints*inertia", "joints*damping", "joints*play", "joints*rounding",
    "--starts", 1, "--workers", 1,
)  # fmt: skip
#: With these the gauges are held, too, and of an arm that was fitted already all of the arm.
SHORT = (*HOLD, "--hold", "gauges*gain")
KNOWN = (*SHORT, "--hold", "links*", "joints*")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Arm file, mapping and recording: 12 s at 100 Hz of an arm that is softer than its file."""
    from flexarm_studies.identification import recording as recordings
    from flexarm_studies.identification.prescribed import MotionPredictor

    folder = tmp_path_factory.mktemp("strains")
    time = np.arange(0.0, 12.0, 0.01)
    position = np.full(time.size, 0.4)
    for at, size in ((1.0, 1.2), (3.0, 1.0), (5.0, -1.4), (7.0, 0.9), (9.5, -0.8)):
        s = np.clip((time - at) / 0.6, 0.0, 1.0)
        position += size * s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
    arm = arm_file.parse(ARM.format(EI=24.0))
    recording = recordings.uniform(
        time, {"position": position[:, None], "strain": np.zeros((time.size, 2))}, joint_names=("shoulder",)
    )  # fmt: skip
    predictor = MotionPredictor(arm, recording)
    strain = predictor.strains(arm, *predictor.states(arm))
    strain = 1e6 * strain + np.random.default_rng(1).normal(0.0, 0.5, strain.shape)
    rows = np.column_stack([time, position, strain])
    np.savetxt(
        folder / "run.csv", rows, delimiter=",", header="t,shoulder,root,middle", comments=""
    )
    (folder / "arm.yaml").write_text(ARM.format(EI=30.0))
    (folder / "mapping.yaml").write_text(MAPPING)
    return folder


@pytest.fixture
def few_steps(monkeypatch):
    """What is made of a fit is tested, and not the fit."""
    for name, count in (("START_STEPS", 3), ("PASS_STEPS", 2), ("PASSES", 1)):
        monkeypatch.setattr(strain_fit, name, count)


@pytest.fixture
def identify(flexarm, folder):
    def run(*words):
        return flexarm(
            "identify", folder / "run.csv", folder / "arm.yaml", "--mapping", folder / "mapping.yaml", *words
        )  # fmt: skip

    return run


@pytest.fixture(scope="module")
def whole(folder):
    """A fit to its end by the command: what it printed as JSON, and the files that it wrote."""
    out, plot, page = folder / "out.yaml", folder / "fit.png", folder / "pages" / "fit.html"
    printed = io.StringIO()
    words = (
        "identify", folder / "run.csv", folder / "arm.yaml", "--mapping", folder / "mapping.yaml", *HOLD,
        "--fit", "0:8", "--score", "8:12", "--json", "--out", out, "--plot", plot,
        "--report", page,
    )  # fmt: skip
    with contextlib.redirect_stdout(printed), pytest.raises(SystemExit) as stop:
        cli.main([str(word) for word in words])
    assert stop.value.code == 0
    return SimpleNamespace(result=json.loads(printed.getvalue()), out=out, plot=plot, page=page)


def test_a_part_is_fitted_and_another_scored_and_the_arm_file_names_origins(whole):
    result = whole.result
    for row in result["parts"]["score"].values():
        assert row["model"]["vaf"] > 99.5 and row["model"]["vaf"] > row["rigid"]["vaf"] + 1.0
        assert row["ceiling"]["vaf"] > row["model"]["vaf"] - 0.5
        assert row["quasi-static"]["coefficients"] == 3
    rows = {row["name"]: row for row in result["parameters"]}
    stiffness = rows["links[0].EI_y"]
    assert abs(stiffness["value"] - 24.0) < 2.0 * stiffness["half_width"] < 2.0
    assert rows["payload.mass"]["kept"] == "held" and rows["payload.mass"]["half_width"] is None
    assert result["ring_downs"]
    for ring in result["ring_downs"]:
        assert ring["modelled_frequency"] == pytest.approx(ring["measured_frequency"], rel=0.02)
    text, made = whole.out.read_text(), arm_file.load(whole.out)
    assert made.links[0].stiffness["y"] == pytest.approx(stiffness["value"], rel=1e-5)
    line = next(line for line in text.splitlines() if "EI_y:" in line and "#" in line)
    assert "identified: +- " in line and "a guess" not in line
    assert "hub_inertia: 0.03            # assumed" in text
    value = rows["joints[0].transmission.stiffness"]["value"]
    assert made.joints[0].transmission.stiffness == pytest.approx(value, rel=1e-5)
    line = next(line for line in text.splitlines() if line.startswith("    stiffness: "))
    assert "identified: +- " in line and "a guess" not in line
    assert "root delay" in text and whole.plot.stat().st_size > 10_000


def test_the_page_has_all_parts_every_number_and_nothing_from_the_network(whole):
    result, text = whole.result, whole.page.read_text(encoding="utf-8")
    assert result["report"] == str(whole.page)
    for part in ("short", "overlays", "scores", "residuals", "parameters", "correlations", "next"):
        assert f'<section id="{part}">' in text and f'href="#{part}"' in text
    traces = json.loads(re.search(r'id="traces">(.*?)</script>', text, re.DOTALL).group(1))
    assert [c["name"] for c in traces["channels"]] == ["root", "middle"]
    assert traces["spans"] == [["fit", 0.0, 8.0], ["score", 8.0, 12.0]]
    for channel in traces["channels"]:
        measured, predicted = (np.array(channel[k], float) for k in ("measured", "predicted"))
        assert len(measured) == len(predicted) == traces["time"][2] == 1200
        rms = result["parts"]["score"][channel["name"]]["model"]["rms"]
        assert np.std((measured - predicted)[800:]) == pytest.approx(1e6 * rms, rel=1e-3)
    for row in result["parameters"]:
        assert f'<th scope="row">{row["name"]}</th>' in text
    assert text.count("<svg") == 2
    assert "http://" not in text and "https://" not in text


def test_without_parts_all_is_fitted_and_printed_for_people(identify, few_steps):
    code, printed, err = identify(*HOLD)
    assert code == 0, err
    assert "links[0].EI_y" in printed and "quasi-static" in printed and "ring-down" in printed
    assert "score 8 to" not in printed
    (scale,) = re.findall(r"the strains do not tell apart: (.*EI_y.*)", printed)
    assert {"links[0].mass_per_length", "payload.mass"} < set(scale.split(", "))
    assert "start 1 of 1" in err and "pass 1 of" in err


def test_a_state_file_of_another_fit_is_refused_and_of_the_same_goes_on(
    identify, folder, few_steps
):
    state = folder / "state.json"
    code, first, err = identify(*SHORT, "--fit", "0:5", "--state", state, "--json")
    assert code == 0 and "start 1 of 1" in err, err
    code, second, err = identify(*SHORT, "--fit", "0:5", "--state", state, "--json")
    assert code == 0 and "start" not in err, err
    values = [[row["value"] for row in json.loads(text)["parameters"]] for text in (first, second)]
    np.testing.assert_allclose(*values, rtol=1e-9)
    code, _, err = identify(*SHORT, "--fit", "0:6", "--state", state)
    assert code != 0 and "another arm, recording or options" in err
    state.write_text("{}")
    code, _, err = identify(*SHORT, "--fit", "0:5", "--state", state)
    assert code != 0 and "is no state of a fit" in err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--fit", "8"), "FROM:TO, as 14:60"),
        (("--fit", "9:8"), "FROM:TO, as 14:60"),
        (("--fit", "90:95"), "samples"),
        (("--above", "60"), "half of the rate"),
        (("--starts", "0"), "--starts"),
        (("--pickup", "8", *KNOWN), "has no motor current"),
        (("--free", "links[7].EI_y"), "matches no parameter"),
    ],
)
def test_options_out_of_range_are_refused(identify, words, message, few_steps):
    code, _, err = identify(*words)
    assert code != 0 and message in err


def test_another_file_is_scored_with_its_own_bias(flexarm, folder, whole, few_steps):
    rows = np.genfromtxt(folder / "run.csv", delimiter=",", skip_header=1)
    rows[:, 2:] += 40.0
    rows[:, 0] += 100.0  # another clock
    other = folder / "other.csv"
    np.savetxt(other, rows, delimiter=",", header="t,shoulder,root,middle", comments="")
    code, printed, err = flexarm(
        "identify", folder / "run.csv", whole.out, "--mapping", folder / "mapping.yaml", *KNOWN,
        "--fit", "0:8", "--score-file", other, "--json",
    )  # fmt: skip
    assert code == 0, err
    result = json.loads(printed)
    for row in result["parts"]["score"].values():
        assert row["model"]["vaf"] > 99.5 and row["model"]["rms"] < 2e-6
    assert result["ring_downs"] and all(ring["from_s"] > 100.0 for ring in result["ring_downs"])


def test_what_gauges_pick_up_from_the_currents_is_scored_beside_the_model(
    flexarm, folder, whole, few_steps
):
    rows = np.genfromtxt(folder / "run.csv", delimiter=",", skip_header=1)
    current = np.random.default_rng(2).standard_normal((len(rows), 1))
    rows[:, 2:] += 3.0 * current
    path, mapping = folder / "driven.csv", folder / "currents.yaml"
    np.savetxt(
        path, np.hstack([rows, current]), delimiter=",", header="t,shoulder,root,middle,amps", comments=""
    )  # fmt: skip
    mapping.write_text(
        MAPPING + "- {column: amps, quantity: current, joint: shoulder, unit: A}\n",
        encoding="utf-8",
    )
    page = folder / "pages" / "pickup.html"
    code, printed, err = flexarm(
        "identify", path, whole.out, "--mapping", mapping, *KNOWN, "--fit", "0:8", "--score", "8:12",
        "--pickup", 8, "--json", "--report", page,
    )  # fmt: skip
    assert code == 0, err
    result = json.loads(printed)
    assert result["pickup"]["useful"] and result["pickup"]["left"] < 0.2
    for row in result["parts"]["score"].values():
        assert row["with pickup"]["rms"] < 0.7 * row["model"]["rms"]
    assert "from the motor currents above 8" in page.read_text(encoding="utf-8")
