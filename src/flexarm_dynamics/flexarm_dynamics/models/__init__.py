# SPDX-License-Identifier: Apache-2.0
"""Equations of motion of an arm, (2) of Siciliano & Book (1986): one class per model, found by name."""
