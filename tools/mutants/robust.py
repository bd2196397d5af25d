# SPDX-License-Identifier: Apache-2.0
"""Errors in the design of gains: `flexarm design`."""

from .mutant import of

TESTS = "flexarm_control/test/"

ERRORS = [
    *of(
        "flexarm_control",
        "robust",
        TESTS + "test_verdict.py",
        (
            "whole",
            "verdict: the torque reported is another one",
            "y[-n:, place(whole + 1)] = (1.0 - late / T) * np.eye(n)",
            "y[-n:, place(1)] = np.eye(n)",
        ),
        (
            "whole",
            "verdict: a late torque acts at once",
            "        acts(end, whole)\n",
            "        acts(end, 0)\n",
        ),
        (
            "whole",
            "verdict: a jump counts as a slope",
            "                raise _JumpError\n",
            "                pass\n",
        ),
        (
            "verdict",
            "verdict: the phase is not tried",
            "np.exp(-1j * PHASE)",
            "1.0 + 0.0j * PHASE",
        ),
    ),
    *of(
        "flexarm_control",
        "robust",
        TESTS + "test_robust.py",
        (
            "uncertain",
            "a joint that sticks: as much decay as of one that turns",
            "STICKING = {1.0: 0.1, 0.1: 0.3}",
            "STICKING = {1.0: 0.8, 0.1: 0.9}",
        ),
        (
            "search",
            "start of a search: modes beyond the low pass as well",
            "square <= corner**2",
            "square <= np.inf",
        ),
        (
            "loop",
            "the integral",
            "F[at_w:at_v, :size] = h",
            "F[at_w:at_v, :size] = -h",
        ),
        ("loop", "a late torque acts at once", "add(end, whole)", "add(end, 0)"),
        (
            "decay",
            "every set has all of the gradient",
            "np.outer(self._weights[id(loop)], slope)",
            "np.outer(np.ones(len(self._weights[id(loop)])), slope)",
            TESTS + "test_schedule.py",
        ),
        ("search", "the worst loops are not chosen", "if value > most and", "if value < most and"),
        (
            "search",
            "searches nearby begin where the first one did",
            "search.refined(best[1] * (1.0 + away), AGAIN)",
            "search.refined(x * (1.0 + away), AGAIN)",
        ),
        (
            "search",
            "searches nearby go on when none brings anything",
            "else waited + 1",
            "else waited",
        ),
        (
            "uncertain",
            "no arm of which payload or stiffness alone differs",
            "        if uncertainty.edges\n",
            "        if False\n",
        ),
        (
            "decay",
            "the smooth maximum is none",
            "worst + w * np.log(total)",
            "worst - w * np.log(total)",
        ),
        (
            "card",
            "limits are looked for outwards only",
            "(middle, high) if stable(middle)",
            "(low, high) if stable(middle)",
        ),
        ("card", "half of the phase", "np.exp(-1j * phase)", "np.exp(-0.5j * phase)"),
        ("tip", "the gains' sign", "np.linalg.solve(A - B @ K", "np.linalg.solve(A + B @ K"),
        ("trade", "each speed starts anew", "say, gains))", "say, None))"),
        ("tip", "settling looked for to 20 %", "SETTLED = 0.02", "SETTLED = 0.2"),
    ),
    *of(
        "flexarm_control",
        "robust",
        TESTS + "test_settling.py",
        (
            "settling",
            "after a motion: forces of the file's arm are left out of the gradient",
            "+ A.T @ to_A + to_S @ S.T",
            "+ A.T @ to_A",
        ),
        (
            "settling",
            "after a motion: the other arm's bending is as stiff as the file's",
            "self._forces(self._M - M, self._K - K)",
            "self._forces(self._M - M, 0.0 * K)",
        ),
        (
            "settling",
            "after a motion: joints with friction do not stick",
            "sampling, sticking=part)",
            "sampling, sticking=0.0)",
        ),
        (
            "settling",
            "after a motion: early and late count the same",
            "step * self._time**LATE",
            "step * self._time**0",
        ),
        (
            "search",
            "after a motion: poles may be as slow as they like",
            "            if pole > low:\n",
            "            if False:\n",
        ),
        (
            "further",
            "after a motion: gains are taken however long rubbing joints let a mode ring",
            "if other is x or _rings_longer(",
            "if other is x or not (",
        ),
        (
            "settling",
            "after a motion: joints that do not rub count as what rings",
            "for k, one in self._residuals if one.rubs)",
            "for k, one in self._residuals)",
        ),
        (
            "further",
            "after a motion: every design goes on",
            "if leaves >= one.much / speed",
            "if leaves >= 0.0",
        ),
        (
            "further",
            "after a motion: all loops are asked as much as before",
            "yield eased if loop.kind == MARGIN else least",
            "yield least",
        ),
        (
            "design",
            "after a motion: gains are taken however much torque limits delay the arm",
            "if not delayed(sooner.recovery, made.recovery):",
            "if True:",
        ),
        (
            "settling",
            "after a motion: steps are as long as during it, not so their times",
            "range(self._doublings + self._longer)",
            "range(self._doublings)",
        ),
    ),
    *of(
        "flexarm_control",
        "robust",
        TESTS + "test_recovery.py",
        (
            "recovery",
            "torque limits: none are taken",
            "for most in (limit, np.inf * limit)",
            "for most in (np.inf * limit, np.inf * limit)",
        ),
        (
            "recovery",
            "torque limits: the motion is as long as it likes",
            "given = part * forces @ way, weight + part * torque, weight",
            "given = forces @ way, weight + torque, weight",
        ),
        (
            "design",
            "torque limits: no design is made slower",
            "if found.comes_back or slower.speed < SLOWEST:",
            "if True:",
        ),
        (
            "design",
            "torque limits: the slowest design is taken",
            "other.comes_back or other.recovery.limited < found.recovery.limited",
            "True",
        ),
        (
            "loop",
            "torque limits: torques under way are not changed",
            "effect[at : at + n] = np.eye(n)",
            "effect[at : at + n] = 0.0",
        ),
    ),
    *of(
        "flexarm_control",
        "robust",
        TESTS + "test_default.py",
        (
            "cache",
            "loops of another rate share a design",
            "[content, asdict(settings), asdict(uncertainty)",
            "[content, asdict(uncertainty)",
        ),
        ("cache", "damaged designs are used", 'found["sum"] == _hash', '"sum" in found or _hash'),
        ("default", "what is given is lost", "made.parameters | rest", "rest | made.parameters"),
    ),
]
