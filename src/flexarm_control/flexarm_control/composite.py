r"""Composite control, (12) of Siciliano & Book (1986): u = u_slow(x) + u_fast(x, z_f).

The deflections' quasi-steady state (9) under the slow torque is what the fast control holds on to:
z_f = z - z_bar(x, u_slow). On the manifold z_f = 0 and u_fast = 0.
"""

import numpy as np

from flexarm_dynamics import registry
from flexarm_dynamics.errors import ParameterError
from flexarm_dynamics.parameters import check_all
from flexarm_dynamics.singular_perturbation import quasi_steady_state

SLOW, FAST = "flexarm.slow_laws", "flexarm.fast_laws"


class CompositeControl:
    """Slow and fast law together; every array of the last step stays readable.

    Parameters
    ----------
    model : ArmModel
    slow : SlowLaw
    fast : FastLaw

    Attributes
    ----------
    slow_torque, fast_torque, torque : ndarray, shape (n,)
        [N m]
    quasi_steady : ndarray, shape (m,)
        delta_bar of (9) [m, rad].
    deviation : ndarray, shape (2m,)
        z_f = z - z_bar [m, rad, m/s, rad/s].
    """

    def __init__(self, model, slow, fast):
        self.model, self.slow, self.fast = model, slow, fast
        n, m = model.n_joints, model.n_modes
        self.slow_torque, self.fast_torque, self.torque = np.zeros(n), np.zeros(n), np.zeros(n)
        self.quasi_steady, self.deviation = np.zeros(m), np.zeros(2 * m)

    def step(self, q, qd, delta, delta_d, reference):
        """Torque for one sample; the control path.

        Parameters
        ----------
        q, qd : ndarray, shape (n,)
            Joint position and velocity [rad], [rad/s].
        delta, delta_d : ndarray, shape (m,)
            Modal amplitude and rate [m, rad], [m/s, rad/s].
        reference : object
            With `position`, `velocity`, `acceleration`, each (n,).

        Returns
        -------
        ndarray, shape (n,)
            u of (12) [N m]; before any limit. Overwritten by the next step.
        """
        m = delta.size
        terms = self.model.terms(q, qd)
        self.slow_torque[:] = self.slow.torque(q, qd, reference, terms)
        self.quasi_steady[:] = quasi_steady_state(terms, self.slow_torque)
        np.subtract(delta, self.quasi_steady, out=self.deviation[:m])
        self.deviation[m:] = delta_d  # the quasi-steady rates of (9) are zero
        self.fast_torque[:] = self.fast.torque(self.deviation)
        np.add(self.slow_torque, self.fast_torque, out=self.torque)
        return self.torque


def sizes(model):
    """Lengths by the names that parameter declarations use."""
    return {"joints": model.n_joints, "modes": model.n_modes, "z": 2 * model.n_modes}


def design_law(group, name, model, values):
    """Find a law by name, check its parameters and design it.

    Parameters
    ----------
    group : str
        `SLOW` or `FAST`.
    name : str
        As registered.
    model : ArmModel
    values : mapping
        Parameter values without prefix; those of other laws are ignored by the caller, not here.

    Returns
    -------
    SlowLaw or FastLaw

    Raises
    ------
    UnknownComponentError, ParameterError, DesignError
    """
    law = registry.find(group, name)
    prefix = "slow." if group == SLOW else "fast."
    return law(model, check_all(law.PARAMETERS, values, sizes(model), prefix))


def design(model, slow, fast):
    """Composite control from two mappings with the key `type` and the law's parameters.

    Parameters
    ----------
    model : ArmModel
    slow, fast : mapping
        ``{"type": "linear_model_following", "kp": [6.25], …}``.

    Returns
    -------
    CompositeControl
    """

    def law(group, given):
        name, values = typed(given, "slow" if group == SLOW else "fast")
        return design_law(group, name, model, values)

    return CompositeControl(model, law(SLOW, slow), law(FAST, fast))


def typed(given, prefix):
    """Split a mapping into its `type` and the parameters.

    Raises
    ------
    ParameterError
        Without a type.
    """
    values = dict(given)
    name = values.pop("type", None)
    if not isinstance(name, str):
        what = "missing" if name is None else f"{name!r} is not a name"
        raise ParameterError(f"{prefix}.type: {what}; write the name of a law, none for no control")
    return name, values
