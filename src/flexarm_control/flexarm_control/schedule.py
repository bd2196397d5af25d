# SPDX-License-Identifier: Apache-2.0
r"""Gains that change with the configuration: a weighted mean of several sets, each made for its own configuration.

.. math::
    K(q) = \sum_k w_k(q)\,K_k, \qquad w_k = \frac{d_k^{-2}}{\sum_l d_l^{-2}}, \qquad
    d_k^2 = \sum_j 4\sin^2\tfrac{q_j - q_{kj}}2 .

This is the interpolation of Shepard (1968): in the configuration of set k, K is K_k and its derivative is zero. The sum
over j includes only joints that change the arm's equations; the first joint of a planar arm without gravity does not.
At rest without error the derivatives of K multiply zero. So the loop linearised in a configuration q is the loop with
the constant gain K(q).
"""

import numpy as np

from flexarm_dynamics.errors import ParameterError
from flexarm_dynamics.parameters import parameter

from . import kernels

#: Relative change of the equations with a joint below which the joint does not matter.
NEGLIGIBLE = 1e-9
SCHEDULE = parameter("schedule", [], "rad", -100.0, 100.0, kind="float_array").described(
    "Configurations of the sets of gains, one after the other; the gains are interpolated between them. Empty: one set"
    " for all configurations."
)


def matters(model):
    """Which joints change the model's equations at rest, (n,) of bool."""
    n, draw = model.n_joints, np.random.default_rng(0)
    out = np.zeros(n, bool)
    for _ in range(2):
        base, other = draw.uniform(-np.pi, np.pi, (2, n))
        here = _equations(model, base)
        for j in np.flatnonzero(~out):
            turned = base.copy()
            turned[j] = other[j]
            out[j] = any(
                np.abs(b - a).max(initial=0.0) > NEGLIGIBLE * np.abs(a).max(initial=1e-9)
                for a, b in zip(here, _equations(model, turned), strict=True)
            )
    return out


def _equations(model, q):
    terms = model.terms(q, np.zeros(q.size))
    return [np.array(x) for x in (terms.M, terms.f1, terms.f2, terms.K1, terms.K2)]


class Schedule:
    """Sets of gains by configuration; see the module.

    Parameters
    ----------
    model : ArmModel
    configurations : array_like, shape (k, n) or (k n,)
        One for each set of gains [rad]; with none or one, the gains are the same everywhere.
    field : str
        Name of the parameter, for errors.

    Attributes
    ----------
    count : int
        Number of sets.

    Raises
    ------
    ParameterError
        If the number of angles gives no whole number of configurations.
    """

    def __init__(self, model, configurations, field="schedule"):
        n, given = model.n_joints, np.array(configurations, float).ravel()
        if given.size % n:
            raise ParameterError(
                "is no whole number of configurations",
                field=field,
                value=given.tolist(),
                hint=f"write {n} joint angles for each set of gains",
            )
        self.at = given.reshape(-1, n)
        self.count = max(len(self.at), 1)
        self._matters = np.flatnonzero(matters(model)) if self.count > 1 else np.zeros(0, int)
        self._weights = np.full(self.count, 1.0 / self.count)

    def weights(self, q):
        """w(q), shape (count,), overwritten by the next call; runs on the control path."""
        if self._matters.size:
            kernels.compiled().weights_between(q, self.at, self._matters, self._weights)
        return self._weights

    def blend(self, q, sets, out):
        """Fill `out`, (size,), with the mean of `sets`, (count, size), at q (n,); runs on the control path."""
        if self.count > 1:
            np.dot(self.weights(q), sets, out=out)
        else:
            out[:] = sets[0]

    def sets(self, values, size, field):
        """Values of a parameter as sets, (count, size); one set stands for all.

        Raises
        ------
        ParameterError
            If the number of sets differs from the number of configurations.
        """
        if not size:  # a rigid arm has no modes to feed back
            return np.zeros((self.count, 0))
        rows = np.array(values, float).reshape(-1, size)
        if len(rows) == self.count:
            return rows
        if len(rows) == 1:
            return np.repeat(rows, self.count, axis=0)
        raise ParameterError(
            f"{len(rows)} sets of gains where {self.count} are needed, one per configuration of the schedule",
            field=field,
            hint="one set stands for all",
        )
