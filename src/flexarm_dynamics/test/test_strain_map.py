# SPDX-License-Identifier: Apache-2.0
"""Gauges to amplitudes: signs, weights, gain and bias, spill-over, gauges that cannot do it."""

from dataclasses import replace

import numpy as np
import pytest

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.arm.description import Gauge
from flexarm_dynamics.arm.strain_map import StrainMap, confused, gauge_rows
from flexarm_dynamics.errors import ModelError, ShapeError
from flexarm_dynamics.models import beam
from flexarm_dynamics.models.one_link import OneLink

LENGTH, DISTANCE = 1.2192, 2.0e-3


def model_with(gauges, modes=2, observed=None):
    arm = arm_file.load("one_link").with_modes(modes)
    observed = arm.mode_names if observed is None else observed
    return OneLink(replace(arm, gauges=tuple(gauges), observed_modes=tuple(observed)))


def gauge(name, position, distance=DISTANCE, **more):
    return Gauge(name, "link1", position, "y", distance, **more)


GAUGES = (gauge("root", 0.0), gauge("middle", 0.6), gauge("outer", 0.9, -DISTANCE))


def map_with(gauges=GAUGES, **changes):
    """Map of gauges with changes: one value for all, or a tuple with one each."""
    each = [
        {key: v[i] if isinstance(v, tuple) else v for key, v in changes.items()}
        for i in range(len(gauges))
    ]
    return StrainMap(model_with([replace(g, **c) for g, c in zip(gauges, each, strict=True)]))


def curvature(model, position):
    """Of every mode, per unit of amplitude [1/m^2]."""
    return model.shapes(position / LENGTH, 2) / LENGTH**2


def test_bending_to_plus_y_compresses_the_plus_y_face():
    model = model_with([gauge("plus", 0.1, DISTANCE), gauge("minus", 0.1, -DISTANCE)])
    rows = gauge_rows(model, model.arm.gauges)
    bent = np.array([0.01, 0.0])  # first mode, tip on the +y side
    assert model.tip_deflection(bent)[0] > 0.0
    plus, minus = rows @ bent
    assert plus < 0.0 < minus
    assert plus == -minus


def test_strain_is_that_of_a_beam_bent_by_its_tip_load():
    """Twenty modes against the cantilever of the textbook: strain = c P (L - eta) / EI."""
    model = model_with([gauge("a", 0.0), gauge("b", 0.5)], modes=20, observed=[])
    force = -1.0  # [N] along y at the tip
    t = model.terms(np.zeros(1), np.zeros(1))
    delta = np.linalg.solve(t.K2, force * model.phi_tip)
    strain = gauge_rows(model, model.arm.gauges) @ delta
    EI = model.link.stiffness["y"]
    expected = [DISTANCE * (LENGTH - eta) / EI for eta in (0.0, 0.5)]
    # The curvature series converges slowly at the clamp.
    np.testing.assert_allclose(strain, expected, rtol=0.03)


def test_rows_are_surface_distance_times_curvature():
    model = model_with(GAUGES)
    rows = gauge_rows(model, GAUGES)
    assert rows.shape == (3, 2)
    for row, g in zip(rows, GAUGES, strict=True):
        np.testing.assert_allclose(
            row, -g.surface_distance * curvature(model, g.position), rtol=1e-14
        )


def test_rows_of_some_modes_are_columns_of_all():
    model = model_with(GAUGES)
    np.testing.assert_array_equal(
        gauge_rows(model, GAUGES, ["link1_y_mode2"]), gauge_rows(model, GAUGES)[:, 1:]
    )


def test_a_gauge_for_another_direction_reads_nothing_of_bending_in_y():
    model = model_with(GAUGES)
    other = replace(GAUGES[0], direction="z")
    np.testing.assert_array_equal(gauge_rows(model, [other]), np.zeros((1, 2)))


@pytest.mark.parametrize("count", [2, 3])
def test_amplitudes_come_back_from_their_strains(count):
    strain_map = StrainMap(model_with(GAUGES[:count]))
    rng = np.random.default_rng(1)
    for _ in range(10):
        delta = 0.02 * rng.standard_normal(2)
        np.testing.assert_allclose(
            strain_map.amplitudes(strain_map.rows @ delta), delta, rtol=0, atol=1e-14
        )


def test_amplitudes_can_be_written_in_place():
    strain_map = map_with()
    strain = np.array([1e-4, -2e-4, 3e-5])
    out = np.empty(2)
    assert strain_map.amplitudes(strain, out=out) is out
    np.testing.assert_array_equal(out, strain_map.amplitudes(strain))


def test_gain_and_bias_are_taken_out():
    """Reading = gain * strain + bias."""
    gain, bias = (1.1, -0.9, 2.0), (1e-5, -3e-5, 2e-6)
    strain_map, model = map_with(gain=gain, bias=bias), model_with(GAUGES)
    delta = np.array([0.03, -0.004])
    strain = [-g.surface_distance * curvature(model, g.position) @ delta for g in GAUGES]
    reading = np.array(gain) * strain + np.array(bias)
    np.testing.assert_allclose(strain_map.amplitudes(reading), delta, rtol=0, atol=1e-14)
    np.testing.assert_allclose(strain_map.rows @ delta + strain_map.bias, reading, rtol=1e-12)


def test_gauges_weigh_by_one_over_their_variance():
    noise = np.array([1e-7, 4e-7, 2e-7])
    strain_map = map_with(noise=tuple(noise), gain=1.3)
    reading = np.array([1e-4, 2e-4, 3e-5])  # of no shape that two modes have
    R, W = strain_map.rows, np.diag(1.0 / noise**2)
    expected = np.linalg.solve(R.T @ W @ R, R.T @ W @ reading)
    np.testing.assert_allclose(strain_map.amplitudes(reading), expected, rtol=1e-11)
    even = map_with(gain=1.3)
    assert np.abs(even.amplitudes(reading) / expected - 1.0).max() > 0.05


def test_weights_make_the_least_variance():
    """Of all unbiased maps; here against the unweighted one."""
    noise = np.array([1e-7, 2e-6, 1e-7])
    weighted, even = map_with(noise=tuple(noise)), map_with()
    scatter = [np.linalg.norm(each.inverse * noise, axis=1) for each in (weighted, even)]
    assert (scatter[0] < scatter[1]).all()


def test_a_gauge_without_stated_noise_weighs_as_the_quietest():
    some, wanted = map_with(noise=(3e-7, 9e-7, 0.0)), map_with(noise=(3e-7, 9e-7, 3e-7))
    np.testing.assert_array_equal(some.inverse, wanted.inverse)
    assert some.condition == wanted.condition


def test_a_third_mode_spills_over_into_the_two_observed():
    """By hand: two gauges, two observed modes, Cramer's rule."""
    two = model_with(GAUGES[:2])
    three = model_with(GAUGES[:2], modes=3)
    delta = np.array([0.02, -0.003, 0.001])
    shapes = beam.loaded(
        3, LENGTH, two.link.mass_per_length, two.arm.payload.mass, two.arm.payload.inertia[2][2]
    )
    k = [shapes(x, 2) / LENGTH**2 for x in (0.0, 0.6 / LENGTH)]
    strain = np.array([-DISTANCE * row @ delta for row in k])
    np.testing.assert_allclose(gauge_rows(three, GAUGES[:2]) @ delta, strain, rtol=1e-12)
    det = k[0][0] * k[1][1] - k[0][1] * k[1][0]
    spill = np.array(
        [
            (k[1][1] * k[0][2] - k[0][1] * k[1][2]) / det,
            (k[0][0] * k[1][2] - k[1][0] * k[0][2]) / det,
        ]
    )
    assert np.abs(spill).min() > 0.05
    np.testing.assert_allclose(
        StrainMap(two).amplitudes(strain), delta[:2] + spill * delta[2], rtol=1e-11
    )


def test_observing_one_mode_of_two_takes_the_rest_as_spill_over():
    strain_map = StrainMap(model_with(GAUGES[:2], observed=["link1_y_mode1"]))
    assert strain_map.mode_names == ("link1_y_mode1",)
    assert strain_map.inverse.shape == (1, 2)
    assert strain_map.gauge_names == ("root", "middle")


def test_no_gauges_and_nothing_to_observe_give_nothing():
    strain_map = StrainMap(model_with([], observed=[]))
    assert strain_map.amplitudes(np.zeros(0)).shape == (0,)


def test_fewer_gauges_than_modes_are_refused():
    with pytest.raises(ModelError, match="can't give 2 modal amplitudes") as error:
        map_with(GAUGES[:1])
    assert (error.value.field, error.value.value) == ("gauges of one_link", 1)


def test_two_gauges_at_one_place_cannot_tell_two_modes_apart():
    twins = [gauge("a", 0.3), gauge("b", 0.3, -DISTANCE)]
    with pytest.raises(ModelError, match="can't tell link1_y_mode1, link1_y_mode2 apart"):
        map_with(twins)


def test_a_gauge_where_the_mode_has_no_curvature_is_refused():
    """Clamped-free: the tip carries no moment."""
    arm = arm_file.load("R").with_modes(1)
    tip = Gauge("tip", "link1", arm.links[0].length, "y", DISTANCE)
    root = replace(tip, name="root", position=0.0)
    model = OneLink(replace(arm, model="one_link", gauges=(root,), observed_modes=arm.mode_names))
    StrainMap(model)
    rows = gauge_rows(model, [tip, root])
    assert abs(rows[0, 0]) < 1e-12 * abs(rows[1, 0])
    two = arm_file.load("R")
    model = OneLink(replace(two, model="one_link", gauges=(tip, root)))
    with pytest.raises(ModelError, match=r"condition number .*move one away"):
        StrainMap(model)


def test_shipped_gauges_are_well_placed(shipped):
    for name in ("R", "P3", "one_link"):
        assert StrainMap(shipped(name)).condition < 10.0


# --------------------------------------------------------------------------- lost gauges, bias, noise


def test_the_map_without_a_gauge_is_the_map_of_the_others():
    gauges = [
        replace(g, noise=n, bias=2e-5) for g, n in zip(GAUGES, (1e-6, 2e-6, 3e-6), strict=True)
    ]
    whole = StrainMap(model_with(gauges))
    reading = np.array([1e-4, -5e-5, 7e-5])
    for lost in range(3):
        rest = StrainMap(model_with(gauges[:lost] + gauges[lost + 1 :]))
        expected = rest.amplitudes(np.delete(reading, lost))
        broken = reading.copy()
        broken[lost] = np.nan
        assert whole.possible_without((lost,))
        np.testing.assert_allclose(whole.amplitudes_without((lost,), broken), expected, rtol=1e-11)
    np.testing.assert_array_equal(whole.amplitudes_without((), reading), whole.amplitudes(reading))


def test_without_too_many_there_is_no_map_and_the_modes_are_named():
    whole = map_with()
    assert not whole.possible_without((0, 2))
    assert whole.unobservable_without((0, 2)) == ("link1_y_mode1", "link1_y_mode2")
    assert whole.unobservable_without((0,)) == ()


def test_a_new_bias_is_the_maps_from_then_on():
    whole, fresh = map_with(), (1e-5, -2e-5, 3e-5)
    wanted = map_with(bias=fresh)
    reading = np.array([1e-4, -5e-5, 7e-5])
    whole.bias = fresh
    np.testing.assert_array_equal(whole.amplitudes(reading), wanted.amplitudes(reading))
    np.testing.assert_array_equal(
        whole.amplitudes_without((1,), reading), wanted.amplitudes_without((1,), reading)
    )
    with pytest.raises(ShapeError) as error:
        whole.bias = [0.0, 0.0]
    assert (error.value.field, error.value.value, error.value.limit) == ("bias", (2,), (3,))


def test_the_noise_of_each_amplitude_is_what_repeated_readings_scatter_by():
    strain_map = map_with(noise=(1e-6, 4e-6, 2e-6))
    noise = np.array([1e-6, 4e-6, 2e-6]) * np.random.default_rng(0).standard_normal((20_000, 3))
    scatter = np.std([strain_map.amplitudes(n) for n in noise], axis=0)
    np.testing.assert_allclose(strain_map.amplitude_noise, scatter, rtol=0.02)
    # and by (R^T W R)^-1
    R, W = strain_map.rows, np.diag(strain_map.noise**-2.0)
    np.testing.assert_allclose(
        strain_map.amplitude_noise, np.sqrt(np.diag(np.linalg.inv(R.T @ W @ R))), rtol=1e-10
    )
    assert np.isnan(map_with().amplitude_noise).all()


def test_rounding_counts_as_noise_of_a_step_over_the_root_of_twelve():
    g = replace(GAUGES[0], bits=10, full_scale=1e-3)
    step = 2e-3 / 1024
    assert g.step == step and g.range == (-1e-3, 1e-3 - step)
    np.testing.assert_allclose(g.uncertainty, step / np.sqrt(12.0))
    np.testing.assert_allclose(
        StrainMap(model_with([g, replace(GAUGES[1], noise=3e-6), GAUGES[2]])).noise,
        [step / np.sqrt(12.0), 3e-6, step / np.sqrt(12.0)],
    )


def test_indistinguishable_modes_are_named():
    names = ("a", "b", "c")
    rows = np.array([[1.0, 2.0, 0.0], [2.0, 4.0, 5.0], [3.0, 6.0, 1.0]])
    assert confused(rows, names) == ((), ("a", "b"))
    assert confused(np.array([[1.0, 0.0], [2.0, 0.0]]), names[:2]) == (("b",), ())
    assert confused(np.array([[1.0, 2.0]]), names[:2]) == ((), ("a", "b"))
    assert confused(np.array([[1.0, 2.0], [1.0, 3.0]]), names[:2]) == ((), ())
    assert confused(np.zeros((2, 2)), names[:2]) == (("a", "b"), ())


def test_an_arm_with_a_laboratorys_gauges_may_lose_any_two(shipped):
    strain_map = StrainMap(shipped("R_lab"))
    for i in range(4):
        for j in range(i):
            assert strain_map.possible_without((j, i))
    assert not strain_map.possible_without((0, 1, 2))
