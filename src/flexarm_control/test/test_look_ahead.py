# SPDX-License-Identifier: Apache-2.0
"""Work done between two samples for the next one: it changes nothing but when it is done."""

from types import SimpleNamespace

import numpy as np
import pytest

from flexarm_control import trajectory
from flexarm_control.composite.design import design
from flexarm_control.trajectory import ReferenceGenerator

SLOW, FAST = {"type": "linear_model_following"}, {"type": "lqr"}
CORRECTED = {"type": "corrected"}
MS = 1_000_000


def torques(model, kind, ahead, gaps, count=None):
    """Torques over two motions; `count` collects how often the manifold was worked out on the path."""
    control = design(model, SLOW, FAST, CORRECTED, {"feedforward": kind})
    reference = ReferenceGenerator(model.joint_names)
    reference.start(np.zeros(1), 0)
    calls, along = [], control.manifold.along

    def counted(reference):
        calls.append(None)
        return along(reference)

    control.manifold.along = counted
    out, stamp, q = [], 0, np.zeros(1)
    for k, gap in enumerate(gaps):
        if k in (3, 40):  # the second takes over from the first while it moves
            point = [(100 * MS, [0.3 - 0.01 * k], [0.0], [0.0], [])]
            data = trajectory.validate(model.joint_names, model.joint_names, 0, point)
            plan = (
                control.feedforward.prepare(data, np.zeros((3, 1)))
                if k == 3 and kind == "preview"
                else None
            )
            verdict = reference.offer(data)
            assert verdict.accepted
            control.feedforward.take(plan, verdict.trajectory_id)
        if k == 80:
            reference.stop(stamp, 1.0, given=False)
        stamp += gap
        reference.sample(stamp)
        before = len(calls)
        q = reference.position + 1e-3 * np.sin(0.1 * k)
        m = model.n_modes
        u = control.step(
            q, reference.velocity, np.zeros(m), np.zeros(m), reference, 1e-9 * gap if k else 0.0
        )
        out.append(u.copy())
        if count is not None:
            count.append(len(calls) - before)
        if ahead:
            control.look_ahead()
    return np.array(out)


@pytest.mark.parametrize("kind", ["model", "preview"])
@pytest.mark.parametrize("jitter", [False, True])
def test_looking_ahead_changes_no_bit(arm_r, kind, jitter):
    gaps = [MS] * 120
    if jitter:  # samples lost: the next one is not the one foreseen
        gaps[20], gaps[45], gaps[46] = 3 * MS, 2 * MS, 2 * MS
    plain, moved = (torques(arm_r, kind, ahead, gaps) for ahead in (False, True))
    assert np.ptp(plain) > 0.1
    np.testing.assert_array_equal(moved, plain)


def test_looking_ahead_leaves_the_manifold_of_the_motion_out_of_the_step(arm_r):
    alone, helped = [], []
    torques(arm_r, "model", False, [MS] * 120, alone)
    torques(arm_r, "model", True, [MS] * 120, helped)
    # Where the second motion takes over, and where it stops, what was before is continued, too.
    assert sum(alone[10:90]) == 80 + 2
    assert sum(helped[10:90]) == 2 + 2


def test_the_slow_torque_is_that_about_the_motion_as_it_is_now(arm_r):
    """Of every sample anew: the torque of the motion less the slow law's on it, and the law's about it."""
    control = design(arm_r, SLOW, FAST, CORRECTED, {"feedforward": "model"})
    motion, n, m = control.feedforward, arm_r.n_joints, arm_r.n_modes
    L, U = control.manifold.error_response(motion.settings.configuration)
    reference = ReferenceGenerator(arm_r.joint_names)
    reference.start(np.zeros(n), 0)
    point = [(100 * MS, [0.3], [0.0], [0.0], [])]
    reference.offer(trajectory.validate(arm_r.joint_names, arm_r.joint_names, 0, point))
    parts = []
    for k in range(60):
        reference.sample((k + 1) * MS)
        q, qd = reference.position + 1e-3, reference.velocity - 2e-3
        control.step(q, qd, np.zeros(m), np.zeros(m), reference, 1e-3 if k else 0.0)
        law, error = control.slow, np.concatenate([q - motion.position, qd - motion.velocity])
        nominal = law.nominal(arm_r.terms(motion.position, motion.velocity), motion.acceleration)
        about = law.torque(q, qd, motion, arm_r.terms(q, qd))
        parts.append(float(nominal[0]))
        wanted = about + motion.torque - nominal + U @ error
        np.testing.assert_allclose(control.slow_torque, wanted, rtol=1e-12)
        off = motion.amplitude + (L @ error)[:m]
        np.testing.assert_allclose(control.quasi_steady, off, rtol=1e-12)
        control.look_ahead()
    assert np.ptp(parts) > 1.0


def test_a_control_without_feedforward_has_nothing_to_look_ahead_to(arm_r):
    control = design(arm_r, SLOW, FAST, CORRECTED)
    control.look_ahead()
    reference = SimpleNamespace(
        position=np.zeros(1),
        velocity=np.zeros(1),
        acceleration=np.zeros(1),
        near=lambda _: np.zeros((3, 1)),
    )
    m = arm_r.n_modes
    control.step(np.zeros(1), np.zeros(1), np.zeros(m), np.zeros(m), reference, 0.001)
    control.look_ahead()
