# SPDX-License-Identifier: Apache-2.0
"""What is wrong with a state, a torque or a process, and what the nodes make of it."""

import math
import re
import signal

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from harness import Arm, Bench, Drive, Source, trajectory
from in_process import InProcess

from flexarm_msgs.msg import ArmState, CompositeState, JointTorque
from flexarm_ros.messages import stamp_ns
from flexarm_sim.nodes.pacing import ALONE_SAMPLES
from flexarm_studies.loop import parameter_files

NAN, INF = math.nan, math.inf
J = ["joint1"]

# Bad states into observer and controller --------------------------------------------------------


def source_on(bench):
    """Observer and controller of the paper, and a source of states in place of a simulator."""
    file = parameter_files.find("paper_composite")
    bench.start("observer", file=file)
    bench.start("controller", {"state_timeout": 60.0}, file=file)
    source = Source(bench)
    bench.publisher(ArmState, "arm_state_estimate")
    source.step()
    return source


def in_a_new_session(source):
    """The source in a new session, its arm in motion and bent, the torque enabled."""
    source.restart()
    for _ in range(20):
        source.sim.advance(np.array([3.0]))
    source.until_enabled()
    assert np.abs(source.sim.amplitude).min() > 1e-6
    return source


@pytest.fixture(scope="module")
def in_this_process():
    with InProcess() as bench:
        yield source_on(bench)


@pytest.fixture
def source(in_this_process):
    return in_a_new_session(in_this_process)


#: What is changed in a good state, what the reason in controller/state says, what the observer logs.
BAD_STATES = {
    "NaN position": ({"joint_position": [NAN]}, "joint_position of joint1: nan"),
    "inf position": ({"joint_position": [INF]}, "joint_position of joint1: inf"),
    "huge position": ({"joint_position": [1e9]}, "joint_position of joint1: 1000000000.0"),
    "two positions": ({"joint_position": [0.0, 0.0]}, "joint_position: 2 values"),
    "no position": ({"joint_position": []}, "joint_position: is empty"),
    "NaN velocity": ({"joint_velocity": [NAN]}, "joint_velocity of joint1: nan"),
    "two velocities": ({"joint_velocity": [0.0, 0.0]}, "joint_velocity: 2 values"),
    "two torques": ({"joint_torque": [0.0, 0.0]}, "joint_torque: 2 values"),
    "wrong joint": ({"joint_names": ["elbow"]}, "missing joint1; unknown elbow"),
    "no joint names": ({"joint_names": []}, "missing joint1"),
    "joint twice": ({"joint_names": ["joint1", "joint1"]}, "joint_names: .*a name twice"),
    "NaN amplitude": ({"modal_amplitude": [NAN, 0.0]}, "modal_amplitude of link1_y_mode1: nan"),
    "inf amplitude": ({"modal_amplitude": [0.0, -INF]}, "modal_amplitude of link1_y_mode2: -inf"),
    "huge amplitude": ({"modal_amplitude": [0.0, 1e8]}, "modal_amplitude of link1_y_mode2: 1"),
    "one amplitude": ({"modal_amplitude": [0.0]}, r"modal_amplitude: \d values"),
    "three amplitudes": ({"modal_amplitude": [0.0] * 3}, r"modal_amplitude: \d values"),
    "wrong mode": (
        {"mode_names": ["link1_y_mode1", "link1_z_mode1"]},
        "missing link1_y_mode2; unknown link1_z_mode1",
    ),
    "NaN strain alone": ({"strain": [0.0, NAN], "modal_amplitude": []}, "strain of middle: nan"),
    "huge strain alone": ({"strain": [1e7, 0.0], "modal_amplitude": []}, "strain of root: 1"),
    "one strain": ({"strain": [0.0], "modal_amplitude": []}, "strain: 1 values"),
    "wrong gauge": ({"gauge_names": ["root", "tip"]}, "missing middle; unknown tip"),
    "neither strain nor amplitude": (
        {"strain": [], "modal_amplitude": []},
        "neither strain nor modal_amplitude",
    ),
    "NaN rate": ({"modal_rate": [NAN, 0.0]}, "modal_rate of link1_y_mode1: nan"),
}


@pytest.mark.parametrize("case", BAD_STATES)
def test_a_bad_state_is_a_fault_with_a_reason_until_recover_is_called(source, case):
    check_bad_state(source, case)


def test_over_dds_a_bad_state_is_a_fault_until_recover_is_called(bench):
    source = in_a_new_session(source_on(bench))
    check_bad_state(source, "NaN position")
    check_bad_state(source, "NaN strain alone")


def check_bad_state(source, case):
    changes, reason = BAD_STATES[case]
    torque, state = source.step(**changes)
    assert torque.mode == JointTorque.DISABLED
    assert list(torque.torque) == [0.0]
    assert state.supervisor_state == CompositeState.FAULT
    rejected = state.rejected_reason
    assert rejected
    # The observer says what it is; the controller does where it concerns the joints.
    assert re.search(reason, source.bench.log("observer")), source.bench.log("observer")
    # Good states alone do not bring the torque back.
    torque, state = source.step()
    assert torque.mode == JointTorque.DISABLED
    assert (state.supervisor_state, state.rejected_reason) == (CompositeState.FAULT, rejected)
    assert source.recover()
    torque, state = source.until_enabled(most=3)
    assert state.rejected_reason == ""
    assert state.supervisor_state == CompositeState.READY
    assert np.isfinite(torque.torque).all()


def test_bad_joints_are_named_in_controller_state_too(source):
    _, state = source.step(joint_position=[NAN])
    assert "joint_position of joint1: nan" in state.rejected_reason
    source.recover()
    _, state = source.step(joint_names=["elbow"])
    assert "missing joint1; unknown elbow" in state.rejected_reason


def test_a_stream_of_bad_states_does_not_flood_the_log(source):
    before = len(source.bench.log("observer").splitlines())
    for i in range(30):
        source.step(joint_position=[1e7 + i], joint_names=["joint1"])
    assert len(source.bench.log("observer").splitlines()) - before <= 2
    source.recover()
    source.until_enabled(most=3)


def run(source, count=15, **changes):
    """The torques of `count` samples from a moving start, in a new session."""
    source.restart()
    for _ in range(20):
        source.sim.advance(np.array([3.0]))
    source.until_enabled(**changes)
    out = []
    for _ in range(count):
        torque, _ = source.step(**changes)
        assert torque.mode == JointTorque.ENABLED
        out.append(torque.torque[0])
    return out


def test_strain_alone_gives_the_same_torque_as_the_amplitudes_that_are_its_map(source):
    assert run(source, modal_amplitude=lambda s: []) == run(source)


def test_names_in_another_order_give_the_same_torque_to_the_last_bit(source):
    gauges, modes = source.sim.arm.gauge_names, source.sim.arm.observed_modes
    turned = run(
        source,
        mode_names=lambda s: list(modes[::-1]),
        modal_amplitude=lambda s: s.sim.amplitude[::-1].tolist(),
    )
    strains = run(
        source,
        gauge_names=lambda s: list(gauges[::-1]),
        strain=lambda s: s.sim.strain[::-1].tolist(),
        modal_amplitude=lambda s: [],
    )
    assert turned == strains == run(source)


def test_a_nan_strain_is_no_matter_where_the_amplitudes_are_given(source):
    assert run(source, strain=lambda s: [NAN, NAN]) == run(source)


def test_an_unknown_applied_torque_is_no_matter_to_the_filtered_derivative(source):
    assert run(source, joint_torque=lambda s: [NAN]) == run(source)
    assert run(source, joint_torque=lambda s: []) == run(source)


def test_a_repeated_sequence_is_answered_from_before_and_moves_no_filter(source):
    plain = run(source)
    source.restart()
    for _ in range(20):
        source.sim.advance(np.array([3.0]))
    source.until_enabled()
    repeated = []
    for _ in plain:
        message = source.state()
        torque, _ = source.exchange(message)
        # Sent again, and even with other content: the sample is known.
        message.joint_position = [0.7]
        again, _ = source.exchange(message)
        assert again == torque
        repeated.append(torque.torque[0])
        source.sim.advance(np.array(torque.torque))
    assert repeated == plain


def test_an_older_sequence_is_left_out_and_the_loop_goes_on(source):
    old = source.state()
    source.step()
    source.step()
    known = len(source.torques.messages)
    source.bench.publisher(ArmState, "arm_state").publish(old)
    torque, state = source.step()
    assert torque.mode == JointTorque.ENABLED
    assert state.supervisor_state == CompositeState.READY
    later = [m.sequence for m in source.torques.messages[known:]]
    assert old.sequence not in later, "what was answered is answered again"


def test_a_stamp_that_goes_back_is_a_fault(source):
    message = source.state()
    message.header.stamp.sec = 0
    torque, state = source.exchange(message)
    assert torque.mode == JointTorque.DISABLED
    assert state.supervisor_state == CompositeState.FAULT
    assert "0.999 s before the last state" in state.rejected_reason
    source.sim.advance(None)
    source.recover()
    source.until_enabled()


def test_a_stamp_that_jumps_ahead_is_a_fault(source):
    message = source.state()
    message.header.stamp.sec += 3600
    torque, state = source.exchange(message)
    assert torque.mode == JointTorque.DISABLED
    assert state.supervisor_state == CompositeState.FAULT
    assert "3600.0 s after the last state" in state.rejected_reason
    source.restart()
    source.until_enabled()


def test_a_gap_in_the_sequence_is_bridged(source):
    for _ in range(7):
        source.sim.advance(np.zeros(1))
    torque, state = source.step()
    assert torque.mode == JointTorque.ENABLED
    assert np.isfinite(state.torque).all()


def test_a_new_session_in_motion_waits_for_recover_then_holds_where_the_arm_is(source):
    arm = Arm(source.bench)
    arm.publish_trajectory(trajectory(J, (5.0, [1.0])))
    source.bench.wait_for(
        "tracking", lambda: source.step()[1].supervisor_state == CompositeState.TRACKING
    )
    source.begin_session()
    source.sim.reset([0.4])
    for _ in range(10):
        torque, state = source.step()
        assert torque.mode == JointTorque.DISABLED
        assert state.supervisor_state == CompositeState.FAULT
    assert "the source of the states has restarted during a motion" in state.rejected_reason
    assert source.recover()
    torque, state = source.until_enabled(most=10)
    assert source.sim.sequence < 22, "the new session was taken for an old one"
    assert state.supervisor_state == CompositeState.READY
    assert list(state.reference_position) == [0.4]
    assert torque.session == source.session


def estimate(source, **changes):
    """A good estimate, straight to the controller: the observer is silent meanwhile."""
    message = source.state(modal_rate=[0.0, 0.0])
    for field, value in changes.items():
        setattr(message, field, value)
    key = (message.session, message.sequence)
    known = len(source.torques.messages)
    source.bench.publisher(ArmState, "arm_state_estimate").publish(message)
    source.bench.wait_for(
        "an answer",
        lambda: [m for m in source.torques.messages[known:] if (m.session, m.sequence) == key],
    )
    source.sim.advance(np.zeros(1))
    return source.torques.newest


@pytest.mark.parametrize(
    "changes",
    (
        {"modal_rate": [NAN, 0.0]},
        {"modal_rate": []},
        {"modal_rate": [0.0]},
        {"modal_amplitude": []},
        {"modal_amplitude": [0.0, 1e7]},
        {"joint_velocity": []},
        {"joint_velocity": [INF]},
        {"joint_names": ["elbow"]},
    ),
    ids=str,
)
def test_the_controller_trusts_no_observer_either(source, changes):
    source.restart()
    assert estimate(source).mode == JointTorque.ENABLED
    assert estimate(source, **changes).mode == JointTorque.DISABLED
    assert estimate(source).mode == JointTorque.DISABLED
    assert source.recover()
    assert estimate(source).mode == JointTorque.ENABLED


# Bad torques into the simulator ------------------------------------------------------------------


def drive_on(bench):
    """A simulator in lockstep that this process answers."""
    lockstep = {"lockstep": True, "pause_at": -1.0, "resend_period": 0.02}
    bench.start("simulator", {"arm": "R", **lockstep})
    return Drive(bench)


def in_motion_beside_its_twin(drive):
    """The simulator after a reset, the arm in motion; and its twin in this process."""
    drive.reset()
    drive.twin = Source.simulator("R")
    claim(drive)
    for _ in range(10):
        step_both(drive, 3.0)
    assert abs(drive.state.joint_velocity[0]) > 1e-3
    return drive


@pytest.fixture(scope="module")
def simulated():
    with InProcess() as bench:
        yield drive_on(bench)


@pytest.fixture
def drive(simulated):
    return in_motion_beside_its_twin(simulated)


def claim(drive, **changes):
    """One period of both under the safe action: the next state names the controller."""
    assert drive.claim(**changes).controller_id == changes.get("controller_id", 1)
    drive.twin.advance(None)
    same(drive)


def step_both(drive, torque, **changes):
    """One period of both under the same torque."""
    drive.step(torque, **changes)
    drive.twin.advance(np.array([torque]))
    same(drive)


def same(drive):
    """Simulator and twin agree to the last bit."""
    assert list(drive.state.joint_position) == drive.twin.position.tolist()
    assert list(drive.state.joint_velocity) == drive.twin.velocity.tolist()
    assert list(drive.state.strain) == drive.twin.strain.tolist()
    assert list(drive.state.joint_torque) == drive.twin.torque.tolist()


BAD_TORQUES = {
    "disabled": {"mode": JointTorque.DISABLED},
    "disabled, and nonsense": {"mode": 0, "torque": [NAN] * 3, "joint_names": ["elbow"]},
    "NaN": {"torque": [NAN]},
    "inf": {"torque": [INF]},
    "minus inf": {"torque": [-INF]},
    "huge": {"torque": [2e9]},
    "wrong joint": {"joint_names": ["elbow"]},
    "no joint names": {"joint_names": []},
    "two torques": {"torque": [1.0, 1.0]},
    "no torque": {"torque": []},
    "joint twice": {"joint_names": ["joint1", "joint1"], "torque": [1.0, 1.0]},
    "mode 7": {"mode": 7},
}


@pytest.mark.parametrize("case", BAD_TORQUES)
def test_a_torque_that_cannot_be_applied_is_answered_by_the_safe_action(drive, case):
    check_bad_torque(drive, case)


def test_over_dds_a_torque_that_cannot_be_applied_is_answered_by_the_safe_action(bench):
    drive = in_motion_beside_its_twin(drive_on(bench))
    check_bad_torque(drive, "NaN")
    check_bad_torque(drive, "wrong joint")


def check_bad_torque(drive, case):
    drive.step(1.0, **BAD_TORQUES[case])
    drive.twin.advance(None)
    same(drive)
    assert drive.state.controller_id == (1 if case.startswith("disabled") else 0)
    if not case.startswith("disabled"):
        assert "the safe action is applied" in drive.bench.log("simulator")
        claim(drive)
    step_both(drive, 1.0)


@pytest.mark.parametrize(
    "shift",
    ({"session": 1}, {"sequence": -2}, {"sequence": -5}, {"sequence": 1}),
    ids=("wrong session", "stale by two", "stale by five", "from the future"),
)
def test_an_answer_to_another_state_is_ignored(drive, shift):
    state = drive.first()
    answer = {"session": state.session, "sequence": state.sequence}
    for field, by in shift.items():
        answer[field] = (answer[field] + by) % 2**32
    good = {"mode": JointTorque.ENABLED, "joint_names": J, "torque": [5.0]}
    drive.send(**answer, **good)
    drive.first()
    drive.first()
    assert drive.state == state
    step_both(drive, 1.0)


def test_the_simulator_says_why_a_torque_was_refused_and_counts_it(drive):
    diagnostics = drive.bench.diagnostics("simulator")

    def refused():
        status = drive.bench.diagnostics("simulator")
        return int({v.key: v.value for v in status[-1].values}["torques refused"]) if status else -1

    drive.bench.wait_for("diagnostics", lambda: refused() >= 0)
    before = refused()
    drive.step(1.0, torque=[NAN])
    drive.bench.wait_for("the refusal in /diagnostics", lambda: refused() == before + 1)
    assert "torque of joint1: nan" in drive.bench.log("simulator")
    assert diagnostics is not None


def levels(bench, name, since):
    """Levels and messages of a node's diagnostics after the first `since`."""
    return [(s.level, s.message) for s in bench.diagnostics(name)[since:]]


def test_two_controllers_are_an_error_on_diagnostics_that_ends_when_one_of_them_ends(drive):
    bench = drive.bench
    bench.diagnostics("simulator")
    several = "several controllers (11, 12) publish joint_torque: stop all but one"
    error = (DiagnosticStatus.ERROR, several)

    def step(controller_id, safe=False):
        drive.step(0.1, controller_id=controller_id)
        drive.twin.advance(None if safe else np.array([0.1]))
        same(drive)

    def turn(ids, safe=False):
        since = len(bench.diagnostics("simulator"))

        def known():
            for controller_id in ids:
                step(controller_id, safe)
            return levels(bench, "simulator", since)[1:]  # the first may be of before

        return bench.wait_for("diagnostics", known)

    step(11, safe=True)
    step(11)
    step(12, safe=True)  # the controller was restarted: another id, one controller
    assert error not in turn([12])
    assert error in turn([11, 12], safe=True)
    assert (drive.state.controller_id, drive.state.trust) == (0, ArmState.DISTRUSTED)
    assert drive.state.doubt == several
    for _ in range(ALONE_SAMPLES):  # since 12 followed 11 for the last time; one more to be named
        step(12, safe=True)
    assert (drive.state.controller_id, drive.state.trust) == (12, ArmState.TRUSTED)
    assert error not in turn([12])
    assert bench.log("simulator").count("several controllers (11, 12)") == 1


def test_a_second_torque_for_one_state_under_the_same_id_is_a_race_that_neither_wins(drive):
    state = drive.state
    answer = {"session": state.session, "sequence": state.sequence, "mode": JointTorque.ENABLED}
    drive.send(**answer, joint_names=J, torque=[1.0])
    drive.send(**answer, joint_names=J, torque=[-1.0])
    drive.bench.wait_for("the next state", lambda: drive.states.newest.sequence > state.sequence)
    drive.state = drive.states.newest
    drive.twin.advance(np.array([1.0]))  # in lockstep the first answer is a step
    same(drive)
    assert drive.state.controller_id == 1
    drive.step(1.0)
    drive.twin.advance(None)
    same(drive)


def test_the_safe_action_of_arm_r_brakes_more_than_no_torque_does(drive):
    free = Source.simulator("R")
    for _ in range(10):
        free.advance(np.array([3.0]))
    for _ in range(20):  # softly begun
        free.advance(np.zeros(1))
        drive.step(1.0, mode=JointTorque.DISABLED)
    assert abs(drive.state.joint_velocity[0]) < 0.98 * abs(free.velocity[0])


# Processes that die, in real time ---------------------------------------------------------------

#: Longer than the 1/3 s for which FastDDS's check of shared-memory ports may hold up a publisher when
#: a process joins or leaves (eProsima/Fast-DDS issue 6535) [s].
TIMEOUT = 1.0
PARAMETERS = {
    "simulator": {"arm": "R", "rate": 200.0},
    "observer": {"arm": "R"},
    "controller": {"arm": "R", "fast.type": "none", "max_gap": 60.0, "state_timeout": TIMEOUT},
}


@pytest.fixture(scope="module")
def real_time_bench(tmp_path_factory):
    """The three nodes in real time."""
    with Bench(tmp_path_factory.mktemp("log")) as bench:
        for name, parameters in PARAMETERS.items():
            bench.start(name, parameters)
        bench.arm = Arm(bench)
        bench.arm.wait_ready()
        yield bench


@pytest.fixture
def real_time(real_time_bench):
    """The loop in real time, all processes alive, the controller ready."""
    for name, parameters in PARAMETERS.items():
        if name not in real_time_bench.processes.running:
            real_time_bench.start(name, parameters)
    arm, seen = real_time_bench.arm, len(real_time_bench.arm.torques.messages)
    arm.recover()
    real_time_bench.wait_for("the loop", lambda: len(arm.torques.messages) > seen + 20)
    arm.wait_ready()
    return arm


def works(arm, by=0.2):
    """Once recovered, the loop makes a small motion from where it is."""
    arm.recover()
    arm.wait_ready()
    arm.wait_applied()
    goal = arm.state.reference_position[0] + by
    arm.offer(trajectory(J, (0.5, [goal], [0.0], [0.0])))
    arm.bench.wait_for(
        "the goal",
        lambda: (
            arm.state.supervisor_state == CompositeState.HOLDING
            and abs(arm.state.reference_position[0] - goal) < 1e-12
            and abs(arm.state.position_error[0]) < 0.05
        ),
    )


def in_motion(arm):
    """Offer a fast motion and wait until the joint is well under way."""
    goal = arm.state.reference_position[0] + 2.0
    arm.offer(trajectory(J, (2.0, [goal], [0.0], [0.0])))
    arm.bench.wait_for("the motion", lambda: arm.measured.newest.joint_velocity[0] > 0.5)


@pytest.mark.real_time
def test_when_the_controller_is_killed_the_safe_action_brings_the_joint_to_rest(real_time):
    bench, measured = real_time.bench, real_time.measured
    in_motion(real_time)
    bench.kill("controller")
    begin = stamp_ns(measured.newest.header.stamp)

    def slow(message):
        return abs(message.joint_velocity[0]) < 0.02

    bench.wait_for("rest", lambda: all(map(slow, measured.messages[-100:])))
    # Arm R: damp, the undamped links swing on and move the joint below 1 degree/s.
    came_slow = next(
        stamp_ns(m.header.stamp)
        for m in measured.messages
        if stamp_ns(m.header.stamp) > begin and abs(m.joint_velocity[0]) < 0.1
    )
    assert (came_slow - begin) * 1e-9 < 1.0
    assert {m.joint_torque[0] for m in measured.messages[-100:]} == {0.0}
    since = len(bench.diagnostics("simulator"))
    warning = (DiagnosticStatus.WARN, "no fresh torque: the safe action is applied")
    bench.wait_for("a warning", lambda: warning in levels(bench, "simulator", since))

    bench.start("controller", PARAMETERS["controller"])
    seen = len(real_time.torques.messages)
    bench.wait_for("torques again", lambda: len(real_time.torques.messages) > seen)
    works(real_time)
    # A controller that was restarted is not a second one.
    since = len(bench.diagnostics("simulator"))
    bench.wait_for("diagnostics", lambda: levels(bench, "simulator", since)[1:])
    assert levels(bench, "simulator", since)[-1] == (DiagnosticStatus.OK, "ok")


@pytest.mark.real_time
def test_when_the_observer_is_killed_the_controller_disables_after_state_timeout(real_time):
    bench = real_time.bench
    in_motion(real_time)
    bench.kill("observer")
    bench.wait_for("DISABLED", lambda: real_time.torques.newest.mode == JointTorque.DISABLED)
    text = f"no arm_state_estimate for {TIMEOUT:g} s"
    bench.wait_for("the reason in the log", lambda: text in bench.log("controller"))
    since = len(bench.diagnostics("controller"))
    bench.wait_for(
        "an error on /diagnostics",
        lambda: any(
            level == DiagnosticStatus.ERROR and "no arm_state_estimate for" in message
            for level, message in levels(bench, "controller", since)
        ),
    )
    bench.start("observer", PARAMETERS["observer"])
    works(real_time)


@pytest.mark.real_time
def test_a_simulator_that_is_killed_and_restarted_is_a_new_session_and_the_loop_works(real_time):
    bench, session = real_time.bench, real_time.state.session
    in_motion(real_time)
    bench.kill("simulator")
    bench.wait_for("DISABLED", lambda: real_time.torques.newest.mode == JointTorque.DISABLED)
    bench.start("simulator", PARAMETERS["simulator"])
    bench.wait_for("a fault that stays", lambda: real_time.state.session != session)
    assert real_time.state.supervisor_state == CompositeState.FAULT
    assert real_time.recover()
    bench.wait_for(
        "a new session, READY",
        lambda: (
            real_time.state.session != session
            and real_time.state.supervisor_state == CompositeState.READY
        ),
    )
    # The motion of before is forgotten: the arm is held where the new session found it, at rest.
    assert abs(real_time.state.reference_position[0]) < 0.01
    works(real_time)
    for name in ("observer", "controller"):
        assert "Traceback" not in bench.log(name)


@pytest.mark.real_time
def test_a_controller_that_is_stopped_for_a_while_brings_the_safe_action_and_then_goes_on(
    real_time,
):
    bench, process = real_time.bench, real_time.bench.processes.running["controller"]
    in_motion(real_time)
    process.send_signal(signal.SIGSTOP)
    try:
        seen = len(real_time.measured.messages)

        def safe():
            late = [m.joint_torque[0] for m in real_time.measured.messages[seen:]]
            return len(late) > 60 and set(late[-30:]) == {0.0}  # 300 ms at 200 Hz

        bench.wait_for("the safe action", safe)
    finally:
        process.send_signal(signal.SIGCONT)
    mark = len(real_time.torques.messages)
    bench.wait_for("torques again", lambda: len(real_time.torques.messages) > mark)
    # The motion is given up: the arm is held where it is then, or was too far behind.
    ends = (CompositeState.READY, CompositeState.HOLDING, CompositeState.FAULT)
    bench.wait_for("the end", lambda: real_time.state.supervisor_state in ends)
    works(real_time)
