# SPDX-License-Identifier: Apache-2.0
r"""Suggests what to measure next, from the covariance of a fit: what narrows most of the other intervals.

Once a parameter j is known, the variance of i is :math:`P_{ii} - P_{ij}^2/P_{jj}`. Its interval is then narrower by the
factor :math:`\sqrt{1 - \rho_{ij}^2}`, where :math:`\rho` is the correlation. Parameters that the motion determines
badly, and those that narrow many intervals, come first.
"""

import numpy as np

#: An interval is mentioned only if it becomes narrower by at least this factor [-].
NARROWER = 0.7
#: Max. number of suggestions, and of names in each.
MAX_SUGGESTIONS, MAX_NAMES = 6, 4
#: Correlations of at least this size are mentioned [-].
STRONG = 0.9

#: How to measure a kind of quantity by itself.
HOW = {
    "payload_mass": "weigh it",
    "payload_inertia": "compute it from the payload's shape, or let it swing as a pendulum",
    "motor_mass": "weigh the motor with its housing, or read its data sheet",
    "mass_per_length": "weigh a piece of the link, or multiply section and density",
    "hub_inertia": "compute it from the drawing",
    "EI": "clamp the link, hang a known mass on its end and read the deflection",
    "GJ": "clamp the link, twist it by a known torque and read the angle",
    "damping": "record the link's ring-down, clamped at its base",
    "gain": "load the clamped link by known masses and read the gauge",
    "bias": "record a rest in a configuration without bending moment at the gauge",
    "position": "measure it with a ruler",
    "offset": "put a level on the link and read the joint's angle",
    "delay": "record a tap on the link at the recorder's highest rate",
    "drift": "record some minutes of rest",
    "transmission_stiffness": "hold the motor, load the link by known masses on both sides and read its angle",
    "transmission_play": "hold the motor, move the link by hand between the flanks and read its angle",
    "transmission_rounding": "hold the motor, load the link by small masses on both sides and read its angle",
    "transmission_damping": "record ring-downs under full load of the gear, the motor held",
    "transmission_load_damping": "record ring-downs with two loads of the gear that differ much",
    "transmission_play_damping": "record ring-downs where the weight changes the side of the play",
    "viscous": "turn the joint at several constant speeds and read the torque",
    "coulomb": "turn the joint slowly both ways and read the torque",
}
ELSE = "move this joint or link more, or measure it by itself"


def correlations(found):
    """Indices (f,) of the fitted quantities of a fit, and their correlation, shape (f, f)."""
    fitted = np.flatnonzero(np.isfinite(found.half_widths))
    P = found.covariance[np.ix_(fitted, fitted)]
    deviation = np.sqrt(np.maximum(np.diag(P), 1e-300))
    return fitted, np.clip(P / np.outer(deviation, deviation), -1.0, 1.0)


def strongest(found, count=8):
    """Pairs of quantities with a correlation above `STRONG`: (name, name, correlation), the strongest first.

    Parameters
    ----------
    found : Identified or StrainFit
    count : int
        Max. number of pairs.
    """
    fitted, rho = correlations(found)
    rows, columns = np.triu_indices(len(fitted), 1)
    order = np.argsort(-np.abs(rho[rows, columns]))[:count]
    names = [found.quantities[j].name for j in fitted]
    pairs = [(names[rows[k]], names[columns[k]], float(rho[rows[k], columns[k]])) for k in order]
    return [pair for pair in pairs if abs(pair[2]) >= STRONG]


def suggestions(found):
    """What to measure next, as plain data, the most useful first.

    Parameters
    ----------
    found : Identified or StrainFit

    Returns
    -------
    list of dict
        ``name``, ``how``, ``why``: sentences; ``narrows``: name of another quantity to the factor of its interval.
    """
    fitted, rho = correlations(found)
    with np.errstate(divide="ignore"):
        relative = found.half_widths[fitted] / np.abs(found.values[fitted])
    factor = np.sqrt(np.maximum(1.0 - rho**2, 0.0))
    np.fill_diagonal(factor, 1.0)
    gain = -np.sum(np.log(np.maximum(factor, 1e-3)), axis=0)
    gain += np.minimum(np.log1p(relative), 3.0)
    made = []
    for k in np.argsort(-gain):
        q = found.quantities[fitted[k]]
        narrows = {
            found.quantities[fitted[i]].name: float(factor[i, k])
            for i in np.argsort(factor[:, k])
            if factor[i, k] < NARROWER
        }
        weak = q.name in found.undetermined
        if len(made) < MAX_SUGGESTIONS and (narrows or weak):
            made.append(
                {
                    "name": q.name,
                    "how": HOW.get(q.kind, ELSE),
                    "why": _why(weak, relative[k], narrows),
                    "narrows": narrows,
                }
            )
    return made


def _why(weak, relative, narrows):
    parts = []
    if weak:
        parts.append(f"its interval is {100.0 * relative:.0f} % of its value")
    if narrows:
        first = list(narrows.items())[:MAX_NAMES]
        more = f" and {len(narrows) - len(first)} more" if len(narrows) > len(first) else ""
        shown = ", ".join(f"{name} to {100.0 * f:.0f} %" for name, f in first)
        parts.append(f"once it is known, intervals become narrower: {shown}{more}")
    return "; ".join(parts)
