# SPDX-License-Identifier: Apache-2.0
"""The installed executables as processes over DDS: signals, refusals, life cycle, parameters, services."""

import copy
import os
import re
import signal

import numpy as np
import pytest
from harness import PATIENT, SHM, Arm, Bench, Drive, Source, abandoned, segments, trajectory
from in_process import InProcess
from sensor_msgs.msg import JointState

from flexarm_control.composite.design import FAST, SLOW, design_law
from flexarm_control.nodes.controller import ControllerNode
from flexarm_control.nodes.observer import ObserverNode
from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.arm.strain_map import gauge_rows
from flexarm_dynamics.models import model
from flexarm_msgs.msg import ArmState, CompositeState, JointTorque
from flexarm_ros import node
from flexarm_ros.messages import stamp_ns
from flexarm_sim.nodes.simulator import SimulatorNode
from flexarm_studies.loop import parameter_files
from flexarm_tools.running.processes import arguments, own_domain

NODES = ("simulator", "observer", "controller")
LOCKSTEP = {"lockstep": True, "resend_period": 0.02}


def printed(text):
    """Lines of a log."""
    return [line for line in text.splitlines() if line.strip()]


# Signals ---------------------------------------------------------------------------------------


def start_unconfigured(bench):
    for name in NODES:
        bench.start(name, {"arm": "R", "autostart": False})
    for name in NODES:
        assert bench.lifecycle(name) == "unconfigured"


def start_active_alone(bench):
    for name in NODES:
        bench.start(name, {"arm": "R", "fast.type": "none"}, remaps=[f"__ns:=/{name}_alone"])
    for name in NODES:
        bench.wait_for(
            f"{name} to be active",
            lambda: bench.lifecycle(f"{name}_alone/{name}") == "active",  # noqa: B023
        )


def start_in_mid_run(bench):
    # A loaded machine may hold the line up for longer than the timeout.
    bench.start_loop({**LOCKSTEP, "pause_at": -1.0}, controller={"state_timeout": 60.0}, arm="R")
    Arm(bench).wait_until(1_100_000_000)


@pytest.mark.parametrize(
    ("start", "number"),
    (
        (start_unconfigured, signal.SIGINT),
        (start_active_alone, signal.SIGTERM),
        (start_in_mid_run, signal.SIGINT),
        (start_in_mid_run, signal.SIGTERM),
    ),
)
def test_a_signal_ends_every_node_with_code_0_and_leaves_nothing_behind(tmp_path, start, number):
    before = set(SHM.iterdir())
    with Bench(tmp_path) as bench:
        start(bench)
        processes = bench.processes.running
        held = {name: segments(process.pid) for name, process in processes.items()}
        assert all(held.values()), f"no shared memory: what is this test about? {held}"
        codes = bench.processes.stop(number)
        logs = {name: bench.log(name) for name in NODES}
    assert codes == dict.fromkeys(NODES, 0), logs
    for name, log in logs.items():
        assert "Traceback" not in log, log
        assert "error" not in log.lower(), log
        assert not abandoned(held[name]) - before, name


def test_a_controller_that_ends_disables_the_torque(bench):
    patient = {"fast.type": "none", "state_timeout": 60.0}
    bench.start_loop({**LOCKSTEP, "pause_at": 0.02}, arm="R", controller=patient)
    arm = Arm(bench, pauses_at=20)
    arm.wait_standing()
    assert arm.torques.newest.mode == JointTorque.ENABLED
    assert bench.stop("controller", signal.SIGTERM) == 0
    bench.wait_for("DISABLED", lambda: arm.torques.newest.mode == JointTorque.DISABLED)
    assert list(arm.torques.newest.torque) == [0.0]


# Start-up refusals -----------------------------------------------------------------------------

ONE_LINK = arm_file.find("one_link").read_text()


def arm_file_with(old, new):
    """The shipped arm with one place changed."""
    assert ONE_LINK.count(old) >= 1, old
    return ONE_LINK.replace(old, new, 1)


#: Node, parameters (arm: text of a file, where it has several lines), and what the one error names.
REFUSALS = {
    "no arm": ("controller", {}, "arm: no arm given"),
    "no arm, simulator": ("simulator", {}, "arm: no arm given"),
    "unknown arm": ("observer", {"arm": "X7"}, "'X7' is neither a file nor a shipped arm"),
    "arm is a number": ("controller", {"arm": 3}, "arm: 3 is not a string"),
    "missing field": (
        "simulator",
        {"arm": arm_file_with("    length: 1.2192               # [m]\n", "")},
        r"links\[0\]\.length: missing",
    ),
    "negative field": (
        "observer",
        {"arm": arm_file_with("mass_per_length: 0.2453384470152408", "mass_per_length: -0.2")},
        r"links\[0\]\.mass_per_length: -0.2.* is too small",
    ),
    "misspelt field": (
        "controller",
        {"arm": arm_file_with("hub_inertia:", "hub_inertai:")},
        r"joints\[0\]\.hub_inertai: .*hub_inertia",
    ),
    "integers for floats": ("controller", {"slow.kp": [6]}, r"slow\.kp: .*write \[6\.0\]"),
    "below range": ("controller", {"fast.alpha": -1.0}, r"fast\.alpha: -1\.0 .*is below"),
    "above range": ("simulator", {"rate": 1e9}, r"rate: 1000000000\.0 .*is above"),
    "unknown law": (
        "controller",
        {"slow.type": "nonsense"},
        r"slow\.type: 'nonsense' is not one of",
    ),
    "unknown observer": (
        "observer",
        {"observer.type": "kalmann"},
        r"observer\.type: 'kalmann' is not one of",
    ),
    "wrong length": ("controller", {"fast.q": [1.0, 2.0]}, r"fast\.q: 2 values where 4 \(z\)"),
    "not finite": ("controller", {"slow.kv": "[.nan]"}, r"slow\.kv"),
    "text for bool": ("simulator", {"lockstep": "yes please"}, "lockstep: 'yes please' is not"),
    "no design": ("controller", {"fast.alpha": 0.0, "fast.q": [0.0]}, "fast: "),
}


#: One of each kind as a process of its own; all of them in this process.
AS_PROCESS = ("missing field", "no design")
CLASSES = {"simulator": SimulatorNode, "observer": ObserverNode, "controller": ControllerNode}


def refused(case, folder):
    """Node and parameters of a refusal, the text of an arm written to a file."""
    name, parameters, _ = REFUSALS[case]
    given = {} if case.startswith("no arm") else {"arm": "R", **parameters}
    if "\n" in str(given.get("arm", "")):
        path = folder / "arm.yaml"
        path.write_text(given["arm"])
        given["arm"] = str(path)
    return name, given


def names_its_error_once(case, log):
    assert len(printed(log)) == 1, log
    assert re.search(REFUSALS[case][2], log), log


@pytest.mark.parametrize("case", REFUSALS)
def test_what_a_node_cannot_start_with_ends_it_with_one_error_that_names_it(
    case, tmp_path, monkeypatch, capfd
):
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    name, given = refused(case, tmp_path)
    with own_domain() as domain:
        monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))
        assert node.run(CLASSES[name], arguments(given)) == 1
    # While a node of an earlier test with this name is not yet collected, rcl prints a line of its own.
    log = "".join(capfd.readouterr())
    names_its_error_once(case, "\n".join(x for x in printed(log) if "rcl.logging_rosout" not in x))


@pytest.mark.parametrize("case", AS_PROCESS)
def test_a_process_that_cannot_start_ends_with_code_1(bench, case, tmp_path):
    name, given = refused(case, tmp_path)
    process = bench.start(name, given)
    assert process.wait(bench.PATIENCE) == 1
    names_its_error_once(case, bench.log(name))


def test_the_other_nodes_go_on_when_one_refuses_to_start(bench):
    bench.start("simulator", {"arm": "R", **LOCKSTEP})
    bench.start("observer", {"arm": "R"})
    arm = Arm(bench)
    bench.wait_for("estimates", lambda: arm.estimated.newest)
    bench.start("controller", {"arm": "R", "fast.alpha": -1.0})
    assert bench.end_of("controller") == 1
    seen = len(arm.estimated.messages)
    bench.wait_for("more estimates", lambda: len(arm.estimated.messages) > seen + 20)
    assert [bench.processes.running[n].poll() for n in ("simulator", "observer")] == [None, None]


# Life cycle ------------------------------------------------------------------------------------


def test_without_autostart_the_lifecycle_services_start_stop_and_restart_every_node():
    with InProcess() as bench:
        check_life_cycle(bench)


def check_life_cycle(bench):
    for name in NODES:
        own = {**LOCKSTEP, "pause_at": -1.0} if name == "simulator" else {}
        bench.start(name, {"arm": "R", "fast.type": "none", "autostart": False, **own})
    arm = Arm(bench)
    for name in NODES:
        assert bench.lifecycle(name) == "unconfigured"
        assert bench.change(name, "configure")
        assert bench.lifecycle(name) == "inactive"
    for name in NODES:
        assert bench.change(name, "activate")
        assert bench.lifecycle(name) == "active"
    arm.wait_until(1_050_000_000)
    session = arm.state.session

    # The controller alone: DISABLED, the loop stands, and goes on when it is active again.
    assert bench.change("controller", "deactivate")
    bench.wait_for("DISABLED", lambda: arm.torques.newest.mode == JointTorque.DISABLED)
    assert bench.lifecycle("controller") == "inactive"
    stamp, answered = arm.now, len(arm.torques.messages)
    seen = len(arm.estimated.messages)
    bench.wait_for("unanswered states", lambda: len(arm.estimated.messages) > seen + 3)
    assert len(arm.torques.messages) == answered
    assert bench.change("controller", "activate")
    arm.wait_until(stamp + 50_000_000)
    assert arm.ready() and arm.state.session == session

    # Each node through clean-up and back.
    for name in NODES:
        assert bench.change(name, "deactivate")
        assert bench.change(name, "cleanup")
        assert bench.lifecycle(name) == "unconfigured"
        assert bench.change(name, "configure")
        assert bench.change(name, "activate")
    bench.wait_for(
        "the loop in a new session",
        lambda: arm.ready() and arm.state.session != session and arm.now > 1_050_000_000,
    )
    for name in NODES:
        assert "Traceback" not in bench.log(name)


def test_a_configuration_that_fails_leaves_the_node_unconfigured_and_alive(bench):
    bench.start("observer", {"arm": "nope", "autostart": False})
    assert not bench.change("observer", "configure")
    assert bench.lifecycle("observer") == "unconfigured"
    assert "'nope' is neither a file nor a shipped arm" in bench.log("observer")


# Live parameters -------------------------------------------------------------------------------

PAPER = parameter_files.load("paper_composite")["controller"]
MODEL = model.build(arm_file.load("R"))


@pytest.fixture(scope="module")
def loop():
    """The three nodes in lockstep in this process, the paper's composite control, paused at 10 ms."""
    file = parameter_files.find("paper_composite")
    with InProcess() as bench:
        bench.start("simulator", {**LOCKSTEP, "pause_at": 0.01}, file=file)
        bench.start("observer", file=file)
        bench.start("controller", file=file)
        arm = Arm(bench, pauses_at=10)
        arm.wait_standing()
        yield arm


@pytest.fixture
def running(loop):
    """The loop in a new session, in the middle of a long motion, with the paper's parameters."""
    bench = loop.bench
    wanted = {k: v for k, v in PAPER.items() if k.partition(".")[0] in ("slow", "fast")}
    answer = bench.set_atomically(
        "controller", **{k.replace(".", "__"): v for k, v in wanted.items()}
    )
    assert answer.successful, answer.reason
    loop.reset()
    loop.pause(False)
    loop.offer(trajectory(["joint1"], (60.0, [6.0], [0.0], [0.0])))
    loop.wait_until(1_300_000_000)
    assert loop.state.supervisor_state == CompositeState.TRACKING
    return loop


def gain(**changes):
    """K_f for the paper's parameters with some changed."""
    keys = ("q", "r", "alpha", "configuration")
    values = {k: PAPER[f"fast.{k}"] for k in keys} | changes
    return design_law(FAST, "lqr", MODEL, values).K_f


def slow_gain():
    """What multiplies the acceleration in (17) [kg m^2]."""
    law = design_law(SLOW, "linear_model_following", MODEL, {})
    return law.B_inverse(MODEL.terms(np.zeros(1), np.zeros(1)))[0, 0]


def obeys(message, kp, K_f, kv=5.0):
    """Whether a controller/state is that of (17) and (15) with these gains."""
    acceleration = (
        message.reference_acceleration[0]
        + kv * message.velocity_error[0]
        + kp * message.position_error[0]
    )
    slow = slow_gain() * acceleration
    fast = K_f @ np.array(message.fast_deviation)
    return (
        np.isclose(message.slow_torque[0], slow, rtol=1e-9, atol=1e-12)
        and np.allclose(message.fast_torque, fast, rtol=1e-9, atol=1e-12)
        and np.isclose(message.torque[0], slow + fast[0], rtol=1e-9, atol=1e-12)
    )


def astray(arm, *laws):
    """Samples of the session that none of the laws (kp, K_f) gives."""
    return [
        (m.sequence, list(m.slow_torque), list(m.fast_torque), list(m.torque))
        for m in arm.samples().values()
        if m.supervisor_state != CompositeState.INACTIVE
        and not any(obeys(m, kp, K_f) for kp, K_f in laws)
    ]


#: In which the difference of two laws fades to nothing at their exchange, in samples.
FADED = 400


def follows(arm, old, new):
    """Whether the samples are those of `old`, then a fading mixture, then `new`, in this order and never back."""
    enabled = [m for m in arm.samples().values() if m.supervisor_state != CompositeState.INACTIVE]
    kinds = [(obeys(m, *old), obeys(m, *new)) for m in enabled]
    begin = next(i for i, (is_old, _) in enumerate(kinds) if not is_old)
    end = max(i for i, (_, is_new) in enumerate(kinds) if not is_new) + 1
    return all(is_old for is_old, _ in kinds[:begin]) and 0 <= end - begin <= FADED


def goes_on(arm, seconds=0.05):
    """Let the loop run on."""
    arm.wait_until(arm.now + round(seconds * 1e9))


def wait_obeys(arm, kp, K_f):
    """Until the newest sample is that of these gains."""
    arm.bench.wait_for("the new law", lambda: obeys(arm.state, kp, K_f))


REFUSED_SETS = {
    "integers": ({"slow__kp": [6]}, r"write \[6\.0\]"),
    "text": ({"slow__kp": "six"}, "'six' is not a list of numbers"),
    "below": ({"slow__kp": [-1.0]}, "below its lower limit"),
    "above": ({"fast__alpha": 1e4}, "fast.alpha out of range"),
    "length": ({"slow__kp": [1.0, 2.0]}, r"2 values where 1 \(joints\)"),
    "length of z": ({"fast__q": [1.0, 2.0, 3.0]}, r"3 values where 4 \(z\)"),
    "empty": ({"fast__q": []}, "fast.q"),
    "nan": ({"slow__kp": [float("nan")]}, "not finite"),
    "inf": ({"fast__alpha": float("inf")}, "fast.alpha out of range"),
    "integer": ({"fast__alpha": 5}, r"write 5\.0"),
    "bool": ({"fast__alpha": True}, "not a number"),
    "choice": ({"slow__gain": "h12"}, r"'h12' is not one of the choices \(m11, h11\)"),
    "no such law": ({"slow__type": "nonsense"}, "'nonsense' is not one of"),
    "number for a name": ({"fast__type": 3}, "not a string"),
    "unknown": ({"slow__kq": [1.0]}, "undeclared parameter"),
    "read-only": ({"arm": "P3"}, "read-only"),
}


def test_a_refused_set_says_why_and_leaves_the_value_and_the_loop_as_they_were(running):
    bench, law = running.bench, gain()
    for case, (values, reason) in REFUSED_SETS.items():
        name = next(iter(values)).replace("__", ".")
        before = bench.get("controller", name)
        (result,) = bench.set("controller", **values)
        assert not result.successful, case
        assert re.search(reason, result.reason), (case, result.reason)
        assert bench.get("controller", name) == before, case
    goes_on(running)
    assert not astray(running, (6.25, law))


def test_an_atomic_set_with_one_bad_value_changes_nothing(running):
    bench = running.bench
    result = bench.set_atomically("controller", slow__kp=[9.0], fast__alpha=-1.0)
    assert not result.successful and "fast.alpha" in result.reason
    assert bench.get("controller", "slow.kp") == [6.25]
    goes_on(running)
    assert obeys(running.state, 6.25, gain())


def test_a_new_slow_gain_swaps_the_slow_law_whole_and_leaves_the_fast_one(running):
    law = gain()
    assert running.bench.set("controller", slow__kp=[9.0])[0].successful
    wait_obeys(running, 9.0, law)
    goes_on(running)
    assert follows(running, (6.25, law), (9.0, law))


def test_a_new_alpha_solves_the_riccati_equation_again_and_leaves_the_slow_law(running):
    old, new = gain(), gain(alpha=8.0)
    assert np.abs(new - old).max() > 0.1 * np.abs(old).max()
    assert running.bench.set("controller", fast__alpha=8.0)[0].successful
    wait_obeys(running, 6.25, new)
    goes_on(running)
    assert follows(running, (6.25, old), (6.25, new))
    assert obeys(running.state, 6.25, new)


def test_the_last_of_many_sets_is_the_law_in_the_end(running):
    for alpha in (6.0, 7.0, 9.0, 4.0):
        assert running.bench.set("controller", fast__alpha=alpha)[0].successful
    wait_obeys(running, 6.25, gain(alpha=4.0))
    goes_on(running)
    assert obeys(running.state, 6.25, gain(alpha=4.0))


def last_set(bench):
    """What the controller's diagnostics say of the parameters that were set last."""
    states = bench.diagnostics("controller")
    return (
        next((v.value for v in states[-1].values if v.key == "last parameters set"), "")
        if states
        else ""
    )


def test_a_law_that_another_process_designs_is_taken_and_a_bad_one_refused(bench):
    file = parameter_files.find("paper_composite")
    bench.start("simulator", {**LOCKSTEP, "pause_at": -1.0}, file=file)
    bench.start("observer", file=file)
    bench.start("controller", {**PATIENT, "design_process": True}, file=file)
    arm = Arm(bench)
    arm.wait_ready()
    assert bench.set("controller", fast__alpha=8.0)[0].successful
    bench.wait_for("the new law", lambda: obeys(arm.state, 6.25, gain(alpha=8.0)))
    says = r"INFO.*fast\.alpha 8\.0 \(was \S+\): active"
    bench.wait_for("the log", lambda: re.search(says, bench.log("controller")))
    assert bench.set_atomically("controller", fast__alpha=0.0, fast__q=[0.0]).successful
    bench.wait_for("the refusal", lambda: "design refused" in bench.log("controller"))
    bench.wait_for("the old value", lambda: bench.get("controller", "fast.alpha") == 8.0)
    bench.wait_for("a diagnosis", lambda: ": refused: fast" in last_set(bench))
    assert "fast.alpha 0.0 (was 8.0)" in last_set(bench)
    goes_on(arm)
    assert obeys(arm.state, 6.25, gain(alpha=8.0))
    assert bench.stop("controller", signal.SIGTERM) == 0


def test_fast_type_none_takes_the_fast_control_out_and_lqr_puts_it_back(running):
    bench, nothing = running.bench, np.zeros((1, 4))
    assert bench.set("controller", fast__type="none")[0].successful
    wait_obeys(running, 6.25, nothing)
    goes_on(running)
    assert list(running.state.fast_torque) == [0.0]
    assert np.abs(running.state.fast_deviation).max() > 0.0
    assert bench.set("controller", fast__type="lqr")[0].successful
    wait_obeys(running, 6.25, gain())


def test_a_design_that_fails_goes_back_to_the_old_parameters_and_says_so(running):
    values = {"fast__alpha": 0.0, "fast__q": [0.0]}
    bench, law = running.bench, gain()
    logged = bench.log("controller").count("design refused")
    assert bench.set_atomically("controller", **values).successful
    names = [name.replace("__", ".") for name in values]
    bench.wait_for(
        "the old parameters",
        lambda: all(bench.get("controller", name) == PAPER[name] for name in names),
    )
    new = [li for li in printed(bench.log("controller")) if "design refused" in li][logged:]
    assert len(new) == 1 and "[ERROR]" in new[0] and "the old law goes on" in new[0], new
    goes_on(running)
    assert not astray(running, (6.25, law))
    # And the next good one is taken.
    assert bench.set("controller", slow__kp=[7.0])[0].successful
    wait_obeys(running, 7.0, law)


def test_a_lower_torque_limit_holds_from_the_next_sample_on(running):
    bench = running.bench
    largest = max(abs(m.torque[0]) for m in running.samples().values())
    limit = largest / 50.0
    try:
        assert bench.set("controller", torque_limit=[limit])[0].successful
        bench.wait_for("saturation", lambda: running.state.saturated)
        start = running.now
        goes_on(running)
        later = [m for stamp, m in running.samples().items() if stamp >= start]
        assert max(abs(m.torque[0]) for m in later) <= limit
    finally:
        assert bench.set("controller", torque_limit=[0.0])[0].successful


def test_a_new_observer_bandwidth_goes_on_from_the_old_estimate(running):
    bench, torques = running.bench, running.torques.messages
    before = len(torques)
    assert bench.set("observer", observer__bandwidth=800.0)[0].successful
    # The set is applied between two samples: the answers to the next ones show it.
    bench.wait_for("hundred torques", lambda: len(torques) > before + 100)
    assert {m.mode for m in torques[before:]} == {JointTorque.ENABLED}
    (result,) = bench.set("observer", observer__bandwidth=0.5)
    assert not result.successful and "observer.bandwidth out of range" in result.reason
    assert bench.set("observer", observer__bandwidth=1000.0)[0].successful


# A user's own law --------------------------------------------------------------------------------

BROKEN_LAW = """
from flexarm_control.slow.base import SlowLaw

class Broken(SlowLaw):
    def __init__(self, model, parameters):
        raise ValueError("my law has a mistake")

    def torque(self, q, qd, reference, terms):
        return q
"""


@pytest.fixture
def broken_law(tmp_path, monkeypatch):
    """A user's package with a slow law whose design fails, on the path of the nodes."""
    (tmp_path / "my_law.py").write_text(BROKEN_LAW)
    info = tmp_path / "my_law-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: my_law\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[flexarm.slow_laws]\nbroken = my_law:Broken\n")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path), os.environ["PYTHONPATH"]]))


def test_a_users_law_that_fails_in_its_design_is_refused_with_its_own_words(broken_law, bench):
    common = {"arm": "R", "fast.type": "none"}
    bench.start("controller", {**common, "slow.type": "broken"}, key="refused")
    bench.start("controller", {**common, "slow.kp": [4.0]})
    assert bench.end_of("refused") == 1
    assert "not configured" in bench.log("refused")
    assert "ValueError: my law has a mistake" in bench.log("refused")
    assert bench.set("controller", slow__type="broken")[0].successful
    bench.wait_for(
        "the old law",
        lambda: bench.get("controller", "slow.type") == "linear_model_following",
    )
    assert "the old law goes on: ValueError: my law has a mistake" in bench.log("controller")


# Services and topics of the simulator ----------------------------------------------------------


def bits(message):
    """A state without its session, to the last bit; as text, since the padding in a serialised message is arbitrary."""
    message = copy.deepcopy(message)
    message.session = 0
    return str(message)


def torques(count):
    """A torque sequence that excites every mode."""
    return [float(t) for t in 3.0 * np.random.default_rng(1).standard_normal(count)]


@pytest.fixture(scope="module")
def three_modes():
    """A simulator whose plant has a mode more than the controller's arm, in lockstep, not paused."""
    with InProcess() as bench:
        settings = {**LOCKSTEP, "pause_at": -1.0, "plant_modes": 3, "joint_states_rate": 500.0}
        bench.start("simulator", {"arm": "R", **settings})
        bench.joint_states = bench.tap(JointState, "joint_states")
        yield bench


def test_the_published_amplitudes_are_the_true_ones_plus_the_spill_over_of_the_third_mode(
    three_modes,
):
    drive, twin = Drive(three_modes), Source.simulator("R", plant_modes=3)
    nominal, plant = twin.nominal, twin.plant_model
    seen = gauge_rows(plant, twin.arm.gauges)
    inverse = np.linalg.inv(gauge_rows(nominal, nominal.arm.gauges))
    spilled = 0.0
    drive.claim()
    twin.advance(None)
    for torque in torques(60):
        drive.step(torque)
        twin.advance(np.array([torque]))
        true = twin.plant.delta
        by_hand = inverse @ (seen @ true)
        np.testing.assert_allclose(drive.state.modal_amplitude, by_hand, rtol=0, atol=1e-12)
        np.testing.assert_allclose(drive.state.strain, seen @ true, rtol=0, atol=1e-12)
        # The first two rows and columns are those of the nominal arm: what is left is spill-over.
        leak = inverse @ (seen[:, 2] * true[2])
        np.testing.assert_allclose(by_hand - true[:2], leak, rtol=0, atol=1e-12)
        spilled = max(spilled, np.abs(leak).max())
    assert spilled > 1e-6


def test_a_reset_is_a_new_session_with_the_same_samples(three_modes):
    drive = Drive(three_modes)
    sessions = {drive.state.session}
    runs = []
    for _ in range(2):
        drive.reset()
        assert drive.state.session not in sessions
        sessions.add(drive.state.session)
        first = drive.state
        runs.append([bits(first), *(bits(drive.step(torque)) for torque in torques(20))])
    assert runs[0] == runs[1]
    assert len(set(runs[0])) == 21


def test_a_torque_of_the_session_before_a_reset_is_ignored(three_modes):
    drive = Drive(three_modes)
    old = drive.state.session
    drive.reset()
    publisher = three_modes.publisher(JointTorque, "joint_torque")
    answer = {"session": old, "sequence": 0, "mode": 1, "joint_names": ["joint1"], "torque": [1.0]}
    publisher.publish(JointTorque(**answer))
    drive.first()
    assert drive.state.sequence == 0
    assert drive.step(1.0).sequence == 1


def test_joint_states_have_the_measured_joints_at_their_own_rate(three_modes):
    drive = Drive(three_modes)
    drive.reset()
    seen = len(three_modes.joint_states.messages)
    states = [drive.state, *(drive.step(torque) for torque in torques(20))]
    found = three_modes.joint_states.messages
    three_modes.wait_for("eleven joint_states", lambda: len(found) >= seen + 11)
    for joint, state in zip(found[seen:], states[::2], strict=True):
        assert list(joint.name) == ["joint1"]
        assert stamp_ns(joint.header.stamp) == stamp_ns(state.header.stamp)
        assert list(joint.position) == list(state.joint_position)
        assert list(joint.velocity) == list(state.joint_velocity)
        assert list(joint.effort) == list(state.joint_torque)


def test_paused_in_lockstep_the_same_state_comes_again_and_torques_advance_nothing(three_modes):
    arm, drive = Arm(three_modes), Drive(three_modes)
    arm.pause(True)
    state = drive.first()
    publisher = three_modes.publisher(JointTorque, "joint_torque")
    answer = {"mode": 1, "controller_id": 1, "joint_names": ["joint1"], "torque": [1.0]}
    publisher.publish(JointTorque(session=state.session, sequence=state.sequence, **answer))
    drive.first()
    drive.first()
    assert drive.state == state
    arm.pause(False)
    assert drive.step(1.0).sequence == state.sequence + 1


@pytest.mark.real_time
def test_pause_and_reset_in_real_time(bench):
    bench.start("simulator", {"arm": "R", "rate": 200.0, "resend_period": 0.02})
    arm = Arm(bench)
    bench.wait_for("samples", lambda: arm.measured.newest and arm.measured.newest.sequence > 10)
    arm.pause(True)
    mark = len(arm.measured.messages)
    bench.wait_for("the state again", lambda: len(arm.measured.messages) > mark + 3)
    again = arm.measured.messages[mark + 1 :]
    assert {m.sequence for m in again} == {again[0].sequence}
    arm.pause(False)
    bench.wait_for(
        "samples after the pause", lambda: arm.measured.newest.sequence > again[0].sequence + 10
    )
    session = arm.measured.newest.session
    assert bench.call(Arm.reset_kind, "simulator/reset").success
    bench.wait_for(
        "a new session that runs",
        lambda: arm.measured.newest.session != session and arm.measured.newest.sequence > 10,
    )
    first = next(m for m in arm.measured.messages if m.session != session)
    assert first.sequence == 0 and stamp_ns(first.header.stamp) == 1_000_000_000


# Two arms --------------------------------------------------------------------------------------


@pytest.mark.real_time
def test_two_arms_side_by_side_one_killed_the_other_unaffected_topics_remapped(bench):
    common = {"arm": "R", "fast.type": "none", "rate": 100.0}
    remaps = {
        "left": [],
        # A namespace of its own, and topics that a driver may call otherwise.
        "right": ["arm_state:=encoder/measured", "joint_trajectory:=/goal"],
    }
    for side, given in remaps.items():
        for name in NODES:
            own = common | (PATIENT if name == "controller" else {})
            bench.start(name, own, key=f"{side}_{name}", remaps=[f"__ns:=/{side}", *given])
    left, right = Arm(bench, "left/"), Arm(bench, "right/")
    bench.wait_for("both arms", lambda: left.ready() and right.ready())
    assert left.state.session != right.state.session
    measured = bench.tap(ArmState, "right/encoder/measured")
    bench.wait_for("the remapped topic", lambda: measured.newest)
    assert right.measured.newest is None

    goal = trajectory(["joint1"], (1.0, [0.2], [0.0], [0.0]))
    right.trajectories = "/goal"
    right.wait_applied(measured)
    right.offer(goal)
    bench.kill("left_controller")
    bench.wait_for(
        "the right arm at its goal",
        lambda: right.state.supervisor_state == CompositeState.HOLDING,
    )
    assert abs(right.state.reference_position[0] - 0.2) < 1e-12
    assert left.state.accepted_trajectory_id == 0
    assert list(left.state.reference_position) == [0.0]
    session = right.state.session
    assert all(m.mode == JointTorque.ENABLED for m in right.torques.messages[-50:])
    assert {m.session for m in right.states.messages} == {session}
    silent = len(left.torques.messages)
    seen = len(right.torques.messages)
    bench.wait_for("the right arm to go on", lambda: len(right.torques.messages) > seen + 30)
    assert len(left.torques.messages) == silent
