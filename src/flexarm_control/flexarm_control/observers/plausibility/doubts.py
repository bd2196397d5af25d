# SPDX-License-Identifier: Apache-2.0
"""Keeps which sensors are in doubt, why, and until when."""

from ...loop.samples import ArmSample

#: A doubt is kept for this long after the last evidence for it, by degree [ns].
KEPT_NS = {ArmSample.STOP: 1_000_000_000, ArmSample.DISTRUSTED: 500_000_000}


class Doubts:
    """The doubts about an arm's sensors.

    Attributes
    ----------
    trust : int
        The worst degree of the present doubts, as in `ArmSample`; TRUSTED if there is none.
    text : str
        Text of the first of the worst doubts; empty if there is none.
    raised : int
        Number of doubts so far.
    """

    def __init__(self):
        self.raised = 0
        self.forget()

    def forget(self):
        """Forget all doubts, since the source has started again."""
        self._known = {}
        self.trust, self.text = ArmSample.TRUSTED, ""

    def add(self, sensor, degree, text, stamp_ns, for_good=False):
        """Note evidence against a sensor; the first text of a doubt stays.

        Parameters
        ----------
        sensor : str
            Name by which further evidence is recognised.
        degree : int
            `ArmSample.STOP` or `DISTRUSTED`.
        text : str
            Which sensor, and what is wrong with it.
        stamp_ns : int
            Stamp of the sample [ns].
        for_good : bool
            Whether the doubt lasts until the source starts again.
        """
        known = self._known.get(sensor)
        if known is None or known[0] < degree:
            self.raised += 1
        else:
            degree, text = known[:2]
        until = None if for_good else stamp_ns + KEPT_NS[degree]
        if known is not None and known[2] is None:
            until = None
        self._known[sensor] = degree, text, until
        self._sum_up()

    def expire(self, stamp_ns):
        """Drop the doubts whose evidence is old at this stamp [ns]."""
        if not self._known:
            return
        left = {k: d for k, d in self._known.items() if d[2] is None or d[2] > stamp_ns}
        if len(left) < len(self._known):
            self._known = left
            self._sum_up()

    def about(self, sensor):
        """Whether this `sensor` is in doubt."""
        return sensor in self._known

    def about_any(self, beginning):
        """Whether any sensor whose name has this `beginning` is in doubt."""
        return any(name.startswith(beginning) for name in self._known)

    def _sum_up(self):
        worst = max(self._known.values(), key=lambda doubt: doubt[0], default=None)
        self.trust, self.text = (ArmSample.TRUSTED, "") if worst is None else worst[:2]
