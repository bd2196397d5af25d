# SPDX-License-Identifier: Apache-2.0
"""Model of the arm with another payload than its file's, for a law that learns the payload."""

import numpy as np

from flexarm_dynamics.errors import DesignError
from flexarm_dynamics.models.model import Terms
from flexarm_dynamics.singular_perturbation import slow_torque


class PayloadModel:
    """A model whose `terms` are those of `scale` payloads; everything else is the arm file's.

    For given mode shapes, every term of (2) is affine in the payload's mass and inertia. So two models give all others.

    Parameters
    ----------
    model : ArmModel

    Attributes
    ----------
    scale : float
        Payload as a multiple of the arm file's; may be set at any time [-].
    """

    #: The inertia changes with `scale`.
    same_inertia = False

    def __init__(self, model):
        self._one, self._two = model, model.with_payload(2.0)
        self.scale = 1.0

    def __getattr__(self, name):
        if name.startswith("_"):
            raise AttributeError(name)
        return getattr(self._one, name)

    def terms(self, q, qd):
        """Terms of (2) without deflections, as `ArmModel.terms`."""
        return self._of(lambda model: model.terms(q, qd))

    def terms_along(self, motions):
        """As `ArmModel.terms_along`."""
        return self._of(lambda model: model.terms_along(motions))

    def slow_torque(self, q, qd, acceleration):
        """As `ArmModel.slow_torque`."""
        return slow_torque(self.terms(q, qd), acceleration)

    def _of(self, terms_of):
        """Terms at the present scale, from those of both models, for one state or several."""
        one, more = terms_of(self._one), self.scale - 1.0
        if more == 0.0:
            return one
        return Terms(*(_between(x, y, more) for x, y in zip(one, terms_of(self._two), strict=True)))


def need_payload(model, who):
    """Refuse a model without payload, because `who` learns it as a multiple of the arm file's."""
    load = model.arm.payload
    if not load.mass and not np.any(load.inertia):
        raise DesignError(
            f"in arm {model.arm.name}: {who} learns the payload in parts of the arm file's",
            field="payload.mass",
            value=0,
            hint="write the mass that it is expected to have there",
        )


def _between(one, two, more):
    out = np.subtract(two, one)
    out *= more
    out += one
    return out
