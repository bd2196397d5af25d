# SPDX-License-Identifier: Apache-2.0
r"""The fully derived one-link arm: everything that the Lagrangian of the planar beam gives.

The hub turns by q, the beam point at x moves to :math:`R(q)\,(x,\ y(x,t))` with
:math:`y = \sum_i\phi_i(x/L)\delta_i`, and the payload (mass M, inertia J about its centre of mass, d beyond the tip)
turns with the tip's slope. To first order in the slope,

.. math::
    2T = I_0\dot q^2 + \int_0^L\rho A[(\dot y + x\dot q)^2 + y^2\dot q^2]dx
       + M[(\dot y_c + (L+d)\dot q)^2 + y_c^2\dot q^2] + J(\dot q + \dot y_e')^2,
    \qquad y_c = y_e + d\,y_e'.

Collecting terms gives the equations of `kernels.one_link` with, for :math:`\phi_c = \phi_e + d\phi_e'`,

.. math::
    J_{rigid} &= I_0 + \rho A L^3/3 + M(L+d)^2 + J, &
    h &= \rho A L^2\!\int\!\xi\phi + M(L+d)\phi_c + J\phi_e', \\
    M_{22} &= \rho A L\!\int\!\phi\phi^T + M\phi_c\phi_c^T + J\phi_e'\phi_e'^T, &
    G &= \rho A L\!\int\!\phi\phi^T + M\phi_c\phi_c^T, \\
    K_e &= \tfrac{EI}{L^3}\int\phi''\phi''^T, &
    \phi_e' &= \tfrac1L\,d\phi/d\xi|_1 .

Foreshortening is not in this model. So the centrifugal term (`K_e - qd^2 G`) makes the beam softer; a beam that keeps
its length would become stiffer. Keep the joint's speed well below the first bending frequency.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..arm.description import scaled
from ..errors import ModelError, check_shape
from ..kernels import integrators, load
from ..kernels import one_link as kernel
from .assembly import outboard, shapes_of
from .model import ArmModel, Terms, damping_matrix, explicit_stepper, rotation

SOURCES = (load.source(kernel), load.source(integrators))

#: Cosine and sine of an angle that is not finite, as in NumPy.
NOWHERE = (math.nan, math.nan)


@dataclass(frozen=True)
class Coefficients:
    """All constants of the one-link equations (SI); see the module and `kernels.one_link`.

    Attributes
    ----------
    rigid : float
        J: inertia of the undeformed arm about the joint [kg m^2].
    moment : float
        First moment of mass about the joint [kg m].
    h : ndarray, shape (m,)
        Inertial coupling of joint and modes [kg m].
    M22, G : ndarray, shape (m, m)
        Modal mass and centrifugal matrix [kg].
    K : ndarray, shape (m, m)
        Elastic stiffness [N/m].
    D : ndarray, shape (m, m)
        Structural damping [N s/m].
    s : ndarray, shape (m,)
        First moments of the modes, on which gravity acts [kg].
    """

    rigid: float
    moment: float
    h: np.ndarray
    M22: np.ndarray
    G: np.ndarray
    K: np.ndarray
    D: np.ndarray
    s: np.ndarray


class OneLinkEquations(ArmModel):
    """Evaluates the one-link equations for the coefficients of a derivation.

    Subclasses derive the coefficients: `OneLink` in full, `paper_appendix.PaperAppendix` as published.

    Parameters
    ----------
    arm : Arm
    shapes : beam.ModeShapes, optional
        Mode shapes; if not given, those of this arm's own payload.
    """

    def __init__(self, arm, shapes=None):
        super().__init__(arm)
        _check_planar(arm)
        self.link, self.joint = arm.links[0], arm.joints[0]
        if self.joint.transmission is not None:
            field, hint = f"transmission of {self.joint.name}", "use model chain"
            raise ModelError("is not in this model", field=field, hint=hint)
        if self.joint.friction.excess:
            field, hint = f"friction.breakaway of {self.joint.name}", "use model chain"
            raise ModelError("is not in this model", field=field, hint=hint)
        self.flexibility = self.link.flexible["y"]
        if shapes is None:
            shapes = shapes_of(self.link, "y", self.flexibility, outboard(arm)[0])
        self.shapes = shapes
        self.phi_tip = self.shapes(1.0)  # [-]
        self.slope_tip = self.shapes(1.0, 1) / self.link.length  # [1/m]
        self.coefficients = self.derive()
        self._rotation = rotation(self.joint.origin_rpy)
        self._gravity = self._rotation.T @ np.asarray(arm.gravity)  # in the joint's frame
        self._gravity_plain = float(self._gravity[0]), float(self._gravity[1])
        self._weighs = any(self._gravity_plain)
        self._terms_at_rest = self._constant_terms()
        self._constant_along = {}  # mass and damping of `terms_along`, by the number of states

    def with_payload(self, scale):
        return self._carrying(scale, type(self)(scaled(self.arm, payload=scale), self.shapes))

    def derive(self):
        """Return the `Coefficients` of this derivation."""
        raise NotImplementedError

    def mode_shapes(self, link, direction):
        if (link, direction) != (self.link.name, "y"):
            raise ModelError("has no modes", field=f"{link} in {direction}")
        return self.shapes

    def _constant_terms(self):
        c = self.coefficients
        m = c.h.size
        M = np.block([[np.array([[c.rigid]]), c.h[None, :]], [c.h[:, None], c.M22]])
        return Terms(M, np.zeros(1), np.zeros(m), np.zeros((1, m)), c.D, np.zeros((1, m)), c.K)

    def terms(self, q, qd, delta=None, delta_d=None):
        c, constant = self.coefficients, self._terms_at_rest
        angle, speed = float(q[0]), float(qd[0])
        # Python floats: NumPy's functions of a single number cost more than the rest of this method.
        gx, gy = self._gravity_plain
        cosine, sine = (math.cos(angle), math.sin(angle)) if math.isfinite(angle) else NOWHERE
        along, across = gx * cosine + gy * sine, gy * cosine - gx * sine
        friction = self.joint.friction
        f1 = (
            friction.viscous * speed
            + friction.coulomb * math.tanh(speed / friction.smoothing)
            - c.moment * across
        )
        M, C1, f2, K1 = constant.M, constant.C1, constant.f2, constant.K1
        if self._weighs:
            f2, K1 = -c.s * across, (c.s * along)[None, :]
        if delta is not None:
            M = M.copy()
            M[0, 0] += delta @ c.G @ delta
            C1 = 2.0 * speed * (delta @ c.G)[None, :]
        return Terms(M=M, f1=np.array([f1]), f2=f2, C1=C1, C2=c.D, K1=K1, K2=c.K - speed**2 * c.G)

    @property
    def same_inertia(self):
        return not self._weighs

    def terms_along(self, motions):
        count, m = len(motions), self.n_modes
        constant = self._constant_along.get(count)
        if constant is None:
            c = self._terms_at_rest
            constant = [np.repeat(x[None], count, axis=0) for x in (c.M, c.C1, c.C2)]
            self._constant_along[count] = constant
        M, C1, C2 = constant
        f1, f2 = np.empty((count, 1)), np.empty((count, m))
        K1, K2 = np.empty((count, 1, m)), np.empty((count, m, m))
        motions = np.ascontiguousarray(motions, float)
        self._kernel.terms_along(motions, self._constants, self._friction[0], f1, f2, K1, K2)
        return Terms(M=M, f1=f1, f2=f2, C1=C1, C2=C2, K1=K1, K2=K2)

    def kinetic_energy(self, q, qd, delta, delta_d):
        v = np.concatenate([qd, delta_d])
        return 0.5 * v @ self.terms(q, qd, delta, delta_d).M @ v

    def potential_energy(self, q, delta):
        c = self.coefficients
        gx, gy = self._gravity[0], self._gravity[1]
        cos, sin = np.cos(q[0]), np.sin(q[0])
        gravity = -c.moment * (gx * cos + gy * sin) - (c.s @ delta) * (-gx * sin + gy * cos)
        return 0.5 * delta @ c.K @ delta + gravity

    def tip_deflection(self, delta, link=None):
        return np.array([self.phi_tip @ delta, 0.0])

    def tip_position(self, q, delta):
        """(A9) and its counterpart along y: the beam's tip, in the base frame."""
        y = self.phi_tip @ delta
        cos, sin = np.cos(q[0]), np.sin(q[0])
        length = self.link.length
        local = np.array([length * cos - y * sin, length * sin + y * cos, 0.0])
        return np.asarray(self.joint.origin_xyz) + self._rotation @ local

    def tip_velocity(self, q, qd, delta, delta_d):
        """(A10) and its counterpart along y."""
        y, yd = self.phi_tip @ delta, self.phi_tip @ delta_d
        cos, sin = np.cos(q[0]), np.sin(q[0])
        length, w = self.link.length, qd[0]
        local = np.array(
            [(-length * sin - y * cos) * w - yd * sin, (length * cos - y * sin) * w + yd * cos, 0.0]
        )
        return self._rotation @ local

    def derivative(self, state, torque):
        state, m = np.asarray(state, float), self.n_modes
        check_shape(state, (2 + 2 * m,), "state")
        out = np.empty_like(state)
        net = np.asarray(torque, float) - self.friction(state[1 + m : 2 + m])
        self._kernel.derivative(state, net, self._constants, out)
        return out

    @cached_property
    def _constants(self):
        return self._data()

    @cached_property
    def _kernel(self):
        """The compiled equations and integrators."""
        return load.joined("one_link", SOURCES, inline=("derivative", "net_torque", "low_storage"))

    def stepper(self, method):
        return self._stepper(method, self._data())

    def lockable_stepper(self, method):
        data = self._data()
        scalars, rigid = data[0], data[0][0]

        def lock(mask):
            # With infinite inertia the joint has no acceleration.
            scalars[0] = np.inf if mask[0] else rigid

        return self._stepper(method, data, lock)

    def _data(self):
        c = self.coefficients
        scalars = np.array([c.rigid, c.moment, self._gravity[0], self._gravity[1]])
        inverse = np.linalg.inv(c.M22)
        inverse = 0.5 * (inverse + inverse.T)
        data = (scalars, c.h, inverse, inverse @ c.h, c.G, c.K, c.D, c.s)
        return tuple(map(np.ascontiguousarray, data))

    def _stepper(self, method, data, lock=None):
        if method is None:
            raise ModelError(
                "has no implicit integrator",
                field=f"model {self.arm.model}",
                hint="take an explicit one, or model chain",
            )
        return explicit_stepper(self._kernel, method, data, self, lock)


class OneLink(OneLinkEquations):
    """The one-link arm derived in full from its Lagrangian (module docstring)."""

    def derive(self):
        link, payload, shapes = self.link, self.arm.payload, self.shapes
        L, rho = link.length, link.mass_per_length
        M, J, d = payload.mass, payload.inertia[2][2], payload.offset[0]
        phi_c = self.phi_tip + d * self.slope_tip
        beam_gram = rho * L * shapes.gram()
        G = beam_gram + M * np.outer(phi_c, phi_c)
        M22 = G + J * np.outer(self.slope_tip, self.slope_tip)
        K = link.stiffness["y"] / L**3 * shapes.gram(2)
        return Coefficients(
            rigid=self.joint.inertia + rho * L**3 / 3.0 + M * (L + d) ** 2 + J,
            moment=rho * L**2 / 2.0 + M * (L + d),
            h=rho * L**2 * shapes.integral(lambda xi: xi)
            + M * (L + d) * phi_c
            + J * self.slope_tip,
            M22=M22,
            G=G,
            K=K,
            D=damping_matrix(M22, K, self.flexibility.damping),
            s=rho * L * shapes.integral() + M * phi_c,
        )


def _check_planar(arm):
    """Refuse an arm that is not one link bending along y in the plane in which its joint turns it."""
    link, joint = arm.links[0], arm.joints[0]
    for field, value, fits, limit in (
        ("links", [link.name for link in arm.links], len(arm.links) == 1, "one link"),
        (f"flexible of {link.name}", list(link.flexible), set(link.flexible) == {"y"}, "y alone"),
        (f"sections of {link.name}", len(link.pieces), link.uniform, "a uniform link"),
        (f"bodies of {link.name}", len(link.bodies), not link.bodies, "none"),
        (
            f"axis of {joint.name}",
            list(joint.axis),
            np.allclose(joint.axis, (0.0, 0.0, 1.0), atol=1e-12),
            "[0, 0, 1]; turn the base with origin.rpy",
        ),
        ("payload.offset", list(arm.payload.offset), not any(arm.payload.offset[1:]), "along x"),
    ):
        if not fits:
            problem = f"is not for model {arm.model}"
            raise ModelError(problem, field=field, value=value, limit=limit)
