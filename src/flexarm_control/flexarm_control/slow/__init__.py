# SPDX-License-Identifier: Apache-2.0
"""Slow control laws: what tracks the trajectory as if the arm were rigid. One law per file."""
