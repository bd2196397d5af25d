# SPDX-License-Identifier: Apache-2.0
"""The driver template on its fake device: it passes the check, and observer and controller run on it unchanged.

In real time: nothing here depends on how fast that is, or on how late a process gets its turn.
"""

import os
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
#: What a busy machine adds to ages and intervals is not the driver's fault.
EASY = ["--duration", "1", "--rate-error", "0.3", "--jitter", "100", "--age", "5"]
EASY += ["--torque-timeout", str(TIMEOUT), "--timeout", "30"]


def start_template(bench, port, *options, **parameters):
    """Start the fake device and the driver, as ``python -m`` from the sources."""
    path = f"{TEMPLATE}:{os.environ.get('PYTHONPATH', '')}"
    python = ["env", f"PYTHONPATH={path}", sys.executable, "-m"]
    fake = [*python, "flexarm_driver_template.fake_device", "--port", str(port)]
    bench.processes.start("fake_device", [*fake, "--rate", str(RATE), *options])
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


@pytest.mark.real_time
def test_observer_and_controller_run_on_it_unchanged(line):
    # Soft fast gains and an observer with a model: they bear torques that come late.
    line.start("observer", {"arm": "R", "observer.type": "kalman"})
    line.start("controller", {"arm": "R", **PATIENT, "fast.alpha": 1.0})
    arm = Arm(line)
    arm.wait_ready()
    start = arm.measured.newest.joint_position[0]
    goal = start + 0.3  # [rad]
    arm.offer(trajectory(arm.joints, (1.5, [goal])))

    def there():
        off = [abs(m.joint_position[0] - goal) for m in arm.measured.messages[-100:]]
        return arm.state.supervisor_state == CompositeState.HOLDING and max(off) < 0.02

    line.wait_for("the arm to be there, and to stay", there)
    assert arm.state.reference_position[0] == pytest.approx(goal)
    assert len({m.session for m in arm.measured.messages}) == 1
    assert "ERROR" not in line.log("driver")
