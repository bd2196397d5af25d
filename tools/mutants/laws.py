# SPDX-License-Identifier: Apache-2.0
"""Errors in slow and fast laws, manifolds, feed-forwards and what joins them."""

from .mutant import of

TESTS = "flexarm_control/test/"
PLANS = "flexarm_studies/test/test_plans.py flexarm_control/test/test_planner.py"

ERRORS = [
    *of(
        "flexarm_control",
        "slow",
        TESTS + "test_slow_laws.py",
        (
            "linear_model_following",
            "the inertia: factor",
            "return self.B_inverse(terms) @ self._wanted(",
            "return 0.98 * self.B_inverse(terms) @ self._wanted(",
        ),
        (
            "model_following",
            "(13): a sign",
            "self.Lambda1 = -np.array(",
            "self.Lambda1 = np.array(",
        ),
        (
            "computed_torque",
            "gravity and velocity torque: missing",
            "u = np.linalg.solve(B, v - a)",
            "u = np.linalg.solve(B, v)",
        ),
        (
            "joint_pid",
            "the integral grows beyond the torque limit",
            "np.where(self._beyond * self._error > 0.0, 0.0, self._error)",
            "self._error",
        ),
        (
            "resolved_acceleration",
            "null space: missing",
            "return y + self.damped_inverse(J) @ (b - J @ y)",
            "return self.damped_inverse(J) @ (b - J @ y)",
        ),
        (
            "sliding_mode",
            "surface: sign",
            "s = rate + self.slope * error",
            "s = rate - self.slope * error",
        ),
        (
            "adaptive_model_following",
            "regressor: velocity torque missing",
            "Y += self._coriolis(self._difference, q, qd, speed)",
            "Y += 0.0",
        ),
    ),
    *of(
        "flexarm_control",
        "composite",
        "flexarm_studies/test/test_payload_estimate.py -k step",
        (
            "law",
            "another payload's torque: missing in the sample in which the integral takes it",
            "                self.torque += taken\n",
            "",
        ),
    ),
    *of(
        "flexarm_control",
        "kernels",
        TESTS + "test_recovery.py",
        (
            "steps",
            "torque limits: the integral goes on",
            "(X[k + 1, at] - X[k, at]) * wanted[i] < 0.0",
            "(X[k + 1, at] - X[k, at]) * wanted[i] < -np.inf",
        ),
    ),
    *of(
        "flexarm_control",
        "kernels",
        TESTS + "test_reading_checks.py",
        (
            "strains",
            "signs of gauges: no Coriolis forces on bending links",
            "moved[j] + turn[i, j] * rate",
            "moved[j] + 0.0 * rate",
        ),
    ),
    *of(
        "flexarm_control",
        "kernels",
        TESTS + "test_pole_kernels.py",
        ("poles", "the gradient's sign", "by_torque /= -period", "by_torque /= period"),
        (
            "poles",
            "half of a reflector",
            "x[i] -= along * H[k, i]",
            "x[i] -= 0.5 * along * H[k, i]",
        ),
        ("poles", "poles in the order of LAPACK", "v[k, i - 1] < value", "v[k, i - 1] < -np.inf"),
        ("poles", "growing poles are asked little", "if s.real >= 0.0:", "if s.real >= 1e9:"),
    ),
    *of(
        "flexarm_control",
        "fast",
        TESTS + "test_fast_laws.py",
        (
            "lqr",
            "(20): alpha missing",
            "_solve(A2 + alpha * np.eye(A2.shape[0]), B2, q, parameters)",
            "_solve(A2, B2, q, parameters)",
        ),
        (
            "pole_placement",
            "damping's sign",
            "wanted = np.stack([-damping * omega + imaginary",
            "wanted = np.stack([damping * omega + imaginary",
        ),
        (
            "output_feedback",
            "its estimator's gain",
            "(1.0 - rho) * (Phi[m:, m:] @ inverse",
            "(1.0 + rho) * (Phi[m:, m:] @ inverse",
        ),
        (
            "fixed_gain",
            "rows and columns of the gain",
            "self._sets, self._now.reshape(-1))",
            "self._sets, self._now.T.reshape(-1))",
        ),
        ("scheduled_lqr", "interpolation", "for v in (1.0 - t, t)]", "for v in (t, 1.0 - t)]"),
    ),
    *of(
        "flexarm_control",
        "manifold",
        TESTS + "test_manifolds.py",
        (
            "expansion",
            "terms of the centre: of the first point",
            "t, centre = terms, len(terms.M) // 2",
            "t, centre = terms, 0",
            TESTS + "test_control_kernels.py",
        ),
        (
            "corrected",
            "the error's own motion: sign",
            "kp * later[:n] + kv * later[n:]",
            "kp * later[:n] - kv * later[n:]",
        ),
        (
            "corrected",
            "the error's own velocity: sign",
            "motion[1] -= later[n:]",
            "motion[1] += later[n:]",
        ),
        (
            "quasi_steady",
            "(9): gone",
            "self.amplitude[:] = quasi_steady_state(terms, slow_torque)",
            "self.amplitude[:] = 0.0",
        ),
        (
            "reference",
            "its feed-forward: gone",
            "self.feedforward[:] = found.beyond",
            "self.feedforward[:] = 0.0",
        ),
    ),
    *of(
        "flexarm_control",
        "composite",
        TESTS + "test_composite.py",
        (
            "seen",
            "a motion that is put elsewhere: seen from before",
            "dt > 0.0 and not motion.placed",
            "dt > 0.0",
        ),
        (
            "seen",
            "another control of the same motion: remembers nothing",
            "self._states[:], self._intervals[:] = other._states, other._intervals",
            "pass",
        ),
        (
            "law",
            "a law that is replaced: not faded",
            "fading.jump(old)",
            "fading.clear()",
        ),
        (
            "law",
            "the manifold without a feed-forward: not faded",
            "fading.jump(old - np.concatenate([u, amplitude, rate]))",
            "fading.clear()",
        ),
    ),
    *of(
        "flexarm_control",
        "feedforward",
        TESTS
        + "test_look_ahead.py flexarm_control/test/test_model_feedforward.py"
        + " flexarm_studies/test/test_beyond_the_paper.py",
        (
            "model",
            "the regulator's gain: sign",
            "    return K @ V.T\n",
            "    return -K @ V.T\n",
        ),
        (
            "model",
            "jumps of the manifold: not faded",
            "fading.jump(self._continued(before, dt) - now)",
            "fading.clear()",
        ),
        (
            "preview",
            "a speed that is scaled on the way: the plan is dropped",
            "or not path.kept:",
            "or path.scaled:",
        ),
        (
            "preview",
            "a speed that is scaled on the way: the plan's bending does not fade",
            "left = min(path.kept, path.pace(stamp_ns, offset))",
            "left = 3.0",
        ),
        (
            "preview",
            "torque of the coming period",
            "plan.torque_at(elapsed + 0.5 * self.settings.period)",
            "0.9 * plan.torque_at(elapsed)",
        ),
    ),
    *of(
        "flexarm_control",
        "kernels",
        TESTS + "test_manifolds.py",
        (
            "manifold",
            "inertia of the bending: sign",
            "zero[i, a] - higher[i, a]",
            "zero[i, a] + higher[i, a]",
        ),
    ),
    *of(
        "flexarm_control",
        "kernels",
        TESTS + "test_reading_checks.py",
        (
            "readings",
            "a velocity beside its position: torque steps between samples",
            "between *= 0.25 * dt * dt",
            "between *= 0.0",
        ),
        (
            "readings",
            "a joint that stands: what others' friction may hold",
            "doubt += abs(inertia[i, j]) * unsure[j]",
            "doubt += abs(inertia[i, j]) * unsure[j] * (i == j)",
        ),
        (
            "strains",
            "what the motion does not explain: the strains' own inertia",
            "inertia += load[i, j] * moved[j]",
            "inertia -= load[i, j] * moved[j]",
        ),
    ),
    *of(
        "flexarm_control",
        "kernels",
        TESTS + "test_arm_controller.py " + TESTS + "test_plausibility.py",
        (
            "limits",
            "velocity limit: never",
            "abs(error[i]), abs(qd[i])",
            "abs(error[i]), 0.0",
        ),
        (
            "limits",
            "deflection limit: only one sign",
            "value[3 * n + i] = abs(amplitude[i])",
            "value[3 * n + i] = amplitude[i]",
        ),
        (
            "limits",
            "strain limit: never",
            "value[3 * n + m + k] = abs(strain)",
            "value[3 * n + m + k] = 0.0",
        ),
        (
            "limits",
            "tracking error: only one sign",
            "abs(error[i]), abs(qd[i])",
            "error[i], abs(qd[i])",
        ),
        (
            "limits",
            "braking distance: factor",
            "abs(qd[i]) / (2.0 * able)",
            "abs(qd[i]) / (20.0 * able)",
        ),
    ),
    *of(
        "flexarm_control",
        "feedforward",
        PLANS,
        (
            "planner",
            "torque left to the feedback: a twentieth",
            "np.append(most - here, most + here)",
            "0.95 - np.append(here, -here)",
        ),
        (
            "planner",
            "torque left to the feedback: only beyond the limit",
            "<= most).all()",
            "<= 1.0).all()",
        ),
        (
            "planner",
            "a weight that takes most of the torque: as the motion's torque",
            "row[:] = torque_for_motion(1.0, weight / self.limit, self.share)",
            "pass",
        ),
        (
            "planner",
            "a plan that does not converge has no more derivatives",
            "KNOTS, SMALL = (80, 400), 1e-6",
            "KNOTS, SMALL = (80, 80), 1e-6",
        ),
        (
            "planner",
            "a plan beyond all bounds is not made again",
            "if finer.steps == planner.steps:",
            "if True:",
        ),
        (
            "planner",
            "modes that no torque reaches: planned at the model's frequency alone",
            "stiffness = (1.0 + self.spread * part) ** 2",
            "stiffness = 1.0",
        ),
        (
            "planner",
            "modes that no torque reaches: brought to rest at the model's frequency, like the others",
            "self.driven = coupling[:slow] > UNDRIVEN * coupling.max(initial=0.0)",
            "self.driven = coupling[:slow] >= 0.0",
        ),
        (
            "planner",
            "penalised torque: values",
            "np.linalg.solve(half, R @ free - values[active])",
            "np.linalg.solve(half, R @ free)",
        ),
    ),
]
