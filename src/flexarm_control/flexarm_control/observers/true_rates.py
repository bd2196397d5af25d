# SPDX-License-Identifier: Apache-2.0
"""Passes on the modal rates that the source publishes, without reconstruction.

It is for a simulator with ``publish_rates: true``, in tests and for reproducing the paper, which assumes the full
state. A real arm does not measure rates.
"""

from flexarm_dynamics.errors import MessageError

from .base import Observer


class TrueRates(Observer):
    """Passes amplitude and rate through."""

    def update(self, sample, dt):
        if sample.rate is None:
            raise MessageError(
                "is empty, and observer.type true_rates does not reconstruct it",
                field="modal_rate",
                hint="set publish_rates on the simulator, or another observer.type",
            )
        self.amplitude[:] = sample.amplitude
        self.rate[:] = sample.rate
        self.converged = True
