# SPDX-License-Identifier: Apache-2.0
"""``flexarm vibration``: measures the vibration of arms that take positions, on plants behind a position loop."""
