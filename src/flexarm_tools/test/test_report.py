# SPDX-License-Identifier: Apache-2.0
"""`flexarm report`: its numbers against the record itself, its page, and broken bags."""

import contextlib
import io
import json
import re
from dataclasses import replace
from functools import partial
from html.parser import HTMLParser
from types import SimpleNamespace

import numpy as np
import pytest
from rclpy.serialization import deserialize_message, serialize_message

from flexarm_bringup import cli
from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.arm.strain_map import StrainMap
from flexarm_dynamics.errors import FlexarmError, MessageError
from flexarm_dynamics.models import model
from flexarm_msgs.msg import ArmState, CompositeState, JointTorque
from flexarm_ros.messages import set_stamp
from flexarm_studies.commands import arm_figure
from flexarm_studies.loop import metrics, scenario
from flexarm_studies.recordings import mapping as mappings
from flexarm_tools.identification import recording as recordings
from flexarm_tools.recording import mcap
from flexarm_tools.recording import record as recording
from flexarm_tools.recording.loop_bag import LoopBag
from flexarm_tools.recording.recorder import BagWriter, raw_stamp_ns
from flexarm_tools.recording.serialised import Decoder, layout_of
from flexarm_tools.report import analysis, animation, command, figures, page, timeline
from flexarm_tools.report import run as run_module
from flexarm_tools.report.run import HOLDING, TRACKING

PERIOD = 5_000_000  # of the bags that are made up here [ns]


def scenario_of(file="paper_slow", arm="R", **more):
    return scenario.Scenario(arm, scenario.parameters(file), **more)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Two short runs of arm R, name to (bag, record, loop)."""
    folder, out = tmp_path_factory.mktemp("report"), {}
    for name, file in (("composite", "paper_composite"), ("slow", "paper_slow")):
        motion = "quintic:to=0.3,duration=0.5"
        of = scenario_of(file, trajectory=motion, rate=500.0, duration=2.5)
        record, _, loop = scenario.run_loop(of, partial(LoopBag, folder / name))
        out[name] = folder / name, record, loop
    return out


@pytest.fixture(scope="module")
def runs(recorded):
    return {name: command.read([path])[0] for name, (path, _, _) in recorded.items()}


# Bags of the loop without ROS ------------------------------------------------------------------


def test_identify_reads_the_same_bag(recorded):
    """Also its states without rates, after whose last array the middleware leaves four bytes."""
    folder, record, loop = recorded["composite"]
    found = recordings.read(folder, loop.model.arm)
    assert found.period == pytest.approx(0.002)
    begin = np.abs(record.position - found.position[0]).sum(axis=1).argmin()
    np.testing.assert_array_equal(found.position[:200], record.position[begin : begin + 200])
    other = replace(loop.model.arm.gauges[0], name="another")
    other = replace(loop.model.arm, gauges=(other, *loop.model.arm.gauges[1:]))
    with pytest.raises(FlexarmError) as error:
        recordings.read(folder, other)
    assert error.value.field == "gauge_names"


def test_a_csv_file_makes_a_report_of_what_it_holds(recorded, tmp_path, flexarm):
    """The same run as a table: angles in degrees, strains in microstrain; other columns are not there."""
    folder, _, loop = recorded["composite"]
    arm = loop.model.arm
    found = recordings.read(folder, arm)
    (tmp_path / "m.yaml").write_text(
        "rate: 500.0\ncolumns:\n- {column: 1, quantity: position, joint: joint1, unit: deg}\n"
        + "".join(
            f"- {{column: {i + 2}, quantity: strain, gauge: {name}, unit: microstrain}}\n"
            for i, name in enumerate(arm.gauge_names)
        )
    )
    table = np.hstack([np.degrees(found.position), 1e6 * found.strain])
    np.savetxt(tmp_path / "run.csv", table, "%.17g", ",")
    words = (tmp_path / "run.csv", "--mapping", tmp_path / "m.yaml", "--out", tmp_path / "r.html")
    code, out, err = flexarm("report", *words, "--arm", "R", "--json")
    assert code == 0, err
    numbers = json.loads(out)["runs"]["run"]
    assert numbers["samples"] == len(table) and numbers["rate_hz"] == pytest.approx(500.0)
    (run,) = command.read([words[0]], "R", mapping=mappings.load(words[2]))
    np.testing.assert_allclose(run.position(0), found.position[:, 0], atol=1e-12)
    wanted = StrainMap(loop.model).amplitudes(found.strain[-1])
    np.testing.assert_allclose(run.deflections()[-1], wanted, atol=1e-12)
    assert "<svg" in (tmp_path / "r.html").read_text()


def test_a_mapping_is_of_no_use_for_a_bag(recorded):
    with pytest.raises(FlexarmError, match="--mapping: is of no use for a bag"):
        recordings.read(recorded["slow"][0], mapping=mappings.parse("rate: 1.0\ncolumns: []"))
    assert (
        recordings.read(recorded["slow"][0]).gauge_names
        == recorded["slow"][2].model.arm.gauge_names
    )


def test_a_bag_of_the_loop_holds_what_the_loop_did(recorded, runs):
    for name, run in runs.items():
        _, record, _ = recorded[name]
        assert run.time.size == record.time.size
        estimate = "arm_state_estimate"
        for got, wanted in (
            (run.position(0), record.position[:, 0]),
            (run.column("controller/state", "reference_position", 0), record.reference[:, 0]),
            (run.column("controller/state", "torque", 0), record.torque[:, 0]),
            (run.column(estimate, "joint_velocity", 0), record.velocity[:, 0]),
            (run.amplitude(1), record.amplitude[:, 1]),
            (run.state, record.state),
        ):
            np.testing.assert_array_equal(got, wanted)
        np.testing.assert_allclose(run.time, record.time - record.time[0], atol=2e-9)


def test_a_bag_of_the_loop_says_which_arm_it_is(recorded, runs):
    assert runs["slow"].arm.name == "R"
    assert runs["slow"].arm.gauge_names == arm_file.load("R").gauge_names
    path, _, loop = recorded["slow"]
    assert loop.bag is None
    with pytest.raises(FlexarmError, match=r"exists already"):
        scenario.run_loop(scenario_of(), partial(LoopBag, path))


def test_a_network_shows_in_the_bag_as_states_without_an_answer(tmp_path):
    motion = "quintic:to=0.05,duration=0.2"
    of = scenario_of("composite", trajectory=motion, rate=500.0, loss=0.2, window=0.1)
    _, _, loop = scenario.run_loop(of, partial(LoopBag, tmp_path / "lossy"))
    (run,) = command.read([tmp_path / "lossy"])
    sent = run.column("joint_torque", "mode")
    assert run.timeline.lost == 0
    unanswered = int(np.isnan(sent).sum())
    # The first sample is lost or not before the loop is asked for it a second time.
    assert loop.network.lost <= unanswered <= loop.network.lost + loop.network.dropped + 1
    assert unanswered > 10


# Numbers ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["composite", "slow"])
def test_the_summary_is_what_the_record_gives(recorded, runs, name):
    _, record, loop = recorded[name]
    got = analysis.summary(runs[name])
    judged = (record.state >= TRACKING) & (record.state <= HOLDING)
    error = (record.reference - record.position)[judged, 0]
    assert got["peak_error_rad"][0] == np.abs(error).max()
    assert got["rms_error_rad"][0] == pytest.approx(np.sqrt(np.mean(error**2)), rel=1e-12)
    enabled = record.state >= 1
    assert got["peak_torque_Nm"][0] == np.abs(record.torque[enabled]).max()
    assert got["torque_limit_Nm"] == [loop.model.arm.joints[0].limits.torque]
    assert got["saturation_share"] == np.mean(record.saturated[enabled])
    assert got["peak_deflection_m"]["link1 y"] == pytest.approx(
        np.abs(record.tip_deflection(loop.model)).max(), rel=1e-12
    )
    assert got["rate_hz"] == pytest.approx(500.0)
    assert (got["motions"], got["lost"], got["faults"], got["sessions"]) == (1, 0, 0, 1)
    assert got["compute_time_s"] is None  # nothing has measured it


def test_residual_vibration_is_the_tips_about_its_mean_once_the_joints_have_settled(recorded, runs):
    _, record, loop = recorded["slow"]
    rest = (record.state == HOLDING) & (record.time >= 0.5 + metrics.SETTLE - 1e-9)
    tip = metrics.tip_path(loop.model, record.position, record.amplitude)[rest]
    rigid = metrics.tip_path(loop.model, record.position, 0.0 * record.amplitude)[rest]
    away = tip - rigid
    wanted = np.sqrt(np.mean(np.linalg.norm(away - away.mean(0), axis=1) ** 2))
    got = analysis.summary(runs["slow"])
    assert got["residual_windows"] == 1
    assert got["residual_window_s"] == pytest.approx([1.0, 2.0], abs=0.01)
    assert got["residual_m"] == pytest.approx(wanted, rel=0.01)
    assert got["residual_m"] > 1e-4


def test_the_report_and_the_case_study_have_one_residual_and_one_peak_error(recorded, runs):
    _, record, loop = recorded["slow"]
    got = analysis.summary(runs["slow"])
    wanted = metrics.case_study_metrics(record, loop.model, 1.5, 2.5)
    assert 1e3 * got["residual_m"] == pytest.approx(304.8 * wanted["residual_tip_rms_ft"], rel=0.05)
    assert np.degrees(got["peak_error_rad"][0]) == pytest.approx(
        wanted["peak_joint_error_deg"], rel=1e-6
    )


def test_slow_settling_right_after_a_motion_is_no_vibration():
    """Rests of 3 s, 1 s and 2 s: the short one, which holds the settling, does not count beside longer ones."""
    time = np.arange(0.0, 10.0, 0.01)
    run = SimpleNamespace(time=time)
    moves = [
        analysis.Motion(0, 100, 400),
        analysis.Motion(500, 600, 700),
        analysis.Motion(700, 750, 950),
    ]
    span, windows = analysis.residual_windows(run, moves)
    assert span == pytest.approx((1.0, 2.99))
    assert windows == [slice(200, 400), slice(850, 950)]
    span, windows = analysis.residual_windows(run, moves[1:2])
    assert span == pytest.approx((0.0, 0.99)) and windows == [slice(600, 700)]
    assert analysis.residual_windows(run, []) == ((0.0, 0.0), [])


def test_a_page_may_open_with_words_and_name_its_runs(tmp_path):
    path = _made_up(tmp_path / "bag", 50)
    made = command.make(
        [path], tmp_path / "x.html", names=["slow control alone"], opening="See <the> tip."
    )
    text = made.read_text(encoding="utf-8")
    assert "Report of slow control alone" in text
    assert text.index("See &lt;the&gt; tip.") < text.index("slow control alone: 0.2")
    with pytest.raises(ValueError):
        command.make([path], tmp_path / "x.html", names=["one", "too many"])


def test_a_spectrum_shows_the_frequencies_of_an_arm_that_rings(tmp_path):
    arm_model = model.build(arm_file.load("R"))
    low, high = arm_model.frequencies(np.zeros(1), True) / (2.0 * np.pi)

    def amplitude(t):
        return [np.sin(2.0 * np.pi * low * t), 0.1 * np.sin(2.0 * np.pi * high * t)]

    _made_up(tmp_path / "ring", 4000, amplitude=amplitude)
    (run,) = command.read([tmp_path / "ring"])
    everything = np.ones(run.time.size, bool)
    found = analysis.spectrum(run, everything)
    first, second = analysis.peaks(found)[:2]
    assert first == pytest.approx(low, abs=0.05)
    assert second == pytest.approx(high, abs=0.05)
    # Parseval: the density's integral is the mean square.
    bent = run.deflections() @ analysis.tip_rows(run.model)[0].T
    power = np.trapezoid if hasattr(np, "trapezoid") else np.trapz
    assert power(found.density[:, 0] ** 2, found.frequency) == pytest.approx(
        np.mean(bent**2), rel=0.05
    )
    np.testing.assert_allclose(analysis.predicted(run, np.zeros(1))["joints locked"], [low, high])


def test_the_animation_bends_as_the_model_does():
    random = np.random.default_rng(3)
    for name in ("two_link", "long_reach"):
        shape = animation.Shape(arm_file.load(name))
        q = random.normal(size=shape.chain.n_joints)
        delta = 0.01 * random.normal(size=shape.chain.n_modes)
        wanted = arm_figure.axis_points(shape.chain, q, delta, animation.POINTS)
        np.testing.assert_allclose(shape.points(q, delta), wanted, atol=1e-12)
        view = shape.view()
        np.testing.assert_allclose(view @ view.T, np.eye(3), atol=1e-12)


# The page --------------------------------------------------------------------------------------

VOID = {"meta", "input", "br", "img", "link", "hr"}


class Checker(HTMLParser):
    """Whether every element is closed by its own end, and what it refers to."""

    def __init__(self):
        super().__init__()
        self.open, self.wrong, self.refers, self.ids = [], [], [], []

    def handle_starttag(self, tag, attributes):
        self.open += [tag] if tag not in VOID else []
        self.handle_startendtag(tag, attributes)

    def handle_startendtag(self, tag, attributes):
        self.refers += [v for k, v in attributes if k in ("src", "href", "xlink:href", "data")]
        self.ids += [v for k, v in attributes if k == "id"]

    def handle_endtag(self, tag):
        if not self.open or self.open.pop() != tag:
            self.wrong.append((tag, self.getpos()))


def checked(text):
    checker = Checker()
    checker.feed(text)
    checker.close()
    assert not checker.wrong and not checker.open
    assert len(checker.ids) == len(set(checker.ids))
    for reference in checker.refers:
        assert reference.startswith(("#", "data:image/png;base64,")), reference
        if reference.startswith("#"):
            assert reference[1:] in checker.ids
    assert "http://" not in text and "https://" not in text and "@import" not in text
    assert set(re.findall(r"url\(#([^)]*)\)", text)) <= set(checker.ids)
    return checker


@pytest.fixture(scope="module")
def reported(recorded, tmp_path_factory):
    """The page of both runs, and what the command prints."""
    out = tmp_path_factory.mktemp("page") / "both.html"
    paths = [str(path) for path, _, _ in recorded.values()]
    with contextlib.redirect_stdout(io.StringIO()) as printed, pytest.raises(SystemExit, match="0"):
        cli.main(["report", *paths, "--out", str(out), "--json"])
    return out, json.loads(printed.getvalue())


@pytest.fixture(scope="module")
def compared(reported):
    return reported[0].read_text(encoding="utf-8")


def test_the_page_is_whole_small_and_needs_no_network(compared):
    checker = checked(compared)
    assert len(compared.encode()) < 1_000_000
    sections = "short summary animation supervisor tracking modes spectra torques strains events"
    assert set(sections.split()) <= set(checker.ids)


def test_the_numbers_of_the_page_as_json(reported, runs):
    out, printed = reported
    assert printed["report"] == str(out) and list(printed["runs"]) == ["composite", "slow"]
    for name, numbers in printed["runs"].items():
        assert numbers["residual_m"] == pytest.approx(analysis.summary(runs[name])["residual_m"])


def test_two_runs_stand_side_by_side(compared, runs):
    assert "2 runs side by side" in compared
    composite, slow = (analysis.summary(runs[name]) for name in ("composite", "slow"))
    for numbers in (composite, slow):
        assert f"<td>{page.digits(1e3 * numbers['residual_m'])}" in compared
        assert f"<td>{page.digits(page.DEGREES * numbers['peak_error_rad'][0])}</td>" in compared
    ratio = slow["residual_m"] / composite["residual_m"]
    better, worse = ("composite", "slow") if ratio > 1.0 else ("slow", "composite")
    factor = page.digits(max(ratio, 1.0 / ratio))
    window = "1 to 2 s after the motion"
    assert (
        f"Residual vibration, {window}: {better} has {factor} times less than {worse}." in compared
    )
    assert compared.count(f"({window})") == 2
    film = json.loads(re.search(r'id="film">(.*?)</script>', compared, re.DOTALL).group(1))
    assert [r["label"] for r in film["runs"]] == ["composite", "slow"]
    assert film["start"] < 0.0 < film["end"]


def test_the_film_shows_the_tip_where_the_model_has_it(recorded, runs):
    run, (_, record, loop) = runs["slow"], recorded["slow"]
    run.start_at(0)
    k = int(np.argmax(np.abs(record.amplitude[:, 0])))
    made = animation.film(run, np.array([run.time[k] + 1e-4]))
    tip = made.straight[0, -1, 1] + made.bent[0, -1, -1]
    wanted = loop.model.tip_position(record.position[k], record.amplitude[k])
    np.testing.assert_allclose(tip, wanted, atol=1e-9)
    rigid = loop.model.tip_position(record.reference[k], 0.0 * record.amplitude[k])
    np.testing.assert_allclose(made.reference[0, -1, 1], rigid, atol=1e-9)


def test_names_from_a_bag_are_text_and_no_markup(tmp_path):
    sad = "<script>alert(1)</script>$x_$"
    _made_up(tmp_path / "_bag & <b>", 300, arm="", names={"joint_names": [sad]})
    made = command.make([tmp_path / "_bag & <b>"], tmp_path / "x.html")
    text = made.read_text(encoding="utf-8")
    checked(text)
    assert "alert(1)</script>" not in text and "_bag &amp; &lt;b&gt;" in text


def test_a_large_figure_becomes_a_picture_and_a_large_page_is_refused(runs, monkeypatch):
    run = runs["slow"]
    paper = figures._Paper([run], [analysis.motions(run)], "", False)
    monkeypatch.setattr(figures, "MAX_SVG", 1000)
    made = paper.tracking()
    checked(made.image)
    assert made.image.startswith('<img alt="Tracking" src="data:image/png;base64,')
    assert len(made.times) == 2 and all(0.0 < left < right < 1.0 for left, right, *_ in made.times)
    asked = []
    monkeypatch.setattr(page.figures, "draw", lambda *args: asked.append(args[-1]) or [])
    monkeypatch.setattr(page, "MAX_SIZE", 10_000)
    with pytest.raises(FlexarmError) as refused:
        page.write([runs["slow"]])
    assert (refused.value.field, refused.value.limit) == ("page", "at most 10000 bytes")
    assert asked == [False, True]  # pictures are tried first
    with pytest.raises(FlexarmError) as refused:
        page.write([runs["slow"]] * 9)
    assert (refused.value.value, refused.value.limit) == (9, "at most 8")


# Bags of every kind ----------------------------------------------------------------------------


def _made_up(path, count, arm="R", amplitude=None, change=lambda k, m: m, names=None, **options):
    """A bag of `count` states, each as `change` returns it: None for a lost one, a list for several."""
    namespaces = options.get("namespaces", ("",))
    with BagWriter(path, arm) as out:
        for space in namespaces:
            out.add(f"{space}arm_state", "flexarm_msgs/msg/ArmState")
        for k in range(count):
            message = ArmState(
                session=7,
                sequence=k,
                joint_names=["joint1"],
                joint_position=[0.1 * np.sin(0.02 * k)],
                joint_torque=[np.nan],
                gauge_names=["root", "middle"],
                strain=[1e-5 * np.cos(0.1 * k), 0.0],
            )
            stamp = 10**9 + k * PERIOD
            set_stamp(message.header.stamp, stamp)
            if amplitude is not None:
                message.mode_names = ["link1_y_mode1", "link1_y_mode2"]
                message.modal_amplitude = amplitude(1e-9 * k * PERIOD)
            for name, value in (names or {}).items():
                setattr(message, name, value)
            changed = change(k, message)
            for each in changed if isinstance(changed, list) else [changed]:
                for space in namespaces if each is not None else ():
                    out.write(f"{space}arm_state", stamp, bytes(serialize_message(each)))
    return path


def read(path, **options):
    return command.read([path], **options)[0]


def test_an_arm_state_alone_makes_a_report(tmp_path, flexarm):
    path = _made_up(tmp_path / "alone", 400)
    code, out, _ = flexarm("report", path, "--out", tmp_path / "alone.html")
    assert code == 0 and "alone.html" in out
    text = (tmp_path / "alone.html").read_text(encoding="utf-8")
    checked(text)
    assert "controller/state is not in the bag" in text
    run = read(path)
    assert run.amplitude_source == "strain"
    wanted = StrainMap(run.model).amplitudes(np.array([1e-5, 0.0]))
    np.testing.assert_allclose(run.deflections(slice(0, 1))[0], wanted, rtol=1e-12)
    got = analysis.summary(run)
    assert got["peak_error_rad"] is None and got["faults"] is None and got["residual_m"] is None
    assert got["peak_torque_Nm"] == [None]


def test_without_strain_modes_and_arm_there_are_still_angles(tmp_path):
    def bare(k, message):
        message.gauge_names, message.strain, message.joint_torque = [], [], []
        return message

    path = _made_up(tmp_path / "bare", 100, arm="", change=bare)
    text = command.make([path], tmp_path / "bare.html").read_text(encoding="utf-8")
    checked(text)
    assert "give --arm" in text and 'id="animation"' not in text and 'id="tracking"' in text
    # With an arm there is an animation, of a straight one.
    film = animation.data([read(path, arm="R")])
    assert film["most"] == 0.0 and film["factor"] == 1.0


def test_numbers_that_are_none_leave_holes(tmp_path):
    def sick(k, message):
        if 50 <= k < 60:
            message.joint_position, message.strain = [np.nan], [np.nan, np.inf]
        return message

    path = _made_up(tmp_path / "nan", 200, change=sick)
    run = read(path)
    assert np.isnan(run.position(0)).sum() == 10
    # Figures and numbers leave them out.
    assert np.isfinite(run.deflections()).sum() == 2 * 190
    assert analysis.summary(run)["peak_deflection_m"]["link1 y"] > 0.0
    assert animation.data([run])["frames"] > 1


def test_lost_repeated_and_late_samples_are_counted(tmp_path):
    held = []

    def line(k, message):
        if 20 <= k < 30:
            return None
        if k == 40:
            return [message, message]
        if k == 50:
            held.append(message)
            return None
        return [message, held.pop()] if held and k == 52 else message

    run = read(_made_up(tmp_path / "line", 100, change=line))
    assert run.timeline.lost == 10 and run.timeline.repeated == 1
    assert run.time.size == 90 and not run.timeline.jumps
    np.testing.assert_allclose(run.time, np.delete(np.arange(100), np.s_[20:30]) * PERIOD * 1e-9)
    assert run.timeline.joined.sum() == 88


def test_a_session_that_begins_anew_goes_on_after_the_one_before(tmp_path):
    def again(k, message):
        if k >= 60:  # another session, whose clock began at zero
            message.session, message.sequence = 9, k - 60
            set_stamp(message.header.stamp, (k - 60) * PERIOD)
        return message

    run = read(_made_up(tmp_path / "again", 100, change=again))
    assert run.sessions == 2 and run.timeline.lost == 0 and run.time.size == 100
    np.testing.assert_allclose(np.diff(run.time), PERIOD * 1e-9, atol=1e-12)
    assert any("started 2 times" in note for note in run.notes)


@pytest.mark.parametrize("by", [3600.0, -0.7])
def test_a_jump_of_the_clock_is_noted_and_left_out(tmp_path, by):
    def jump(k, message):
        set_stamp(message.header.stamp, 10**10 + k * PERIOD + (k >= 60) * round(by * 1e9))
        return message

    run = read(_made_up(tmp_path / "jump", 100, change=jump))
    assert [at for at, _ in run.timeline.jumps] == [60]
    assert run.timeline.jumps[0][1] == pytest.approx(by, abs=1e-6)
    np.testing.assert_allclose(np.diff(run.time), PERIOD * 1e-9, atol=1e-12)
    assert any("the stamps jump" in note for note in run.notes)


def test_names_in_another_order_are_put_right(tmp_path):
    def turned(k, message):
        message.joint_names = ["joint2", "joint1"] if k % 2 else ["joint1", "joint2"]
        message.joint_position = [2.0, 1.0] if k % 2 else [1.0, 2.0]
        message.joint_torque, message.gauge_names, message.strain = [], [], []
        return message

    run = read(_made_up(tmp_path / "turned", 50, arm="two_link", change=turned))
    assert run.joint_names == ("joint1", "joint2")
    np.testing.assert_array_equal(run.positions(), np.tile([1.0, 2.0], (50, 1)))


def test_another_arms_joints_are_refused_with_what_to_do(tmp_path):
    path = _made_up(tmp_path / "r", 20)
    with pytest.raises(FlexarmError, match=r"joint1.*two_link.*--arm"):
        command.read([path], "two_link")

    def foreign(k, message):
        message.joint_names = ["elbow"] if k == 5 else ["joint1"]
        return message

    run = read(_made_up(tmp_path / "mixed", 20, change=foreign))
    assert run.time.size == 19 and any("other joint_names" in note for note in run.notes)


def test_namespaces_are_runs_of_their_own(tmp_path):
    path = _made_up(tmp_path / "two", 30, namespaces=("left/", "right/deep/"))
    both = command.read([path])
    assert [r.label for r in both] == ["two /left", "two /right/deep"]
    (one,) = command.read([path], namespace="/left/")
    assert one.contents.namespace == "/left"
    with pytest.raises(
        FlexarmError, match=r"no topic of an arm in namespace middle.*/left/arm_state"
    ):
        command.read([path], namespace="middle")


@pytest.mark.parametrize(
    ("name", "content", "reason"),
    [
        ("nowhere", None, "no such file"),
        ("folder/notes.txt", b"hello", "a folder, a .mcap or a .db3"),
        ("folder", None, "neither metadata.yaml nor a .mcap"),
        ("junk.mcap", 100 * b"hello", "is not an MCAP file"),
        ("broken", b"- a\n- b: [\n", "(?s)can't be read as a bag.*ros2 bag reindex"),
    ],
)
def test_what_is_no_bag_says_what_to_do(tmp_path, name, content, reason):
    (tmp_path / "folder").mkdir()
    (tmp_path / "broken").mkdir()
    path = tmp_path / name
    if content is not None:
        (path / "metadata.yaml" if path.is_dir() else path).write_bytes(content)
    with pytest.raises(FlexarmError, match=reason) as error:
        command.read([path])
    assert str(path) == error.value.field


def test_an_empty_bag_and_a_page_that_is_none_say_what_to_do(tmp_path):
    empty = _made_up(tmp_path / "empty", 0)
    with pytest.raises(FlexarmError, match=r"empty.*flexarm record"):
        command.read([empty])
    with pytest.raises(FlexarmError, match=r"ends in .html"):
        command.make([empty], tmp_path / "x.pdf")


def test_a_bag_without_states_is_refused(tmp_path):
    with BagWriter(tmp_path / "torques") as out:
        out.write("joint_torque", 1, bytes(serialize_message(JointTorque(joint_names=["joint1"]))))
    with pytest.raises(FlexarmError, match=r"neither arm_state nor arm_state_estimate"):
        command.read([tmp_path / "torques"])


@pytest.mark.parametrize("with_metadata", [True, False])
def test_a_bag_that_breaks_off_is_read_as_far_as_it_goes(tmp_path, with_metadata):
    path = _made_up(tmp_path / "cut", 400)
    file = next(path.glob("*.mcap"))
    data = file.read_bytes()
    file.write_bytes(data[: len(data) // 2])
    if not with_metadata:
        (path / "metadata.yaml").unlink()
    run = read(path)
    whole = len(list(mcap.messages(file)))
    assert 100 < whole < 400 and run.time.size == whole
    assert any("as far as it goes" in note for note in run.notes)
    assert (run.arm is not None) == with_metadata


def test_a_file_in_a_folder_bag_and_the_folder_above_are_found(tmp_path):
    path = _made_up(tmp_path / "run" / "bag", 20)
    for given in (path, path.parent, next(path.glob("*.mcap")), path / "metadata.yaml"):
        assert read(given).time.size == 20
    assert read(path).label == "run"
    with pytest.raises(FlexarmError, match=r"there are .*bag"):
        command.read([tmp_path])


def test_messages_that_are_none_are_left_out_and_counted(tmp_path):
    path = tmp_path / "junk"
    with BagWriter(path, "R") as out:
        for k in range(20):
            message = ArmState(sequence=k, joint_names=["joint1"], joint_position=[0.1])
            message.header.stamp.sec = k
            raw = bytes(serialize_message(message))
            out.write("arm_state", k, raw[:30] if k in (3, 4) else raw)
    run = read(path)
    assert run.time.size == 18 and any("2 messages can't be read" in n for n in run.notes)


def test_samples_without_an_answer_change_no_number_but_their_own(tmp_path, recorded, runs):
    path, _, _ = recorded["slow"]
    random = np.random.default_rng(5)
    answered = dict(enumerate(random.random(5000) > 0.2))  # 20 % of the states get no answer
    with BagWriter(tmp_path / "holes", "R") as out:
        for topic, _, raw in mcap.messages(next(path.glob("*.mcap"))):
            stamp = raw_stamp_ns(raw)
            if topic == "/arm_state" or answered[stamp // 2_000_000 % 5000]:
                out.write(topic[1:], stamp, raw)
    run, whole = read(tmp_path / "holes"), analysis.summary(runs["slow"])
    got = analysis.summary(run)
    assert got["unanswered"] > 0.1 * got["samples"] and whole["unanswered"] == 0
    assert [got[k] for k in ("motions", "faults", "residual_windows")] == [1, 0, 1]
    assert got["residual_m"] == pytest.approx(whole["residual_m"], rel=0.02)
    assert got["peak_error_rad"][0] == pytest.approx(whole["peak_error_rad"][0], rel=0.02)
    film = animation.film(run, run.time[::50])
    assert np.isfinite(film.bent).all()


def test_holes_are_bridged_when_they_are_short():
    values = np.array([np.nan, 0.0, np.nan, np.nan, 3.0, np.nan, np.nan, np.nan, 7.0, np.nan])
    got = run_module.bridged(values, 2)
    np.testing.assert_array_equal(got[:5], [np.nan, 0.0, 1.0, 2.0, 3.0])
    assert np.isnan(got[[5, 6, 7, 9]]).all() and got[8] == 7.0


def test_a_fault_is_shown_with_its_reason(tmp_path, recorded):
    path, _, _ = recorded["slow"]
    faulty = tmp_path / "faulty"
    with BagWriter(faulty, "R") as out:
        for topic, _, raw in mcap.messages(next(path.glob("*.mcap"))):
            name = topic.lstrip("/")
            if name == "controller/state":
                message = deserialize_message(raw, CompositeState)
                if message.sequence >= 500:
                    message.supervisor_state = CompositeState.FAULT
                    message.rejected_reason = "tracking error <of joint1>"
                message.compute_time = 1e-4 * (1 + message.sequence % 2)
                raw = bytes(serialize_message(message))
            out.write(name, raw_stamp_ns(raw), raw)
    run = read(faulty)
    got = analysis.summary(run)
    assert got["faults"] == 1 and "tracking error <of joint1>" in got["first_fault"]
    assert got["compute_time_s"] == pytest.approx([1.5e-4, 2e-4, 2e-4], rel=0.34)
    assert "One fault, the first at" in page.short([run], [got])[0]
    events = [(state, why) for _, _, state, why in page._events([run])]
    assert ("FAULT", "tracking error <of joint1>") in events
    timing = figures._Paper([run], [analysis.motions(run)], "", False).timing()
    assert "<svg" in timing.image and len(timing.times) == 1


# The parts -------------------------------------------------------------------------------------


@pytest.mark.parametrize("padding", range(5))
@pytest.mark.parametrize("rates", [[], [0.5, -0.5]])
def test_a_recording_from_before_states_had_a_trust_is_read(rates, padding):
    names = ["a", "b"] if rates else []
    message = ArmState(sequence=7, joint_names=["j"], joint_position=[0.1], mode_names=names)
    message.modal_amplitude = message.modal_rate = rates
    raw = bytes(serialize_message(message))
    kind = "flexarm_msgs/msg/ArmState"
    end = layout_of(raw, kind).numbers["controller_id"][0]
    old = raw[:end] + bytes(padding)
    layout = layout_of(old, kind)
    assert "trust" not in layout.numbers
    block = np.frombuffer(old, np.uint8)[None]
    np.testing.assert_array_equal(layout.column(block, "modal_rate")[0], rates)
    with pytest.raises(MessageError):
        layout_of(old[: end - 9], kind)


@pytest.mark.parametrize("padding", range(4))
def test_a_recording_from_before_states_named_parameters_is_read(padding):
    raw = bytes(serialize_message(CompositeState(sequence=7, compute_time=0.25)))
    kind = "flexarm_msgs/msg/CompositeState"
    end = layout_of(raw, kind).texts["parameters_set"][0] - 4
    old = raw[:end] + bytes(padding)
    layout = layout_of(old, kind)
    assert "parameters_set" not in layout.texts
    block = np.frombuffer(old, np.uint8)[None]
    assert layout.column(block, "compute_time")[0] == 0.25


def test_columns_are_what_the_middleware_reads():
    random = np.random.default_rng(1)
    messages = []
    for k in range(300):
        n, m = random.integers(1, 4), random.integers(0, 3)
        message = CompositeState(sequence=k, session=3, supervisor_state=int(k % 6))
        message.header.stamp.sec, message.header.frame_id = k, "base"[: k % 5]
        message.joint_names = [f"j{i}" * int(i + 1) for i in range(n)]
        message.torque = random.normal(size=n).tolist()
        message.mode_names = [f"m{i}" for i in range(m)]
        message.quasi_steady_amplitude = random.normal(size=m).tolist()
        message.saturated = bool(k % 3)
        message.rejected_reason = "why " * (k % 4)
        message.compute_time = float(random.normal())
        messages.append(message)
    raw = [bytes(serialize_message(m)) for m in messages]
    decoder = Decoder("flexarm_msgs/msg/CompositeState")
    seen = []
    for rows, layout, block in decoder.groups(raw):
        seen += rows.tolist()
        texts, which = layout.text(block, "rejected_reason")
        for i, row in enumerate(rows):
            wanted = messages[row]
            np.testing.assert_array_equal(layout.column(block, "torque")[i], wanted.torque)
            got = layout.column(block, "quasi_steady_amplitude")[i]
            np.testing.assert_array_equal(got, wanted.quasi_steady_amplitude)
            assert layout.names["joint_names"] == tuple(wanted.joint_names)
            assert layout.column(block, "compute_time")[i] == wanted.compute_time
            assert layout.column(block, "saturated")[i] == wanted.saturated
            assert layout.column(block, "header.stamp.sec")[i] == wanted.header.stamp.sec
            assert texts[which[i]] == wanted.rejected_reason
    assert sorted(seen) == list(range(300)) and not decoder.broken


@pytest.mark.parametrize("size", [10, 1000, 12345])
def test_thinning_keeps_what_is_least_and_greatest_everywhere(size):
    random = np.random.default_rng(size)
    time, values = np.arange(size) * 1e-3, random.normal(size=size)
    values[size // 3] = 50.0
    values[size // 2 : size // 2 + size // 5] = np.nan
    t, v = timeline.thinned(time, values, 100)
    assert t.size <= max(300, size) and (np.diff(t) >= 0.0).all()
    assert np.nanmax(v) == 50.0 and np.nanmin(v) == np.nanmin(values)
    known = {(a, b) for a, b in zip(time, values, strict=True) if np.isfinite(b)}
    assert {(a, b) for a, b in zip(t, v, strict=True) if np.isfinite(b)} <= known
    hole = (time[size // 2], time[size // 2 + size // 5 - 1])
    assert np.isnan(v[(t >= hole[0] - 0.2) & (t <= hole[1])]).any()


def test_matching_takes_the_last_word():
    keys = timeline.keys(np.arange(5), np.full(5, 2), np.arange(5))
    given = keys[[3, 1, 3, 4]]
    np.testing.assert_array_equal(timeline.match(keys, given), [-1, 1, -1, 2, 3])
    np.testing.assert_array_equal(timeline.match(keys, given[:0]), [-1] * 5)
    assert len(set(timeline.keys(np.arange(5), np.arange(5)[::-1], np.zeros(5)).tolist())) == 5


def test_two_sources_at_once_are_put_one_after_the_other():
    session = np.tile([1, 2], 200)
    sequence, stamp = np.repeat(np.arange(200), 2), np.repeat(np.arange(200), 2) * PERIOD
    got = timeline.arrange(stamp, session, sequence)
    assert got.epoch.max() == 1 and got.lost == 0 and got.rows.size == 400


def test_labels_tell_bags_apart():
    none = ["", ""]
    assert command.labels(["/a/x/bag", "/a/y/bag"], none) == ["x", "y"]
    assert command.labels(["/a/x", "/b/x"], none) == ["a/x", "b/x"]
    assert command.labels(["/a/x", "/a/x"], none) == ["x (1)", "x (2)"]
    assert command.labels(["/a/x.mcap"], [""]) == ["x"]


def test_digits_are_for_reading():
    shown = [page.digits(v) for v in (0.0, 3.0, 1234.5, 0.00123456, 1e-7, None, np.nan)]
    assert shown == ["0", "3.00", "1234", "0.00123", "1.00e-07", "–", "–"]


# Recording -------------------------------------------------------------------------------------


class _Ending:
    """In the place of a `Listener`: so many states, then Ctrl-C, then nothing more."""

    namespace = "left"

    def __init__(self, count):
        self._count, self.sent = count, 0

    def poll(self):
        self.sent += 1
        if self.sent == self._count + 1:
            raise KeyboardInterrupt
        if self.sent > self._count:
            return {}
        message = ArmState(sequence=self.sent, joint_names=["joint1"], joint_position=[0.5])
        message.header.stamp.sec = self.sent
        return {"arm_state": [bytes(serialize_message(message))], "joint_torque": []}

    def ask_arm(self):
        return lambda: "R" if self.sent > 3 else ""


def test_a_recording_ends_with_ctrl_c_and_is_a_bag_of_the_nodes_arm(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(recording, "POLL_PERIOD", 0.0)
    taken = recording._take(_Ending(10), tmp_path / "bag", None, None)
    assert taken.counts["arm_state"] == 10 and taken.arm == "R"
    run = read(tmp_path / "bag")
    assert run.time.size == 10 and run.arm.name == "R" and run.contents.namespace == "/left"
    printed = capsys.readouterr().out
    assert "10 arm_state" in printed and "no messages on arm_state_estimate" in printed
    assert f"flexarm report {tmp_path / 'bag'}\n" in printed


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"out": "."}, "exists already"),
        ({"duration": -1.0}, "--duration"),
        ({"arm": "none"}, "none"),
    ],
)
def test_what_can_not_be_recorded_is_refused(tmp_path, monkeypatch, changes, reason):
    monkeypatch.chdir(tmp_path)
    options = {"out": "x", "duration": None, "arm": None, "namespace": "", **changes}
    with pytest.raises(FlexarmError, match=reason):
        recording.record(SimpleNamespace(**options))
    assert not list(tmp_path.iterdir())


def test_simulate_takes_a_bag_only_with_a_motion(flexarm):
    code, _, err = flexarm("simulate", "R", "--bag", "x")
    assert code == 1 and "only with --trajectory" in err


def test_an_arm_that_was_read_has_no_name_in_its_bag(tmp_path):
    of = scenario_of(
        arm=replace(arm_file.load("R")),
        trajectory="quintic:to=0.01,duration=0.1",
        rate=200.0,
        window=0.0,
    )
    scenario.run_loop(of, partial(LoopBag, tmp_path / "b"))
    assert read(tmp_path / "b").arm is None
