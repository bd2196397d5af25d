# SPDX-License-Identifier: Apache-2.0
"""Scalars with first derivatives: running a kernel on them differentiates it, exactly, in all directions at once.

A value is a number or a `symbols.Symbol`, and so is each derivative; derivatives that are zero are left out.
"""

import numpy as np

from .symbols import is_zero


class Dual:
    """A scalar and its derivatives.

    Parameters
    ----------
    value : float or Symbol
    slopes : dict
        Derivative by the number of its direction.
    """

    __slots__ = ("slopes", "value")

    def __init__(self, value, slopes=None):
        self.value = value
        self.slopes = {k: v for k, v in (slopes or {}).items() if not is_zero(v)}

    @classmethod
    def of(cls, x):
        """A scalar as one of these."""
        return x if isinstance(x, cls) else cls(x)

    def _chain(self, value, slope):
        return Dual(value, {k: slope * v for k, v in self.slopes.items()})

    def __neg__(self):
        return self._chain(-self.value, -1.0)

    def __add__(self, other):
        other, slopes = Dual.of(other), dict(self.slopes)
        for k, v in other.slopes.items():
            slopes[k] = slopes[k] + v if k in slopes else v
        return Dual(self.value + other.value, slopes)

    __radd__ = __add__

    def __sub__(self, other):
        return self + -Dual.of(other)

    def __rsub__(self, other):
        return -self + other

    def __mul__(self, other):
        other = Dual.of(other)
        mine = self._chain(0.0, other.value)
        return Dual(self.value * other.value, (mine + other._chain(0.0, self.value)).slopes)

    __rmul__ = __mul__

    def sin(self):
        """The sine, as numpy asks it of an object."""
        return self._chain(np.sin(self.value), np.cos(self.value))

    def cos(self):
        """The cosine, as numpy asks it of an object."""
        return self._chain(np.cos(self.value), -np.sin(self.value))
