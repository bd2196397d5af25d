# SPDX-License-Identifier: Apache-2.0
"""Slow manifolds, which give the deflections that belong to the slow motion; one manifold per file."""
