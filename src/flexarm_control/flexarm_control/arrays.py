# SPDX-License-Identifier: Apache-2.0
"""Small arrays on the control path, where numpy's convenience costs more than the arithmetic."""

import numpy as np


def clip(values, low, high):
    """`np.clip` in place, at a third of its cost for a few values."""
    np.maximum(values, low, out=values)
    np.minimum(values, high, out=values)
