# SPDX-License-Identifier: Apache-2.0
"""Errors in observers, the checks of readings, and the estimate of the payload."""

from .mutant import of

TESTS = "flexarm_control/test/"

ERRORS = [
    *of(
        "flexarm_control",
        "payload",
        "flexarm_control/test/test_payload_estimator.py",
        (
            "estimator",
            "strains and torques that contradict each other are used",
            "if self.low > self.high:",
            "if False:",
        ),
        (
            "estimator",
            "weight and inertia of the strains: sign",
            "strains.add(Y[n:], -need[n:], W, spring, errors, dt)",
            "strains.add(Y[n:], need[n:], W, spring, errors, dt)",
        ),
    ),
    *of(
        "flexarm_control",
        "observers",
        TESTS + "test_observers.py",
        (
            "filtered_derivative",
            "settling",
            "dt, self.bandwidth, self.amplitude",
            "dt, 2.0 * self.bandwidth, self.amplitude",
        ),
        (
            "luenberger",
            "its correction: missing",
            "predicted[m:] + L @ self.innovation",
            "predicted[m:]",
        ),
        ("true_rates", "a rate", "self.rate[:] = sample.rate", "self.rate[:] = 0.0"),
        (
            "kalman",
            "noise of the process: missing",
            "        P += step.Q\n",
            "",
            TESTS + "test_kalman.py",
        ),
        (
            "motion",
            "the rest of a step: missing",
            "        out += rest * (rate + (0.5 * rest) * (step.A @ rate))\n",
            "        pass\n",
            TESTS + "test_kalman.py",
        ),
        (
            "motion",
            "foreseen acceleration: the torque's change missing",
            "rate[self._size :] += foreseen.push @ change",
            "rate[self._size :] += 0.0",
            TESTS + "test_kalman.py",
        ),
        (
            "extended_kalman",
            "payload's scale",
            "one = (2.0 - s) * model.mass_matrix(q, delta)",
            "one = (1.0 - s) * model.mass_matrix(q, delta)",
            TESTS + "test_kalman.py",
        ),
        (
            "motion_kalman",
            "motion_kalman: the joints' acceleration does not move the links",
            "force = M[n:, :n] @ a + modal_forces(",
            "force = 0.0 * M[n:, :n] @ a + modal_forces(",
            TESTS + "test_motion_kalman.py",
        ),
        (
            "motion_kalman",
            "motion_kalman: no bias is measured",
            "self._C[n:, self._bias] = np.eye(g)",
            "self._C[n:, self._bias] = 0.0",
            TESTS + "test_motion_kalman.py",
        ),
        (
            "motion_kalman",
            "motion_kalman: the shared noise is white",
            "Phi[last, last] = self._companion",
            "Phi[last, last] = 0.0",
            TESTS + "test_motion_kalman.py",
        ),
        (
            "innovation_memory",
            "innovation_memory: one sample is remembered",
            "np.concatenate([scaled, self._past[: -scaled.size]])",
            "np.concatenate([scaled, 0.0 * self._past[: -scaled.size]])",
            TESTS + "test_innovation_memory.py",
        ),
        (
            "gauge_health",
            "a gauge that is silent",
            "self.health[~np.isfinite(strain)] = MISSING",
            "self.health[~np.isfinite(strain)] = GOOD",
            TESTS + "test_gauge_health.py",
        ),
    ),
    *of(
        "flexarm_control",
        "observers/plausibility",
        TESTS + "test_reading_checks.py",
        (
            "amplitudes",
            "amplitudes beside strains: as much as they are",
            "+ SHARE * large",
            "+ 2.5 * large",
        ),
        (
            "channels",
            "light joints: in the first configuration alone",
            "self.heavy = bool(max(light) <= LIGHT)",
            "self.heavy = bool(light[0] <= LIGHT)",
        ),
        (
            "channels",
            "gauges: what a torque does at once, not while the modes turn",
            "strains = np.maximum(strains, _largest(shown))",
            "pass",
        ),
        (
            "channels",
            "light joints: no mode more than the arm file has",
            "model.fuller(model.arm.most_modes + 1)",
            "model",
        ),
        (
            "channels",
            "amplitudes as gauges show them: only the modes of the file",
            "bends = np.maximum(bends, _largest([shown @ each for _, each in means]))",
            "pass",
        ),
    ),
]
