# SPDX-License-Identifier: Apache-2.0
"""The checks of a driver on simulated samples: a good one passes, each broken one fails with the right sentence."""

import json
import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.arm.description import scaled
from flexarm_dynamics.models import model
from flexarm_dynamics.parameters import check_all
from flexarm_sim import simulator
from flexarm_tools.check_driver import listening, moving
from flexarm_tools.check_driver.command import merged, report
from flexarm_tools.check_driver.listening import Tolerances
from flexarm_tools.check_driver.samples import Finding, Received, Samples, Verdict, samples

RATE = 200.0  # [Hz]
NOW = 1_700_000_000_000_000_000  # [ns] what the clock shows at the first sample
TOLERANCES = Tolerances(rate=RATE)


class Bench:
    """A simulated arm as a driver would tell of it; records are taken once and changed copies are judged.

    Parameters
    ----------
    name : str
        Of the arm file, which the checks know.
    joint : int
        Which one is pushed.
    settings : mapping
        Of the simulator: another plant, noise.
    """

    def __init__(self, name, joint=0, position=0.0, **settings):
        self.model = model.build(arm_file.load(name))
        self.arm = self.model.arm
        n = self.model.n_joints
        values = {"arm": name, "rate": RATE, "initial_position": [position] * n, **settings}
        plant_arm = values.pop("plant_arm", "")
        values = check_all(simulator.PARAMETERS, values, {"joints": n})
        self.sim = simulator.Simulator({**values, "plant_arm": plant_arm})
        self.push = moving.plan(self.model, [position] * n, joint)
        self.rest = self.record(200, lambda t: None)
        self.moved = self.record(round(self.push.duration * RATE), self.push.torque)
        self.sent = moving.sent_torque(self.moved, self.answered, self.torques)

    def record(self, count, torque):
        """So many samples, each answered at once by a function of the time since the first."""
        sim, rows = self.sim, []
        self.answered, self.torques = [], []
        for k in range(count):
            values = (sim.position, sim.velocity, sim.torque, sim.strain, sim.amplitude)
            rows.append([sim.stamp_ns, sim.sequence, *(a.copy() for a in values)])
            u = torque(k / RATE)
            if u is not None:
                self.answered.append(sim.sequence)
                self.torques.append(u)
            sim.advance(u)
        stamp, sequence, *values = (np.array(c) for c in zip(*rows, strict=True))
        stamp = stamp.astype(np.int64) + NOW
        names = ("position", "velocity", "torque", "strain", "amplitude")
        columns = {k: v if v.shape[1] else None for k, v in zip(names, values, strict=True)}
        return Samples(
            arrival=1e-9 * stamp,
            clock=stamp + 1_000_000,
            stamp=stamp,
            session=np.full(count, 4711),
            sequence=sequence.astype(np.int64),
            **columns,
        )

    def push_again(self, torque):
        """Push from rest under another torque; None is the safe action."""
        self.sim.reset()
        self.moved = self.record(self.moved.size, torque)
        self.sent = moving.sent_torque(self.moved, self.answered, self.torques)

    def findings(self, change=None):
        """Everything that listening and one push find, with `change` made to both records."""
        rest, moved = (change(s) if change else s for s in (self.rest, self.moved))
        found = listening.check_listening(self.model, rest, TOLERANCES)
        sent = self.sent
        if moved.size != sent.shape[0]:
            sent = moving.sent_torque(moved, self.answered, self.torques)
        found += moving.check_push(self.model, self.push, moved, sent, TOLERANCES)
        return {f.check: f for f in merged(found)}

    def broken(self, change):
        """Checks that fail, by name."""
        return {c: f.text for c, f in self.findings(change).items() if f.verdict == Verdict.FAIL}


@pytest.fixture(scope="module")
def bench():
    """The paper's arm: one joint, two gauges, modal amplitudes published."""
    return Bench("R")


@pytest.fixture(scope="module")
def lab():
    """The same on a 12-bit bridge with noise and an encoder: the plant stiffer, with more payload and damping."""
    arm = arm_file.load("R_lab")
    return Bench("R_lab", noise=True, plant_arm=scaled(arm, payload=1.2, stiffness=0.85))


@pytest.fixture(scope="module")
def two_link():
    """Two joints, four gauges; the first joint is pushed."""
    return Bench("two_link")


def verdicts(findings):
    return {c: f.verdict.value for c, f in findings.items()}


def changed(*fields, by):
    """A change of some fields of samples by a function."""
    return lambda s: replace(s, **{field: by(getattr(s, field)) for field in fields})


def frozen(strain):
    return np.full_like(strain, strain[0, 0])


def without(*fields, then):
    """A change of samples that lack some fields."""
    return lambda s: then(replace(s, **dict.fromkeys(fields)))


# Good drivers ------------------------------------------------------------------------------------------


def test_the_simulator_passes_every_check_and_reads_what_its_model_does(bench):
    found = bench.findings()
    assert set(verdicts(found).values()) == {"PASS"}, verdicts(found)
    text = "gauges bend as the model does: root 1.00, middle 1.00"
    assert found["strain response"].text == text
    assert "moves 1 times as far as its model" in found["response"].text


@pytest.mark.parametrize("name", ["lab", "two_link"])
def test_other_arms_pass(name, request):
    found = request.getfixturevalue(name).findings()
    assert set(verdicts(found).values()) <= {"PASS", "SKIPPED"}, found
    assert verdicts(found)["response"] == verdicts(found)["strain response"] == "PASS"


def test_the_push_goes_as_far_as_it_says_and_comes_to_rest(bench):
    moved = np.ptp(bench.moved.position)
    assert moved == pytest.approx(bench.push.angle, rel=0.05)
    assert abs(bench.moved.velocity[-1, 0]) < 0.05 * np.abs(bench.moved.velocity).max()


def test_the_weight_of_an_arm_is_held_while_it_is_pushed():
    arm_model = model.build(arm_file.load("long_reach"))
    position = [0.3, 0.4, -0.5, 0.2]
    push = moving.plan(arm_model, position, 1)
    terms = arm_model.terms(np.array(position), np.zeros(4))
    a, B = moving.slow_subsystem(terms)
    np.testing.assert_allclose(a + B @ push.torque(0.0), 0.0, atol=1e-9)
    assert np.abs(push.hold).max() > 1.0


def test_a_push_during_which_the_safe_action_came_is_replayed_with_it():
    b = Bench("R")
    b.push_again(lambda t: None if 0.45 < t < 0.6 else b.push.torque(t))
    assert np.ptp(b.moved.position) < 0.9 * b.push.angle
    assert "moves 1 times as far as its model" in b.findings()["response"].text


def test_a_push_whose_samples_were_lost_is_not_judged(bench):
    def lose(samples, first, last):
        kept = np.r_[0:first, last : samples.size]
        arrays = {k: v[kept] for k, v in vars(samples).items() if v is not None}
        return replace(samples, **arrays)

    gap = bench.findings(lambda s: lose(s, 100, 115))["response"]
    assert gap.verdict == Verdict.SKIPPED
    assert "no sample came for 0.0" in gap.text and "joint1" in gap.text
    assert bench.findings(lambda s: lose(s, 100, 103))["response"].verdict == Verdict.PASS


def test_an_arm_under_its_weight_is_pushed_from_rest():
    b = Bench("long_reach", joint=1, position=0.2)
    b.push_again(b.push.torque)
    found = b.findings()
    assert "FAIL" not in verdicts(found).values(), found
    assert verdicts(found)["response"] == "PASS"
    # Gauges across the push are not judged: it hardly bends them.
    # The arm is simulated with its stiffening, of which the check's model knows nothing.
    ratio = re.search(r"upper_root_z (\d\.\d+)", found["strain response"].text)[1]
    assert 0.9 < float(ratio) < 1.02
    assert "upper_root_y" not in found["strain response"].text


def test_velocity_need_not_be_published_nor_torque_known(bench):
    unknown = changed("torque", by=lambda torque: torque + np.nan)
    found = verdicts(bench.findings(without("velocity", then=unknown)))
    assert (found["velocity"], found["torque reported"]) == ("PASS", "WARN")
    assert found["response"] == "PASS"  # replayed with the torque that was sent


def test_a_pause_of_the_reader_makes_no_driver_fail(bench):
    def late(samples):
        kept = np.r_[0:60, 90 : samples.size]
        fields = {k: v if v is None else v[kept] for k, v in vars(samples).items()}
        clock = fields["clock"].copy()
        clock[60:90] += 80_000_000
        return Samples(**{**fields, "clock": clock})

    found = bench.findings(late)
    assert "FAIL" not in verdicts(found).values()
    assert verdicts(found)["sequence"] == "WARN" and "did not arrive" in found["sequence"].text


# What goes wrong -------------------------------------------------------------------------------------


EXCHANGED = "mode link1_y_mode1 moves as link1_y_mode2 should: they are exchanged"
SWAPPED = changed("amplitude", by=lambda a: a[:, ::-1])


@pytest.mark.parametrize(
    ("change", "failures"),
    [
        (
            changed("position", "velocity", by=np.negative),
            {"response": "wrong sign: reverse the sign of the position's or of the torque's scale"},
        ),
        (
            changed("position", by=np.degrees),
            {
                "velocity": "joint1 moves 57.3 times its integrated velocity: position is in degrees",
                "response": "moves 57.3 times as far as its model",
            },
        ),
        # The velocity in degrees as well: only the model can tell.
        (
            changed("position", "velocity", by=np.degrees),
            {"response": "position is in degrees, send rad"},
        ),
        (SWAPPED, {"mode order": EXCHANGED}),
        (without("strain", then=SWAPPED), {"mode order": EXCHANGED}),
        (
            changed("stamp", by=lambda t: t - 200_000_000),
            {
                "stamps": "stamps are at least 0.201 s old when they arrive, allowed are 0.05 s: stamp at the"
                " measurement and publish at once"
            },
        ),
        (
            without("amplitude", then=changed("strain", by=frozen)),
            {"frozen strain": "strain of root, middle did not change at all while the arm moved"},
        ),
    ],
    ids=(
        *("wrong sign", "position in degrees", "both in degrees", "swapped modes"),
        *("swapped modes without strain", "old stamps", "frozen strain"),
    ),
)
def test_a_fault_fails_its_own_checks_alone_and_is_named(bench, change, failures):
    failed = bench.broken(change)
    assert set(failed) == set(failures)
    for check, text in failures.items():
        assert text in failed[check]


def test_one_frozen_gauge_of_several(lab):
    def change(s):
        strain = s.strain.copy()
        strain[:, 2] = strain[0, 2]
        return replace(s, strain=strain, amplitude=None)

    assert "strain of middle did not" in lab.broken(change)["frozen strain"]


@pytest.mark.parametrize("reports", [True, False])
def test_torque_ignored(bench, reports):
    """A driver that reports the torque sent but does not apply it, and one that reports zero."""

    def change(s):
        torque = bench.sent if s is bench.moved else s.torque
        still = {k: np.repeat(getattr(s, k)[:1], s.size, axis=0) for k in ("position", "velocity")}
        return replace(s, **still, torque=torque if reports else np.zeros_like(s.torque))

    failed = bench.broken(change)
    assert set(failed) == ({"response"} if reports else {"response", "torque reported"})
    assert "torque is ignored: is the drive enabled" in failed["response"]


@pytest.mark.parametrize(
    ("change", "check", "text"),
    [
        (changed("velocity", by=np.degrees), "velocity", "velocity is in degrees per second"),
        (changed("velocity", by=np.negative), "velocity", "one of the two has the wrong sign"),
        (changed("strain", by=lambda e: 1e6 * e), "strain response", "check its scale"),
        (changed("strain", by=np.negative), "strain response", "what its model does: wrong sign"),
        (changed("strain", by=lambda e: e[:, ::-1]), "gauge order", "root moves as middle should"),
        (changed("strain", by=lambda e: e + np.nan), "finite", "root is not finite in 200 of"),
        (changed("position", by=lambda q: q + 90.0), "position", "are these degrees or counts?"),
        (changed("torque", by=np.negative), "torque reported", "reported with the wrong sign"),
        (changed("torque", by=lambda u: 0.5 * u), "torque reported", "reports 0.50 of the torque"),
        (changed("sequence", by=lambda k: 0 * k), "sequence", "stands still"),
        (changed("sequence", by=lambda k: 5 * k), "sequence", "in steps of 5"),
        (changed("session", by=lambda k: k + np.arange(k.size)), "session", "sessions in one run"),
        (changed("stamp", by=lambda t: t + 10**8), "stamps", "in the future"),
        (changed("stamp", by=lambda t: 0 * t), "stamps", "100% of the stamps do not rise"),
        (changed("stamp", by=lambda t: t // 1000), "stamps", "0.001 s per second"),
        (changed("stamp", by=lambda t: t - (t - t[0]) // 5), "rate", "250.0 samples per second"),
    ],
)
def test_other_faults_are_named(bench, change, check, text):
    with np.errstate(all="ignore"):
        failed = bench.broken(change)
    assert text in failed[check]


def test_a_scale_that_is_wrong_is_not_one_of_the_tolerated(bench):
    for factor, fails in ((0.6, False), (1.4, False), (0.4, True), (1.6, True)):
        failed = bench.broken(changed("position", "velocity", by=lambda v, f=factor: f * v))
        assert ("response" in failed) == fails, factor


def test_joints_that_are_exchanged_are_distinguished(two_link):
    failed = two_link.broken(changed("position", "velocity", by=lambda v: v[:, ::-1]))
    assert "joint joint1 moves as joint2 should" in failed["joint order"]


def test_gauges_of_two_links_that_are_exchanged_are_distinguished(two_link):
    change = without("amplitude", then=changed("strain", by=lambda e: e[:, [2, 1, 0, 3]]))
    text = two_link.broken(change)["gauge order"]
    assert "gauge link1_root moves as link2_root should" in text


def test_a_bridge_out_of_balance_is_a_warning_and_at_the_end_of_its_range_a_failure(bench):
    found = bench.findings(changed("strain", by=lambda e: e + 150e-6))
    assert verdicts(found)["strain at rest"] == "WARN"
    assert "call observer/calibrate_gauges" in found["strain at rest"].text
    failed = bench.broken(changed("strain", by=lambda e: np.minimum(e + 1.0, 1000e-6)))
    assert "at the end of its range in 100%" in failed["strain at rest"]
    failed = bench.broken(changed("strain", by=lambda e: e + 1.0))
    assert "not microstrain or counts" in failed["strain at rest"]


def test_without_motion_what_needs_it_is_skipped(bench):
    found = listening.check_listening(bench.model, bench.rest, TOLERANCES)
    skipped = {f.check for f in found if f.verdict == Verdict.SKIPPED}
    assert skipped == {"velocity", "frozen strain"}


def test_a_few_stamps_in_the_future_are_a_warning(bench):
    stamp = bench.rest.stamp.copy()
    stamp[:20] += 4_000_000
    finding = listening.check_stamps(replace(bench.rest, stamp=stamp), Tolerances())
    assert finding.verdict == Verdict.WARN and "up to 0.003 s in the future" in finding.text


def test_stamps_that_deviate_from_their_grid_fail(bench):
    jitter = np.random.default_rng(0).uniform(-0.004, 0.004, bench.rest.size)
    finding = listening.check_jitter(
        replace(bench.rest, stamp=bench.rest.stamp + (1e9 * jitter).astype(int)), Tolerances()
    )
    assert finding.verdict == Verdict.FAIL
    one = bench.rest.stamp.copy()
    one[100:110:2] += 4_000_000
    finding = listening.check_jitter(replace(bench.rest, stamp=one), Tolerances(jitter=0.3))
    assert finding.verdict == Verdict.WARN


# When torque stops -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("held", "verdict"), [(0.04, "PASS"), (0.06, "PASS"), (0.2, "WARN"), (0.6, "FAIL")]
)
def test_how_long_a_torque_goes_on_is_measured(bench, held, verdict):
    rest = bench.rest
    last, sent = int(rest.sequence[40]), np.array([-2.0])
    on = (rest.sequence > last - 20) & (rest.time <= rest.time[40] + held + 1e-6)
    reported = replace(rest, torque=np.where(on[:, None], sent, 0.0))
    finding = moving.check_stop(reported, last, sent, 0, Tolerances())
    assert finding.verdict.value == verdict
    assert f"went on for {held:.3f} s" in finding.text


def test_a_watchdog_is_not_judged_where_no_torque_was_applied(bench):
    last = int(bench.rest.sequence[40])
    finding = moving.check_stop(bench.rest, last, np.array([1.0]), 0, Tolerances())
    assert finding.verdict == Verdict.SKIPPED


def test_a_torque_that_has_to_be_refused_and_is_applied_fails(bench):
    rest, sent = bench.rest, np.array([2.0])
    taken = rest.torque.copy()
    taken[50] = 2.0
    for kind in moving.REFUSALS:
        assert moving.check_refused(kind, rest, sent, 0).verdict == Verdict.PASS
        finding = moving.check_refused(kind, replace(rest, torque=taken), sent, 0)
        assert finding.verdict == Verdict.FAIL and "it was applied" in finding.text


def test_the_torque_sent_is_that_of_the_answer_before(bench):
    rest = replace(bench.rest, sequence=np.arange(bench.rest.size))
    sent = moving.sent_torque(rest, [2, 3, 5], [[1.0], [2.0], [3.0]])
    np.testing.assert_array_equal(sent[:8, 0], [0, 0, 0, 1, 2, 2, 3, 3])


# Messages -----------------------------------------------------------------------------------------------


def message(**changes):
    """What an ArmState of arm R holds."""
    fields = {
        "header": SimpleNamespace(stamp=SimpleNamespace(sec=3, nanosec=7)),
        "session": 5,
        "sequence": 9,
        "joint_names": ["joint1"],
        "joint_position": [0.1],
        "joint_velocity": [],
        "joint_torque": [],
        "gauge_names": ["root", "middle"],
        "strain": [1e-6, 2e-6],
        "mode_names": [],
        "modal_amplitude": [],
        "modal_rate": [],
    }
    return SimpleNamespace(**{**fields, **changes})


@pytest.mark.parametrize(
    ("changes", "name", "text"),
    [
        ({"joint_names": ["j1"]}, "names", "joint_names are ['j1'], arm R has ['joint1']"),
        ({"gauge_names": ["root"], "strain": [0.0]}, "names", "['root'], arm R has"),
        ({"strain": [0.0]}, "lengths", "strain has 1 values for 2 gauge_names"),
        ({"joint_position": []}, "lengths", "joint_position has 0 values for 1 joint_names"),
        ({"strain": []}, "lengths", "strain has 0 values for 2 gauge_names"),
    ],
)
def test_names_and_lengths_are_checked(bench, changes, name, text):
    found = {f.check: f for f in listening.check_layout(bench.arm, [message(), message(**changes)])}
    assert found[name].verdict == Verdict.FAIL and text in found[name].text


def test_another_order_is_read_by_name_and_warned_of(bench):
    turned = message(gauge_names=["middle", "root"], strain=[2e-6, 1e-6])
    names, lengths = listening.check_layout(bench.arm, [turned])
    assert (names.verdict, lengths.verdict) == (Verdict.WARN, Verdict.PASS)
    read = samples(bench.arm, [Received(turned, 0.5, 42)])
    np.testing.assert_array_equal(read.strain, [[1e-6, 2e-6]])
    assert (read.stamp[0], read.session[0], read.sequence[0]) == (3_000_000_007, 5, 9)
    assert read.velocity is None and read.amplitude is None
    assert np.isnan(read.torque).all()


def test_the_report_is_a_line_a_check_and_its_exit_code_tells(capsys):
    findings = [
        Finding("rate", Verdict.PASS, "well"),
        Finding("rate", Verdict.FAIL, "not well"),
        Finding("age", Verdict.WARN, "so so"),
    ]
    assert report(merged(findings)) == 1
    assert capsys.readouterr().out.splitlines() == [
        "FAIL     rate  not well",
        "WARN     age   so so",
        "1 of 2 checks failed",
    ]
    assert report(findings[2:], as_json=True) == 0
    assert json.loads(capsys.readouterr().out) == [
        {"check": "age", "verdict": "WARN", "text": "so so"}
    ]
