# SPDX-License-Identifier: Apache-2.0
"""The driver template on its fake device: it passes the check, and observer and controller run on it unchanged.

In real time: nothing here depends on how fast that is, or on how late a process gets its turn.
"""

import os
import signal
import sys
from pathlib import Path

import numpy as np
import pytest
from harness import PATIENT, Arm, Bench, trajectory

from flexarm_msgs.msg import ArmState, CompositeState, JointTorque
from flexarm_tools.running.processes import arguments, executable

TEMPLATE = Path(__file__).resolve().parents[1] / "examples" / "flexarm_driver_template"
RATE = 200.0  # [Hz]
TIMEOUT = 0.2  # [s] of the torque; generous, for a machine that is busy
WATCHDOG = 0.4  # [s] of the fake device
#: What a busy machine adds to ages and intervals is not the driver's fault.
EASY = ["--duration", "1", "--rate-error", "0.3", "--jitter", "100", "--age", "5"]
EASY += ["--torque-timeout", str(TIMEOUT), "--timeout", "30"]


def start_template(bench, port, *options, **parameters):
    """Start the fake device and the driver, as ``python -m`` from the sources."""
    path = f"{TEMPLATE}:{os.environ.get('PYTHONPATH', '')}"
    python = ["env", f"PYTHONPATH={path}", sys.executable, "-m"]
    fake = [*python, "flexarm_driver_template.fake_device", "--port", str(port)]
    fake += ["--rate", str(RATE), "--watchdog", str(WATCHDOG)]
    bench.processes.start("fake_device", [*fake, *options])
    bench.wait_for("the fake device", port.exists)
    file = TEMPLATE / "config" / "driver.yaml"
    own = {"port": str(port), "torque_timeout": TIMEOUT, **parameters}
    driver = [*python, "flexarm_driver_template.driver", *arguments(own, file)]
    bench.processes.start("driver", driver)


def check_driver(bench, *options):
    """Run ``flexarm check_driver R --allow-motion``; exit code and output."""
    words = ["check_driver", "R", "--allow-motion", *EASY, *options]
    bench.processes.start("check", [executable("flexarm_bringup", "flexarm"), *words])
    return bench.end_of("check", 3 * bench.PATIENCE), bench.log("check")


def test_stamps_are_the_devices_times_however_late_a_frame_comes(monkeypatch):
    monkeypatch.syspath_prepend(TEMPLATE)
    from flexarm_driver_template.device import MeasurementTime

    random, period, start = np.random.default_rng(1), 5_000_000, 10**18  # [ns]
    late = 1_000_000 + random.exponential(3e6, 2000).astype(int)  # [ns] on the network
    late[0] = 200_000_000  # the first one waited for its reader
    clock, measured = MeasurementTime(), period * np.arange(2000)
    stamps = [clock.stamp(int(t), int(start + t + w)) for t, w in zip(measured, late, strict=True)]
    known = np.array([s for s in stamps if s is not None])
    assert len(known) == 1900
    away = known - (start + measured[100:])
    assert away.min() > 0 and away.max() < 2_000_000  # near the quickest way, never in the future
    assert np.abs(np.diff(known) - period).max() < 0.1 * period


def test_a_damaged_line_is_no_frame_and_pieces_make_whole_lines(monkeypatch):
    monkeypatch.syspath_prepend(TEMPLATE)
    from flexarm_driver_template import protocol

    whole = protocol.seal("S", 7, 35000, -12, 40, 50, 3)
    frame = protocol.frame(whole.strip(), 1, 2)
    assert frame == protocol.Frame(7, 35000, [-12], [40, 50], [3])
    for k in range(len(whole) - 1):
        broken = bytearray(whole.strip())
        broken[k] ^= 1
        assert protocol.frame(bytes(broken), 1, 2) is None, bytes(broken)
    assert protocol.frame(whole.strip(), 2, 2) is None
    lines = protocol.Lines()
    assert [lines.feed(p) for p in (whole[:5], whole[5:] + whole, b"x")] == [
        [],
        [whole.strip(), whole.strip()],
        [],
    ]


@pytest.fixture(scope="module")
def line(tmp_path_factory):
    """A bench with the template running."""
    directory = tmp_path_factory.mktemp("template")
    with Bench(directory / "log") as bench:
        start_template(bench, directory / "arm")
        states = bench.tap(ArmState, "arm_state")
        bench.wait_for("a state", lambda: states.newest)
        yield bench


@pytest.mark.real_time
def test_the_template_passes_the_check(line):
    code, output = check_driver(line, "--rate", str(RATE))
    assert code == 0, output
    for check in ("torque reported", "response", "strain response", "torque stops"):
        assert f"PASS     {check}" in output or f"WARN     {check}" in output, output


def send(publisher, state, torque, controller_id=1):
    """Answer a state."""
    fields = {"session": state.session, "sequence": state.sequence, "mode": JointTorque.ENABLED}
    names = {"joint_names": ["joint1"], "torque": [torque], "controller_id": controller_id}
    publisher.publish(JointTorque(**fields, **names))


@pytest.mark.real_time
def test_two_controllers_in_turn_bring_the_safe_action_and_a_torque_is_clipped(line):
    states = line.tap(ArmState, "arm_state")
    publisher = line.publisher(JointTorque, "joint_torque")

    def apply(controllers, torque, condition):
        seen, turn = states.newest.sequence, 0

        def applied():
            nonlocal seen, turn
            if states.newest.sequence == seen:
                return False
            seen, turn = states.newest.sequence, turn + 1
            send(publisher, states.newest, torque, controllers[turn % len(controllers)])
            return condition(states.newest.joint_torque[0])

        line.wait_for(f"the torque of {controllers}", applied)

    limit = 13.558  # [N m] the arm file's
    apply([1], 1000.0, lambda u: abs(u - limit) < 1e-3)
    apply([1], -1000.0, lambda u: abs(u + limit) < 1e-3)
    apply([1, 2], 1.0, lambda u: u == 0.0)
    line.wait_for("the warning", lambda: "several controllers" in line.log("driver"))
    apply([1], 0.5, lambda u: abs(u - 0.5) < 1e-6)


def test_the_watchdog_bites_once_when_the_driver_is_silent(monkeypatch, capsys):
    monkeypatch.syspath_prepend(TEMPLATE)
    from flexarm_driver_template import fake_device, protocol

    device = fake_device.FakeDevice("R", RATE, watchdog=0.1)

    def drive():
        return protocol.frame(device.sample().strip(), 1, 2).drive

    for _ in range(30):  # fed at each sample
        device.receive(protocol.seal("T", 1000))
        assert drive() == [1000]
    applied = [drive() for _ in range(60)]
    assert applied == 20 * [[1000]] + 40 * [[0]]  # 0.1 s, and then the safe action
    assert device.watchdog.bites == 1 and capsys.readouterr().out.count("watchdog") == 1
    assert abs(device.sim.velocity[0]) < 0.05  # [rad/s] softly braked, from 0.16
    device.receive(protocol.seal("T", 1000))
    assert drive() == [1000]
    device.receive(protocol.seal("X"))
    assert [drive() for _ in range(60)] == 60 * [[0]] and device.watchdog.bites == 1


@pytest.mark.real_time
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP], ids=["SIGKILL", "SIGSTOP"])
def test_when_the_driver_dies_in_motion_the_device_itself_takes_the_safe_action(
    tmp_path, monkeypatch, number
):
    monkeypatch.syspath_prepend(TEMPLATE)
    from flexarm_driver_template.device import Device

    port, per_count = tmp_path / "arm", 2.0 * np.pi / 2**20  # [rad]
    with Bench(tmp_path / "log") as bench:
        start_template(bench, port)
        bench.start("observer", {"arm": "R", "observer.type": "kalman"})
        bench.start("controller", {"arm": "R", **PATIENT, "fast.alpha": 1.0})
        arm = Arm(bench)
        arm.wait_ready()
        start = arm.measured.newest.joint_position[0]
        arm.offer(trajectory(arm.joints, (2.0, [start + 1.5], [0.0], [0.0])))
        bench.wait_for("the motion", lambda: arm.measured.newest.joint_position[0] > start + 0.4)
        assert arm.measured.newest.joint_torque[0] != 0.0
        before = bench.log("fake_device").count("watchdog")
        driver = bench.processes.running["driver"]
        bench.processes.expect_end("driver")
        driver.send_signal(number)
        # What the device does now, from its own frames, which no driver reads any more.
        line, frames = Device(str(port), 1, 2), []
        try:

            def at_rest():
                frames.extend(line.frames(wait=0.1))
                last = frames[-50:]  # a quarter of a second
                moved = np.ptp([f.encoder[0] for f in last]) * per_count if len(last) == 50 else 1.0
                return moved < 0.01 and all(f.drive == [0] for f in last)

            bench.wait_for("rest in the safe action", at_rest)
        finally:
            line.close()
            if number == signal.SIGSTOP:
                driver.send_signal(signal.SIGCONT)
        assert bench.log("fake_device").count("watchdog") > before
        # By the device's own clock, whose samples the frames are: the last torque acted no longer than it allows.
        assert sum(f.drive != [0] for f in frames) <= WATCHDOG * RATE + 5


@pytest.fixture
def controlled(line):
    """The arm on the template's line under observer and controller, which end with the test.

    A second try would start them beside those of the first one: two controllers.
    """
    # Soft fast gains and an observer with a model: they bear torques that come late.
    line.start("observer", {"arm": "R", "observer.type": "kalman"})
    line.start("controller", {"arm": "R", **PATIENT, "fast.alpha": 1.0})
    yield Arm(line)
    for key in ("controller", "observer"):
        line.stop(key, signal.SIGINT)


@pytest.mark.real_time
def test_observer_and_controller_run_on_it_unchanged(line, controlled):
    arm, offers = controlled, 1
    arm.wait_ready()
    start = arm.measured.newest.joint_position[0]
    goal = start + 0.3  # [rad]
    arm.offer(trajectory(arm.joints, (1.5, [goal])))

    def there():
        nonlocal offers
        # After a gap, as a busy machine makes them, the controller gives the motion up and asks for it again.
        if line.log("controller").count("send it again") >= offers:
            offers += 1
            arm.offer(trajectory(arm.joints, (1.5, [goal])))
        off = [abs(m.joint_position[0] - goal) for m in arm.measured.messages[-100:]]
        return arm.state.supervisor_state == CompositeState.HOLDING and max(off) < 0.02

    line.wait_for("the arm to be there, and to stay", there)
    assert arm.state.reference_position[0] == pytest.approx(goal)
    assert len({m.session for m in arm.measured.messages}) == 1
    assert "ERROR" not in line.log("driver")
