# SPDX-License-Identifier: Apache-2.0
"""The observer of an arm: strains, order of samples, what is refused and what that leaves behind."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from flexarm_control.loop.samples import ArmSample
from flexarm_control.observers.arm_observer import OBSERVERS, observe
from flexarm_dynamics import registry
from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.arm.strain_map import gauge_rows
from flexarm_dynamics.errors import MessageError, ModelError
from flexarm_dynamics.models import model

MS = 10**6  # [ns]


def sample(k=0, session=1, **fields):
    """Sample k of 1 kHz, of an arm that swings; fields replace its own."""
    s = ArmSample(1, 2, 2)
    s.stamp_ns, s.session, s.sequence = fields.pop("stamp_ns", 10**9 + k * MS), session, k
    s.position[:], s.velocity[:] = 0.1 * k, 0.7
    s.amplitude[:] = 0.01 * np.sin(0.3 * k), 0.001 * k
    s.strain, s.torque[:] = None, 0.5
    for name, value in fields.items():
        as_it_is = value is None or isinstance(value, bool)
        setattr(s, name, value if as_it_is else np.array(value, float))
    return s


def observed(arm, name="filtered_derivative", **options):
    return observe(arm, name, options)


def state(core):
    o = core.observer
    joints = core.position, core.velocity
    return np.concatenate(
        [*joints, o.amplitude, o.rate, o.innovation, o.covariance_diagonal, [o.converged]]
    )


# --------------------------------------------------------------------------- strains


@pytest.mark.parametrize(("gain", "bias"), [(1.0, 0.0), (2.0, 1e-4)])
def test_strains_are_mapped_to_the_amplitudes_that_bend_the_gauges_so(arm_r, gain, bias):
    gauges = tuple(replace(g, gain=gain, bias=bias) for g in arm_r.arm.gauges)
    arm = model.build(replace(arm_r.arm, gauges=gauges))
    core, delta = observed(arm), np.array([0.012, -0.003])
    core.step(sample(strain=gain * gauge_rows(arm, gauges) @ delta + bias, amplitude=None))
    assert_allclose(core.observer.amplitude, delta, rtol=1e-11)


def test_without_amplitudes_strains_and_gauges_are_needed(arm_r):
    with pytest.raises(MessageError, match="neither strain nor modal_amplitude"):
        observed(arm_r).step(sample(strain=None, amplitude=None))
    core = observed(model.build(replace(arm_r.arm, gauges=())))
    with pytest.raises(MessageError, match="arm file of R has no gauges"):
        core.step(sample(strain=[0.0, 0.0], amplitude=None))


def test_an_arm_with_a_mode_that_it_does_not_observe_is_refused():
    arm = replace(arm_file.load("R"), observed_modes=("link1_y_mode1",))
    with pytest.raises(ModelError, match="link1_y_mode2"):
        observed(model.build(arm))


# --------------------------------------------------------------------------- order of samples


@pytest.mark.parametrize("name", registry.names(OBSERVERS))
def test_a_repeated_sample_changes_nothing_to_the_last_bit(arm_r, name):
    core = observed(arm_r, name)
    for k in range(20):
        core.step(sample(k, rate=[1.0, k], strain=[1e-6 * k, 0.0]))
        once, known = state(core), core.observer.converged
        for _ in range(3):
            # what it carries does not matter: it is known
            again = sample(k, rate=[9.0, 9.0], amplitude=[0.5, 0.5], position=[9.0])
            assert core.step(again) is known
        assert_array_equal(state(core), once)
    fresh = observed(arm_r, name)
    for k in range(20):
        fresh.step(sample(k, rate=[1.0, k], strain=[1e-6 * k, 0.0]))
    assert_array_equal(state(core), state(fresh))


@pytest.mark.parametrize("name", ["filtered_derivative", "kalman"])
def test_what_is_left_until_the_estimate_is_sent_changes_nothing_to_the_last_bit(arm_r, name):
    """A joint velocity of wrong sign is found by what is left; both then say so in the same sample."""
    late, whole = observed(arm_r, name), observed(arm_r, name)
    doubts = []
    for k in range(100):
        mine, other = (sample(k, position=[7e-4 * k], velocity=[-0.7]) for _ in range(2))
        late.step(mine, later=True)
        whole.step(other)
        assert_array_equal(state(late), state(whole))
        assert (mine.trust, mine.doubt) == (other.trust, other.doubt)
        doubts.append(mine.doubt)
        late.look_ahead()
    assert not doubts[0]
    assert "wrong sign" in doubts[-1]


def test_a_new_session_starts_the_observer_again(arm_r):
    core, fresh = observed(arm_r), observed(arm_r)
    for k in range(20):
        core.step(sample(k, amplitude=[0.3 * k, 1.0], velocity_known=False))
    assert core.observer.converged
    for k in range(3):
        # earlier stamps and sequence numbers: a simulator that was reset
        args = {"session": 2, "velocity_known": False}
        assert core.step(sample(k, **args)) is fresh.step(sample(k, **args)) is False
        assert_array_equal(state(core), state(fresh))


def test_an_older_sample_is_left_out_and_the_next_goes_on(arm_r):
    core, clean = observed(arm_r), observed(arm_r)
    for k in (0, 1, 2, 5):
        core.step(sample(k))
        clean.step(sample(k))
    for stale in (sample(3), sample(4, stamp_ns=10**9 + 6 * MS)):
        assert core.step(stale) is None
        assert_array_equal(state(core), state(clean))
    core.step(sample(8))
    clean.step(sample(8))
    assert_array_equal(state(core), state(clean))


@pytest.mark.parametrize("stamp_ns", [10**9 + 5 * MS, 10**9, 10**9 + 900 * MS])
def test_after_a_clock_that_jumps_the_observer_starts_afresh(arm_r, stamp_ns):
    core, fresh = observed(arm_r), observed(arm_r)
    for k in (0, 1, 2, 5):
        core.step(sample(k, amplitude=[0.1 * k, 0.0]))
    for k in range(6, 20):
        new = sample(k, stamp_ns=stamp_ns + (k - 6) * MS, amplitude=[0.01 * k, 0.0])
        assert core.step(new) == fresh.step(new)
        assert_array_equal(state(core), state(fresh))


def test_two_sources_are_named(arm_r):
    core = observed(arm_r)
    core.step(sample(0))
    core.step(sample(0, session=9))
    with pytest.raises(MessageError, match=r"two sources send states \(sessions 9 and \d+\)"):
        core.step(sample(1))


def test_a_gap_is_bridged_with_the_true_time_step(arm_r):
    core = observed(arm_r)
    for k in (0, 1, 2, 7, 8, 20, 21, 22, 23, 24, 25, 26, 27, 28, 40):
        core.step(sample(k, amplitude=[0.002 * k, -0.001 * k], position=[0.003 * k]))
    assert_allclose(core.observer.rate, [2.0, -1.0], rtol=1e-12)


def test_a_stamp_ahead_of_its_number_is_a_jump_of_the_clock_where_the_joints_have_moved_so_little(
    arm_r,
):
    """A driver whose clock jumps by 0.3 s in the middle of a motion: the arm goes on as fast as it was."""
    steady, jumped = observed(arm_r, plausibility=True), observed(arm_r, plausibility=True)
    for k in range(200):
        given = {"amplitude": [0.002, -0.001], "position": [1e-3 * k], "velocity_known": False}
        steady.step(sample(k, **given))
        jumped.step(sample(k, stamp_ns=(k + 300 * (k >= 150)) * MS + MS, **given))
    assert_allclose(steady.velocity, [1.0], rtol=1e-6)
    assert_allclose(jumped.velocity, [1.0], rtol=1e-6)


def test_a_stamp_ahead_of_its_number_is_a_pause_where_the_joints_have_moved_as_far(arm_r):
    core = observed(arm_r, plausibility=True)
    for k in range(200):
        moved = 1e-3 * (k + 299 * (k >= 150))
        stamp = (k + 300 * (k >= 150)) * MS + MS
        core.step(
            sample(k, stamp_ns=stamp, amplitude=[0.0, 0.0], position=[moved], velocity_known=False)
        )
        if k == 150:
            assert core._step_of(sample(151, stamp_ns=stamp + MS)) == pytest.approx(1e-3)
            assert_allclose(core.velocity, [1.0], rtol=0.02)


# --------------------------------------------------------------------------- refusals

BAD = {
    "joint_position of joint1": {"position": [np.nan]},
    "joint_velocity of joint1": {"velocity": [np.inf]},
    "modal_amplitude of link1_y_mode2": {"amplitude": [0.0, np.nan]},
    "modal_amplitude of link1_y_mode1": {"amplitude": [-1e6, 0.0]},
    "modal_rate of link1_y_mode1": {"rate": [np.nan, 0.0]},
    "strain of middle": {"amplitude": None, "strain": [0.0, 1e30]},
    "strain of root": {"amplitude": None, "strain": [-np.inf, 0.0]},
}


@pytest.mark.parametrize("name", BAD)
def test_an_unusable_value_is_refused_naming_where_it_stands(arm_r, name):
    core, clean = observed(arm_r), observed(arm_r)
    for k in range(10):
        core.step(sample(k))
        clean.step(sample(k))
    (values,) = (v for v in BAD[name].values() if v is not None)
    bad = next(v for v in values if not abs(v) < 1e6)
    with pytest.raises(MessageError, match=f"{name}( is|:) {np.float64(bad)}".replace("+", r"\+")):
        core.step(sample(10, **BAD[name]))
    assert_array_equal(state(core), state(clean))
    # and it was never there: the same sample, repaired, is new
    assert core.step(sample(10)) is clean.step(sample(10)) is True
    assert_array_equal(state(core), state(clean))


def test_values_of_a_sane_size_are_taken(arm_r):
    assert observed(arm_r).step(sample(position=[-999_999.0], strain=[1.0, 1.0])) is False


def test_a_bad_joint_velocity_does_not_matter_where_none_was_given(arm_r):
    core = observed(arm_r)
    core.step(sample(0, velocity=[np.nan], velocity_known=False))
    assert_array_equal(core.velocity, [0.0])


@pytest.mark.parametrize(
    ("name", "delay", "why"),
    [
        ("luenberger", 0.0, "luenberger"),
        ("kalman", 0.0, "kalman"),
        ("extended_kalman", 0.0, "extended_kalman"),
        ("filtered_derivative", 0.01, r"observer\.delay"),
    ],
)
def test_a_sample_that_the_observer_refuses_leaves_nothing_behind(arm_r, name, delay, why):
    """Its time step neither: the next estimate is the one of a stream that never had it."""
    core, clean = observed(arm_r, name, delay=delay), observed(arm_r, name, delay=delay)
    for k in range(30):
        args = {"velocity_known": False, "position": [0.01 * k**2]}
        if k == 12:
            for _ in range(2):  # sent again, it is refused again
                with pytest.raises(MessageError, match=f"joint_torque: is unknown.*{why} predicts"):
                    core.step(sample(k, torque=[np.nan], **args))
                assert_array_equal(state(core), state(clean))
            continue
        assert core.step(sample(k, **args)) == clean.step(sample(k, **args))
        assert_array_equal(state(core), state(clean))


def test_a_start_that_the_observer_refuses_is_no_start(arm_r):
    core = observed(arm_r, "true_rates")
    with pytest.raises(MessageError, match="modal_rate: is empty"):
        core.step(sample(0))
    assert core.step(sample(0, rate=[1.0, 2.0])) is True


def test_whatever_an_observer_raises_becomes_a_refusal_that_names_it(arm_r):
    core = observed(arm_r)

    def update(sample, dt):
        raise ZeroDivisionError("no such thing")

    core.observer.update = update
    with pytest.raises(
        MessageError, match="observer FilteredDerivative: failed: ZeroDivisionError: no such thing"
    ):
        core.step(sample(0))


# --------------------------------------------------------------------------- joint velocity


def test_an_absent_joint_velocity_is_the_filtered_derivative_of_the_position(arm_r):
    core = observed(arm_r, joint_velocity_bandwidth=400.0)
    for k in (0, 1, 2, 5, 6, 9, 30):
        s = sample(k, position=[0.002 * k], velocity_known=False)
        core.step(s)
        assert_allclose(core.velocity, [2.0 * -np.expm1(-0.4 * k)], rtol=1e-11)
        assert_array_equal(s.velocity, core.velocity)


def test_a_measured_joint_velocity_that_is_not_used_is_checked_and_left_as_it_was(arm_r):
    options = {"joint_velocity_bandwidth": 400.0}
    unused, without = (
        observed(arm_r, measured_velocity=False, **options),
        observed(arm_r, **options),
    )
    for k in range(40):
        args = {"position": [0.002 * k**1.5]}
        sent = sample(k, velocity=[0.07 * k**0.5], **args)
        unused.step(sent)
        without.step(sample(k, velocity_known=False, **args))
        assert_array_equal(unused.velocity, without.velocity)
        assert_array_equal(sent.velocity, [0.07 * k**0.5])
        assert sent.velocity_known
    assert np.abs(unused.velocity - sent.velocity) > 1e-3
    # Of the wrong sign: found, though it is not used.
    doubts = []
    for k in range(40, 80):
        sent = sample(k, position=[0.002 * k**1.5], velocity=[-0.07 * k**0.5])
        unused.step(sent)
        doubts.append(sent.doubt)
    assert any("wrong" in doubt for doubt in doubts), set(doubts)


def test_luenberger_takes_its_friction_from_the_reconstructed_joint_velocity(heavy_arm):
    known, unknown = observed(heavy_arm, "luenberger"), observed(heavy_arm, "luenberger")
    for k in range(40):
        args = {"position": [0.002 * k], "amplitude": [0.0, 0.0]}
        known.step(sample(k, velocity=[2.0], **args))
        unknown.step(sample(k, velocity=[99.0], velocity_known=False, **args))
    assert_allclose(unknown.velocity, [2.0], rtol=1e-6)
    assert_allclose(unknown.observer.rate, known.observer.rate, rtol=1e-4)


def test_a_prediction_that_is_no_number_is_refused_and_the_estimate_stays(arm_r):
    # Found by fuzzing: a huge estimate, predicted over the delay, was passed on as NaN, converged.
    core = observed(arm_r, delay=0.004)
    for k in range(5):
        core.step(sample(k))
    before = (core.amplitude.copy(), core.rate.copy(), core.position.copy())
    core._motion.advance = lambda x, *_: np.full_like(x, np.nan)
    with pytest.raises(MessageError, match="has lost the arm"):
        core.step(sample(5))
    for now, then in zip((core.amplitude, core.rate, core.position), before, strict=True):
        assert_array_equal(now, then)
    assert not core.observer.converged
