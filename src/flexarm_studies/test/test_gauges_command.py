# SPDX-License-Identifier: Apache-2.0
"""``flexarm gauges``: noise of the amplitudes, the best places, modes that can't be distinguished."""

from itertools import combinations
from math import comb

import numpy as np
import pytest

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.arm.strain_map import StrainMap, gauge_rows
from flexarm_dynamics.models import model
from flexarm_studies.commands import gauges


def test_present_gauges_are_those_of_the_strain_map(result):
    (place,) = result("gauges", "R_lab")["places"]
    strain_map = StrainMap(model.build(arm_file.load("R_lab")))
    now = place["present"]
    assert now["names"] == ["root", "quarter", "middle", "three_quarter"]
    np.testing.assert_allclose(now["condition"], strain_map.condition, rtol=1e-12)
    np.testing.assert_allclose(now["amplitude_noise"], strain_map.amplitude_noise, rtol=1e-10)


def test_one_gauge_for_the_first_mode_belongs_at_the_root(changed_arm, result):
    """A cantilever's first curvature is greatest there; noise goes with one over it."""

    def one_mode(data):
        data["links"][0]["flexible"]["y"]["modes"] = 1
        (gauge,) = data["gauges"] = data["gauges"][:1]
        gauge["position"] = 3.0
        data.pop("observed_modes", None)

    one_mode = changed_arm("R", one_mode)
    for criterion in ("A", "D"):
        (place,) = result("gauges", one_mode, "--criterion", criterion)["places"]
        assert place["best"][0]["positions"] == [0.0]
    arm = model.build(arm_file.load(one_mode))
    shapes = arm.mode_shapes("link1", "y")
    gain = abs(shapes(0.75, 2)[0] / shapes(0.0, 2)[0])
    best, now = (place[k] for k in ("best", "present"))
    np.testing.assert_allclose(best[0]["amplitude_noise"][0], gain * now["amplitude_noise"][0])


def by_hand(rows, criterion):
    information = rows.T @ rows
    if criterion == "A":
        return np.trace(np.linalg.inv(information))
    if criterion == "D":
        return np.linalg.det(np.linalg.inv(information))
    return np.linalg.cond(rows / np.linalg.norm(rows, axis=0))


@pytest.mark.parametrize("criterion", gauges.CRITERIA)
def test_the_best_set_is_the_best_of_all(criterion):
    rows = np.random.default_rng(3).standard_normal((9, 2))
    sets, values = gauges.best_sets(rows, 3, criterion)
    every = sorted((by_hand(rows[list(s)], criterion), s) for s in combinations(range(9), 3))
    assert [s for _, s in every[:3]] == sets
    np.testing.assert_allclose(values, [v for v, _ in every[:3]], rtol=1e-10)


@pytest.mark.parametrize("criterion", ["A", "D"])
def test_exchange_finds_the_best_set_of_a_links_positions(criterion, monkeypatch):
    rows = rows_of("R")
    every, _ = gauges.best_sets(rows, 4, criterion)
    monkeypatch.setattr(gauges, "MAX_SETS", comb(gauges.GRID, 2))
    (found,), _ = gauges.best_sets(rows, 4, criterion)
    assert found == every[0]


def rows_of(name):
    arm = model.build(arm_file.load(name))
    link = arm.arm.links[0]
    grid = np.linspace(0.0, link.length, gauges.GRID)
    return gauge_rows(arm, [gauges.Gauge("", link.name, x, "y", 1e-3) for x in grid])


def test_a_set_that_cannot_tell_the_modes_is_infinitely_bad():
    rows = np.array([[[1.0, 2.0], [2.0, 4.0]], [[1.0, 2.0], [2.0, 3.0]], [[0.0, 1.0], [0.0, 2.0]]])
    for criterion in gauges.CRITERIA:
        assert np.isfinite(gauges.criterion_of(rows, criterion)).tolist() == [False, True, False]
    assert gauges.criterion_of(rows[:, :1], "A").tolist() == [np.inf] * 3


def test_the_best_places_are_better_than_the_present_ones_and_one_more_helps(result):
    (place,) = result("gauges", "R")["places"]

    def cost(s):
        return np.sum(np.square(s["amplitude_noise"]))

    assert cost(place["best"][0]) < cost(place["present"])
    assert [cost(s) for s in place["best"]] == sorted(cost(s) for s in place["best"])
    assert cost(place["next"][0]) < cost(place["present"])
    assert place["assumed"] == ["1 microstrain rms of noise"]


def test_modes_that_the_gauges_cannot_distinguish_are_named(flexarm):
    code, out, _ = flexarm("gauges", "R", "--modes", "3")
    assert code == 0
    assert "root, middle can't distinguish link1_y_mode1" in out
    assert "link1_y_mode3, which cause the same strains" in out
    assert "not enough" in out and "best" in out


def test_two_gauges_side_by_side_hardly_tell_two_modes_apart(changed_arm, flexarm):
    near = changed_arm("R", lambda data: data["gauges"][1].update(position=0.05))
    out = flexarm("gauges", near)[1]
    assert "link1_y_mode1 and link1_y_mode2 are hard to distinguish" in out
    assert "hard to" not in flexarm("gauges", "R")[1]


def test_every_link_and_direction_has_its_own_gauges(result):
    places = result("gauges", "long_reach")["places"]
    assert [(p["link"], p["direction"]) for p in places] == [
        (link, d) for link in ("upper", "fore") for d in ("y", "z", "twist")
    ]


def test_a_plot_is_drawn(tmp_path, flexarm):
    path = tmp_path / "deep" / "gauges.svg"
    code, out, _ = flexarm("gauges", "R", "--plot", path)
    assert code == 0 and f"plot: {path}" in out
    assert path.stat().st_size > 5000
