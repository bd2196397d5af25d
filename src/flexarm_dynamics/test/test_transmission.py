# SPDX-License-Identifier: Apache-2.0
"""Joints with transmissions: equations of motion, play, energy, prescribed motors, places of rest."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp

from flexarm_dynamics.arm.description import (
    Arm,
    Flexibility,
    Joint,
    Link,
    Payload,
    Transmission,
    scaled,
)
from flexarm_dynamics.arm.encoders import encoder_rows, motors_at_rest
from flexarm_dynamics.kernels import transmissions as kernel
from flexarm_dynamics.linear import linear_plant
from flexarm_dynamics.models.chain import Chain
from flexarm_dynamics.models.fixed_step import METHODS, substeps
from flexarm_dynamics.models.model import rotation
from flexarm_dynamics.singular_perturbation import (
    fast_subsystem,
    quasi_steady_state,
    slow_subsystem,
)

GEAR = Transmission(850.0, 3.0, 0.012, 0.7)


def spatial(gears, flexible=True, gravity=(1.0, -2.0, -9.0)):
    """Three links about three axes; `gears`: the transmission of each joint."""
    rng = np.random.default_rng(7)
    axes = ((0.0, 0.0, 1.0), (0.6, 0.8, 0.0), (0.0, -1.0, 0.0))
    joints = tuple(
        Joint(
            f"joint{i + 1}", axis, (0.1, 0.0, 0.05), tuple(rng.uniform(-1, 1, 3)),
            hub_inertia=0.05, motor_mass=0.3, rotor_inertia=4e-4, gear_ratio=10.0 + i, transmission=gear,
        )
        for i, (axis, gear) in enumerate(zip(axes, gears, strict=True))
    )  # fmt: skip
    stiffness = {"y": 5.0, "z": 7.0, "twist": 3.0}
    every = {d: Flexibility(1, "loaded", (), (0.01,)) for d in stiffness}
    links = tuple(
        Link(f"link{i + 1}", 0.6, 0.5, stiffness, every if flexible and i != 1 else {}, 2e-3)
        for i in range(3)
    )
    inertia = ((2e-3, 1e-4, 0.0), (1e-4, 3e-3, 0.0), (0.0, 0.0, 4e-3))
    payload = Payload(0.2, inertia, (0.05, 0.02, -0.03))
    return Arm("spatial", joints, links, payload, gravity=gravity)


GEARS = (GEAR, None, replace(GEAR, stiffness=300.0))


def swinging(chain, seed=3, deflection=0.02):
    """A state that turns, vibrates and winds its transmissions up."""
    rng = np.random.default_rng(seed)
    n, m = chain.n_joints, chain.n_modes
    return np.concatenate(
        [rng.uniform(-1, 1, n), deflection * rng.uniform(-1, 1, m), rng.uniform(-1, 1, n), rng.uniform(-0.3, 0.3, m)]
    )  # fmt: skip


def single(gear, gravity=(0.0, 0.0, 0.0), rotor=1e-4):
    """One rigid link behind a transmission, and the inertias of link and motor about the joint."""
    joint = Joint(
        "joint1", hub_inertia=0.02, rotor_inertia=rotor, gear_ratio=50.0, transmission=gear
    )
    arm = Arm("single", (joint,), (Link("link1", 0.6, 0.5),), gravity=gravity)
    return Chain(arm), 0.02 + 0.5 * 0.6**3 / 3.0, rotor * 2500.0


def test_coordinates_are_named_after_joints_and_come_after_the_links_modes():
    arm = spatial(GEARS)
    assert arm.mode_names[-2:] == ("joint1_transmission", "joint3_transmission")
    assert arm.mode_names[:-2] == spatial((None,) * 3).mode_names


@pytest.mark.parametrize("level", [{}, {"foreshortening": True}])
def test_accelerations_by_recursion_are_those_of_the_mass_matrix(level):
    """The articulated-body recursion against the Newton-Euler one, and straight-line code against both."""
    chain = Chain(replace(spatial(GEARS), **level))
    state = swinging(chain)
    n, m = chain.n_joints, chain.n_modes
    q, delta, qd, delta_d = np.split(state, [n, n + m, 2 * n + m])
    torque = np.array([1.0, -2.0, 0.5])
    force = -chain.forces(q, qd, delta, delta_d)
    force[:n] += torque
    expected = np.linalg.solve(chain.mass_matrix(q, delta), force)
    found = chain.derivative(state, torque)[n + m :]
    assert_allclose(found, expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())
    if not level:
        stepped = [state.copy(), state.copy()]
        for s, straight in zip(stepped, (True, False), strict=True):
            chain.stepper(METHODS["rk4"], straight_line=straight)(s, torque, 1e-4, 20)
        assert_allclose(stepped[0], stepped[1], rtol=1e-9, atol=1e-12)


def test_kinetic_energy_is_the_links_and_that_of_rotors_that_spin_with_the_motors():
    """Against the arm without transmissions at the links' angles, its rotors replaced by spins of their own."""
    chain = Chain(spatial(GEARS))
    bare = Chain(
        replace(
            chain.arm,
            joints=tuple(
                replace(j, transmission=None, rotor_inertia=0.0) for j in chain.arm.joints
            ),
        ),
        shapes=chain._shapes,
    )
    state, n, m = swinging(chain), 3, chain.n_modes
    q, delta, qd, delta_d = np.split(state, [n, n + m, 2 * n + m])
    bending, slack, slack_d = delta[:-2], np.zeros(3), np.zeros(3)
    slack[[0, 2]], slack_d[[0, 2]] = delta[-2:], delta_d[-2:]
    link, link_d = q + slack, qd + slack_d
    energy = bare.kinetic_energy(link, link_d, bending, delta_d[:-2])
    for i, joint in enumerate(chain.arm.joints):
        R, carrier = np.eye(3), np.zeros(3)
        if i:
            before = chain.arm.links[i - 1]
            carrier = bare.velocity(
                before.name, before.length, link, link_d, bending, delta_d[:-2]
            )[3:]
            R = bare.frames(link, bending)[0][
                i
            ]  # the joint's axis is the same before and after its turn
        else:
            R = rotation(joint.origin_rpy)
        spin = R @ joint.axis @ carrier + joint.gear_ratio * qd[i]
        energy += 0.5 * joint.rotor_inertia * spin**2
    assert chain.kinetic_energy(q, qd, delta, delta_d) == pytest.approx(energy, rel=1e-12)
    assert_allclose(chain.frames(q, delta)[1], bare.frames(link, bending)[1], atol=1e-14)
    assert_allclose(chain.link_ends(q, delta), bare.link_ends(link, bending), atol=1e-14)
    assert_allclose(
        chain.velocity("link3", 0.3, q, qd, delta, delta_d),
        bare.velocity("link3", 0.3, link, link_d, bending, delta_d[:-2]),
        atol=1e-13,
    )


def test_power_goes_in_by_the_motors_and_out_by_dampers():
    chain = Chain(spatial(GEARS))
    state, torque, n, m = (
        swinging(chain, deflection=0.03),
        np.array([1.0, -2.0, 0.5]),
        3,
        chain.n_modes,
    )
    rate = chain.derivative(state, torque)
    step = 1e-6
    power = (chain.energy(state + step * rate) - chain.energy(state - step * rate)) / (2 * step)
    delta, qd, delta_d = state[n : n + m], state[n + m : 2 * n + m], state[2 * n + m :]
    lost = 0.0
    for i in range(3):
        k, first = chain.data.count[i], chain.data.first[i]
        part = delta_d[first : first + k]
        lost += part @ chain.data.damping[i, :k, :k] @ part
    for x, v, gear in zip(delta[-2:], delta_d[-2:], (GEARS[0], GEARS[2]), strict=True):
        s = max(abs(x) - 0.5 * gear.play, 0.0)
        engaged = s**2 / (s**2 + (gear.play / 20.0) ** 2)
        lost += (engaged * gear.damping + gear.load_damping * gear.stiffness * s) * v**2
    assert lost > 0.01
    assert power == pytest.approx(torque @ qd - lost, rel=1e-6)


ROUNDED = replace(GEAR, rounding=0.002, play_damping=0.4)


@pytest.mark.parametrize("gears, beyond", [(GEARS, 0.006), ((ROUNDED, None, ROUNDED), 0.0)])
def test_derivatives_of_the_forces_include_the_transmissions(gears, beyond):
    chain = Chain(spatial(gears))
    state, n, m = swinging(chain, deflection=0.05 if beyond else 0.006), 3, chain.n_modes
    q, delta, qd, delta_d = np.split(state, [n, n + m, 2 * n + m])
    assert (np.abs(delta[-2:]) > beyond).all()
    K, C = chain.linearisation(q, qd, delta, delta_d)
    for j in range(m):
        e = 1e-6 * np.eye(m)[j]
        dK = (
            chain.forces(q, qd, delta + e, delta_d) - chain.forces(q, qd, delta - e, delta_d)
        ) / 2e-6
        dC = (
            chain.forces(q, qd, delta, delta_d + e) - chain.forces(q, qd, delta, delta_d - e)
        ) / 2e-6
        assert_allclose(K[:, j], dK, rtol=1e-6, atol=1e-6 * np.abs(dK).max())
        assert_allclose(C[:, j], dC, rtol=1e-6, atol=1e-6 * np.abs(dC).max())


def test_rounded_flanks_transmit_the_gradient_of_their_energy_and_approach_sharp_ones():
    c, x = np.array([850.0, 0.0, 0.006, 0.0, 0.002, 0.0]), np.linspace(-0.02, 0.02, 41)
    for at in x:
        ends = [kernel.dead_zone_energy(at + h, 0.006, 0.002) for h in (-1e-6, 1e-6)]
        torque = 850.0 * (ends[1] - ends[0]) / 2e-6
        assert kernel.spring_torque(c, at, 0.0) == pytest.approx(torque, rel=1e-6, abs=1e-6)
    assert kernel.spring_torque(c, 0.006, 0.0) == pytest.approx(850.0 * 0.000917237, rel=1e-5)
    sharp = [kernel.dead_zone(at, 0.006, 0.0) for at in x]
    assert_allclose([kernel.dead_zone(at, 0.006, 1e-7) for at in x], sharp, atol=1e-7)
    assert kernel.spring_torque(np.array([850.0, 3.0, 0.006, 0.0, 0.0, 0.4]), 0.0, 2.0) == 0.8


def test_a_rounded_transmission_has_one_motion_in_loops_and_in_straight_line_code():
    chain = Chain(spatial((ROUNDED, None, ROUNDED)))
    assert chain.straight_line is not None
    states = [swinging(chain, deflection=0.006) for _ in range(2)]
    for state, straight in zip(states, (True, False), strict=True):
        chain.stepper(METHODS["rk4"], straight)(state, np.ones(3), 1e-4, 50)
    assert_allclose(*states, rtol=1e-9, atol=1e-12)


def test_a_link_rests_where_rounded_flanks_bear_its_weight():
    for q in (0.3, 1.5, np.pi / 2 + 1e-3):
        chain, _, _ = single(ROUNDED, gravity=(0.0, -9.81, 0.0))
        delta = chain.static_deflection(np.array([q]))
        force = chain.forces(np.array([q]), np.zeros(1), delta, np.zeros(1))[1]
        assert force == pytest.approx(0.0, abs=1e-8)


def test_a_stiff_transmission_is_a_rigid_joint():
    stiff = Chain(spatial((Transmission(1e9),) * 3, flexible=False))
    rigid = Chain(spatial((None,) * 3, flexible=False))
    q, qd, torque = (
        np.array([0.3, -0.5, 0.8]),
        np.array([0.4, 1.0, -0.7]),
        np.array([1.0, -2.0, 0.5]),
    )
    t = stiff.terms(q, qd)
    a, B = slow_subsystem(t)
    t = rigid.terms(q, qd)
    assert_allclose(B, np.linalg.inv(t.M), rtol=1e-6)
    assert_allclose(a + B @ torque, np.linalg.solve(t.M, torque - t.f1), rtol=1e-6)


def test_one_joint_has_the_frequencies_of_two_inertias_on_a_spring():
    chain, link, motor = single(replace(GEAR, play=0.0))
    assert chain.frequencies()[0] == pytest.approx(np.sqrt(850.0 * (1 / link + 1 / motor)))
    assert chain.frequencies(locked=True)[0] == pytest.approx(np.sqrt(850.0 / link))


def test_a_transmission_is_the_fast_coordinate_of_spongs_split():
    """One rigid link behind a spring: k gamma_bar turns the link, both turn as one, and swing on the spring."""
    gear = replace(GEAR, play=0.0, load_damping=0.0)
    chain, link, motor = single(gear)
    t, torque = chain.terms(np.zeros(1), np.zeros(1)), np.array([3.0])
    transmitted = torque * link / (link + motor)
    assert_allclose(-gear.stiffness * quasi_steady_state(t, torque), transmitted, rtol=1e-12)
    assert_allclose(slow_subsystem(t)[1], 1.0 / (link + motor), rtol=1e-12)
    A2, B2 = fast_subsystem(t)
    both = 1.0 / link + 1.0 / motor
    assert_allclose(A2, [[0.0, 1.0], [-gear.stiffness * both, -gear.damping * both]], rtol=1e-12)
    assert_allclose(B2, [[0.0], [-1.0 / motor]], rtol=1e-12)


# --- play --------------------------------------------------------------------------------------


def thrown(times, omega, speed, half):
    """Deflection of a mass thrown at `speed` from the middle of a play of +-half between two springs: exact."""
    free, contact = 2.0 * half / speed, np.pi / omega
    number, rest = np.divmod(times + half / speed, free + contact)
    flying = -half + speed * rest
    pressed = half + speed / omega * np.sin(omega * (rest - free))
    return np.where(number % 2, -1.0, 1.0) * np.where(rest < free, flying, pressed)


@pytest.mark.parametrize("speed", [0.05, 0.3, 2.0])
@pytest.mark.parametrize(
    "method, error, drift",
    [("dop853", 1e-2, 1e-3), ("rk4", 1e-2, 1e-3), ("implicit", 2e-2, 5e-3)],
)
def test_play_against_the_closed_form(speed, method, error, drift):
    """Motor and link fly apart and together: forty changes of flank, at the substeps that a plant takes."""
    chain, link, motor = single(Transmission(850.0, play=0.012))
    omega = np.sqrt(850.0 * (1 / link + 1 / motor))
    period, sample = 2.0 * (0.012 / speed + np.pi / omega), 1e-3
    count = substeps(chain, sample, method)
    rows = int(10 * period / sample)
    states = np.zeros((rows + 1, 4))
    states[0, 2:] = -speed * link / (link + motor), speed  # the centre of mass rests
    none = np.zeros((rows, 1))
    chain.stepper(METHODS[method]).trajectory(states, none, none, sample / count, count)
    exact = thrown(sample * np.arange(rows + 1), omega, speed, 0.006)
    assert np.abs(states[:, 1] - exact).max() < error * np.abs(exact).max()
    energy = np.array([chain.energy(s) for s in states[::7]])
    assert np.ptp(energy) < drift * energy[0]
    assert_allclose(states[:, 0], -link / (link + motor) * states[:, 1], atol=1e-12)


def test_play_with_damping_gravity_and_friction_of_the_flanks_against_events():
    """Against scipy with an event at each flank; the equations of the reference are written out here."""
    chain, link, motor = single(GEAR, gravity=(0.0, -9.81, 0.0))
    moment = 0.5 * 0.6**2 / 2.0
    k, d, half, c = 850.0, 3.0, 0.006, 0.7

    def rate(t, y):
        q, x, qd, xd = y
        s = np.sign(x) * max(abs(x) - half, 0.0)
        tau = k * s + (d * s**2 / (s**2 + (0.1 * half) ** 2) + c * k * abs(s)) * xd
        qdd = (0.3 * t + tau) / motor
        weight = -9.81 * moment * np.cos(q + x)
        return [qd, xd, qdd, (weight - tau) / link - qdd]

    def flank(sign):
        def event(t, y):
            return y[1] - sign * half

        event.terminal = True
        return event

    start = np.array([0.1, 0.0, 0.2, 0.5])
    t, y = 0.0, start
    while t < 1.0:
        leg = solve_ivp(
            rate, (t, 1.0), y, "DOP853", rtol=1e-11, atol=1e-13, events=[flank(1), flank(-1)],
            first_step=1e-6,
        )  # fmt: skip
        t, y = leg.t[-1], leg.y[:, -1]
        if t < 1.0:  # past the flank, so that it does not end where it starts
            y = y + 1e-12 * np.array(rate(t, y))
    state = start.copy()
    count = substeps(chain, 1.0)
    chain.stepper(METHODS["dop853"])(state, np.zeros(1), 1.0 / count, count, None, np.array([0.3]))
    assert_allclose(state, y, rtol=2e-4, atol=1e-6)


def test_a_prescribed_motor_moves_as_prescribed_and_its_link_follows_behind_the_play():
    chain, link, _ = single(Transmission(850.0, 1.0, 0.012), gravity=(0.0, -9.81, 0.0))
    moment = 0.5 * 0.6**2 / 2.0
    state, start = np.array([0.2, 0.004, 0.1, 0.0]), np.array([0.2, 0.004, 0.1, 0.0])
    T, count = 0.5, substeps(chain, 0.5)
    first, change = np.array([2.0]), np.array([-3.0])
    chain.driven_stepper(METHODS["dop853"])(state, first, T / count, count, None, change)
    assert state[0] == pytest.approx(0.2 + 0.1 * T + T**2 * (2.0 / 2.0 - 3.0 / 6.0), abs=1e-12)

    def rate(t, y):
        qdd = 2.0 - 3.0 * t / T
        tau = kernel.spring_torque((850.0, 1.0, 0.006, 0.0, 0.0, 0.0), y[1], y[3])
        return [y[2], y[3], qdd, (-9.81 * moment * np.cos(y[0] + y[1]) - tau) / link - qdd]

    exact = solve_ivp(rate, (0, T), start, "DOP853", rtol=1e-11, atol=1e-13, max_step=1e-4).y[:, -1]
    assert_allclose(state, exact, rtol=1e-3, atol=1e-6)


def test_in_its_play_a_link_is_free_of_the_motor():
    chain, _, _ = single(GEAR)
    state = np.array([0.0, 0.001, 1.0, -1.0])  # the link rests, the motor turns by
    chain.stepper(METHODS["rk4"])(state, np.zeros(1), 1e-5, 400)
    assert_allclose(state, [0.004, -0.003, 1.0, -1.0], atol=1e-12)


# --- rest --------------------------------------------------------------------------------------


@pytest.mark.parametrize("angle, flank", [(0.0, -1.0), (np.pi, 1.0)])
def test_a_link_rests_on_the_flank_that_carries_it(angle, flank):
    chain, _, _ = single(GEAR, gravity=(0.0, -9.81, 0.0))
    x = chain.static_deflection(np.array([angle]))[0]
    load = -9.81 * 0.5 * 0.6**2 / 2.0 * np.cos(angle + x)
    assert x == pytest.approx(flank * 0.006 + load / 850.0, rel=1e-9)


@pytest.mark.parametrize("angle", [-np.pi / 2, -np.pi / 2 + 0.004])
def test_a_link_hangs_within_its_play(angle):
    chain, _, _ = single(GEAR, gravity=(0.0, -9.81, 0.0))
    assert chain.static_deflection(np.array([angle]))[0] == pytest.approx(
        -np.pi / 2 - angle, abs=1e-9
    )


def test_a_link_that_nothing_turns_rests_in_the_middle_of_its_play():
    chain, _, _ = single(GEAR, gravity=(0.0, 0.0, -9.81))
    assert chain.static_deflection(np.zeros(1))[0] == pytest.approx(0.0, abs=1e-12)


def test_flexible_links_behind_play_are_at_rest_in_their_static_deflection():
    chain = Chain(spatial(GEARS, gravity=(0.3, -0.6, -3.0)))
    q, n, m = np.array([0.3, -0.5, 0.8]), 3, chain.n_modes
    delta = chain.static_deflection(q)
    forces = chain.forces(q, np.zeros(n), delta, np.zeros(m))
    assert np.abs(forces[n:]).max() < 1e-9
    assert (np.abs(delta[-2:]) > 0.006).all()


# --- arms without ------------------------------------------------------------------------------


def test_arms_without_transmissions_run_code_without_them():
    bare, geared = Chain(spatial((None,) * 3)), Chain(spatial(GEARS))
    assert not bare.kernel.JOINT_PARTS and geared.kernel.JOINT_PARTS
    assert not bare.complex_kernel.JOINT_PARTS


# --- what controllers know ---------------------------------------------------------------------


def test_a_controller_knows_the_arm_with_its_links_fixed_to_the_motors():
    arm = replace(spatial(GEARS), observed_modes=("link1_y_mode1",))
    known = arm.known
    assert known.mode_names == spatial((None,) * 3).mode_names
    assert known.joints[0].inertia == arm.joints[0].inertia
    assert known.whole is arm and arm.whole is arm and known.known is known
    assert bare_arm().known.simplifies is None
    changed = scaled(known.with_modes(2), payload=2.0)
    assert changed.whole.payload.mass == changed.payload.mass == 2.0 * arm.payload.mass
    assert changed.whole.joints == arm.joints
    assert len(changed.whole.mode_names) == len(changed.mode_names) + 2


def bare_arm():
    """Without transmissions."""
    return spatial((None,) * 3)


def test_linear_models_take_the_play_as_closed():
    chain, link, motor = single(replace(GEAR, damping=0.0))
    A, _ = linear_plant(chain, np.zeros(1))
    omega = np.sqrt(850.0 * (1 / link + 1 / motor))
    assert np.abs(np.linalg.eigvals(A)).max() == pytest.approx(omega, rel=1e-6)
    assert bare_arm().without_play == bare_arm()


@pytest.mark.parametrize("encoder", ["motor", "link"])
def test_an_encoder_reads_the_motor_or_the_link(encoder):
    arm = single(GEAR, gravity=(0.0, -9.81, 0.0))[0].arm
    chain = Chain(replace(arm, joints=(replace(arm.joints[0], encoder=encoder),)))
    assert_allclose(encoder_rows(chain), [[1.0, float(encoder == "link")]])
    motor, delta = motors_at_rest(chain, np.array([0.3]))
    assert encoder_rows(chain) @ np.concatenate([motor, delta]) == pytest.approx(0.3, abs=1e-12)
    assert chain.static_deflection(motor) == pytest.approx(delta, abs=1e-12)
    assert delta[0] < -0.006
