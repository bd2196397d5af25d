# SPDX-License-Identifier: Apache-2.0
"""Frequencies and damping of what rings, from recordings, and the shaper that takes it out: ``flexarm resonance``."""
