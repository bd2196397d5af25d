# SPDX-License-Identifier: Apache-2.0
r"""First-order assumed-modes equations of one and two planar links, as one writes them in numpy.

A point of a link is at :math:`(x, y(x))` in the frame of its base, :math:`y =
\sum_i\phi_i(x/L)\delta_i`; the bending is of first order (no foreshortening, slope as angle), and
no term of the kinetic energy of these kinematics is neglected. Link 2 starts at the tip of link 1 and is turned
by :math:`\alpha_2 = q_1 + y_1'(L) + q_2`. Its hub's inertia turns with :math:`\dot\alpha_2`; with
:math:`\alpha_2` in place of :math:`q_2` the coupling of the links is one first moment at the elbow.

State of one link: :math:`(q, \delta, \dot q, \dot\delta)`, of two :math:`(q_1, q_2, \delta_1,
\delta_2, \dot q_1, \dots)`, the amplitudes link by link, two modes each.
"""

from itertools import pairwise

import numpy as np
from scipy.integrate import solve_ivp

from flexarm_dynamics.models.beam import loaded

from . import Peer, steps_per_sample, times

MODES = 2

#: Fastest settings that keep the tip within 0.5 mm (one_link_pulse) and 50 um
#: (two_link_torque_x0p1), where the model's own errors are 126 and 23 um. In two_link_torque its
#: error is 3.7 mm with any settings. Scanned: steps of 10, 5, 2.5 and 1 ms; rtol 0.1 to 1e-6
#: with atol 1e-3 to 1e-8.
BEST = {
    "NumpyRk4": {
        "one_link_pulse": {"step": 1e-2},
        "two_link_torque_x0p1": {"step": 1e-2},
        "two_link_torque": {"step": 1e-2},
    },
    "NumpyDop853": {
        "one_link_pulse": {"rtol": 1e-2, "atol": 1e-4},
        "two_link_torque_x0p1": {"rtol": 1e-2, "atol": 1e-3},
        "two_link_torque": {"rtol": 1e-2, "atol": 1e-3},
    },
}


class Link:
    r"""Modal constants of one link that carries a point mass and an inertia at its tip.

    Parameters
    ----------
    length, rho, stiffness : float
        L [m], rho A [kg/m], EI [N m^2].
    hub : float
        Inertia that turns with the base [kg m^2].
    tip_mass, tip_inertia : float
        Mass that moves with the tip, and inertia that turns with its tangent [kg, kg m^2].
    shapes : ModeShapes
        Shape functions.

    Attributes
    ----------
    inertia : float
        Inertia of the straight link about its base, hub included [kg m^2].
    coupling : ndarray, shape (m,)
        Mass coupling between base rotation and amplitudes [kg m].
    mass : ndarray, shape (m, m)
        Modal mass [kg].
    gram : ndarray, shape (m, m)
        Modal mass without the tip's inertia, for the centrifugal terms [kg].
    stiffness : ndarray, shape (m, m)
        Modal stiffness [N/m].
    total, first_x : float
        Mass [kg] and first moment along the link [kg m], without the hub.
    first_y : ndarray, shape (m,)
        First moment across the link per amplitude [kg].
    tip, slope : ndarray, shape (m,)
        Tip deflection [-] and slope [1/m] per amplitude.
    """

    def __init__(self, length, rho, stiffness, hub, tip_mass, tip_inertia, shapes):
        self.length = length
        self.tip = shapes(1.0)
        self.slope = shapes(1.0, 1) / length
        self.inertia = hub + rho * length**3 / 3.0 + tip_mass * length**2 + tip_inertia
        self.coupling = (
            rho * length**2 * shapes.integral(lambda xi: xi)
            + tip_mass * length * self.tip
            + tip_inertia * self.slope
        )
        self.gram = rho * length * shapes.gram() + tip_mass * np.outer(self.tip, self.tip)
        self.mass = self.gram + tip_inertia * np.outer(self.slope, self.slope)
        self.stiffness = stiffness / length**3 * shapes.gram(2)
        self.total = rho * length + tip_mass
        self.first_x = 0.5 * rho * length**2 + tip_mass * length
        self.first_y = rho * length * shapes.integral() + tip_mass * self.tip


def links(parameters, tip_mass=None, tip_inertia=None):
    """The links of a case.

    Parameters
    ----------
    parameters : dict
        Entry of ``parameters.json``.
    tip_mass, tip_inertia : float, optional
        Tip load that is assumed for the mode shapes of a two-link arm's first link [kg, kg m^2]; by
        default elbow, second link and payload, and the second hub's inertia. It changes the shapes, not
        the masses.

    Returns
    -------
    list of Link
        One or two. The first of two carries the whole mass beyond the elbow at its tip.
    """
    p = parameters
    length, rho, stiffness = p["L"], p["rhoA"], p["EI"]
    outer = loaded(MODES, length, rho, p["Mp"], p["Jp"])
    if "Jh" in p:
        return [Link(length, rho, stiffness, p["Jh"], p["Mp"], p["Jp"], outer)]
    beyond = p["Mm"] + rho * length + p["Mp"]
    inner = loaded(
        MODES,
        length,
        rho,
        beyond if tip_mass is None else tip_mass,
        p["Jh2"] if tip_inertia is None else tip_inertia,
    )
    return [
        Link(length, rho, stiffness, p["Jh1"], beyond, 0.0, inner),
        Link(length, rho, stiffness, p["Jh2"], p["Mp"], p["Jp"], outer),
    ]


class OneLink:
    """Equations of motion of one link.

    Parameters
    ----------
    link : Link
        Its constants.
    """

    size = 1 + MODES

    def __init__(self, link):
        self.link = link
        self.mass = np.empty((self.size, self.size))
        self.mass[0, 1:] = self.mass[1:, 0] = link.coupling
        self.mass[1:, 1:] = link.mass

    def accelerations(self, state, torque):
        """Second derivatives of (q, delta), shape (3,)."""
        k = self.link
        delta, rate, delta_rate = state[1:3], state[3], state[4:]
        bent = k.gram @ delta
        self.mass[0, 0] = k.inertia + delta @ bent
        force = np.empty(3)
        force[0] = torque[0] - 2.0 * rate * (delta_rate @ bent)
        force[1:] = rate**2 * bent - k.stiffness @ delta
        return np.linalg.solve(self.mass, force)

    def columns(self, states):
        """Report columns of `states`, shape (n, 6)."""
        q, tip = states[:, 0], states[:, 1:3] @ self.link.tip
        cos, sin, length = np.cos(q), np.sin(q), self.link.length
        return {"theta1": q, "tip_x": length * cos - tip * sin, "tip_y": length * sin + tip * cos}


class TwoLinks:
    """Equations of motion of two links.

    Parameters
    ----------
    inner, outer : Link
        Their constants; the inner one carries all mass beyond the elbow.
    """

    size = 2 + 2 * MODES

    def __init__(self, inner, outer):
        self.inner, self.outer = inner, outer
        # Internal order: q1, delta1, alpha2, delta2.
        self.mass = np.zeros((6, 6))
        self.mass[0, 1:3] = self.mass[1:3, 0] = inner.coupling
        self.mass[1:3, 1:3] = inner.mass
        self.mass[3, 4:] = self.mass[4:, 3] = outer.coupling
        self.mass[4:, 4:] = outer.mass
        self.corner = np.outer(inner.tip, outer.first_y)

    def accelerations(self, state, torque):
        """Second derivatives of (q1, q2, delta1, delta2), shape (6,)."""
        a, b, mass = self.inner, self.outer, self.mass
        delta1, delta2 = state[2:4], state[4:6]
        rate1, rate2, delta_rate1, delta_rate2 = state[6], state[7], state[8:10], state[10:]
        bend = state[1] + a.slope @ delta1
        alpha_rate = rate1 + rate2 + a.slope @ delta_rate1
        cos, sin = np.cos(bend), np.sin(bend)
        tip, tip_rate = a.tip @ delta1, a.tip @ delta_rate1
        first, first_rate = b.first_y @ delta2, b.first_y @ delta_rate2
        bent1, bent2 = a.gram @ delta1, b.gram @ delta2

        # First moment of link 2 in the frame of link 1.
        along = b.first_x * cos - first * sin
        across = b.first_x * sin + first * cos
        mass[0, 0] = a.inertia + delta1 @ bent1
        mass[3, 3] = b.inertia + delta2 @ bent2
        mass[0, 3] = mass[3, 0] = tip * across + a.length * along
        mass[1:3, 3] = mass[3, 1:3] = a.tip * along
        mass[0, 4:] = mass[4:, 0] = b.first_y * (tip * sin + a.length * cos)
        mass[1:3, 4:] = self.corner * cos
        mass[4:, 1:3] = mass[1:3, 4:].T

        # Velocity-dependent parts: of link 2's inertial force in its own frame, then in that of link 1,
        # ...
        own_x = -2.0 * alpha_rate * first_rate - alpha_rate**2 * b.first_x
        own_y = -(alpha_rate**2) * first
        force_x, force_y = cos * own_x - sin * own_y, sin * own_x + cos * own_y
        # ... of the elbow's acceleration in the frame of link 1, then in that of link 2.
        elbow_x = -2.0 * rate1 * tip_rate - rate1**2 * a.length
        elbow_y = -(rate1**2) * tip
        turned_x, turned_y = cos * elbow_x + sin * elbow_y, -sin * elbow_x + cos * elbow_y

        force = np.empty(6)
        force[0] = (
            torque[0]
            - torque[1]
            - 2.0 * rate1 * (delta_rate1 @ bent1)
            + tip * force_x
            - a.length * force_y
        )
        force[1:3] = rate1**2 * bent1 - a.stiffness @ delta1 - a.tip * force_y - a.slope * torque[1]
        force[3] = (
            torque[1]
            - 2.0 * alpha_rate * (delta_rate2 @ bent2)
            - b.first_x * turned_y
            + first * turned_x
        )
        force[4:] = alpha_rate**2 * bent2 - b.stiffness @ delta2 - b.first_y * turned_y
        acc = np.linalg.solve(mass, force)
        result = np.empty(6)
        result[0] = acc[0]
        result[1] = acc[3] - acc[0] - a.slope @ acc[1:3]
        result[2:4], result[4:] = acc[1:3], acc[4:]
        return result

    def columns(self, states):
        """Report columns of states, shape (n, 12)."""
        a, b = self.inner, self.outer
        q1, q2, delta1, delta2 = states[:, 0], states[:, 1], states[:, 2:4], states[:, 4:6]
        alpha = q1 + q2 + delta1 @ a.slope
        bend1, bend2 = delta1 @ a.tip, delta2 @ b.tip
        elbow_x = a.length * np.cos(q1) - bend1 * np.sin(q1)
        elbow_y = a.length * np.sin(q1) + bend1 * np.cos(q1)
        return {
            "theta1": q1,
            "tip_x": elbow_x + b.length * np.cos(alpha) - bend2 * np.sin(alpha),
            "tip_y": elbow_y + b.length * np.sin(alpha) + bend2 * np.cos(alpha),
            "elbow_x": elbow_x,
            "elbow_y": elbow_y,
            "alpha2": alpha,
        }


def equations(parameters, tip_mass=None, tip_inertia=None):
    """OneLink or TwoLinks of a case; parameters as for `links`."""
    arm = links(parameters, tip_mass, tip_inertia)
    return OneLink(*arm) if len(arm) == 1 else TwoLinks(*arm)


class _Numpy(Peer):
    """Base class of both integrators.

    Parameters
    ----------
    tip_mass, tip_inertia : float, optional
        As for `links`.
    **settings
        Settings of the integrator.
    """

    def __init__(self, case, parameters, *, tip_mass=None, tip_inertia=None, **settings):
        super().__init__(case, parameters, **settings)
        self.arm = equations(parameters, tip_mass, tip_inertia)

    def pieces(self, duration):
        """Start and end of each smooth piece of the torque [s], and the constant torque there; None for a sine."""
        for start, end in pairwise(
            (0.0, *(e for e in self.torque.edges if e < duration), duration)
        ):
            # Constant: the last stage of a piece must not use the next level.
            yield start, end, self.torque(0.5 * (start + end)) if self.torque.edges else None

    def derivative(self, state, torque):
        """Time derivative of the state."""
        n = self.arm.size
        return np.concatenate([state[n:], self.arm.accelerations(state, torque)])

    def report(self, result):
        return self.arm.columns(result)


class NumpyDop853(_Numpy):
    """`scipy.integrate.solve_ivp` with DOP853, restarted at a pulse's edges.

    Parameters
    ----------
    rtol, atol : float
        Tolerances.
    """

    name = "numpy, solve_ivp DOP853"

    def __init__(self, case, parameters, *, rtol=1e-6, atol=1e-8, **settings):
        super().__init__(case, parameters, **settings)
        self.rtol, self.atol = rtol, atol

    def integrate(self, duration):
        t = times(duration)
        state = np.zeros(2 * self.arm.size)
        states = np.empty((t.size, state.size))
        for start, end, held in self.pieces(duration):
            right = lambda t, x, held=held: self.derivative(  # noqa: E731
                x, self.torque(t) if held is None else held
            )
            here = (t >= start - 1e-9) & (t <= end + 1e-9)
            piece = solve_ivp(
                right,
                (start, end),
                state,
                method="DOP853",
                t_eval=np.clip(t[here], start, end),
                rtol=self.rtol,
                atol=self.atol,
            )
            states[here] = piece.y.T
            state = piece.y[:, -1]
        return states


class NumpyRk4(_Numpy):
    """Classical Runge-Kutta with a fixed step.

    Parameters
    ----------
    step : float
        Step [s]; divides 10 ms.
    """

    name = "numpy, RK4"

    def __init__(self, case, parameters, *, step=1e-3, **settings):
        super().__init__(case, parameters, **settings)
        self.step = step
        self.every = steps_per_sample(step)

    def integrate(self, duration):
        t, h = times(duration), self.step
        steps = (t.size - 1) * self.every
        torque = self.torque.stages(steps, h)
        x = np.zeros(2 * self.arm.size)
        states = np.empty((t.size, x.size))
        states[0] = x
        for i in range(steps):
            start, middle, end = torque[i]
            k1 = self.derivative(x, start)
            k2 = self.derivative(x + 0.5 * h * k1, middle)
            k3 = self.derivative(x + 0.5 * h * k2, middle)
            k4 = self.derivative(x + h * k3, end)
            x = x + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
            if (i + 1) % self.every == 0:
                states[(i + 1) // self.every] = x
        return states
