# SPDX-License-Identifier: Apache-2.0
"""No reconstruction: passes on the modal rates that the source publishes.

For a simulator with ``publish_rates: true``, in tests and for reproducing the paper, which assumes the full
state; a real arm has no such thing.
"""

from flexarm_dynamics.errors import MessageError

from .base import Observer


class TrueRates(Observer):
    """Passes amplitude and rate through."""

    def update(self, sample, dt):
        if sample.rate is None:
            raise MessageError(
                "modal_rate is empty, and observer.type true_rates does not reconstruct it: set"
                " publish_rates on the simulator, or another observer.type"
            )
        self.amplitude[:] = sample.amplitude
        self.rate[:] = sample.rate
        self.converged = True
