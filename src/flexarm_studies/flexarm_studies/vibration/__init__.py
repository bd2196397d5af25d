# SPDX-License-Identifier: Apache-2.0
"""Vibration of arms that take positions, measured on plants behind a position loop: ``flexarm vibration``."""
