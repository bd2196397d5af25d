# SPDX-License-Identifier: Apache-2.0
"""Lists what strains under a prescribed motion can determine: numbers of the arm file and of the recording.

In addition to those of `quantities`, these are the parameters of transmissions, what moves with the joints, and the
positions of gauges. Quantities of the recording alone are the error of each joint's zero angle, and the delay and drift
of each channel. Strains show only the ratio of mass and stiffness, not both, so masses per length keep the file's
value.
"""

from dataclasses import dataclass, replace

import numpy as np

from .quantities import KEY, Quantity, damping_of, quantity

#: Parameters of a transmission: dimension, unit, and smallest scale.
TRANSMISSION = {
    "stiffness": ("torque", "N m/rad", 1.0),
    "damping": ("viscous", "N m s/rad", 0.5),
    "play": ("none", "rad", 2e-3),
    "load_damping": ("none", "s/rad", 0.1),
    "rounding": ("none", "rad", 5e-4),
    "play_damping": ("viscous", "N m s/rad", 0.5),
}
#: Parameters that have an effect only if there is play.
OF_PLAY = ("rounding", "play_damping")
#: Scales of what belongs to the recording: angle [rad], delay [s], drift over the recording [-].
OFFSET, DELAY, DRIFT = 0.02, 0.005, 1e-5


@dataclass(frozen=True, eq=False)
class Setup:
    """An arm, and how it was recorded.

    Attributes
    ----------
    arm : Arm
    offset : ndarray, shape (n,)
        Angle of each joint minus the recorded one [rad].
    delay : ndarray, shape (g,)
        Time by which each strain channel is late [s].
    drift : ndarray, shape (g,)
        Drift of each reading over the fitted part [-].
    """

    arm: object
    offset: np.ndarray
    delay: np.ndarray
    drift: np.ndarray

    @classmethod
    def of(cls, arm):
        """An arm recorded without offset, delay and drift."""
        n, g = len(arm.joints), len(arm.gauges)
        return cls(arm, np.zeros(n), np.zeros(g), np.zeros(g))


#: Kinds that belong to the recording, and the attribute of `Setup` that has them.
OF_RECORDING = {"offset": "offset", "delay": "delay", "drift": "drift"}
#: Kinds that only change the readings of the gauges, not the motion of the arm.
OF_GAUGES = ("gain", "bias", "position", "delay", "drift")


def value_of(setup, q):
    """Value of the `Quantity` `q` in a `Setup` [SI]."""
    if q.kind in OF_RECORDING:
        return float(getattr(setup, OF_RECORDING[q.kind])[q.where[0]])
    return q.get(setup.arm)


def changed(setup, found, values):
    """The `Setup` with other values of the quantities `found`."""
    arm, of = setup.arm, {name: getattr(setup, name).copy() for name in OF_RECORDING.values()}
    for q, value in zip(found, values, strict=True):
        if q.kind in OF_RECORDING:
            of[OF_RECORDING[q.kind]][q.where[0]] = value
        elif value != q.get(arm):
            arm = q.put(arm, value)
    return Setup(arm, **of)


def strain_quantities(arm, recording):
    """All quantities of an `arm` that strains of a `recording` may determine, in the file's order."""
    made = []
    add = lambda *given: made.append(quantity(arm, *given))  # noqa: E731
    for i, joint in enumerate(arm.joints):
        at = f"joints[{i}]"
        if joint.transmission is not None or i > 0:
            add(f"{at}.hub_inertia", "hub_inertia", (i,), "kg m^2", "inertia", 1e-3)
        if i > 0:
            add(f"{at}.motor_mass", "motor_mass", (i,), "kg", "mass", 0.02)
        if joint.transmission is not None:
            for part, (dimension, unit, least) in TRANSMISSION.items():
                if joint.transmission.play > 0.0 or part not in OF_PLAY:
                    name = f"{at}.transmission.{part}"
                    add(name, f"transmission_{part}", (i,), unit, dimension, least)
        made.append(
            Quantity(f"{joint.name} offset", "offset", (i,), "rad", "none", OFFSET, -np.inf)
        )
    for i, link in enumerate(arm.links):
        if link.uniform:  # the file gives sections in place of these
            name = f"links[{i}].mass_per_length"
            add(name, "mass_per_length", (i,), "kg/m", "mass_per_length", 1e-3)
        for direction, flexibility in link.flexible.items():
            if link.uniform:
                name = f"links[{i}].{KEY[direction]}"
                add(name, "EI", (i, direction), "N m^2", "stiffness", 1e-6)
            for k in range(len(damping_of(flexibility))):
                name = f"links[{i}].flexible.{direction}.damping[{k}]"
                add(name, "damping", (i, direction, k), "-", "none", 1e-2)
    add("payload.mass", "payload_mass", (), "kg", "mass", 0.02)
    if np.any(arm.payload.inertia):
        add("payload.inertia", "payload_inertia", (), "kg m^2", "inertia", 1e-9)
    for i, gauge in enumerate(arm.gauges):
        if not np.isfinite(recording.strain[:, i]).any():
            continue
        low = 0.0 if gauge.gain > 0.0 else -np.inf
        add(f"gauges[{i}].gain", "gain", (i,), "-", "none", 1e-3, low)
        add(f"gauges[{i}].bias", "bias", (i,), "strain", "none", 1e-5, -np.inf)
        add(f"gauges[{i}].position", "position", (i,), "m", "length", 1e-3)
        made += [
            Quantity(f"{gauge.name} delay", "delay", (i,), "s", "none", DELAY, -np.inf),
            Quantity(f"{gauge.name} drift", "drift", (i,), "strain", "none", DRIFT, -np.inf),
        ]
    return made


def with_offset(arm, offset):
    """The arm with its joints' origins turned by `offset` (n,) [rad], so that recorded angles are its joint angles."""
    from flexarm_dynamics.models.model import about_axis, rotation

    joints = []
    for joint, angle in zip(arm.joints, offset, strict=True):
        if angle:
            turn = rotation(joint.origin_rpy) @ about_axis(joint.axis, float(angle))
            joint = replace(joint, origin_rpy=roll_pitch_yaw(turn))
        joints.append(joint)
    return replace(arm, joints=tuple(joints))


def roll_pitch_yaw(R):
    """Angles, as in URDF, of a rotation matrix [rad]."""
    pitch = np.arctan2(-R[2, 0], np.hypot(R[0, 0], R[1, 0]))
    angles = np.arctan2(R[2, 1], R[2, 2]), pitch, np.arctan2(R[1, 0], R[0, 0])
    return tuple(float(a) + 0.0 for a in angles)  # no -0.0 in files
