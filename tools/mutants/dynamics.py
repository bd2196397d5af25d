# SPDX-License-Identifier: Apache-2.0
"""Errors in the kernels and models of the arm."""

from .mutant import of

CHAIN = "flexarm_dynamics/test/test_chain.py"
FORCES = f"{CHAIN}::test_forces_are_those_of_a_second_derivation"
FORWARD = f"{CHAIN}::test_forward_dynamics_solve_what_the_terms_say"
ENERGY = f"{CHAIN}::test_energies_and_momenta_are_sums_over_all_that_has_mass"
IMPLICIT = "flexarm_sim/test/test_chain_simulation.py -k implicit"
ONE_LINK = "flexarm_dynamics/test/test_one_link.py -k kernel"
STEPPER = "flexarm_dynamics/test/test_one_link.py -k stepper"
ORDER = "flexarm_sim/test/test_chain_simulation.py::test_order_of_the_integrators"
ROUNDED = "flexarm_dynamics/test/test_transmission.py -k rounded"

KERNELS = of(
    "flexarm_dynamics",
    "kernels",
    FORCES,
    (
        "transmissions",
        "rounded play: only one flank is rounded",
        "    return x - 0.5 * (np.sqrt(a * a + w2) - np.sqrt(b * b + w2))",
        "    return x - 0.5 * (np.sqrt(a * a + w2) - abs(b))",
        ROUNDED,
    ),
    (
        "bodies",
        "centripetal force of a link: sign of 2 w x c'",
        "t[1, 0], t[1, 1], t[1, 2] = 0.0, 2.0 * cyd, 2.0 * czd",
        "t[1, 0], t[1, 1], t[1, 2] = 0.0, -2.0 * cyd, 2.0 * czd",
    ),
    (
        "bodies",
        "Coriolis force on a mode: factor",
        "wy * along - w2 * gy - 2.0 * wx * gzd",
        "wy * along - w2 * gy - wx * gzd",
    ),
    (
        "bodies",
        "centrifugal force on a mode: missing",
        "wz * along - w2 * gz + 2.0 * wx * gyd",
        "wz * along + 2.0 * wx * gyd",
    ),
    (
        "bodies",
        "coupling of a mode to the joint: sign",
        "w.l[i, j, 1] = -e\n",
        "w.l[i, j, 1] = e\n",
    ),
    ("bodies", "inertia of a bent link: missing", "    J[1, 1] += zz\n", ""),
    ("bodies", "inertia of a bent link: index", "    J[0, 2] -= xz\n", "    J[0, 2] -= xy\n"),
    (
        "bodies",
        "moment of r x (w x r'): sign",
        "N[1] += 2.0 * (wy * rr - (",
        "N[1] += 2.0 * (wy * rr + (",
    ),
    (
        "bodies",
        "foreshortening: factor",
        "            w.node[0, g] = 0.5 * u\n",
        "            w.node[0, g] = u\n",
    ),
    (
        "bodies",
        "foreshortening's acceleration: missing",
        "    F[0] += (wy * wy + wz * wz) * short - link[SHORT_DD]\n",
        "    F[0] += (wy * wy + wz * wz) * short\n",
    ),
    (
        "bodies",
        "foreshortening's moment r x r'': sign",
        "2.0 * (syd * wx - xsd * wy) - zsdd",
        "2.0 * (syd * wx - xsd * wy) + zsdd",
    ),
    (
        "bodies",
        "foreshortening's part of a mode's centrifugal force: missing",
        "            w.q[i, j] -= wx * wz * mode[j, SPHI] - 2.0 * wy * mode[j, SDPHI]\n",
        "            w.q[i, j] += 2.0 * wy * mode[j, SDPHI]\n",
    ),
    (
        "bodies",
        "coupling of modes by foreshortening: missing",
        "+= modes[j, k] if k <= j else modes[k, j]",
        "+= 0.0",
    ),
    (
        "sections",
        "foreshortening of the tip: sign",
        "w.partial[n, j, 0] = -draws[j]",
        "w.partial[n, j, 0] = draws[j]",
    ),
    (
        "bodies",
        "elastic force of finite slopes: missing",
        "kz2 * phi2 + kz2 * kz2 * sz * phi1",
        "kz2 * phi2",
    ),
    (
        "sections",
        "tip's Coriolis acceleration: factor",
        "        t[5, k] += 2.0 * rate[k]\n",
        "        t[5, k] += rate[k]\n",
    ),
    ("sections", "tip's angular acceleration: missing", "    bias_al[0] += ad * bd * ca\n", ""),
    (
        "sections",
        "force of a body on a link, about the joint: missing",
        "            w.N[i, k] += t[3, k] + t[9, k]\n",
        "            w.N[i, k] += t[3, k]\n",
    ),
    (
        "sections",
        "joint's offset from the tip: missing",
        "cross(carried, t[8], t[9])",
        "cross(om, t[8], t[9])",
    ),
    (
        "sections",
        "twist of a tip's frame: sign",
        "-ca * st - sa * sb * ct,",
        "ca * st - sa * sb * ct,",
    ),
    (
        "placing",
        "payload's centrifugal force: missing",
        "    cross(om, w.t[0], zf)\n",
        "    cross(om, s, zf)\n",
    ),
    (
        "recursions",
        "gravity: sign",
        "        w.a0[0, k] = -w.a0[0, k]\n",
        "        w.a0[0, k] = w.a0[0, k]\n",
    ),
    (
        "recursions",
        "rotor: its gear",
        "w.u[n] = d.rotor[n] * (dot(d.axis[n], w.al[n]) + d.gear[n] * qdd[n])",
        "w.u[n] = d.rotor[n] * (dot(d.axis[n], w.al[n]) + qdd[n])",
    ),
    (
        "recursions",
        "articulated inertia: sign of a coupling",
        "- Y[a, k] * S[k, b] - tm[5, a, k]",
        "+ Y[a, k] * S[k, b] - tm[5, a, k]",
        FORWARD,
    ),
    (
        "recursions",
        "elimination of a mode: sign",
        "            w.zn[i, a] += ga * r\n",
        "            w.zn[i, a] -= ga * r\n",
        FORWARD,
    ),
    (
        "recursions",
        "elimination of a joint: rotor missing",
        "D = dot(a, Ua) + d.gear[i] * d.gear[i] * d.rotor[i] + extra",
        "D = dot(a, Ua) + extra",
        FORWARD,
    ),
    (
        "chain",
        "momentum: coupling of a mode missing",
        "                    L[k] += w.l[i, j, k] * delta_d[d.first[i] + j]\n",
        "",
        ENERGY,
    ),
    (
        "implicit_steps",
        "implicit method: gamma",
        "gamma = 1.0 - np.sqrt(0.5)",
        "gamma = 0.5",
        IMPLICIT,
    ),
    (
        "one_link",
        "centrifugal stiffness: sign",
        "r2 = ri + qd * qd * gi",
        "r2 = ri - qd * qd * gi",
        ONE_LINK,
    ),
    ("one_link", "Coriolis torque: factor", "r1 -= 2.0 * qd * gi", "r1 -= qd * gi", ONE_LINK),
    (
        "integrators",
        "viscous friction: sign",
        "fraction * change[i] - friction[i, 0] * rate",
        "fraction * change[i] + friction[i, 0] * rate",
        STEPPER,
    ),
    (
        "integrators",
        "a stage's step",
        "point[v] = state[v] + ahead * rate[v]",
        "point[v] = state[v] + gain * rate[v]",
        ORDER,
    ),
)

MODELS = of(
    "flexarm_dynamics",
    "models",
    "flexarm_sim/test/test_integrators.py",
    (
        "fixed_step",
        "substeps of modes that are not damped: as if they were",
        "PART_OF_DAMPING * 2.0 * np.pi * damping / omega",
        "1.0 + 0.0 * omega",
    ),
    (
        "fixed_step",
        "substeps of damped modes: as if they were not",
        "return fewer",
        "return count",
    ),
    (
        "chain",
        "slow torque: play and slip are left out",
        "or self._transmissions or self._slips:\n            return None",
        "or self._slips:\n            return None",
        "flexarm_dynamics/test/test_straight_arm.py",
    ),
)

ERRORS = [
    *KERNELS,
    *MODELS,
    *of(
        "flexarm_dynamics",
        "",
        "flexarm_dynamics/test/test_sampling.py",
        (
            "sampling",
            "any period: both sides of the noise's series",
            "noise = noise + noise.T",
            "noise = 2.0 * noise",
        ),
        (
            "sampling",
            "any period: transitions add up",
            "Gamma = first.Gamma + first.Phi @ then.Gamma",
            "Gamma = first.Gamma + then.Gamma",
        ),
    ),
    *of(
        "flexarm_dynamics",
        "models",
        "flexarm_dynamics/test/test_levels.py",
        (
            "levels",
            "level: lower than its loads need",
            "    if stiffening > negligible:\n",
            "    if stiffening < negligible:\n",
        ),
        (
            "levels",
            "level: unknown loads are none",
            "        return np.inf, np.inf\n",
            "        return 0.0, 0.0\n",
        ),
        (
            "levels",
            "level: bending that stiffness would prevent is not counted",
            "            error += self._unstiffened(q, qd, delta)\n",
            "            error += 0.0\n",
        ),
        (
            "levels",
            "level: out of range without a warning",
            "        if not beyond and np.isfinite(error):\n",
            "        if np.isfinite(error):\n",
        ),
    ),
    *of(
        "flexarm_dynamics",
        "arm",
        "flexarm_dynamics/test/test_strain_map.py",
        (
            "strain_map",
            "readings: without the gauges' gains",
            "return gains[:, None] * gauge_rows",
            "return gauge_rows",
        ),
    ),
]
