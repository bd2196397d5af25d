# SPDX-License-Identifier: Apache-2.0
"""Eigenvectors by inverse iteration, beside LAPACK's, compiled and as plain Python."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.linalg import eig, hessenberg

from flexarm_control.kernels import compiled, eigenvectors


@pytest.mark.parametrize("kernel", [eigenvectors, compiled()])
def test_both_eigenvectors_are_those_of_the_matrix(kernel):
    # Rows and columns of very different size, so that eliminations with and without exchanges occur.
    draw = np.random.default_rng(4)
    size = draw.uniform(-2.0, 2.0, 12)
    A = draw.standard_normal((12, 12)) * 10.0 ** (size[:, None] - size)
    H = np.ascontiguousarray(hessenberg(A))
    z, left, right = eig(H, left=True)
    for k in range(12):
        x, y = kernel.eigenvectors(H, complex(z[k]))
        for mine, theirs in ((x, right[:, k]), (y, left[:, k])):
            assert_allclose(abs(np.vdot(mine, theirs)), 1.0, rtol=1e-9)
        assert np.linalg.norm(x) == pytest.approx(1.0) == np.linalg.norm(y)
