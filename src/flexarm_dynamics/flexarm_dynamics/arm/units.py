# SPDX-License-Identifier: Apache-2.0
"""Converts to SI, once on reading; everything inside is SI.

A dimension is written as powers of force and length; time is in seconds in both systems. Imperial means ft, lbf, s, so
mass is in lbf s^2/ft (slug) and inertia in lbf ft s^2.
"""

FOOT = 0.3048  # [m], exact
POUND_FORCE = 4.4482216152605  # [N], exact
POUND_FORCE_FOOT = POUND_FORCE * FOOT  # [N m]

#: Dimension of a field: (power of force, power of length). Time is in seconds in both systems.
DIMENSIONS = {
    "none": (0, 0),
    "angle": (0, 0),
    "frequency": (0, 0),
    "time": (0, 0),
    "length": (0, 1),
    "acceleration": (0, 1),
    "mass": (1, -1),
    "inertia": (1, 1),
    "mass_per_length": (1, -2),
    "density": (1, -4),
    "stress": (1, -2),
    "stiffness": (1, 2),
    "torque": (1, 1),
    "viscous": (1, 1),
}

#: SI unit of each dimension, for messages and tables.
SI_UNIT = {
    "none": "-",
    "angle": "rad",
    "frequency": "Hz",
    "time": "s",
    "length": "m",
    "acceleration": "m/s^2",
    "mass": "kg",
    "inertia": "kg m^2",
    "mass_per_length": "kg/m",
    "density": "kg/m^3",
    "stress": "Pa",
    "stiffness": "N m^2",
    "torque": "N m",
    "viscous": "N m s/rad",
}


def to_si(system, dimension):
    """Factor from `system` (`si` or `imperial`) to SI for a quantity of `dimension`."""
    if system == "si":
        return 1.0
    force, length = DIMENSIONS[dimension]
    return POUND_FORCE**force * FOOT**length
