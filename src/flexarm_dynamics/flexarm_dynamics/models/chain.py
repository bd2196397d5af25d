# SPDX-License-Identifier: Apache-2.0
r"""The general model: arms with any number of rigid or flexible links, evaluated by `kernels.chain`.

A link is a beam along its frame's x axis, uniform or with sections that change along it. It bends (Euler-Bernoulli, no
rotary inertia of the sections in bending) and twists (with the sections' polar inertia) in the assumed modes of the arm
file: :math:`y(x,t)=\sum_i\phi_i(x/L)\delta_i(t)`. A link can also be given by reduced matrices, which have modes of
their own (`arm.reduced`). The mass matrix depends on the deflections. At the arm's `level` no term of the Lagrangian is
left out:

- first order: displacements are linear in delta, and the tip turns by its slopes (y' about z, -z' about y, twist);
- `foreshortening`: the axis keeps its length to second order, so that a spinning link is stiffer;
- `finite_slope`: the axis keeps its length exactly, its curvature is y''/sqrt(1 - y'^2), the tip turns by
  arcsin y'.

The hub's inertia turns with its link. A rotor behind a gear of ratio N spins at ``a . w_carrier + N qd``. The motor's
mass is at the joint and moves with the previous link, as does its housing. Without deflections, `Chain.terms` gives the
paper's control model (assumptions a) and b): no deflections in the mass matrix, no products of deflections).
"""

from functools import cached_property

import numpy as np

from ..arm.description import REDUCED, scaled
from ..errors import ModelError, check_shape
from ..kernels import (
    bodies,
    chain,
    chain_data,
    generated,
    implicit_steps,
    integrators,
    load,
    placing,
    recursions,
    sections,
    straight_arm,
    transmissions,
    vectors,
)
from .assembly import (
    assemble,
    bishop_integrals,
    modes_of,
    nodes_of,
    outboard,
    packed,
    roomy,
    shapes_of,
    work_space,
)
from .model import ArmModel, Stepper, Terms, about_axis, explicit_stepper, rotation

#: Kernel modules, each after those whose functions it calls.
_MODULES = (
    chain_data, vectors, sections, bodies, placing, transmissions, recursions, chain, implicit_steps, integrators,
)  # fmt: skip
CHAIN_SOURCES = tuple(load.source(module) for module in _MODULES)
#: Sources for arms without transmissions, without housings, and without friction beyond Coulomb's.
PLAIN_SOURCES = (
    CHAIN_SOURCES[0].replace("JOINT_PARTS = True", "JOINT_PARTS = False"),
    *CHAIN_SOURCES[1:],
)

#: Functions that are short enough to be inlined in the integrators' loops.
INLINE = ("derivative", "net_torque", "low_storage")

#: Imaginary step of the complex-step derivatives: no difference is taken, so no digits are lost.
STEP = 1e-30


class Chain(ArmModel):
    """A serial chain of flexible links (module docstring).

    Parameters
    ----------
    arm : Arm
    compiled : bool
        False: evaluate the kernels as plain Python, for debugging; about a hundred times slower.
    shapes : mapping, optional
        (link, direction) to `beam.ModeShapes`; if not given, the shapes follow from this arm's own loads.
    """

    def __init__(self, arm, compiled=True, shapes=None):
        super().__init__(arm)
        self._compiled = compiled
        loads = outboard(arm)
        if shapes is None:
            shapes = {
                (link.name, direction): shapes_of(link, direction, flexibility, body)
                for link, body in zip(arm.links, loads, strict=True)
                for direction, flexibility in link.flexible.items()
            }
        self._shapes = dict(shapes)
        self.data = assemble(arm, self._shapes, loads)
        self._check_inertia()

    @property
    def _sources(self):
        parts = self._transmissions or self._slips or self.data.housed.any()
        return CHAIN_SOURCES if parts else PLAIN_SOURCES

    @cached_property
    def _slips(self):
        """Joints with friction beyond Coulomb's."""
        return [i for i, c in enumerate(self.data.slip) if c[0] or c[2]]

    @cached_property
    def kernel(self):
        """The kernels: compiled on first use, or plain."""
        return load.joined("chain", self._sources, self._compiled)

    @cached_property
    def complex_kernel(self):
        """The kernels for complex numbers: a separate module, so that both can be compiled at the same time."""
        return load.joined("chain_complex", self._sources, self._compiled)

    @cached_property
    def _room(self):
        return roomy(self.data)

    def _packed(self, data):
        return packed(data, chain_data.DATA, self._room) if self._compiled else (data,)

    def _new_work(self, dtype=float):
        if not self._compiled:
            return (work_space(self.data, dtype),)
        return packed(work_space(self.data, dtype, self._room), chain_data.WORK, self._room)

    @cached_property
    def _data(self):
        return self._packed(self.data)

    @cached_property
    def _work(self):
        return self._new_work()

    @cached_property
    def _complex_work(self):
        return self._new_work(complex)

    def _check_inertia(self):
        """Refuse an arm that can move without moving mass: for example a link without polar inertia about its axis."""
        n = self.n_joints
        for q in (np.zeros(n), 0.7 + np.arange(n)):
            M = self.mass_matrix(q)
            scale = 1.0 / np.sqrt(np.maximum(np.diag(M), 1e-300))
            values, vectors = np.linalg.eigh(M * np.outer(scale, scale))
            weightless = np.flatnonzero(np.diag(M)[:n] <= 1e-14 * np.diag(M)[:n].max())
            if weightless.size or values[0] <= 1e-13:
                worst = np.abs(vectors[:, 0])
                i = int(weightless[0] if weightless.size else np.argmax(worst[:n]))
                raise ModelError(
                    "can turn without moving any mass",
                    field=f"joints[{i}]",
                    value=self.joint_names[i],
                    hint="give it a hub_inertia, or its link a polar_inertia_per_length",
                )

    def mode_shapes(self, link, direction):
        try:
            return self._shapes[link, direction]
        except KeyError:
            raise ModelError("has no modes", field=f"{link} in {direction}") from None

    def with_payload(self, scale):
        arm = scaled(self.arm, payload=scale)
        return self._carrying(scale, type(self)(arm, self._compiled, self._shapes))

    # Equations of motion -----------------------------------------------------------------------

    def mass_matrix(self, q, delta=None):
        """M of (2), shape (n + m, n + m)."""
        n, m = self.n_joints, self.n_modes
        q, delta = self._joint(q, "q"), self._modal(delta, "delta")
        M = np.zeros((n + m, n + m))
        self.kernel.mass_matrix(
            self._data, self._work, q, delta, np.zeros(n), np.zeros(m), np.zeros(3), M
        )
        return M

    def forces(self, q, qd, delta=None, delta_d=None):
        """Generalised forces at zero acceleration, without friction; shape (n + m,).

        Coriolis, centrifugal, gravitational and elastic forces and modal damping: all of (2) except the term with M.
        """
        return self._forces(q, qd, None, delta, delta_d, None)

    def _forces(self, q, qd, qdd, delta, delta_d, delta_dd):
        """`inverse_dynamics` without friction; None: zero."""
        out = np.zeros(self.n_joints + self.n_modes)
        qdd = np.zeros(self.n_joints) if qdd is None else self._joint(qdd, "qdd")
        delta, delta_d = self._modal(delta, "delta"), self._modal(delta_d, "delta_d")
        self.kernel.generalised_forces(
            self._data, self._work, self._joint(q, "q"), delta, self._joint(qd, "qd"), delta_d,
            qdd, self._modal(delta_dd, "delta_dd"), out,
        )  # fmt: skip
        for j, constants in self._transmissions:
            out[self.n_joints + j] += transmissions.spring_torque(constants, delta[j], delta_d[j])
        return out

    @cached_property
    def _transmissions(self):
        """(index in delta, constants) of each transmission."""
        d = self.data
        return [(d.spring[i], d.transmission[i]) for i in np.flatnonzero(d.spring >= 0)]

    def transmitted_torque(self, delta, delta_d):
        """Torque from each link to its motor through the transmission, (k, n) [N m]; NaN for joints without one.

        `delta` and `delta_d` are amplitudes and rates, both (k, m).
        """
        out = np.full((len(delta), self.n_joints), np.nan)
        for i in np.flatnonzero(self.data.spring >= 0):
            j, constants = self.data.spring[i], self.data.transmission[i]
            out[:, i] = transmissions.spring_torque(constants, delta[:, j], delta_d[:, j])
        return out

    def inverse_dynamics(self, q, qd, qdd, delta=None, delta_d=None, delta_dd=None):
        """As `ArmModel.inverse_dynamics`; arguments that are not given are zero."""
        out = self._forces(q, qd, qdd, delta, delta_d, delta_dd)
        out[: self.n_joints] += self.friction(self._joint(qd, "qd"), delta, delta_d)
        return out

    def linearisation(self, q, qd, delta=None, delta_d=None):
        r"""Derivatives of `forces` by delta and by its rates, to machine precision (complex step).

        Without deflections, all play is closed: transmissions have their stiffness and damping in contact.

        Returns
        -------
        K, C : ndarray, shape (n + m, m)
            :math:`\partial/\partial\delta` and :math:`\partial/\partial\dot\delta`.
        """
        n, m = self.n_joints, self.n_modes
        K, C = np.zeros((n + m, m)), np.zeros((n + m, m))
        arrays = (
            self._joint(q, "q"),
            self._modal(delta, "delta"),
            self._joint(qd, "qd"),
            self._modal(delta_d, "delta_d"),
        )
        zeros = (np.zeros(n, complex), np.zeros(m, complex), np.zeros(n + m, complex))
        self.complex_kernel.linearise(
            self._data, self._complex_work, *(a.astype(complex) for a in arrays), STEP, *zeros, K, C
        )
        if delta is None:
            self._close_play(K, C)
        else:
            self._add_transmissions(K, C, arrays[1], arrays[3])
        return K, C

    def _close_play(self, K, C):
        """Add stiffness and damping of the transmissions in contact to derivatives of the forces."""
        for j, (stiffness, damping, *_) in self._transmissions:
            K[self.n_joints + j, j] += stiffness
            C[self.n_joints + j, j] += damping

    def _add_transmissions(self, K, C, delta, delta_d):
        """Add derivatives of the transmissions' torque, including the play."""
        for j, c in self._transmissions:
            stiffness, damping, half, load, rounding, within = c
            s, row = transmissions.dead_zone(delta[j], half, rounding), self.n_joints + j
            C[row, j] += transmissions.spring_damping(c, s)
            slope = transmissions.dead_zone_slope(delta[j], half, rounding)
            width2 = (chain_data.ENGAGEMENT * half + rounding) ** 2
            rise = 2.0 * s * width2 / (s * s + width2) ** 2 if half else 0.0
            rate = (damping - within) * rise + load * stiffness * np.sign(s)
            K[row, j] += slope * (stiffness + rate * delta_d[j])

    def terms(self, q, qd, delta=None, delta_d=None):
        """Terms of (2).

        C and K are the derivatives of the forces by delta_d and delta at the straight arm (Jacobian of the
        elastic, centrifugal, Coriolis and gravitational forces). Without deflections, f is the force at the straight
        arm: this is the paper's control model, assumptions a) and b). With deflections, f also contains the products of
        deflections, so f + C delta_d + K delta is exact.
        """
        n = self.n_joints
        q, qd = self._joint(q, "q"), self._joint(qd, "qd")
        f, K, C, M = self._straight_arm(q, qd)
        if delta is not None:
            delta, delta_d = self._modal(delta, "delta"), self._modal(delta_d, "delta_d")
            f = self.forces(q, qd, delta, delta_d) - K @ delta - C @ delta_d
            f[:n] += self.friction(qd, delta, delta_d)
            M = self.mass_matrix(q, delta)
        return Terms(M=M, f1=f[:n], f2=f[n:], C1=C[:n], C2=C[n:], K1=K[:n], K2=K[n:])

    def _straight_arm(self, q, qd):
        """Forces with the joints' friction, K, C and M without deflections."""
        n = self.n_joints
        if self._tape is None:
            K, C = self.linearisation(q, qd)
            f = self.forces(q, qd)
            f[:n] += self.friction(qd)
            return f, K, C, self.mass_matrix(q)
        f, K, C, M = self._tape(q, qd)
        self._close_play(K, C)
        for i in self._slips:
            f[i] += self._slip_torque(i, qd[i])
        return f, K, C, M

    @cached_property
    def _tape(self):
        """Recorded terms of the straight arm, for control laws that need them at every sample; None if not recorded."""
        if not self._compiled or self.data.level != chain_data.FIRST_ORDER:
            return None
        return self._recorded(straight_arm.Terms)

    def _recorded(self, kind):
        return kind(self.data, lambda dtype: work_space(self.data, dtype), self.friction_table())

    @cached_property
    def _slow_tape(self):
        """Recorded torque of the slow subsystem; None if no terms are recorded, or if `_straight_arm` adds to them."""
        if self._tape is None or self._transmissions or self._slips:
            return None
        return self._recorded(straight_arm.SlowTorque)

    def terms_along(self, motions):
        if self._tape is None or self._transmissions or self._slips:
            return super().terms_along(motions)
        n = self.n_joints
        f, K, C, M = self._tape.along(np.ascontiguousarray(motions, float))
        return Terms(
            M=M, f1=f[:, :n], f2=f[:, n:], C1=C[:, :n], C2=C[:, n:], K1=K[:, :n], K2=K[:, n:]
        )

    def slow_torque(self, q, qd, acceleration):
        if self._slow_tape is None:
            return super().slow_torque(q, qd, acceleration)
        q, qd = self._joint(q, "q"), self._joint(qd, "qd")
        return self._slow_tape(q, qd, self._joint(acceleration, "acceleration"))

    def derivative(self, state, torque):
        n, m = self.n_joints, self.n_modes
        state = np.asarray(state, float)
        check_shape(state, (2 * (n + m),), "state")
        out = np.empty_like(state)
        net = np.asarray(torque, float) - super().friction(state[n + m : 2 * n + m])
        self.kernel.derivative(state, net, (self._data, self._work, *self._none), out)
        return out

    @cached_property
    def _none(self):
        """Arguments of the forward recursion for a free motion: no extra inertia, no driven joint."""
        n, K = self.data.links, self.data.s.shape[1]
        return np.zeros((n, 2)), np.zeros((n, K, K)), np.zeros(n, np.int64), np.zeros(self.n_modes)

    def friction(self, qd, delta=None, delta_d=None):
        out = super().friction(qd)
        for i in self._slips:
            out[i] += self._slip_torque(i, qd[i], delta, delta_d)
        return out

    def _slip_torque(self, i, rate, delta=None, delta_d=None):
        """Friction of joint i beyond Coulomb's [N m]."""
        delta, delta_d = self._modal(delta, "delta"), self._modal(delta_d, "delta_d")
        level = transmissions.slip_level(self.data, i, delta, delta_d, rate)
        return level * np.tanh(rate / self.data.slip[i, 3])

    def stiffness_matrix(self):
        m = self.n_modes
        out = np.zeros((m, m))
        for i in range(self.data.links):
            a, k = self.data.first[i], self.data.count[i]
            out[a : a + k, a : a + k] = self.data.stiffness[i, :k, :k]
        for j, constants in self._transmissions:
            out[j, j] = constants[0]
        return out

    def without_play(self):
        return self if self.arm.without_play is self.arm else self._closed

    @cached_property
    def _closed(self):
        return type(self)(self.arm.without_play, self._compiled, self._shapes)

    def transmission_rates(self):
        """As `ArmModel.transmission_rates`: rates of spring or damper in a straight arm that is otherwise free."""
        if not self._transmissions:
            return 0.0, 0.0
        H = np.linalg.inv(self.mass_matrix(np.zeros(self.n_joints)))
        rates = []
        for j, (stiffness, damping, half, _, _, within) in self._transmissions:
            h = H[self.n_joints + j, self.n_joints + j]
            rates.append((np.sqrt(stiffness * h), 0.5 * max(damping, within) * h, half > 0.0))
        fastest = max(max(omega, damped) for omega, damped, _ in rates)
        return fastest, max((omega for omega, _, play in rates if play), default=0.0)

    def static_deflection(self, q):
        """As `ArmModel.static_deflection`; with play, each link rests on the flank to which its load presses it.

        A link without load rests in the middle of its play. A link that neither flank holds hangs within its play.
        """
        sharp = self._on_flanks(q)
        rounded = [(j, c) for j, c in self._transmissions if c[4] > 0.0]

        def soften(delta, force, K2):
            for j, c in rounded:
                K2[j, j] -= c[0] * (1.0 - transmissions.dead_zone_slope(delta[j], c[2], c[4]))

        return self._rest(q, soften, sharp) if rounded else sharp

    def _on_flanks(self, q):
        """`static_deflection` with sharp corners of the play."""
        play = [(j, c) for j, c in self._transmissions if c[2] > 0.0]
        if not play or not any(self.arm.gravity):
            return super().static_deflection(q)
        rest, none = np.zeros(self.n_joints), np.zeros(self.n_modes)
        load = -self.forces(q, rest, none, none)[self.n_joints :]
        side = {j: np.sign(load[j]) * (abs(load[j]) > 1e-9 * c[0] * c[2]) for j, c in play}
        turned, hangs = set(), set()

        def replace_forces(delta, force, K2):
            for j, c in play:
                force[j] -= transmissions.spring_torque(c, delta[j], 0.0)
                if j in hangs:
                    K2[j, j] -= c[0]
                else:
                    force[j] += c[0] * (delta[j] - side[j] * c[2])

        while True:
            delta = self._rest(q, replace_forces)
            pulled = [
                j for j, c in play if j not in hangs and side[j] * (delta[j] - side[j] * c[2]) < 0.0
            ]
            if not pulled:
                return delta
            for j in pulled:  # a flank can't pull: try the other one, then neither
                (hangs if j in turned else turned).add(j)
                side[j] = -side[j]

    def kinetic_energy(self, q, qd, delta, delta_d):
        v = np.concatenate([self._joint(qd, "qd"), self._modal(delta_d, "delta_d")])
        return 0.5 * v @ self.mass_matrix(q, delta) @ v

    def potential_energy(self, q, delta):
        delta = self._modal(delta, "delta")
        return float(
            self.kernel.potential_energy(self._data, self._work, self._joint(q, "q"), delta,
                                         np.zeros(self.n_joints), np.zeros(self.n_modes))
        )  # fmt: skip

    def momentum(self, q, qd, delta=None, delta_d=None):
        """Linear momentum, and angular momentum about the base's origin, in the base frame.

        Returns
        -------
        linear, angular : ndarray, shape (3,)
            [kg m/s], [kg m^2/s]; they include the spin of the rotors about their joints' axes.
        """
        out = np.zeros((2, 3))
        self.kernel.momentum(
            self._data, self._work, self._joint(q, "q"), self._modal(delta, "delta"),
            self._joint(qd, "qd"), self._modal(delta_d, "delta_d"), out,
        )  # fmt: skip
        return out[0], out[1]

    # Kinematics --------------------------------------------------------------------------------

    def frames(self, q, delta=None):
        """Orientation and origin of each joint's frame, turned with its link, and last of the tip, in the base frame.

        Returns
        -------
        R : ndarray, shape (n + 1, 3, 3)
        p : ndarray, shape (n + 1, 3)
        """
        n = self.n_joints
        R, p = np.zeros((n + 1, 3, 3)), np.zeros((n + 1, 3))
        self.kernel.frames(
            self._data, self._work, self._joint(q, "q"), self._modal(delta, "delta"),
            np.zeros(n), np.zeros(self.n_modes), R, p,
        )  # fmt: skip
        return R, p

    def point(self, link, position, q, delta=None, offset=(0.0, 0.0, 0.0)):
        """Position of a point of a link in the base frame, shape (3,) [m].

        Parameters
        ----------
        link : str
        position : float
            From the link's base along its axis [m].
        q, delta : ndarray
        offset : array_like, shape (3,)
            From the axis, in the section's frame [m].
        """
        return self._point(link, position, q, delta, offset)[0]

    def jacobian(self, link, position, q, delta=None, offset=(0.0, 0.0, 0.0)):
        """Jacobian of a point's velocity and of its section's angular velocity, shape (6, n + m).

        Rows: linear [m/s], angular [rad/s], in the base frame; columns: (qd, delta_d).

        The point is at `position` [m] along the link's axis, with an `offset` [m] from it in the section's frame.
        """
        return self._point(link, position, q, delta, offset)[1]

    def velocity(self, link, position, q, qd, delta=None, delta_d=None, offset=(0.0, 0.0, 0.0)):
        """Linear and angular velocity of a point of a link in the base frame, shape (6,)."""
        rates = np.concatenate([self._joint(qd, "qd"), self._modal(delta_d, "delta_d")])
        return self.jacobian(link, position, q, delta, offset) @ rates

    def _point(self, link, position, q, delta, offset):
        index = [item.name for item in self.arm.links].index(link)
        piece = self._cut(index, float(position))
        n, m = self.n_joints, self.n_modes
        jacobian, place = np.zeros((6, n + m)), np.zeros(3)
        self.kernel.point(
            self._packed(piece), self._work, index, self._joint(q, "q"), self._modal(delta, "delta"),
            np.zeros(n), np.zeros(m), np.asarray(offset, float), place, jacobian,
        )  # fmt: skip
        return place, jacobian

    def _cut(self, index, position):
        """The data of an arm whose link `index` ends at `position`: its tip has the kinematics of that section."""
        link = self.arm.links[index]
        if not 0.0 <= position <= link.length * (1.0 + 1e-12):
            field, limit = f"position on {link.name}", f"0 to {link.length} m"
            raise ModelError("m is not on the link", field=field, value=position, limit=limit)
        d = self.data
        xi = position / link.length
        tip, slope, length = d.tip.copy(), d.slope.copy(), d.length.copy()
        length[index] = position
        if link.reduced is not None:
            return self._cut_reduced(index, position)
        for j, (shapes, number, direction) in enumerate(modes_of(link, self._shapes)):
            tip[index, j] = 0.0 if direction == "twist" else shapes(xi)[number]
            slope[index, j] = shapes(xi, 0 if direction == "twist" else 1)[number] / (
                1.0 if direction == "twist" else link.length
            )
        piece = d._replace(links=index + 1, tip=tip, slope=slope, length=length)
        return (
            piece if d.level == chain_data.FIRST_ORDER else self._with_nodes_up_to(piece, index, xi)
        )

    def _cut_reduced(self, index, position):
        """As `_cut`, for a link given by reduced matrices; between its stations, sections are interpolated linearly."""
        d, link = self.data, self.arm.links[index]
        r, part = d.reduced[index], position / link.length
        translation, rotation = self._shapes[link.name, REDUCED].at(part * link.tip[0])
        place, T, R = d.red_tip.copy(), d.red_T.copy(), d.red_R.copy()
        T2, R2 = d.red_T2.copy(), d.red_R2.copy()
        place[r], m = part * link.tip, slice(len(translation))
        T[r, m], R[r, m] = translation, rotation
        if (
            part < 1.0
        ):  # the archive has the second order only at the tip: scale it in proportion, for pictures
            T2[r], R2[r] = part * T2[r], part * R2[r]
        return d._replace(links=index + 1, red_tip=place, red_T=T, red_R=R, red_T2=T2, red_R2=R2)

    def _with_nodes_up_to(self, data, index, xi):
        """The data with the nodes of link `index` between its base and `xi`, for the kinematics of that section."""
        link, d = self.arm.links[index], data
        node_slope, node_bend = d.node_slope.copy(), d.node_bend.copy()
        cumulate, bishop = d.cumulate.copy(), d.bishop.copy()
        modes = modes_of(link, self._shapes)
        if not modes:
            return d
        count = (d.nodes - len(link.bodies)) // (len(link.breaks) - 1)
        nodes = nodes_of(link, count, d.nodes, xi)
        for j, (shapes, number, direction) in enumerate(modes):
            if direction != "twist":
                node_slope[index, :, j] = shapes(nodes.xi, 1)[:, number] / link.length
                node_bend[index, :, j] = shapes(nodes.xi, 2)[:, number] / link.length**2
        cumulate[index] = link.length * nodes.cumulate
        data = d._replace(node_slope=node_slope, node_bend=node_bend, cumulate=cumulate)
        bishop[index] = bishop_integrals(data, index, cumulate[index, :, -1])
        return data._replace(bishop=bishop)

    def tip_position(self, q, delta):
        return self.frames(q, delta)[1][-1]

    def tip_velocity(self, q, qd, delta, delta_d):
        link = self.arm.links[-1]
        return self.velocity(link.name, link.length, q, qd, delta, delta_d)[:3]

    def tip_deflection(self, delta, link=None):
        """Deflection of a link's tip (by default the last one's) along y and z of the link's base frame, (2,) [m]."""
        delta = self._modal(delta, "delta")
        names = [item.name for item in self.arm.links]
        i = len(names) - 1 if link is None else names.index(link)
        d = self.data
        out = np.zeros(2)
        if d.reduced[i] >= 0:
            r, m = d.reduced[i], int(d.count[i])
            own = delta[d.first[i] : d.first[i] + m]
            return (d.red_T[r, :m, 1:].T @ own) + 0.5 * np.einsum(
                "jka,j,k->a", d.red_T2[r, :m, :m, 1:], own, own
            )
        for j in range(d.count[i]):
            if d.direction[i, j] != chain_data.TWIST:
                out[d.direction[i, j] - 1] += d.tip[i, j] * delta[d.first[i] + j]
        return out

    def link_ends(self, q, delta=None):
        """Positions of all links' tips in the base frame, shape (n, 3) [m]."""
        R, p = self.frames(q, delta)
        ends = p[1:].copy()
        for i in range(self.n_joints - 1):
            # The frame after the tip is the next joint's. Its offset from the tip, origin_xyz, is in the tip's frame,
            # which is this frame with the joint's rotation undone.
            joint = self.arm.joints[i + 1]
            place = self.data.spring[i + 1]
            angle = q[i + 1] + (delta[place] if delta is not None and place >= 0 else 0.0)
            turn = rotation(joint.origin_rpy) @ about_axis(joint.axis, angle)
            ends[i] -= R[i + 1] @ turn.T @ np.asarray(joint.origin_xyz)
        return ends

    @cached_property
    def planar_axis(self):
        """Axis, in the base frame, to which all joint axes are parallel; None if there is no such axis."""
        R, _ = self.frames(np.zeros(self.n_joints))
        axes = np.einsum("ijk,ik->ij", R[:-1], self.data.axis)
        return axes[0] if np.allclose(np.cross(axes, axes[0]), 0.0, atol=1e-9) else None

    def base_angles(self, q, delta=None):
        """Absolute rotation of each link's base about its joint's axis, for a planar arm, shape (n,) [rad].

        It is measured from the base frame's orientation, without the fixed rotations of the joints' origins. It may
        exceed a full turn. For a straight planar arm it is the sum of the joint angles.
        """
        q = self._joint(q, "q")
        R, _ = self.frames(q, delta)
        rest, _ = self.frames(np.zeros(self.n_joints))
        axis = self.planar_axis
        signs = np.sign(np.einsum("ijk,ik->ij", rest[:-1], self.data.axis) @ axis)
        about = np.cumsum(signs * q)
        angles = np.empty(self.n_joints)
        for i in range(self.n_joints):
            turn = R[i] @ rest[i].T
            sine = 0.5 * axis @ (turn[[2, 0, 1], [1, 2, 0]] - turn[[1, 2, 0], [2, 0, 1]])
            cosine = 0.5 * (np.trace(turn) - 1.0)
            error = np.arctan2(sine, cosine) - about[i]
            angles[i] = about[i] + (error + np.pi) % (2.0 * np.pi) - np.pi
        return angles * signs

    # Integration -------------------------------------------------------------------------------

    @cached_property
    def straight_line(self):
        """Generated right-hand side of this arm's structure: (module, constants); None if too long or not compiled."""
        return self._generated and self._generated[:2]

    @cached_property
    def _generated(self):
        """As `straight_line`, and third the way in which the code gets its sums, one of `generated.ways`."""
        if not self._compiled:
            return None
        for way in generated.ways(self.data):
            room = work_space(self.data, object)
            program, constants, operations = generated.right_hand_side(self.data, room, way)
            if operations <= generated.MAX_OPERATIONS:
                sources = generated.sources(program, self.data, way)
                given = self.kernel if way == generated.AT_NODES else None
                return load.joined("generated", sources, inline=INLINE, given=given), constants, way
        return None

    def stepper(self, method, straight_line=True):
        """As `ArmModel.stepper`; ``straight_line=False`` takes the recursion in loops instead of generated code."""
        if method is not None and straight_line and self._generated is not None:
            module, data, way = self._generated
            if way == generated.AT_NODES:
                room = np.zeros(max(1, generated.room_for_sums(self.data)))
                data = (data, self._data, self._new_work(), room)
            return explicit_stepper(module, method, data, self)
        return self._loops(method)

    def lockable_stepper(self, method):
        return self._loops(method, lockable=True)

    def _loops(self, method, lockable=False):
        """A stepper that runs the recursion in loops."""
        none = tuple(np.zeros_like(part) for part in self._none)
        driven, n, size = none[2], self.n_joints, 2 * (self.n_joints + self.n_modes)
        stages = np.zeros((4, size))  # of the implicit method

        def lock(mask):
            driven[:] = mask  # at zero acceleration
            stages[:, size // 2 : size // 2 + n] = 0.0

        lock = lock if lockable else None
        data = (self._data, self._new_work(), *none)
        if method is not None:
            return explicit_stepper(self.kernel, method, data, self, lock)
        return self._implicit(data, stages, lock)

    def _implicit(self, data, stages, lock=None):
        """A stepper of the linearly implicit method."""
        extra = (np.zeros_like(self._none[0]), np.zeros_like(self._none[1]))
        arguments = (stages, np.zeros(self.n_joints), extra)
        step, trajectory = self.kernel.implicit_step, self.kernel.implicit_trajectory
        return Stepper(self, step, trajectory, arguments, data, lock)

    def driven_stepper(self, method):
        """As `stepper`, with joint accelerations [rad/s^2] in place of torque: prescribed motion.

        `method` is a value of `fixed_step.METHODS`. For a joint with a transmission the motor's motion is prescribed,
        and the link follows.
        """
        none = [np.zeros_like(part) for part in self._none]
        none[2][:] = 1
        data = (self._data, self._new_work(), *none)
        if method is None:
            stepper = self._implicit(data, np.zeros((4, 2 * (self.n_joints + self.n_modes))))
        else:
            stepper = explicit_stepper(self.kernel, method, data, self)
        # Friction adds to the torque that the motion needs; it does not change the motion.
        stepper.friction[:, :2] = 0.0
        return stepper

    def _joint(self, value, name):
        value = np.ascontiguousarray(value, float)
        check_shape(value, (self.n_joints,), name)
        return value

    def _modal(self, value, name):
        value = np.zeros(self.n_modes) if value is None else np.ascontiguousarray(value, float)
        check_shape(value, (self.n_modes,), name)
        return value
