# SPDX-License-Identifier: Apache-2.0
"""Lists the numbers of an arm file that can be identified: path in the file, scale and smallest value of each."""

from dataclasses import dataclass, replace
from fnmatch import fnmatch

import numpy as np

from flexarm_dynamics.errors import FlexarmError

KEY = {"y": "EI_y", "z": "EI_z", "twist": "GJ"}


@dataclass(frozen=True)
class Quantity:
    """One number of an arm.

    Attributes
    ----------
    name : str
        Its path in the arm file, as ``joints[0].friction.viscous``.
    kind : str
        One of EI, damping, hub_inertia, motor_mass, viscous, coulomb, payload_mass, payload_inertia, gain, bias,
        position, transmission_stiffness and so on, and those of `strain_quantities`.
    where : tuple
        Index of the link, joint or gauge, then direction and mode.
    unit : str
    dimension : str
        As `flexarm_dynamics.arm.units` names it.
    scale : float
        Typical size of its changes; an interval is compared with it if the value is near zero.
    low : float
        Smallest possible value.
    """

    name: str
    kind: str
    where: tuple
    unit: str
    dimension: str
    scale: float
    low: float = 0.0

    def get(self, arm):
        """The value in an arm [SI]."""
        return float(_GET[self.kind](arm, *self.where))

    def put(self, arm, value):
        """The arm with another value."""
        return _PUT[self.kind](arm, float(value), *self.where)


def quantities(arm, recording):
    """All quantities of an arm that can be identified, in the file's order.

    The torques and speeds of the `recording` give a scale for friction if the file has none.
    """
    found = []
    torque = np.abs(recording.torque).max(axis=0)
    moved = np.abs(np.gradient(recording.position, recording.period, axis=0))
    speed = np.maximum(np.percentile(moved, 98, axis=0), 1e-3)
    for i in range(len(arm.joints)):
        at, tau = f"joints[{i}]", max(float(torque[i]), 1e-6)
        found += [
            quantity(arm, f"{at}.hub_inertia", "hub_inertia", (i,), "kg m^2", "inertia", 1e-3),
            quantity(
                arm, f"{at}.friction.viscous", "viscous", (i,), "N m s/rad", "viscous",
                0.02 * tau / float(speed[i]),
            ),
            quantity(arm, f"{at}.friction.coulomb", "coulomb", (i,), "N m", "torque", 0.02 * tau),
        ]  # fmt: skip
    for i, link in enumerate(arm.links):
        for direction, flexibility in link.flexible.items():
            at = f"links[{i}]"
            if link.uniform:  # the file gives sections in place of a stiffness
                name = f"{at}.{KEY[direction]}"
                found.append(quantity(arm, name, "EI", (i, direction), "N m^2", "stiffness", 1e-6))
            for k in range(flexibility.modes):
                name = f"{at}.flexible.{direction}.damping[{k}]"
                found.append(quantity(arm, name, "damping", (i, direction, k), "-", "none", 2e-3))
    least = 0.02 * sum(link.mass for link in arm.links)
    found.append(quantity(arm, "payload.mass", "payload_mass", (), "kg", "mass", least))
    if np.any(arm.payload.inertia):
        name = "payload.inertia"
        found.append(quantity(arm, name, "payload_inertia", (), "kg m^2", "inertia", 1e-9))
    for i, gauge in enumerate(arm.gauges):
        if np.isfinite(recording.strain[:, i]).any():
            gain, bias = f"gauges[{i}].gain", f"gauges[{i}].bias"
            low = 0.0 if gauge.gain > 0.0 else -np.inf
            found.append(quantity(arm, gain, "gain", (i,), "-", "none", 1e-3, low))
            found.append(quantity(arm, bias, "bias", (i,), "strain", "none", 1e-5, -np.inf))
    return found


def quantity(arm, name, kind, where, unit, dimension, least, low=0.0):
    """A quantity whose scale is its value in the file, at least `least`."""
    made = Quantity(name, kind, where, unit, dimension, least, low)
    return replace(made, scale=max(abs(made.get(arm)), least))


def held(found, patterns):
    """Names of the quantities `found` that match one of the `patterns`; a pattern that matches none is refused."""
    names = set()
    for pattern in patterns:
        # The brackets of a path are literal, not a character class.
        literal = pattern.replace("[", "[[]")
        match = {q.name for q in found if fnmatch(q.name, literal)}
        if not match:
            known = ", ".join(q.name for q in found)
            raise FlexarmError("matches no parameter", field="--hold", value=pattern, limit=known)
        names |= match
    return names


def changed(arm, found, values):
    """The arm with the values of several quantities."""
    for quantity, value in zip(found, values, strict=True):
        arm = quantity.put(arm, value)
    return arm


# Each kind's place in an `Arm` ------------------------------------------------------------------


def _transmission(arm, i, **fields):
    return _joint(arm, i, transmission=replace(arm.joints[i].transmission, **fields))


def _at(items, i, item):
    return (*items[:i], item, *items[i + 1 :])


def _joint(arm, i, **fields):
    return replace(arm, joints=_at(arm.joints, i, replace(arm.joints[i], **fields)))


def _friction(arm, i, **fields):
    return _joint(arm, i, friction=replace(arm.joints[i].friction, **fields))


def _link(arm, i, **fields):
    return replace(arm, links=_at(arm.links, i, replace(arm.links[i], **fields)))


def _flexibility(arm, i, direction, **fields):
    flexible = dict(arm.links[i].flexible)
    flexible[direction] = replace(flexible[direction], **fields)
    return _link(arm, i, flexible=flexible)


def _put_stiffness(arm, value, i, direction):
    link, flexibility = arm.links[i], arm.links[i].flexible[direction]
    ratio = np.sqrt(value / link.stiffness[direction])
    arm = _link(arm, i, stiffness={**link.stiffness, direction: value})
    if not flexibility.frequencies:
        return arm
    # Measured frequencies determine the shapes. If they are scaled with the stiffness, the shapes do not change.
    frequencies = tuple(float(ratio * f) for f in flexibility.frequencies)
    return _flexibility(arm, i, direction, frequencies=frequencies)


def damping_of(flexibility):
    """Damping ratio of each mode, the last one repeated."""
    given = flexibility.damping or (0.0,)
    return tuple(given[min(k, len(given) - 1)] for k in range(flexibility.modes))


def _put_damping(arm, value, i, direction, k):
    all_of_them = damping_of(arm.links[i].flexible[direction])
    return _flexibility(arm, i, direction, damping=_at(all_of_them, k, value))


def _payload_scale(arm):
    """Mean of the payload's principal inertias [kg m^2]; if the inertia is one number, that number."""
    return float(np.trace(np.array(arm.payload.inertia))) / 3.0


def _put_payload_inertia(arm, value):
    factor = value / _payload_scale(arm)
    inertia = tuple(tuple(factor * x for x in row) for row in arm.payload.inertia)
    return replace(arm, payload=replace(arm.payload, inertia=inertia))


def _gauge(arm, i, **fields):
    return replace(arm, gauges=_at(arm.gauges, i, replace(arm.gauges[i], **fields)))


_GET = {
    "hub_inertia": lambda arm, i: arm.joints[i].hub_inertia,
    "motor_mass": lambda arm, i: arm.joints[i].motor_mass,
    "viscous": lambda arm, i: arm.joints[i].friction.viscous,
    "coulomb": lambda arm, i: arm.joints[i].friction.coulomb,
    "mass_per_length": lambda arm, i: arm.links[i].mass_per_length,
    "EI": lambda arm, i, d: arm.links[i].stiffness[d],
    "damping": lambda arm, i, d, k: damping_of(arm.links[i].flexible[d])[k],
    "payload_mass": lambda arm: arm.payload.mass,
    "payload_inertia": _payload_scale,
    "gain": lambda arm, i: arm.gauges[i].gain,
    "bias": lambda arm, i: arm.gauges[i].bias,
    "position": lambda arm, i: arm.gauges[i].position,
}
_PUT = {
    "hub_inertia": lambda arm, v, i: _joint(arm, i, hub_inertia=v),
    "motor_mass": lambda arm, v, i: _joint(arm, i, motor_mass=v),
    "viscous": lambda arm, v, i: _friction(arm, i, viscous=v),
    "coulomb": lambda arm, v, i: _friction(arm, i, coulomb=v),
    "mass_per_length": lambda arm, v, i: _link(arm, i, mass_per_length=v),
    "EI": _put_stiffness,
    "damping": _put_damping,
    "payload_mass": lambda arm, v: replace(arm, payload=replace(arm.payload, mass=v)),
    "payload_inertia": _put_payload_inertia,
    "gain": lambda arm, v, i: _gauge(arm, i, gain=v),
    "bias": lambda arm, v, i: _gauge(arm, i, bias=v),
    "position": lambda arm, v, i: _gauge(arm, i, position=v),
}
for _part in ("stiffness", "damping", "play", "load_damping", "rounding", "play_damping"):
    _GET[f"transmission_{_part}"] = lambda arm, i, part=_part: getattr(
        arm.joints[i].transmission, part
    )
    _PUT[f"transmission_{_part}"] = lambda arm, v, i, part=_part: _transmission(arm, i, **{part: v})
