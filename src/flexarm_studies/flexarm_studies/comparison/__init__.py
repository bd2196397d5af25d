# SPDX-License-Identifier: Apache-2.0
"""Composite control beside its rivals on the same arms, motions, limits, sensors and observers: ``flexarm compare``."""
