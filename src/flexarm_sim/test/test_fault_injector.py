# SPDX-License-Identifier: Apache-2.0
"""Faults: their lines, and what each makes of the samples."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.errors import ParameterError
from flexarm_sim import fault_injector
from flexarm_sim.fault_injector import FIELDS, Fault, FaultInjector, Sample, parse

ARM = arm_file.load("two_link")
PERIOD = 1_000_000  # [ns]
START = 1_000_000_000
NAMES = {
    "joint_names": list(ARM.joint_names),
    "gauge_names": list(ARM.gauge_names),
    "mode_names": list(ARM.observed_modes),
}


def sample(k):
    """Sample k: entry i of field f reads 100 f + 10 i + k / 1000."""
    fields = FIELDS
    values = {
        name: 100.0 * f + 10.0 * np.arange(2 if name.startswith("joint") else 4) + 1e-3 * k
        for f, name in enumerate(fields)
    }
    return Sample(k, START + k * PERIOD, NAMES, values)


def sent(lines, count=20, injector=None):
    """What goes out for each of `count` samples."""
    injector = injector or FaultInjector(ARM, lines)
    return [injector.outgoing(sample(k), k * 1e-3) for k in range(count)]


def only(lines, count=20):
    """The same, where every sample is one message."""
    out = sent(lines, count)
    assert [len(s) for s in out] == [1] * count
    return [s[0] for s in out]


def numbers(out):
    return [[s.sequence for s in messages] for messages in out]


# --------------------------------------------------------------------------- lines


NO_FAULT = 'a fault is "SIGNAL KIND [key=value ...]"'
REFUSED = [
    ("", "", NO_FAULT),
    ("strain", "strain", NO_FAULT),
    ("voltage nan", "voltage", "(joint_position, joint_velocity, "),
    ("strain.root nan", "strain.root", "(link1_root, link1_middle, "),
    ("joint_position.link1_root nan", "joint_position.link1_root", "(joint1, joint2)"),
    ("state.joint1 drop", "state.joint1", "state has no parts"),
    ("strain break", "break", "no kind of strain (drop, short, long, nan, inf, huge, stick, "),
    ("strain.link1_root drop", "drop", "use nan"),
    ("names nan", "nan", "(reorder, wrong)"),
    ("strain bias", "bias", "needs by="),
    ("clock jump by=1", "jump", "needs at="),
    ("clock jump by=1 at=1 from=2", "from=2", "(by=…, at=…)"),
    ("strain nan by=2", "by=2", "(from=…, for=…)"),
    ("strain nan from", "from", "no key of nan"),
    ("strain nan from=1 from=2", "from=2", "given twice"),
    ("strain nan from=x", "from=x", "not a number"),
    ("strain nan from=nan", "from=nan", "not finite"),
    ("strain nan from=-1", "from=-1", "(from 0 to "),
    ("strain nan for=0", "for=0", "(from 1e-09 to "),
    ("state drop share=1.5", "share=1.5", "out of range (from 0 to 1)"),
    ("state drop share=0.5 seed=1.5", "seed=1.5", "a seed is an integer"),
    ("state delay by=0", "by=0", "(from 1e-09 to 10)"),
    ("state delay by=11", "by=11", "(from 1e-09 to 10)"),
    ("strain saturate at=-1", "at=-1", "(from 0 to "),
]


@pytest.mark.parametrize(("line", "word", "text"), REFUSED)
def test_a_bad_line_is_refused_with_the_word_and_what_is_allowed(line, word, text):
    with pytest.raises(ParameterError) as error:
        parse(line, ARM)
    assert (error.value.field, error.value.value) == ("faults", word)
    assert f"in {line!r}: " in str(error.value) and text in str(error.value)


def test_a_bad_line_among_good_ones_changes_nothing():
    injector = FaultInjector(ARM, ["strain nan"])
    with pytest.raises(ParameterError, match="voltage"):
        injector.set(["joint_position nan", "voltage nan"])
    assert injector.faults == (Fault("strain", "nan"),)


NUMBERS = {
    "from": st.floats(0.0, 1e6),
    "for": st.floats(1e-6, 1e6),
    "at": st.floats(0.0, 1e6),
    "share": st.floats(0.0, 1.0),
    "seed": st.integers(0, 1000),
    "by": st.floats(1e-6, 10.0),
}


@st.composite
def faults(draw):
    signal = draw(st.sampled_from([*FIELDS, *fault_injector.OTHER_KINDS]))
    entry = ""
    if signal in FIELDS:
        entry = draw(st.sampled_from(["", *NAMES[FIELDS[signal]]]))
    kinds = fault_injector.OTHER_KINDS.get(signal) or {
        **fault_injector.VALUE_KINDS,
        **({} if entry else fault_injector.FIELD_KINDS),
    }
    kind = draw(st.sampled_from(sorted(kinds)))
    allowed, needed = kinds[kind]
    window = () if (signal, kind) in fault_injector.EVENTS else fault_injector.WINDOW
    optional = [k for k in (*allowed, *window) if k not in needed]
    given = [
        *needed,
        *draw(st.lists(st.sampled_from(optional), unique=True) if optional else st.just([])),
    ]
    return Fault(signal, kind, entry, tuple((k, draw(NUMBERS[k])) for k in given))


@settings(max_examples=200, deadline=None, derandomize=True)
@given(faults())
def test_a_fault_is_what_its_line_says(fault):
    assert parse(str(fault), ARM) == fault


PARTS = ["strain", "state", "clock", "nan", "drop", "jump", "by=1", "from=", "for=1e999", "at=ö"]
WORDS = st.sampled_from([*PARTS, "=", "."])


@settings(max_examples=300, deadline=None, derandomize=True)
@given(st.one_of(st.text(max_size=40), st.lists(WORDS, max_size=6).map(" ".join)))
def test_any_text_is_a_fault_or_refused(text):
    try:
        assert parse(str(parse(text, ARM)), ARM) == parse(text, ARM)
    except ParameterError as error:
        assert str(error).startswith("faults: ")


# --------------------------------------------------------------------------- values


@pytest.mark.parametrize("signal", FIELDS)
@pytest.mark.parametrize(
    ("kind", "reads"),
    [
        ("nan", lambda v: np.full_like(v, np.nan)),
        ("inf", lambda v: np.full_like(v, np.inf)),
        ("huge", lambda v: np.full_like(v, fault_injector.HUGE)),
        ("bias by=-0.5", lambda v: v - 0.5),
        ("saturate at=0.25", lambda v: np.minimum(v, 0.25)),
        ("drop", lambda v: None),
        ("short", lambda v: v[:-1]),
        ("long", lambda v: np.append(v, v[-1])),
    ],
)
def test_a_whole_field_reads_what_its_fault_says_while_it_acts(signal, kind, reads):
    for k, out in enumerate(only([f"{signal} {kind} from=0.005 for=0.003"])):
        true = sample(k)
        for name, value in true.values.items():
            wanted = reads(value) if name == signal and 5 <= k < 8 else value
            if wanted is None:
                assert out.values[name] is None
            else:
                assert_array_equal(out.values[name], wanted)
        assert (out.sequence, out.stamp_ns, out.names) == (k, true.stamp_ns, NAMES)


def test_a_fault_of_one_entry_leaves_the_others_alone():
    out = only(["strain.link1_middle nan", "joint_position.joint2 bias by=1"], 1)[0]
    assert_array_equal(np.isnan(out.values["strain"]), [False, True, False, False])
    assert_array_equal(out.values["joint_position"], sample(0).values["joint_position"] + [0, 1])


def test_stick_keeps_the_reading_of_its_beginning_and_a_reset_forgets_it():
    injector = FaultInjector(ARM, ["strain.link2_root stick from=0.004 for=0.010"])
    for _ in range(2):
        out = [s[0].values["strain"][2] for s in sent((), injector=injector)]
        true = [sample(k).values["strain"][2] for k in range(20)]
        assert out == [*true[:4], *[true[4]] * 10, *true[14:]]
        injector.reset()


def test_a_delayed_value_is_that_of_so_long_ago():
    out = only(["joint_position.joint1 delay by=0.003 from=0.006"])
    read = [round(1e3 * s.values["joint_position"][0]) for s in out]
    assert read == [0, 1, 2, 3, 4, 5, *range(3, 17)]
    assert [round(1e3 * (s.values["joint_position"][1] - 10.0)) for s in out] == list(range(20))


def test_the_true_sample_is_not_touched():
    true = sample(3)
    FaultInjector(ARM, ["strain nan", "names reorder", "clock jump by=1 at=0"]).outgoing(
        true, 0.003
    )
    assert (true.stamp_ns, true.names) == (START + 3 * PERIOD, NAMES)
    assert_array_equal(true.values["strain"], sample(3).values["strain"])


def test_a_field_that_is_empty_stays_empty():
    true = sample(0)
    true.values["strain"] = None
    out = FaultInjector(ARM, ["strain stick", "strain nan", "names reorder"]).outgoing(true, 0.0)
    assert out[0].values["strain"] is None


# --------------------------------------------------------------------------- messages


def test_lost_messages_are_lost():
    out = numbers(sent(["state drop from=0.002 for=0.003"], 8))
    assert out == [[0], [1], [], [], [], [5], [6], [7]]


def test_a_share_is_lost_by_seed_the_same_ones_each_time():
    def lost(seed, start=0):
        injector = FaultInjector(ARM, [f"state drop share=0.2 seed={seed}"])
        return [k for k in range(start, 500) if not injector.outgoing(sample(k), 1e-3 * k)]

    first = lost(3)
    assert 70 < len(first) < 130
    assert lost(3, 100) == [k for k in first if k >= 100]  # whenever it was set
    assert lost(4) != first


def test_late_messages_keep_order_number_and_stamp():
    out = sent(["state delay by=0.003 from=0.004 for=0.004"], 14)
    late = [[], [], [], [4], [5], [6], [7, 8, 9, 10]]
    assert numbers(out) == [[0], [1], [2], [3], *late, [11], [12], [13]]
    assert all(s.stamp_ns == START + s.sequence * PERIOD for messages in out for s in messages)


def test_messages_come_twice_or_out_of_order():
    assert numbers(sent(["state duplicate for=0.002"], 4)) == [[0, 0], [1, 1], [2], [3]]
    swapped = sent(["state swap from=0.001 for=0.004"], 7)
    assert numbers(swapped) == [[0], [], [2, 1], [], [4, 3], [5], [6]]
    assert numbers(sent(["state swap for=0.001"], 3)) == [[], [1, 0], [2]]


def test_stamps_ahead_and_a_clock_that_jumps():
    out = only(["state future by=0.5 from=0.002 for=0.002", "clock jump by=-0.9 at=0.006"], 8)
    off = [s.stamp_ns - START - s.sequence * PERIOD for s in out]
    assert off == [0, 0, 500_000_000, 500_000_000, 0, 0, -900_000_000, -900_000_000]
    assert only(["clock jump by=-10 at=0"], 1)[0].stamp_ns == 0  # no stamp lies before 1970


def test_names_in_another_order_go_with_their_values():
    out, true = only(["names reorder"], 1)[0], sample(0)
    for name, of in FIELDS.items():
        assert out.names[of] == NAMES[of][::-1]
        assert_array_equal(out.values[name], true.values[name][::-1])


def test_a_wrong_name():
    out = only(["names wrong"], 1)[0]
    assert out.names["joint_names"] == ["not_joint1", "joint2"]
    assert_array_equal(out.values["joint_position"], sample(0).values["joint_position"])


def test_several_faults_act_together():
    lines = ["strain.link1_root bias by=1", "strain saturate at=0.5", "state drop from=0.003"]
    out = sent(lines, 5)
    assert numbers(out) == [[0], [1], [2], [], []]
    assert (out[0][0].values["strain"] == 0.5).all()


# --------------------------------------------------------------------------- lies that keep on


def test_drift_scale_and_exchange_change_an_entry_or_a_field():
    entry = "strain.link1_middle"
    for line, changed in (
        (f"{entry} drift by=2.0 from=0.005", lambda v, t: v + np.eye(4)[1] * 2.0 * (t - 0.005)),
        (f"{entry} scale by=-1.0 from=0.005", lambda v, t: v * (1.0 - 2.0 * np.eye(4)[1])),
        (f"{entry} exchange from=0.005", lambda v, t: v[[0, 2, 1, 3]]),
        ("strain.link2_middle exchange from=0.005", lambda v, t: v[[3, 1, 2, 0]]),
        ("strain exchange from=0.005", lambda v, t: v[::-1]),
        ("modal_rate bias by=900 from=0.005", lambda v, t: v + 900.0),
    ):
        name = line.split()[0].split(".")[0]
        for k, out in enumerate(only([line], 8)):
            true = sample(k).values[name]
            expected = true if k < 5 else changed(true, 1e-3 * k)
            assert_allclose(out.values[name], expected, rtol=1e-12, err_msg=line)


def test_a_frozen_frame_has_the_number_and_stamp_of_now_and_a_repeat_those_of_then():
    for kind in ("freeze", "repeat"):
        out = only([f"state {kind} from=0.003 for=0.004"], 10)
        for k, message in enumerate(out):
            held = 3 if 3 <= k < 7 else k
            for name, value in message.values.items():
                assert_array_equal(value, sample(held).values[name], err_msg=kind)
            own = held if kind == "repeat" else k
            assert (message.sequence, message.stamp_ns) == (own, START + own * PERIOD)


def test_stamps_jitter_within_their_bound_and_alike_with_the_same_seed():
    off = [
        [
            m.stamp_ns - START - k * PERIOD
            for k, m in enumerate(only([f"state jitter by=4e-4 seed={seed}"]))
        ]
        for seed in (1, 1, 2)
    ]
    assert off[0] == off[1] != off[2]
    assert 300_000 < max(np.abs(off[0])) <= 400_000


@pytest.mark.parametrize(
    "fault", ["state jitter by=1e9", "state future by=1e9", "clock jump by=-1e9 at=0"]
)
def test_a_stamp_is_one_that_a_message_can_hold(fault):
    stamps = {m.stamp_ns for m in only([fault] * 4, 200)}
    assert min(stamps) >= 0 and max(stamps) <= fault_injector.LAST_NS


def test_a_session_changes_for_good_and_a_second_source_sends_in_turn():
    injector = FaultInjector(ARM, ["session change at=0.003"])
    assert [m[0].session for m in sent([], 6, injector)] == [0, 0, 0, 1, 1, 1]
    assert injector.session == 1
    injector.reset()
    assert injector.session == 0
    out = sent(["session alternate from=0.002 for=0.002"], 6)
    assert [[m.session for m in messages] for messages in out] == [[0]] * 2 + [[0, 1]] * 2 + [
        [0]
    ] * 2
    assert numbers(out) == [[0], [1], [2, 2], [3, 3], [4], [5]]
