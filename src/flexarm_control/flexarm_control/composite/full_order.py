# SPDX-License-Identifier: Apache-2.0
r"""The sampled full-order closed loop: the arm with its bending under a composite control, linearised at rest.

The arm (2) is linearised about rest in a configuration, where its torque holds it against gravity. From sample to
sample it moves exactly by

.. math:: s_{k+1} = \Phi s_k + \Gamma u_k, \qquad s = (q, \delta, \dot q, \dot\delta) .

The control law is linearised by finite differences of its own `step`, so this works for any slow law and manifold. The
gain or the states of the fast law, and the torques under way in a delay, are added to the loop. Poles are given as
those of continuous time, s = ln(z) / T.
"""

import numpy as np

from flexarm_dynamics.errors import DesignError
from flexarm_dynamics.linear import jacobian, linear_plant, sampled, state_at_rest

from ..component import at_rest
from ..fast.none import NoFastLaw

#: Allowance for rounding [1/s]: a pole may lie this far to the right of minus the margin.
ROUNDING = 1e-6


def linear_law(law, q):
    """A composite control `law` linearised at rest: the output of its slow part and the input of its fast part.

    Returns
    -------
    U : ndarray, shape (n, 2 (n + m))
        Matrix of the slow torque, including the manifold's feed-forward.
    Z : ndarray, shape (2m, 2 (n + m))
        Matrix of the fast law's z_f.
    """
    model = law.model
    n, m = model.n_joints, model.n_modes
    # The fast law is left out here, because its gain or compensator is known.
    reference, plain = at_rest(q), type(law)(model, law.slow, NoFastLaw(model, {}), law.manifold)

    def response(s):
        a, delta, ad, delta_d = np.split(s, [n, n + m, 2 * n + m])
        plain.step(a, ad, delta, delta_d, reference)
        return np.concatenate([plain.slow_torque, plain.deviation])

    with law.slow.without_friction():
        both = jacobian(response, state_at_rest(model, q))
    return both[:n], both[n:]


def closed_loop(law, q, period, delay=0.0, plant=None, gain=1.0):
    """Transition matrix of the sampled closed loop.

    Parameters
    ----------
    law : CompositeControl
    q : ndarray, shape (n,)
        Configuration of rest [rad].
    period : float
        Sampling period [s].
    delay : float
        Time from the measurement to the torque [s].
    plant : ArmModel, optional
        The arm itself, if it is not the law's model; it must have as many modes.
    gain : float
        Factor of the torque on its way to the arm [-].

    Returns
    -------
    ndarray
        Matrix for (s, the fast law's states, torques under way, newest last).
    """
    model = law.model
    # A slow law with model terms compensates Coulomb friction with its slope at rest, so the plant has this slope, too.
    # For a `separate` law the plant has no Coulomb friction, so that friction does not count as damping.
    A, B = linear_plant(plant or model, np.asarray(q, float), not law.slow.separate)
    B = gain * B
    n = B.shape[1]
    U, Z = linear_law(law, q)
    compensator = law.fast.state_space(period)
    if compensator is None:
        K = law.fast.gain(np.asarray(q, float))
        compensator = np.zeros((0, 0)), np.zeros((0, len(Z))), np.zeros((n, 0)), K
    Ac, Bc, Cc, Dc = compensator
    size, w, whole = A.shape[0], len(Ac), int(delay / period + 1e-9)
    late = delay - whole * period
    # u_{k-whole-1} acts until `late`, then u_{k-whole}.
    later, end = sampled(A, B, period - late)
    split = late > 1e-12
    under_way = whole + split
    total = size + w + n * under_way
    F = np.zeros((total, total))
    F[:size, :size] = sampled(A, B, period)[0]
    F[size : size + w, : size + w] = np.hstack([Bc @ Z, Ac])
    command = np.zeros((n, total))
    command[:, : size + w] = np.hstack([U + Dc @ Z, Cc])

    def torque(age):
        """Rows that select u_{k - age} from the state."""
        at = total - n * age
        return np.eye(total)[at : at + n] if age else command

    F[:size] += end @ torque(whole)
    if split:
        F[:size] += later @ sampled(A, B, late)[1] @ torque(whole + 1)
    for age in range(under_way, 0, -1):  # oldest first
        at = total - n * age
        F[at : at + n] = torque(age - 1)
    return F


def poles(law, q, period, delay=0.0, plant=None, gain=1.0):
    """Poles of the sampled closed loop, converted to continuous time [1/s], slowest first."""
    z = np.linalg.eigvals(closed_loop(law, q, period, delay, plant, gain)).astype(complex)
    z = z[np.abs(z) > 1e-12]  # without the dead-beat poles of the delay
    s = np.log(z) / period
    return s[np.lexsort((s.imag, -s.real))]


def check(law, q, rate, margin=0.0):
    """Refuse a design whose full-order poles, sampled at a `rate` [Hz], are not left of -margin [1/s].

    Raises
    ------
    DesignError
        It names the pole of the `law` in the configuration q of its design.
    """
    field = f"poles of the full-order closed loop, sampled at {rate:g} Hz"
    try:
        slowest = poles(law, q, 1.0 / rate)[0]
    except np.linalg.LinAlgError as error:
        hint = "lower the gains, they are beyond what a double holds"
        raise DesignError(f"can't be computed ({error})", field=field, hint=hint) from None
    if slowest.real < -margin + ROUNDING:
        return
    real, imag = (float(f"{part:.4g}") for part in (slowest.real, abs(slowest.imag)))
    raise DesignError(
        f"1/s at joint configuration {np.round(q, 4).tolist()} is not left of -stability_margin",
        field=field,
        value=complex(real, imag) if imag else real,
        limit=0.0 - margin,
        hint="lower the gains (slow.kp, slow.kv, fast.q, fast.alpha), take manifold.type corrected, or a higher rate",
    )
