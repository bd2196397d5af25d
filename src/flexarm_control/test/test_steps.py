# SPDX-License-Identifier: Apache-2.0
"""Linear steps, compiled and as plain Python, beside products of matrices."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from flexarm_control.kernels import compiled, steps


@pytest.mark.parametrize("kernel", [steps, compiled()])
@pytest.mark.parametrize("count", [0, 3, 5])
def test_steps_are_products_with_the_matrix_and_pushes_while_there_are_any(kernel, count):
    draw = np.random.default_rng(count)
    A, pushes = draw.standard_normal((4, 4)), draw.standard_normal((count, 2, 4))
    X = np.full((6, 2, 4), np.nan)
    X[0] = state = draw.standard_normal((2, 4))
    kernel.steps(A, pushes, X)
    for k in range(1, 6):
        state = state @ A + (pushes[k - 1] if k <= count else 0.0)
        assert_allclose(X[k], state, rtol=1e-12)
