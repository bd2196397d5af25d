# SPDX-License-Identifier: Apache-2.0
"""Sensors that lie in the middle of a move: what is replaced, what is named and how soon, what is no lie."""

from dataclasses import replace

import numpy as np
import pytest

from flexarm_control import trajectory
from flexarm_control.loop.samples import ArmSample
from flexarm_control.loop.supervisor import State
from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.arm.description import Friction, scaled
from flexarm_studies.loop.closed_loop import ClosedLoop

pytestmark = pytest.mark.slow

#: When a sensor begins to lie: in the middle of the move's acceleration [s].
BEGIN = 0.25
GAINS = {
    "R": ({"kp": [6.25], "kv": [5.0], "gain": "m11"}, {}),
    "two_link": (
        {"kp": [1.0, 1.0], "kv": [2.0, 2.0], "gain": "m11"},
        {"q": [0.0] * 4 + [0.3] * 4, "r": [1.0], "alpha": 0.3, "configuration": [0.8, 0.8]},
    ),
}


class LyingLoop(ClosedLoop):
    """A loop whose sensors lie from `BEGIN` on: `lie` changes the sample, with its number since then and a memory."""

    def __init__(
        self, arm="R", observer="filtered_derivative", velocity=False, lie=None, **options
    ):
        slow, fast = GAINS[arm]
        simulator = {"publish_joint_velocity": velocity, "publish_modal_amplitude": False}
        super().__init__(
            options.pop("known", arm),
            {"type": "linear_model_following", **slow},
            {"type": "lqr", **fast},
            {"type": observer, **options.pop("observer", {})},
            simulator | options.pop("simulator", {}),
            {"trajectory_torque_margin": 0.0} | options.pop("controller", {}),
            **options,
        )
        self.lie, self.memory, self.named = lie, {}, None

    def measure(self):
        s = super().measure()
        for field in ("strain", "amplitude", "rate"):
            if getattr(s, field) is not None:
                setattr(s, field, getattr(s, field).copy())
        k = round((self.simulator.time - BEGIN) * 1e9 / self.simulator.period_ns)
        if self.lie is not None and k >= 0:
            self.lie(s, k, self.memory)
        return s

    def move(self, seconds):
        """Begin a quintic of 0.5 rad in half a second; the torques (samples, n) of the first `seconds`."""
        n, names = self.model.n_joints, self.model.joint_names
        zero, goal = np.zeros(n), np.full(n, 0.5)
        points = [(0, zero, zero, zero, ()), (500_000_000, goal, zero, zero, ())]
        motion = trajectory.validate(names, names, 0, points)
        torques, offered = [], False
        while self.simulator.time < seconds:
            torque = self.step()
            offered = offered or self.controller.offer(motion).accepted
            torques.append(np.zeros(n) if torque is None else torque.copy())
            doubt = self._estimate.doubt
            if doubt and self.named is None:
                self.named = self.simulator.time - BEGIN, doubt, self._estimate.trust
        return np.array(torques)


def once(field, i, by):
    """A single reading i of a field, changed by this."""

    def lie(sample, k, memory):
        if k == 0:
            getattr(sample, field)[i] += by

    return lie


def always(field, change):
    """All readings of a field, changed for good: each by a number, or by a function."""

    def lie(sample, k, memory):
        values = getattr(sample, field)
        values[:] = change(values) if callable(change) else values + change

    return lie


def stuck(*fields):
    """Fields that stay as they are."""

    def lie(sample, k, memory):
        for field in fields:
            values = getattr(sample, field)
            values[:] = memory.setdefault(field, values.copy())

    return lie


def noisy(name):
    """The shipped arm with noise of its gauges and a coarse encoder, both stated."""
    known = arm_file.load(name)
    return replace(
        known,
        gauges=tuple(replace(g, noise=5e-7) for g in known.gauges),
        joints=tuple(replace(j, encoder_counts=65536) for j in known.joints),
    )


def exchanged(values):
    return values[::-1].copy()


ONCE = {
    "position, far": (False, once("position", 0, 0.2)),
    "position, near": (False, once("position", 0, -0.001)),
    "root gauge, far": (False, once("strain", 0, 2e-4)),
    "root gauge, near": (False, once("strain", 0, 1e-6)),
    "middle gauge": (False, once("strain", 1, -2e-4)),
    "velocity, far": (True, once("velocity", 0, 1.0)),
    "velocity, near": (True, once("velocity", 0, -0.05)),
}


@pytest.mark.parametrize("observer", ["filtered_derivative", "luenberger", "kalman"])
def test_a_single_outlier_hardly_changes_the_torque(observer):
    honest = {v: LyingLoop(observer=observer, velocity=v).move(BEGIN + 0.02) for v in (False, True)}
    for name, (velocity, lie) in ONCE.items():
        loop = LyingLoop(observer=observer, velocity=velocity, lie=lie)
        change = np.abs(loop.move(BEGIN + 0.02) - honest[velocity])
        assert (change < 0.05 * loop.model.arm.torque_limits).all(), name
        assert loop.named is None, name
        assert sum(loop.observer.monitor.bridged.values()) == 1, name


STOP, DISTRUSTED = ArmSample.STOP, ArmSample.DISTRUSTED
#: Lie, with measured velocity, what is named, how soon [s], and what follows.
LASTING = {
    "position jumps": (always("position", 0.2), False, "joint_position of joint1 jumped by 0.2 rad", 0.01, DISTRUSTED),
    "position stuck": (stuck("position"), False, "joint_position of joint1 stands still", 0.01, DISTRUSTED),
    "frame frozen": (stuck("position", "velocity", "strain", "torque"), True, "the frame is frozen", 0.01, DISTRUSTED),
    "frame without velocity": (stuck("position", "strain", "torque"), False, "the frame is frozen", 0.01, DISTRUSTED),
    "gauges stuck": (stuck("strain"), False, "strain of root and middle stands still", 0.01, DISTRUSTED),
    "gauge jumps": (always("strain", np.array([2e-4, 0.0])), False, "strain of root jumped by", 0.01, DISTRUSTED),
    "strain negated": (always("strain", np.negative), False, "root and middle has the wrong sign", 0.01, DISTRUSTED),
    "gauges exchanged": (always("strain", exchanged), False, "the gauges are exchanged", 0.01, DISTRUSTED),
    "velocity of wrong sign": (always("velocity", np.negative), True, "joint_velocity of joint1 jumped", 0.01, STOP),
    "velocity doubled": (always("velocity", lambda v: 2.0 * v), True, "joint_velocity of joint1 jumped", 0.01, STOP),
    "velocity stuck": (stuck("velocity"), True, "joint_velocity of joint1 stands still", 0.01, STOP),
}  # fmt: skip


@pytest.mark.parametrize("name", LASTING)
def test_a_lie_that_lasts_is_named(name):
    lie, velocity, words, within, trust = LASTING[name]
    loop = LyingLoop(velocity=velocity, lie=lie)
    loop.move(BEGIN + 0.05)
    time, doubt, degree = loop.named
    assert words in doubt
    assert time <= within
    assert degree == trust
    expected = State.FAULT if trust == DISTRUSTED else State.STOPPING
    assert loop.controller.state == expected
    assert words in loop.controller.reason


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (np.negative, "strain of root and middle has the wrong sign"),
        (lambda e: e * [-1.0, 1.0], "strain of root has the wrong sign"),
        (lambda e: e * [1.0, -1.0], "strain of middle has the wrong sign"),
        (exchanged, "strain of root and middle: the gauges are exchanged"),
    ],
)
def test_wrong_wiring_from_the_start_is_named_by_the_motion(change, words):
    """No reading jumps, so the strain's law has to find it; a payload that is 30 % off does not hide it."""
    plant = scaled(arm_file.load("R"), 1.3)
    loop = LyingLoop(plant_arm=plant)

    def lie(sample):
        sample.strain[:] = change(sample.strain)

    honest = loop.measure

    def measure():
        sample = honest()
        lie(sample)
        return sample

    loop.measure = measure
    loop.move(0.7)
    # That they do not fit is noticed before it is known why.
    assert "strain" in loop.named[1]
    assert words in loop.observer.monitor.doubts.text


def test_a_wrong_velocity_that_does_not_jump_is_named():
    """The wrong sign from the start: the motion shows it, and the loop goes on with its own estimate."""
    loop = LyingLoop(velocity=True)
    honest = loop.measure

    def measure():
        sample = honest()
        sample.velocity *= -1.0
        return sample

    loop.measure = measure
    loop.move(0.3)
    assert "joint_velocity of joint1 has the wrong sign" in loop.named[1]
    assert loop.named[2] == STOP
    assert np.abs(loop.observer.velocity - loop.simulator.velocity)[0] < 0.1


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda rate: np.full_like(rate, 900.0), "modal_rate of link1_y_mode1 jumped"),
        (np.negative, "modal_rate of link1_y_mode1"),
    ],
)
def test_modal_rates_that_can_not_be_are_named(change, words):
    source = {"publish_rates": True, "publish_modal_amplitude": True}
    loop = LyingLoop(observer="true_rates", simulator=source, lie=always("rate", change))
    loop.move(BEGIN + 0.1)
    assert loop.controller.state == State.FAULT
    assert words in loop.controller.reason


def test_without_plausibility_everything_is_believed():
    loop = LyingLoop(lie=always("position", 0.2))
    loop.observer.settings = loop.observer.settings | {"plausibility": False}
    loop.move(BEGIN + 0.01)
    assert loop.named is None


@pytest.mark.parametrize("arm", GAINS)
@pytest.mark.parametrize("payload", [0.7, 1.3])
def test_an_honest_arm_is_not_doubted(arm, payload):
    """Noise, a coarse encoder, friction and another payload than in the arm file."""
    known = noisy(arm)
    rough = tuple(replace(j, friction=Friction(0.02, 0.02, 0.02)) for j in known.joints)
    plant = replace(scaled(known, payload), joints=rough)
    loop = LyingLoop(arm, "kalman", known=known, plant_arm=plant, simulator={"noise": True})
    loop.move(0.8)
    assert loop.named is None
    assert not loop.observer.monitor.bridged


def test_a_gauge_that_drifts_stops_the_arm_and_hardly_moves_it():
    """The strain that the motion explains takes its place, for as long as it drifts."""
    loop = LyingLoop(observer="kalman", known=noisy("R"), simulator={"noise": True})

    def lie(sample, k, memory):
        sample.strain[0] += 1e-4 * 1e-3 * min(max(k - 1000, 0), 1000)

    loop.lie = lie
    loop.move(4.0)
    time, doubt, degree = loop.named
    assert doubt.startswith("strain of root drifts")
    assert 1.0 < time < 1.7  # in motion a payload of up to three times the file's is possible
    assert degree == STOP
    assert loop.controller.state == State.HOLDING
    assert loop.simulator.position[0] < 0.5 + 0.1
    assert abs(loop.controller.position_error[0]) < 0.1
    assert loop.observer.monitor.doubts.trust == STOP  # as long as its zero is wrong
    loop.observer.calibrate()
    while loop.simulator.time < 5.5:
        loop.step()
    assert loop.observer.monitor.doubts.trust == ArmSample.TRUSTED


# --------------------------------------------------------------------------- what follows


def test_a_gauge_that_the_others_can_replace_is_left_out_and_the_arm_stops():
    """R_lab has four gauges for two modes."""
    known = arm_file.load("R_lab")
    jump = np.array([0.0, 2e-4, 0.0, 0.0])
    loop = LyingLoop(
        observer="kalman", known=known, lie=always("strain", jump), simulator={"noise": True}
    )
    loop.move(BEGIN + 0.1)
    _, doubt, degree = loop.named
    assert doubt.startswith("strain of quarter jumped by")
    assert degree == STOP
    assert loop.observer.gauges.lost == (1,)
    assert loop.controller.state == State.STOPPING


def test_a_gauge_whose_noise_is_gone_is_named_at_rest():
    known = arm_file.load("R_lab")
    loop = LyingLoop(observer="kalman", known=known, simulator={"noise": True})

    def lie(sample, k, memory):
        sample.strain[2] = memory.setdefault("middle", sample.strain[2])

    loop.lie = lie
    while loop.simulator.time < BEGIN + 0.1:  # it stands
        loop.step()
    assert loop.observer.monitor.doubts.text.startswith("strain of middle stands still")


def test_rounded_readings_at_rest_are_not_doubted():
    """The encoder and the gauges of R_lab without noise: all are the same for ever."""
    loop = LyingLoop(observer="kalman", known=arm_file.load("R_lab"))
    while loop.simulator.time < 0.5:
        loop.step()
    assert not loop.observer.monitor.doubts.raised


def test_a_clicking_encoder_stops_the_arm_with_its_name():
    def lie(sample, k, memory):
        if k % 10 == 0:
            sample.position[0] += 0.01

    loop = LyingLoop(lie=lie)
    loop.move(BEGIN + 0.15)
    _, doubt, degree = loop.named
    assert doubt.startswith("joint_position of joint1 has many outliers")
    assert degree == STOP


def test_doubts_end_after_a_while_and_the_observer_has_started_afresh():
    def lie(sample, k, memory):
        sample.position[0] += 0.2

    loop = LyingLoop(lie=lie)
    loop.move(BEGIN + 0.01)
    assert loop.observer.monitor.doubts.trust == DISTRUSTED
    while loop.simulator.time < BEGIN + 0.7:
        loop.step()
    assert loop.observer.monitor.doubts.trust == ArmSample.TRUSTED
    assert loop.observer.observer.converged
    assert loop.observer.position[0] == pytest.approx(loop.simulator.position[0] + 0.2, abs=0.01)
    assert loop.controller.state == State.FAULT  # until it is asked to recover


def test_a_sample_that_is_sent_again_carries_the_same_doubt():
    loop = LyingLoop(lie=always("position", 0.2))
    loop.move(BEGIN + 0.01)
    measured = loop.measure()
    loop.observer.step(measured)
    text = measured.doubt
    measured.trust, measured.doubt = ArmSample.TRUSTED, ""
    loop.observer.step(measured)
    assert (measured.trust, measured.doubt) == (DISTRUSTED, text)


def test_a_new_session_has_no_doubts():
    loop = LyingLoop(lie=always("position", 0.2))
    loop.move(BEGIN + 0.01)
    sample = loop.measure()
    sample.session, sample.stamp_ns = 2, 10**9
    loop.observer.step(sample)
    assert sample.trust == ArmSample.TRUSTED


@pytest.mark.parametrize("factor", [3.0, 0.3])
def test_stamps_that_run_at_another_rate_are_named(factor):
    loop = LyingLoop()
    honest = loop.measure
    ends = {}

    def measure():
        sample = honest()
        if loop.simulator.time >= BEGIN:
            begin = ends.setdefault("begin", sample.stamp_ns)
            sample.stamp_ns = begin + round(factor * (sample.stamp_ns - begin))
        return sample

    loop.measure = measure
    while loop.simulator.time < BEGIN + 0.3:
        loop.step()
    assert loop.observer.monitor.doubts.text.startswith("header.stamp: samples are")
    assert loop.observer.monitor.doubts.trust == STOP


def test_jitter_and_loss_are_no_lies():
    loop = LyingLoop(velocity=True)
    random = np.random.default_rng(5)
    honest, answer = loop.measure, loop._answer
    offsets = {}

    def measure():
        sample = honest()
        offset = offsets.setdefault(sample.sequence, random.uniform(-4e5, 4e5))
        sample.stamp_ns += round(offset)
        return sample

    def lossy():
        lost = loop.simulator.time > 0.1 and random.random() < 0.2
        return loop.controller.enabled if lost else answer()

    loop.measure, loop._answer = measure, lossy
    loop.move(0.7)
    assert loop.named is None
    assert not loop.observer.monitor.bridged
