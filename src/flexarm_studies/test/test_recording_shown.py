# SPDX-License-Identifier: Apache-2.0
"""What `flexarm recording show` finds: in made-up recordings what was put in, in a real one what is known."""

import json

import numpy as np
import pytest
from scipy.signal import lfilter

from flexarm_studies.identification import recording
from flexarm_studies.recordings import mapping as mappings
from flexarm_studies.recordings import rest, ring_down, trends
from flexarm_studies.recordings.summary import peaks, summary

PERIOD = 0.01
FREQUENCY, DAMPING = 3.2, 0.012
DRIFT, DELAY = 12e-6, 0.015
LOADS = np.array([200e-6, 80e-6])


@pytest.fixture(scope="module")
def made():
    """60 s: 10 s of rest, then moves that end in ring-downs; weight, common noise, a drift, a late channel."""
    draw, time = np.random.default_rng(3), PERIOD * np.arange(6000)
    place, begin, ring = np.zeros(time.size), 10.0, np.zeros(time.size)
    target, omega = 0.0, 2.0 * np.pi * FREQUENCY
    for k in range(12):
        change = (0.9, 0.7, -1.1, 0.4)[k % 4]
        s = np.clip((time - begin) / 1.5, 0.0, 1.0)
        place += change * s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
        target, after = target + change, np.maximum(time - begin - 1.35, 0.0)
        faded = (
            np.exp(-DAMPING * omega * after) * (after > 0.0) * (after < (2.75 if k < 11 else 9.0))
        )
        ring += 60e-6 * faded * np.sin(omega * np.sqrt(1.0 - DAMPING**2) * after)
        begin += 4.0
    common, own = draw.standard_normal(time.size), draw.standard_normal((time.size, 2))
    late = np.interp(time - DELAY, time, place)
    seen = [np.cos(place) + 0.3 * np.sin(place), np.cos(late) + 0.3 * np.sin(late)]
    strain = LOADS * np.column_stack(seen) + ring[:, None] * [1.0, 0.4]
    strain += 2e-6 * common[:, None] + 0.5e-6 * own
    strain[:, 0] += DRIFT * time / time[-1]
    return recording.Recording(
        PERIOD, place[:, None], np.full((time.size, 1), np.nan), strain, joint_names=("j",),
        gauge_names=("a", "b"), velocity=np.gradient(np.roll(place, 2), PERIOD)[:, None],
    )  # fmt: skip


@pytest.fixture(scope="module")
def found(made):
    return summary(made)


def test_noise_is_taken_where_nothing_moves_and_is_split_into_common_and_own(found):
    noise = found["noise"]
    assert noise["from_s"] == 0.0 and 9.5 < noise["to_s"] < 10.7
    np.testing.assert_allclose(noise["rms"], np.hypot(2e-6, 0.5e-6), rtol=0.06)
    assert noise["correlation"][0][1] == pytest.approx(4.0 / 4.25, abs=0.01)
    np.testing.assert_allclose(noise["shared_rms"], 2e-6, rtol=0.06)
    np.testing.assert_allclose(noise["own_rms"], 0.5e-6 / np.sqrt(2.0), rtol=0.06)
    assert np.abs(noise["shared_memory"]).max() < 0.1  # it is white
    # What is left of one bridge once the other has been taken off by regression.
    np.testing.assert_allclose(
        noise["rms_corrected"], 0.5e-6 * np.sqrt(1.0 + 4.0 / 4.25), rtol=0.06
    )


def test_the_memory_of_shared_noise_is_found():
    draw, source = np.random.default_rng(1), np.zeros(3000)
    for k in range(4, 3000):
        source[k] = 0.3 * source[k - 1] - 0.5 * source[k - 4] + draw.standard_normal()
    strain = 1e-6 * (source[:, None] * [1.0, 2.0] + 0.1 * draw.standard_normal((3000, 2)))
    still = np.zeros((3000, 1))
    made = rest.noise(recording.Recording(0.01, still, still, strain), slice(0, 3000))
    np.testing.assert_allclose(made.memory, [0.3, 0.0, 0.0, -0.5], atol=0.05)
    assert made.shared[1] == pytest.approx(2.0 * made.shared[0], rel=0.02)


def test_every_ring_down_is_found_with_its_frequency_and_damping(found):
    rings = found["ring_downs"]
    assert len(rings) >= 11
    for ring in rings:
        assert ring["gauge"] == "a"
        assert abs(ring["frequency_hz"] - FREQUENCY) < 3.0 * ring["frequency_half_width_hz"]
        assert abs(ring["damping"] - DAMPING) < 3.0 * ring["damping_half_width"] < 0.01
    starts = np.array([ring["from_s"] for ring in rings])
    assert np.abs((starts - 11.5 + 2.0) % 4.0 - 2.0).max() < 0.35


def test_drift_and_delay_are_found_from_the_motion(found):
    a, b = found["drift"]
    assert abs(a["drift"] - DRIFT) < 2.0 * a["drift_half_width"] < 4e-6
    assert abs(b["drift"]) < 2.0 * b["drift_half_width"] < 2e-6
    assert abs(b["delay_s"] - DELAY) < 2.0 * b["delay_half_width_s"] < 0.02
    assert abs(a["delay_s"]) < 2.0 * a["delay_half_width_s"] < 0.02


def test_channels_that_follow_each_other_show_by_how_much(found):
    (speed,) = [d for d in found["delays"] if d["of"] == "velocity of j"]
    assert speed["delay_s"] == pytest.approx(0.02, abs=2e-4)


def test_a_series_is_found_late_between_samples_too():
    time = 0.01 * np.arange(1000)
    wave = lambda t: np.sin(7.0 * t) + 0.4 * np.sin(11.0 * t)  # noqa: E731
    delay, alike = trends.lag(-wave(time - 0.0234), wave(time), 0.01)
    assert delay == pytest.approx(0.0234, abs=5e-4) and alike < -0.99


@pytest.mark.parametrize("damping", [0.003, 0.05, 0.2])
def test_a_decay_is_fitted_to_its_numbers(damping):
    time, omega = 0.005 * np.arange(400), 2.0 * np.pi * 4.3
    values = (
        3e-4
        * np.exp(-damping * omega * time)
        * np.cos(omega * np.sqrt(1 - damping**2) * time + 1.0)
    )
    ring = ring_down.fit(values + 1e-5 * time + 2e-4, 0.005)
    assert ring.damping == pytest.approx(damping, rel=1e-5)
    assert ring.frequency == pytest.approx(4.3 * np.sqrt(1 - damping**2), rel=1e-6)
    assert ring.amplitude == pytest.approx(3e-4, rel=1e-5) and ring.explained > 0.999999


@pytest.mark.parametrize("memory", [0.0, 0.9])
def test_intervals_of_a_decay_hold_where_what_is_left_is_coloured(memory):
    """Of 60 decays of a second and a half nearly all are within; with intervals of white residuals, half would be."""
    random, time, omega = np.random.default_rng(3), 0.01 * np.arange(150), 2.0 * np.pi * 3.1
    inside = 0
    for _ in range(60):
        new = random.standard_normal(400)
        noise = lfilter([np.sqrt(1.0 - memory**2)], [1.0, -memory], new)[-time.size :]
        values = 25.0 * np.exp(-0.01 * omega * time) * np.cos(omega * time + 1.0) + noise
        ring = ring_down.fit(values, 0.01)
        inside += abs(ring.frequency - 3.1) < ring.frequency_width
        inside += abs(ring.damping - 0.01) < ring.damping_width
    assert 0.88 * 120 < inside < 120


def test_noise_alone_rings_nowhere(made):
    quiet = recording.Recording(
        PERIOD, np.zeros((900, 1)), np.full((900, 1), np.nan), made.strain[:900],
        joint_names=("j",), gauge_names=("a", "b"),
    )  # fmt: skip
    found = summary(quiet)
    assert found["ring_downs"] == [] and found["noise"]["to_s"] == pytest.approx(8.99)
    assert found["drift"][0]["drift"] is not None  # of an arm that stands, the line alone


def test_an_encoder_that_toggles_at_rest_stands():
    position = 1.5e-3 * (np.arange(2000) % 7 == 0) + np.where(np.arange(2000) > 1000, 1.0, 0.0)
    made = recording.Recording(
        0.002, position[:, None], np.full((2000, 1), np.nan), np.zeros((2000, 0))
    )
    assert rest.still(made)[:900].all() and not rest.still(made)[1000]


def test_gaps_and_jitter_are_those_of_the_source(made):
    time = np.delete(made.time, slice(700, 720)) + 5.0
    rows = np.delete(np.arange(6000), slice(700, 720))
    again = recording.uniform(
        time, {"position": made.position[rows], "strain": made.strain[rows]},
        joint_names=("j",), gauge_names=("a", "b"),
    )  # fmt: skip
    found = summary(again)
    assert found["gaps"] == [{"at_s": pytest.approx(11.99), "length_s": pytest.approx(0.21)}]
    assert found["start_s"] == pytest.approx(12.2) and "left out" in found["notes"][0]


def test_a_spectrum_names_its_peaks(made):
    time = made.time
    tone = made.strain + 3e-6 * np.sin(2.0 * np.pi * 17.0 * time)[:, None]
    other = recording.Recording(
        PERIOD, made.position, made.torque, tone, joint_names=("j",), gauge_names=("a", "b")
    )
    assert any(abs(f - 17.0) < 0.2 for f in peaks(other)["a"])
    assert not any(abs(f - 17.0) < 0.2 for f in peaks(made)["a"])


def test_the_command_prints_draws_and_gives_json(made, tmp_path, flexarm, result):
    table = np.column_stack([made.time, made.position, made.strain])
    path, figure = tmp_path / "run.csv", tmp_path / "run.png"
    np.savetxt(path, table, "%.9g", ",", header="t,j_position,a_strain,b_strain", comments="")
    words = ("recording", "show", path)
    found = result(*words, "--figure", figure)
    assert figure.stat().st_size > 50_000 and found["rate_hz"] == pytest.approx(100.0)
    assert json.dumps(found["noise"]["correlation"]) != "null"
    _, out, _ = flexarm(*words)
    for line in (
        "6000 samples at 100 Hz",
        "gaps: 0",
        "position of j [rad]",
        "Hz, damping 0.01",
        "drift over",
    ):
        assert line in out
    code, _, err = flexarm("recording", "show", tmp_path / "none.csv")
    assert code == 1 and "no such file or bag" in err


def test_what_is_known_of_the_real_arms_recording_comes_out(real_arm):
    """Rest in the first 15 s, noise with one source, ring-downs of 3.0 to 3.3 Hz, and a gauge that drifts."""
    made = recording.read_csv(real_arm / "exp1.csv", None, mappings.load("tudor"))
    found = summary(made)
    noise = found["noise"]
    assert noise["from_s"] == 0.0 and 15.0 < noise["to_s"] < 15.5
    table = np.array(noise["correlation"])
    off = table[~np.eye(4, dtype=bool)]
    assert off.min() > 0.94 and off.max() < 0.985
    assert max(noise["rms_corrected"]) < 0.55e-6 < 1.5e-6 < min(noise["rms"])
    rings = found["ring_downs"]
    for at in (17.0, 28.0, 53.0, 60.0, 76.0):
        ring = min(rings, key=lambda r: abs(r["from_s"] - at))
        assert abs(ring["from_s"] - at) < 1.5
        assert 3.0 < ring["frequency_hz"] < 3.3 and 0.005 < ring["damping"] < 0.03
    drift = {row["gauge"]: row for row in found["drift"]}
    assert 6e-6 < drift["eps22"]["drift"] < 12e-6
    others = [abs(drift[name]["drift"]) for name in ("eps21", "eps31", "eps32")]
    assert max(others) < 4e-6
    assert found["gaps"] == [] and found["rate_hz"] == pytest.approx(100.0)
