# SPDX-License-Identifier: Apache-2.0
"""Errors in the loop around the laws: supervisor, limits, trajectories and motions."""

from .mutant import of

TESTS = "flexarm_control/test/"
TORQUE = TESTS + "test_trajectory_torque.py"

ERRORS = [
    *of(
        "flexarm_control",
        "motions",
        TESTS + "test_shapers.py",
        (
            "shapers",
            "damped period: natural",
            "return np.pi / (omega * root), ",
            "return np.pi / omega, ",
        ),
        ("shapers", "MZV: decay of half a period", "k = K**MZV_SPACING", "k = K"),
        ("shapers", "two-hump EI: its zeros", "c = 3.0 - 3.0 / x0**2", "c = 3.0 - 2.9 / x0**2"),
        ("shapers", "ZVDD: an impulse", "3.0 * K**2, K**3", "3.0 * K, K**3"),
    ),
    *of(
        "flexarm_control",
        "loop",
        "flexarm_studies/test/test_late_torque.py",
        (
            "arm_controller",
            "the measured delay: not given to the law",
            "self.law.take_delay(self.torque_delay.known)",
            "pass",
        ),
    ),
    *of(
        "flexarm_control",
        "composite",
        "flexarm_studies/test/test_late_torque.py",
        (
            "law",
            "a late torque: the feed-forward is not ahead of the reference",
            "self._lead_ns = round(self._seen.late * SECOND)",
            "self._lead_ns = 0",
        ),
        (
            "seen",
            "a late torque: a motion is seen from zero at first",
            "follows = self._goes_on and dt > 0.0",
            "follows = dt > 0.0",
        ),
        (
            "seen",
            "a late torque: a control from another process sees nothing",
            "(state)\n        self._name_parts()\n",
            "(state)\n        self._name_parts()\n        self._state = self._state.copy()\n",
        ),
    ),
    *of(
        "flexarm_control",
        "loop",
        TESTS + "test_torque_delay.py",
        (
            "torque_delay",
            "the delay for the control: an offset counts",
            "sums - BLOCK * np.array(means)",
            "sums",
        ),
        (
            "torque_delay",
            "the delay for the control: also from reports that never change",
            "FITS_WELL * min(change, varies)",
            "FITS * change",
        ),
        (
            "torque_delay",
            "the delay for the control: also from a torque that changes smoothly",
            " and change >= CHANGES_MUCH**2 * varies:",
            ":",
        ),
        ("torque_delay", "whole periods only", "float((k + f[k])", "float((k + 0.0 * f[k])"),
        (
            "torque_delay",
            "lost samples take no time",
            "range(min(count - 1, SENT))",
            "range(min(count - count, SENT))",
        ),
        (
            "torque_delay",
            "torques from before an interruption",
            "if first <= LAGS + 1 or",
            "if first <= 0 or",
        ),
        (
            "applied",
            "a first confirmation that comes late is no interruption",
            "return max(self._other_for, self._unconfirmed_for)",
            "return self._other_for",
            TESTS + "test_arm_controller.py",
        ),
    ),
    *of(
        "flexarm_control",
        "trajectory",
        TESTS + "test_trajectory.py",
        (
            "request",
            "joints that are left out: at zero",
            "np.asarray(held, float)[~given] if name",
            "0.0 * np.asarray(held, float)[~given] if name",
        ),
        (
            "reference",
            "a motion under way that is joined: from its first point on",
            "times_ns = trajectory.times_ns - (now_ns - trajectory.stamp_ns)",
            "times_ns = trajectory.times_ns",
        ),
    ),
    *of(
        "flexarm_control",
        "trajectory",
        TESTS + "test_goal.py",
        (
            "goal",
            "a goal: the tip's swing along the axis with the least",
            "axis=0).max())",
            "axis=0).min())",
        ),
        ("goal", "a goal: before its motion's end", "if stamp_ns < self._end_ns:", "if False:"),
        (
            "goal",
            "a goal: its own tolerance of the parameter's joint",
            "limits[row, names.index(name)] = value",
            "limits[row] = value",
        ),
    ),
    *of(
        "flexarm_control",
        "trajectory",
        TORQUE,
        (
            "torque",
            "torque of a trajectory: without its velocity",
            "slow_torque(model.terms(q, qd), qdd)",
            "slow_torque(model.terms(q, 0.0 * qd), qdd)",
        ),
        (
            "torque",
            "torque of a trajectory: the start is not taken",
            "        path.begin(0, start)\n",
            "        pass\n",
        ),
        (
            "torque",
            "torque of a trajectory: the hold at its end",
            "    hold[0, 0] = path.end\n",
            "    pass\n",
        ),
    ),
    *of(
        "flexarm_control",
        "loop",
        TESTS + "test_arm_controller.py " + TESTS + "test_plausibility.py",
        (
            "supervisor",
            "time at the torque limit: never",
            "value[-1] = self._saturated_for",
            "value[-1] = 0.0",
        ),
        (
            "supervisor",
            "a limit that stays exceeded: never a fault",
            'if self._exceeded_for > self.settings["limit_patience"]:',
            "if False:",
        ),
        (
            "supervisor",
            "a fault is left by itself",
            "            self.state, self.reason = State.INACTIVE, reason\n",
            "            self.state, self.reason = State.READY, reason\n",
        ),
        (
            "arm_controller",
            "signs of life: a state that is repeated for ever",
            "if self._repeats > MAX_REPEATS:",
            "if False:",
        ),
        (
            "arm_controller",
            "a source that restarts elsewhere",
            "if moved.max() > SAME_PLACE:",
            "if False:",
        ),
        (
            "arm_controller",
            "a gap: the motion goes on",
            "if gap > self._resume_gap and gap > PERIODS_OF_GAP * known:",
            "if False:",
        ),
        (
            "arm_controller",
            "a driver that applied nothing for a while: torque at once",
            "elif away > self._resume_gap:",
            "elif False:",
        ),
        (
            "arm_controller",
            "a moving arm: taken over as if at rest",
            "        if _moves(sample):\n            velocity = ",
            "        if False:\n            velocity = ",
        ),
        (
            "arm_controller",
            "a swing: the reference is as fast as it",
            "np.minimum(np.abs(mean), np.abs(sample.velocity))",
            "np.abs(sample.velocity)",
        ),
        (
            "authority",
            "ramp: torque at once",
            "part = min(1.0, (self._elapsed / self._time) ** 2)",
            "part = 1.0",
        ),
        (
            "authority",
            "ramp: without the arm's weight",
            "self._weight[:] = self._holding(q)",
            "self._weight[:] = 0.0",
        ),
        (
            "authority",
            "budget of the rate: none",
            "return np.where(np.isinf(stated), BUDGET * omega * arm.torque_limits, stated)",
            "return stated",
        ),
        (
            "applied",
            "what the driver reports: only too large",
            "wrong = (reported < low) | (reported > high)",
            "wrong = reported > high",
        ),
        (
            "applied",
            "a driver that confirms no longer",
            "return not confirmed and (self._confirms or sample.controller_id != 0)",
            "return not confirmed and sample.controller_id != 0",
        ),
        (
            "arm_controller",
            "a trajectory's torque is not judged",
            "None if judged else self._judge_torque",
            "None",
            TORQUE,
        ),
        (
            "arm_controller",
            "stamps: max_gap",
            "if since_ns > self._max_gap and self.enabled:",
            "if False:",
        ),
        (
            "arm_controller",
            "stamps: max_age, of the future",
            "if abs(age) > self._max_age:",
            "if age > self._max_age:",
        ),
        (
            "samples",
            "stamps: a clock that goes back",
            "return self.NEW if sample.stamp_ns > self.stamp_ns else self.JUMP",
            "return self.NEW",
        ),
        (
            "samples",
            "sequence: an older state",
            "        if ahead >= WRAP // 2:\n",
            "        if False:\n",
        ),
    ),
]
