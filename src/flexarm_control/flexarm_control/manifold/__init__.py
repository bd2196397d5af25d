# SPDX-License-Identifier: Apache-2.0
"""Slow manifolds: where the deflections belong while the slow motion goes on. One manifold per file."""
