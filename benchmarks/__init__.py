# SPDX-License-Identifier: Apache-2.0
"""Speed and accuracy of flexarm beside other codes: ``python -m benchmarks`` in the project's root."""
