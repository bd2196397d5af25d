# SPDX-License-Identifier: Apache-2.0
"""Describes an arm as plain data in SI units, as `arm_file.load` reads it.

Frames: each joint's frame is the tip frame of the previous link (the base frame for the first joint) moved by
the joint's fixed `origin` and turned by the joint angle about `axis`. A link extends along the x axis of its
joint's frame; it bends along y and z and twists about x.
"""

import contextlib
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from numpy.polynomial import polynomial

from ..errors import ModelError
from .reduced import DIRECTION as REDUCED
from .reduced import Reduced

#: Directions in which a beam is flexible, and all directions: links given by reduced matrices have their own.
BEAM_DIRECTIONS = ("y", "z", "twist")
DIRECTIONS = (*BEAM_DIRECTIONS, REDUCED)
ENCODERS = ("motor", "link")
SAFE_ACTIONS = ("brake", "damp", "zero")
#: Max. number of modes per direction; with more, a slender beam is no longer the right model.
MAX_MODES = 20
SHAPES = ("clamped_free", "loaded", "from_frequencies")


@dataclass(frozen=True)
class Friction:
    r"""Joint friction, on the motor's side of a transmission.

    .. math:: f_v\dot q + \bigl(f_c + (f_b - f_c)e^{-(\dot q/v_s)^2} + c\,|\tau|\bigr)\tanh(\dot q/v_0)

    where tau is the torque that the transmission transmits. A breakaway level below the Coulomb level has no effect.
    """

    viscous: float = 0.0  # [N m s/rad] f_v
    coulomb: float = 0.0  # [N m] f_c
    smoothing: float = 0.01  # [rad/s] v_0: speed at which Coulomb friction reaches 76 %
    breakaway: float = 0.0  # [N m] f_b: level at rest
    stribeck: float = 0.1  # [rad/s] v_s: speed at which 37 % of the excess over Coulomb remains
    load: float = (
        0.0  # [-] c: fraction of the transmitted torque that is friction; only with a transmission
    )

    @property
    def excess(self):
        """Excess of the breakaway level over the Coulomb level [N m]."""
        return max(self.breakaway - self.coulomb, 0.0)


@dataclass(frozen=True)
class Transmission:
    r"""Gear, belt or shaft between a joint's motor and its link: a spring and a damper behind play.

    The joint's coordinate q is then the motor's angle (seen through the gear). Torque and friction act on it.
    :math:`\gamma`, the link's angle minus the motor's, is one of the modal coordinates. The torque from link to motor
    is

    .. math::
        \tau = k\,s + (e\,d + (1 - e)\,d_0 + c\,|k\,s|)\,\dot\gamma, \qquad
        s = \gamma - \tfrac12\sqrt{(\gamma + \tfrac b2)^2 + w^2} + \tfrac12\sqrt{(\gamma - \tfrac b2)^2 + w^2}, \qquad
        e = \frac{s^2}{s^2 + (b/20 + w)^2} \ (1 \text{ without play}).

    With sharp corners (w = 0), s is the part of the deflection beyond the play. Within the play, only the damping d_0
    of the grease transmits torque. The flanks of a real gear meet gradually: w is half the angle over which they do.
    The damper d takes effect gradually as the flanks are pressed together, so the torque has no jump. c is damping that
    grows with the transmitted torque (Hunt & Crossley 1975).
    """

    stiffness: float  # [N m/rad] k
    damping: float = 0.0  # [N m s/rad] d
    play: float = 0.0  # [rad] b: whole angle by which the link moves freely, with the motor held
    load_damping: float = 0.0  # [s/rad] c
    rounding: float = 0.0  # [rad] w
    play_damping: float = 0.0  # [N m s/rad] d_0


@dataclass(frozen=True)
class Limits:
    """Limits of a joint; infinite if the file has none."""

    position: tuple = (-np.inf, np.inf)  # [rad] low, high
    velocity: float = np.inf  # [rad/s]
    torque: float = np.inf  # [N m]
    torque_rate: float = (
        np.inf
    )  # [N m/s]; infinite: a budget from torque limit and lowest frequency


@dataclass(frozen=True)
class Joint:
    """A revolute joint."""

    name: str
    axis: tuple = (0.0, 0.0, 1.0)  # unit vector in the joint's frame
    origin_xyz: tuple = (0.0, 0.0, 0.0)  # [m] from the previous link's tip
    origin_rpy: tuple = (0.0, 0.0, 0.0)  # [rad] roll, pitch, yaw, as in URDF
    hub_inertia: float = 0.0  # [kg m^2] about the axis, turns with the link
    motor_mass: float = 0.0  # [kg] at the joint, moves with the previous link
    housing_inertia: tuple = (
        (0.0,) * 3,
    ) * 3  # [kg m^2] of the motor about the joint, in the joint's frame at angle zero
    rotor_inertia: float = 0.0  # [kg m^2] motor side
    gear_ratio: float = 1.0  # [-] motor turns per joint turn
    friction: Friction = Friction()
    limits: Limits = Limits()
    safe_action: str = "damp"
    brake_torque: float | None = None  # [N m] holding capacity; None: the torque limit
    damp_coefficient: float | None = None  # [N m s/rad], no torque limit; None: limited torque
    damp_torque: float | None = None  # [N m] limit of damp; None: from limits, gauges and weight
    damp_time: float | None = None  # [s] of damp's soft start; None: half a period, at most 0.25
    encoder_counts: int = 0  # [-] per turn of the joint; 0: not quantised
    encoder: str = (
        "motor"  # what it measures: the angle of the motor, or of the link behind the transmission
    )
    transmission: Transmission | None = None  # None: the link is fixed to the motor
    continuous: bool = False  # may turn without end: a trajectory takes the shorter way

    @property
    def housed(self):
        """Whether the motor's housing has an inertia."""
        return any(map(any, self.housing_inertia))

    @property
    def inertia(self):
        """Hub inertia plus the rotor's inertia seen through the gear [kg m^2]."""
        return self.hub_inertia + self.rotor_inertia * self.gear_ratio**2


@dataclass(frozen=True)
class Flexibility:
    """Bending or twist of a link in one direction."""

    modes: int
    shape: str = "clamped_free"
    frequencies: tuple = ()  # [Hz], for from_frequencies
    damping: tuple = ()  # [-] modal damping ratio, per mode; shorter: the last one repeats


@dataclass(frozen=True)
class Piece:
    r"""A part of a link over which its section changes gradually or is constant.

    Each property is a polynomial in :math:`t = (\xi - start)/(end - start)`, lowest power first, relative to the link's
    own value (mass per length, stiffness or polar inertia per length).
    """

    start: float  # [-] xi at the end nearer to the base
    end: float  # [-]
    mass: tuple = (1.0,)
    y: tuple = (1.0,)
    z: tuple = (1.0,)
    twist: tuple = (1.0,)
    polar: tuple = (1.0,)


@dataclass(frozen=True)
class Body:
    """A rigid body on a section of a link."""

    position: float  # [m] of the section, from the link's base
    mass: float = 0.0  # [kg]
    inertia: tuple = ((0.0,) * 3,) * 3  # [kg m^2] about its centre of mass, section's frame
    offset: tuple = (0.0, 0.0, 0.0)  # [m] centre of mass from the section


@dataclass(frozen=True)
class Link:
    """A link along x; rigid in directions that are not in `flexible`, uniform if it is a beam without `pieces`."""

    name: str
    length: float  # [m]
    mass_per_length: float  # [kg/m]; with pieces: the mean
    # direction -> EI [N m^2], twist: GJ [N m^2]; with pieces: at the base
    stiffness: dict = field(default_factory=dict)
    flexible: dict = field(default_factory=dict)  # direction -> Flexibility
    polar_inertia_per_length: float = 0.0  # [kg m] rho I_p, for twist; with pieces: the mean
    pieces: tuple = ()  # Piece, from base to tip, without gaps
    bodies: tuple = ()  # Body
    root: tuple = (0.0, 0.0, 0.0)  # [m] of its base, from the joint
    reduced: Reduced | None = None  # its matrices, if it is not a beam

    @property
    def tip(self):
        """Position of its undeformed tip relative to its base, (3,) [m]."""
        if self.reduced is not None:
            return self.reduced["tip"]
        return np.array([self.length, 0.0, 0.0])

    def available(self, count):
        """The number of modes `count`, or the number of modes of its matrices if that is lower."""
        return count if self.reduced is None else min(count, self.reduced.modes)

    @property
    def uniform(self):
        """Whether it is a beam with the same section everywhere."""
        return not self.pieces and self.reduced is None

    @property
    def mass(self):
        """Mass of the beam [kg]."""
        return self.mass_per_length * self.length

    @property
    def total_mass(self):
        """Mass of the beam and of the bodies on it [kg]."""
        return self.mass + sum(body.mass for body in self.bodies)

    @property
    def breaks(self):
        """Places where the section jumps or a body sits, and both ends, from 0 to 1 [-]."""
        places = {piece.end for piece in self.pieces}
        places |= {body.position / self.length for body in self.bodies}
        return tuple(sorted({0.0, *places, 1.0}))

    def factor(self, name, xi):
        """A property along the link, relative to the link's own value; where it jumps, the value on the base's side.

        Parameters
        ----------
        name : str
            ``mass``, ``y``, ``z``, ``twist`` or ``polar``, as in `Piece`.
        xi : ndarray
            Places [-].

        Returns
        -------
        ndarray, of the shape of xi
        """
        xi = np.asarray(xi, float)
        if not self.pieces:
            return np.ones_like(xi)
        ends = [piece.end for piece in self.pieces[:-1]]
        span = np.searchsorted(ends, xi)
        out = np.empty_like(xi)
        for k, piece in enumerate(self.pieces):
            here = span == k
            t = (xi[here] - piece.start) / (piece.end - piece.start)
            out[here] = polynomial.polyval(t, getattr(piece, name))
        return out

    def rigidity(self, direction, position):
        """EI (twist: GJ) at a place [N m^2].

        Parameters
        ----------
        direction : str
        position : float
            From the link's base [m].
        """
        return self.stiffness[direction] * float(self.factor(direction, position / self.length))

    def moments(self, low=0.0, high=None):
        """Integrals over the mass of the straight link, or of its part between two places.

        Parameters
        ----------
        low, high : float
            Distance from the link's base; the tip if `high` is not given [m].

        Returns
        -------
        mass, first, second, polar : float
            Mass [kg], integrals of x [kg m] and x^2 [kg m^2] from the link's base, inertia about x [kg m^2].
        """
        high = self.length if high is None else high
        if self.reduced is not None:
            r, part = self.reduced, (high - low) / self.length
            inertia = r["inertia"]
            second = 0.5 * (inertia[1, 1] + inertia[2, 2])
            return tuple(
                part * float(v) for v in (r["mass"], r["first_moment"][0], second, inertia[0, 0])
            )
        if not self.pieces:
            powers = ((high**k - low**k) / k for k in (1, 2, 3))
            mass, first, second = (self.mass_per_length * p for p in powers)
            return mass, first, second, self.polar_inertia_per_length * (high - low)
        sums = np.zeros(4)
        points, weights = np.polynomial.legendre.leggauss(8)  # exact to degree 15
        for a, b in pairwise(np.clip(np.array(self.breaks) * self.length, low, high)):
            x = a + 0.5 * (b - a) * (points + 1.0)
            w = 0.5 * (b - a) * weights
            m = w * self.mass_per_length * self.factor("mass", x / self.length)
            polar = w * self.polar_inertia_per_length * self.factor("polar", x / self.length)
            sums += [m.sum(), m @ x, m @ x**2, polar.sum()]
        return tuple(sums.tolist())


@dataclass(frozen=True)
class Payload:
    """Rigid body at the last link's tip."""

    mass: float = 0.0  # [kg]
    inertia: tuple = ((0.0,) * 3,) * 3  # [kg m^2] about its centre of mass, tip frame
    offset: tuple = (0.0, 0.0, 0.0)  # [m] centre of mass from the tip


@dataclass(frozen=True)
class Gauge:
    """A strain gauge, or the bridge it stands for.

    The strain read is ``gain * (-c y''(eta)) + bias + drift + noise`` for bending along y or z, with the
    curvature ``y''`` at `position` and `surface_distance` c, and ``gain * c theta'(eta) + ...`` for twist. The reading
    is rounded to the bridge's steps and clipped to its range.
    """

    name: str
    link: str
    position: float  # [m] from the link's base
    direction: str
    surface_distance: float  # [m] from the neutral axis; its sign gives the face
    gain: float = 1.0  # [-]
    bias: float = 0.0  # [-] strain
    noise: float = 0.0  # [-] rms strain
    bits: int = 0  # [-] of the bridge's converter, from -full_scale to full_scale; 0: not quantised
    full_scale: float = 1000e-6  # [-] strain at both ends of the range, without sign
    drift: float = 0.0  # [1/sqrt(s)] strain: rms change of the bias over a second, a random walk
    point: str = ""  # on a link given by reduced matrices: the archive's name of its place

    @property
    def step(self):
        """Strain of one count of the converter [-]; 0 without one."""
        return 2.0 * self.full_scale / 2**self.bits if self.bits else 0.0

    @property
    def range(self):
        """Lowest and highest reading [-]; a converter's highest count is one step below +full_scale."""
        return -self.full_scale, self.full_scale - self.step

    @property
    def uncertainty(self):
        """Rms error of one reading [-]: its noise and the error of rounding, step / sqrt(12)."""
        return float(np.hypot(self.noise, self.step / np.sqrt(12.0)))


#: `Mode.direction` of the deflection of a joint's transmission.
TRANSMISSION = "transmission"


@dataclass(frozen=True)
class Mode:
    """A modal coordinate: its link (for a transmission: its joint), direction and number (from 1)."""

    link: str
    direction: str
    number: int

    @property
    def name(self):
        """Name on every topic: ``link1_y_mode1``, ``joint1_transmission``."""
        if self.direction == TRANSMISSION:
            return f"{self.link}_{TRANSMISSION}"
        return f"{self.link}_{self.direction}_mode{self.number}"


@dataclass(frozen=True)
class Arm:
    """A serial arm; the result of reading an arm file."""

    name: str
    joints: tuple
    links: tuple
    payload: Payload = Payload()
    gauges: tuple = ()
    observed_modes: tuple = ()  # names; all modes of the arm's links unless the file states them
    gravity: tuple = (0.0, 0.0, 0.0)  # [m/s^2] in the base frame
    foreshortening: bool = False  # links keep their length, so they are stiffer when they spin
    finite_slope: bool = False  # curvature and tip angles are correct for large slopes, too
    model: str = "chain"  # name of the model class, found through entry points
    model_options: dict = field(default_factory=dict)  # options of that class only, SI
    description: str = ""
    source: str = ""
    simplifies: "Arm | None" = (
        None  # the actual arm, if this one is how a controller knows it, see `known`
    )

    @property
    def known(self):
        """The arm as observer and controller know it: with its links fixed to the motors.

        No sensor measures the deflection of a transmission, so it is not one of their states.
        """
        if all(j.transmission is None for j in self.joints):
            return self
        joints = tuple(replace(j, transmission=None) for j in self.joints)
        return replace(self, joints=joints, simplifies=self)

    @property
    def whole(self):
        """The actual arm with its transmissions, even if this one is the `known` arm."""
        return self if self.simplifies is None else self.simplifies

    @property
    def without_play(self):
        """The same arm with all play closed."""
        if not any(j.transmission and j.transmission.play for j in self.joints):
            return self
        closed = (j.transmission and replace(j.transmission, play=0.0) for j in self.joints)
        joints = (replace(j, transmission=t) for j, t in zip(self.joints, closed, strict=True))
        return replace(self, joints=tuple(joints))

    @property
    def joint_names(self):
        """Joint names, base to tip."""
        return tuple(j.name for j in self.joints)

    @property
    def modes(self):
        """All modal coordinates: link by link, direction by direction, mode by mode; then the transmissions."""
        bending = tuple(
            Mode(link.name, direction, i + 1)
            for link in self.links
            for direction in DIRECTIONS
            if direction in link.flexible
            for i in range(link.flexible[direction].modes)
        )
        return bending + tuple(Mode(j.name, TRANSMISSION, 1) for j in self.joints if j.transmission)

    @property
    def mode_names(self):
        """Names of all modal coordinates in order."""
        return tuple(m.name for m in self.modes)

    @property
    def gauge_names(self):
        """Gauge names in the file's order."""
        return tuple(g.name for g in self.gauges)

    @property
    def position_limits(self):
        """Lowest and highest position of each joint, (n, 2) [rad]; infinite where the file has none."""
        return np.array([j.limits.position for j in self.joints], float)

    @property
    def reach(self):
        """Length of all links together [m]."""
        return sum(link.length for link in self.links)

    @property
    def velocity_limits(self):
        """Largest speed of each joint, (n,) [rad/s]; infinite where the file has none."""
        return np.array([j.limits.velocity for j in self.joints], float)

    @property
    def continuous(self):
        """Whether each joint may turn without end, (n,) bool."""
        return np.array([j.continuous for j in self.joints], bool)

    @property
    def torque_limits(self):
        """Largest torque of each joint, (n,) [N m]; infinite where the file has none."""
        return np.array([j.limits.torque for j in self.joints], float)

    @property
    def torque_rates(self):
        """Largest change of each joint's torque per second, (n,) [N m/s]; infinite where the file has none."""
        return np.array([j.limits.torque_rate for j in self.joints], float)

    def link(self, name):
        """The link called `name`."""
        return next(link for link in self.links if link.name == name)

    @property
    def most_modes(self):
        """Largest number of modes in any direction of any link; 0 for a rigid arm."""
        return max((f.modes for link in self.links for f in link.flexible.values()), default=0)

    def with_modes(self, count):
        """The same arm with `count` modes in every flexible direction of every link.

        Gauges stay as they are, and so do observed modes that the arm still has. Modes that the controller does not
        know strain the gauges, too: this is spill-over.
        """
        if self.simplifies is not None:
            return self.simplifies.with_modes(count).known
        if not 1 <= count <= MAX_MODES:
            field, limit = f"modes of {self.name}", f"1 to {MAX_MODES}"
            raise ModelError("is out of range", field=field, value=count, limit=limit)
        for link in self.links:
            for direction, f in link.flexible.items():
                if f.shape == "from_frequencies" and len(f.frequencies) < count:
                    raise ModelError(
                        "is more than the measured frequencies",
                        field=f"modes of {self.name}: {link.name} in {direction}",
                        value=count,
                        limit=len(f.frequencies),
                    )
        links = tuple(
            replace(
                link,
                flexible={
                    d: replace(f, modes=link.available(count), frequencies=f.frequencies[:count])
                    for d, f in link.flexible.items()
                },
            )
            for link in self.links
        )
        arm = replace(self, links=links)
        kept = tuple(n for n in self.observed_modes if n in arm.mode_names)
        return replace(arm, observed_modes=kept)

    def fuller(self, modes, stiffens, finite_slope):
        """The arm with more modes and more of its kinematics, as far as possible; see `ArmModel.fuller`."""
        arm = self
        for count in range(modes, self.most_modes, -1):
            with contextlib.suppress(ModelError):  # fewer frequencies were measured
                arm = self.with_modes(count)
                break
        if arm.model != "chain" or not arm.most_modes:
            return arm
        stiffens, finite_slope = arm.foreshortening or stiffens, arm.finite_slope or finite_slope
        return replace(arm, foreshortening=stiffens, finite_slope=finite_slope)


def scaled(arm, payload=1.0, stiffness=1.0, damping=1.0):
    """The same arm with another payload, stiffness or damping: for tests of a controller designed for the original.

    Gauges, observed modes and everything else stay. Mode shapes that depend on the payload (`loaded`) change with it.

    Parameters
    ----------
    arm : Arm
    payload : float
        Factor of the payload's mass and inertia; its offset stays [-].
    stiffness : float
        Factor of every link's EI and GJ; transmissions stay. Measured frequencies (`from_frequencies`) change by its
        square root, so their shapes stay as they are [-].
    damping : float
        Factor of every modal damping ratio [-].

    Returns
    -------
    Arm

    Raises
    ------
    ModelError
        For a factor that is negative or not finite, or for a stiffness of 0.
    """
    for name, value in (("payload", payload), ("stiffness", stiffness), ("damping", damping)):
        low = value > 0.0 if name == "stiffness" else value >= 0.0
        if not (low and np.isfinite(value)):
            limit = "above 0, finite" if name == "stiffness" else "not below 0, finite"
            field = f"factor of the {name} of {arm.name}"
            raise ModelError("is out of range", field=field, value=value, limit=limit)
    if arm.simplifies is not None:
        return scaled(arm.simplifies, payload, stiffness, damping).known
    body = replace(
        arm.payload,
        mass=payload * arm.payload.mass,
        inertia=tuple(tuple(payload * i for i in row) for row in arm.payload.inertia),
    )
    return replace(
        arm, payload=body, links=tuple(_scaled_link(i, stiffness, damping) for i in arm.links)
    )


def _scaled_link(link, stiffness, damping):
    root = np.sqrt(stiffness)
    flexible = {
        d: replace(
            f,
            frequencies=tuple(float(root * v) for v in f.frequencies),
            damping=tuple(damping * v for v in f.damping),
        )
        for d, f in link.flexible.items()
    }
    rigidity = {d: stiffness * v for d, v in link.stiffness.items()}
    reduced = link.reduced and link.reduced.scaled(stiffness, damping * root)
    return replace(link, stiffness=rigidity, flexible=flexible, reduced=reduced)
