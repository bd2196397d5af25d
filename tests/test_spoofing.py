# SPDX-License-Identifier: Apache-2.0
"""A second program on joint_torque beside the controller, in mid-motion: what the driver applies and reports."""

import numpy as np
import pytest
from harness import Arm, trajectory
from in_process import InProcess

from flexarm_msgs.msg import ArmState, CompositeState, JointTorque

TORQUE = 13.0  # [N m] what the stranger sends; the motion takes 2
#: Samples after the first message of the stranger until both know [-].
SOON = 5


class Stranger:
    """Answers states as soon as they come: before the controller, whose observer has to look at them first.

    Parameters
    ----------
    bench : InProcess
    controller_id : int
        To send under.
    """

    def __init__(self, bench, controller_id):
        self.applied, self.named, self.begun = [], [], None
        self._publisher = bench.publisher(JointTorque, "joint_torque")
        self._id = controller_id
        self._reader = bench.queue.subscribe("/arm_state", self._answer)
        self._bench = bench

    def _answer(self, state):
        self.begun = state.sequence if self.begun is None else self.begun
        self.applied.append(state.joint_torque[0])
        self.named.append(state.controller_id)
        fields = {"session": state.session, "sequence": state.sequence, "mode": JointTorque.ENABLED}
        names = {"joint_names": ["joint1"], "torque": [TORQUE]}
        self._publisher.publish(JointTorque(**fields, **names, controller_id=self._id))

    def leave(self):
        """Send nothing any more."""
        self._bench.queue.unsubscribe(self._reader)


@pytest.fixture
def moving():
    """The loop in lockstep, in mid-motion."""
    with InProcess() as bench:
        simulator = {"lockstep": True, "pause_at": -1.0}
        bench.start_loop(arm="R", simulator=simulator)
        arm = Arm(bench)
        arm.wait_ready()
        arm.offer(trajectory(arm.joints, (2.0, [1.0], [0.0], [0.0])))
        bench.wait_for("the motion", lambda: arm.measured.newest.joint_position[0] > 0.3)
        assert arm.measured.newest.controller_id == arm.torques.newest.controller_id != 0
        yield arm


@pytest.mark.parametrize(
    ("who", "reason"),
    [
        ("another id", "several controllers"),
        ("the controller's id", "two answers to one state"),
    ],
)
def test_a_stranger_can_stop_the_arm_but_not_drive_it(moving, who, reason):
    bench, own = moving.bench, moving.torques.newest.controller_id
    stranger = Stranger(bench, own % 2**31 + 1 if who == "another id" else own)
    bench.wait_for("the fault", lambda: moving.state.supervisor_state == CompositeState.FAULT)
    # The controller says why, and soon.
    assert reason in moving.state.rejected_reason
    assert reason in bench.log("controller") and reason in bench.log("simulator")
    assert moving.state.sequence - stranger.begun <= SOON
    bench.wait_for("more states", lambda: len(stranger.applied) > 150)
    # Who has the controller's id wins a race or two, then nothing until the dispute has been silent (100 samples here).
    theirs = np.abs(np.array(stranger.applied)) > 12.0
    assert theirs.sum() <= (0 if who == "another id" else 6)
    doubted = [m for m in moving.measured.messages if m.trust == ArmState.DISTRUSTED]
    assert doubted and {reason in m.doubt for m in doubted} == {True}
    assert {m.controller_id for m in doubted} == {0}
    assert bench.diagnostics("simulator") is not None
    bench.wait_for("rest", lambda: abs(moving.measured.newest.joint_velocity[0]) < 0.05)
    stranger.leave()
    # The fault stays until somebody asks; then the arm moves as before.
    bench.wait_for("no doubt", lambda: moving.measured.newest.trust == ArmState.TRUSTED)
    assert moving.state.supervisor_state == CompositeState.FAULT
    assert moving.recover()
    moving.wait_ready()
    goal = moving.state.reference_position[0] + 0.2
    moving.offer(trajectory(moving.joints, (1.0, [goal], [0.0], [0.0])))

    def there():
        state = moving.state
        return state.supervisor_state == state.HOLDING and abs(state.position_error[0]) < 0.02

    bench.wait_for("the goal", there)


def test_a_message_of_a_stranger_that_does_not_listen_changes_nothing(moving):
    bench, publisher = moving.bench, moving.bench.publisher(JointTorque, "joint_torque")
    state = moving.measured.newest
    names = {"joint_names": ["joint1"], "torque": [TORQUE], "mode": JointTorque.ENABLED}
    own = moving.torques.newest.controller_id
    for session, sequence in ((state.session + 1, state.sequence + 5), (state.session, 10**6)):
        answer = {"session": session % 2**32, "sequence": sequence, "controller_id": own}
        publisher.publish(JointTorque(**answer, **names))
    bench.wait_for("the end", lambda: moving.state.supervisor_state == CompositeState.HOLDING)
    assert max(abs(m.joint_torque[0]) for m in moving.measured.messages) < 5.0
    assert bench.log("controller").count("[ERROR]") == 0
