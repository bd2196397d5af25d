# SPDX-License-Identifier: Apache-2.0
"""Figures: each is there as PNG and SVG, says what it shows and in which unit, and shows just that."""

import re

import matplotlib.pyplot as plt
import numpy as np
import pytest
from numpy.testing import assert_allclose

from flexarm_dynamics.arm.units import FOOT, POUND_FORCE_FOOT
from flexarm_studies.case_study import figures

pytestmark = pytest.mark.slow

NAMES = [
    "fig02_reference_velocity", "fig03_joint_angle_error", "fig04_joint_velocity_error",
    "fig05_mode1_deflection", "fig06_mode2_deflection", "fig07_mode1_rate", "fig08_mode2_rate",
    "fig09_tip_position_error", "fig10_tip_velocity_error", "fig05b_quasi_steady_state",
    "fig11_torques", "overview",
]  # fmt: skip
UNITS = {
    "fig02": "[deg/s]", "fig03": "[deg]", "fig04": "[deg/s]", "fig05": "[ft]", "fig06": "[ft]",
    "fig07": "[ft/s]", "fig08": "[ft/s]", "fig09": "[ft]", "fig10": "[ft/s]", "fig11": "[lbf ft]",
    "overview": "[lbf ft]",
}  # fmt: skip


@pytest.fixture(scope="session")
def swinging(arm_r, make_record):
    """Makes a record of an arm that swings by `size`."""
    return lambda size: make_record(
        arm_r,
        reference=lambda t: 1.0,
        position=lambda t: 1.0 - np.radians(size) * np.cos(t),
        velocity=lambda t: np.radians(10.0 * size),
        reference_velocity=lambda t: np.radians(30.0),
        amplitude=lambda t: FOOT * size * np.array([np.sin(14 * t), 0.1 * np.sin(90 * t)]),
        rate=lambda t: FOOT * size * np.array([14 * np.cos(14 * t), 9.0 * np.cos(90 * t)]),
        quasi_steady=lambda t: FOOT * np.array([0.5 * size, 0.0]),
        slow_torque=lambda t: POUND_FORCE_FOOT * size,
        fast_torque=lambda t: -0.25 * POUND_FORCE_FOOT * size,
        torque=lambda t: 0.75 * POUND_FORCE_FOOT * size,
    )


@pytest.fixture(scope="module")
def directory(tmp_path_factory):
    return tmp_path_factory.mktemp("figures") / "R_m11"


def content(axis):
    lines = {line.get_label(): line.get_xydata() for line in axis.get_lines()}
    return {
        "title": axis.get_title(),
        "x": axis.get_xlabel(),
        "y": axis.get_ylabel(),
        "lines": lines,
    }


@pytest.fixture(scope="module")
def drawn(swinging, arm_r, directory):
    """File names that were made, and what every axis held: by figure, then axis."""
    held, close = [], plt.close

    def remember(figure):
        held.append([content(axis) for axis in figure.axes])
        close(figure)

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(plt, "close", remember)
        made = figures.draw(directory, "arm R", swinging(2.0), swinging(1.0), arm_r)
    return made, dict(zip([p.stem for p in made], held, strict=True))


def test_every_figure_of_the_paper_is_made_as_png_and_svg(drawn, directory):
    made, _ = drawn
    assert [p.stem for p in made] == NAMES
    assert sorted(p.name for p in directory.iterdir()) == sorted(
        f"{name}.{suffix}" for name in NAMES for suffix in ("png", "svg")
    )
    for path in made:
        assert path.read_bytes().startswith(b"\x89PNG\r\n\x1a\n")
        svg = path.with_suffix(".svg").read_text()
        assert "<svg" in svg and svg.rstrip().endswith("</svg>")
    text = (directory / "fig03_joint_angle_error.svg").read_text()
    assert "Fig. 3  Joint angle tracking error  (arm R)" in text
    assert "reference - joint angle [deg]" in text


@pytest.mark.parametrize("name", NAMES)
def test_every_axis_has_a_title_the_time_in_seconds_and_a_unit(drawn, name):
    axes = drawn[1][name]
    if (short := name.split("_")[0]) in UNITS:
        assert any(axis["y"].endswith(UNITS[short]) for axis in axes)
    for axis in axes:
        assert axis["title"]
        assert axis["x"] == "time from the start of the trajectory [s]"
        assert not axis["y"] or re.search(r"\[\S.*\]$", axis["y"])
    if len(axes) == 1:
        assert "(arm R)" in axes[0]["title"]


def test_the_curves_are_the_records_in_the_papers_units(drawn):
    held = drawn[1]
    slow, composite = "slow control alone", "composite control"

    def curve(name, label, axis=0):
        return held[name][axis]["lines"][label]

    t = curve("fig03_joint_angle_error", composite)[:, 0]
    assert_allclose(np.diff(t), 0.04, rtol=1e-9)
    assert_allclose(curve("fig03_joint_angle_error", slow)[:, 1], 2.0 * np.cos(t), rtol=1e-9)
    assert_allclose(curve("fig03_joint_angle_error", composite)[:, 1], np.cos(t), rtol=1e-9)
    assert_allclose(curve("fig04_joint_velocity_error", slow)[:, 1], 10.0, rtol=1e-9)
    assert_allclose(curve("fig02_reference_velocity", "reference")[:, 1], 30.0, rtol=1e-9)
    wanted = {
        "fig05_mode1_deflection": np.sin(14 * t),
        "fig06_mode2_deflection": 0.1 * np.sin(90 * t),
        "fig07_mode1_rate": 14 * np.cos(14 * t),
        "fig08_mode2_rate": 9.0 * np.cos(90 * t),
    }
    for name, values in wanted.items():
        assert_allclose(curve(name, composite)[:, 1], values, rtol=1e-9, atol=1e-12)
        assert_allclose(curve(name, slow)[:, 1], 2.0 * values, rtol=1e-9, atol=1e-12)
    torques = [c[:, 1] for k, c in held["fig11_torques"][1]["lines"].items() if k[0] != "_"]
    assert_allclose(np.array(torques)[:, 0], [1.0, -0.25, 0.75], rtol=1e-9)


def test_the_end_points_error_is_the_rigid_arms_position_less_its_own(drawn):
    lines = drawn[1]["fig09_tip_position_error"][0]["lines"]["composite control"]
    t, error = lines.T
    q, y = 1.0 - np.radians(1.0) * np.cos(t), 2.0 * (np.sin(14 * t) - 0.1 * np.sin(90 * t))
    assert_allclose(error, 4.0 * np.cos(1.0) - (4.0 * np.cos(q) - y * np.sin(q)), atol=1e-6)


def test_drawing_leaves_no_figure_open_and_the_style_alone(drawn):
    assert plt.get_fignums() == []
    assert plt.rcParams["axes.grid"] is plt.rcParamsDefault["axes.grid"]


def test_the_same_records_give_the_same_files(drawn, directory, swinging, arm_r, tmp_path):
    records = (swinging(size).thinned(figures.PLOTTED_EVERY) for size in (2.0, 1.0))
    with plt.rc_context(figures.STYLE):
        figure = figures.overview(*records, arm_r, "arm R")
        figure.tight_layout()
        figures.save(figure, tmp_path / "overview.png", tmp_path / "overview.svg")
    for path in tmp_path.iterdir():
        assert (directory / path.name).read_bytes() == path.read_bytes(), path.name
