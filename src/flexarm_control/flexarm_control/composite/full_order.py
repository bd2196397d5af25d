# SPDX-License-Identifier: Apache-2.0
r"""The full order closed loop, sampled: the arm with its bending under a composite control, linearised at rest.

The arm (2), linear about rest in a configuration, held by its torque against gravity, moves exactly from sample to
sample,

.. math:: s_{k+1} = \Phi s_k + \Gamma u_k, \qquad s = (q, \delta, \dot q, \dot\delta),

and the control law is linearised as it is: its own `step` is differenced, so that whatever slow law, manifold and
fast law there is counts. A fast law with states of its own brings them along, and a delay keeps the torques
under way. Poles are given as those of continuous time, s = ln(z) / T.
"""

import numpy as np

from flexarm_dynamics.errors import DesignError
from flexarm_dynamics.linear import jacobian, linear_plant, sampled, state_at_rest

from ..component import at_rest
from ..fast.none import NoFastLaw

#: A pole may grow this fast [1/s] before a design counts as unstable where no margin is asked for: rounding.
ROUNDING = 1e-6


def linear_law(law, q):
    """A composite control `law` linearised at rest: what the slow part does, and what the fast part sees.

    Returns
    -------
    U : ndarray, shape (n, 2 (n + m))
        Slow torque, the manifold's feed-forward included.
    Z : ndarray, shape (2m, 2 (n + m))
        z_f of the fast law.
    """
    model = law.model
    n, m = model.n_joints, model.n_modes
    # The fast law's gain is known.
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
        Where, at rest [rad].
    period : float
        [s]
    delay : float
        From the measurement to the torque [s].
    plant : ArmModel, optional
        The arm itself, when it is not the law's model; of as many modes.
    gain : float
        Of the torque on its way to the arm [-].

    Returns
    -------
    ndarray
        Of (s, the fast law's states, torques under way, newest last).
    """
    model = law.model
    # A law that compensates Coulomb friction takes it to be as steep as at rest; to another one it is no damping.
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
        """Rows of u_{k - age} in the state."""
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
    """Poles of the sampled closed loop as those of continuous time [1/s], slowest first."""
    z = np.linalg.eigvals(closed_loop(law, q, period, delay, plant, gain)).astype(complex)
    z = z[np.abs(z) > 1e-12]  # dead-beat: a delay's own
    s = np.log(z) / period
    return s[np.lexsort((s.imag, -s.real))]


def check(law, q, rate, margin=0.0):
    """Refuse a design whose full-order poles, sampled at a `rate` [Hz], are not left of -margin [1/s].

    Raises
    ------
    DesignError
        Naming the pole of the `law` in the configuration q of its design.
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
