# SPDX-License-Identifier: Apache-2.0
r"""The slow manifold of the reference trajectory, with its rates and its feed-forward torque.

.. math::
    \bar\delta = \delta^{(2)}(q_{ref}, \dot q_{ref}, \dots), \qquad \dot{\bar\delta} = \tfrac{d}{dt}\delta^{(0)}

This is the manifold of `corrected`, along the reference alone. A tracking error does not move it, so the slow feedback
does not ask the fast control for a deflection. The slow loop then acts on the whole arm, fast control included, and
its poles move: on the paper's arm from the double pole -2.5 to -1.5 +- 1.5j.
"""

from .base import Manifold


class ReferenceManifold(Manifold):
    """Order 2 along the reference; see the module."""

    order = 2

    def update(self, q, qd, reference, terms, slow_torque):
        found = self._of_reference(reference)
        self.amplitude[:], self.rate[:] = found.delta, found.rate
        self.feedforward[:] = found.beyond
