# SPDX-License-Identifier: Apache-2.0
"""Slow control laws, which track the trajectory as if the arm were rigid; one law per file."""
