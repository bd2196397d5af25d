r"""The slow manifold of the reference trajectory, with its rates and the feed-forward torque that goes with it.

.. math::
    \bar\delta = \delta^{(2)}(q_{ref}, \dot q_{ref}, \dots), \qquad \dot{\bar\delta} = \tfrac{d}{dt}\delta^{(0)}

of `corrected` along the reference alone: a tracking error does not move it, so that the slow feedback does not
ask the fast control for a deflection. The slow loop then acts on the whole arm, fast control included, and its
poles move: on the paper's arm from the double pole -2.5 to -1.5 +- 1.5j.
"""

import numpy as np

from .corrected import CorrectedManifold


class ReferenceManifold(CorrectedManifold):
    """The order 2 of `CorrectedManifold`, off the reference; see the module."""

    PARAMETERS = ()
    follows_error = False

    def __init__(self, model, slow, parameters):
        super().__init__(model, slow, {"order": 2, **parameters})

    def update(self, q, qd, reference, terms, slow_torque):
        along = self.model.terms(reference.position, reference.velocity)
        self._acceleration = reference.acceleration
        super().update(reference.position, reference.velocity, reference, along, np.zeros(0))

    def _slow_acceleration(self, terms, slow_torque):
        return self._acceleration
