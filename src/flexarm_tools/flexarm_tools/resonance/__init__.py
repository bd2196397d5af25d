# SPDX-License-Identifier: Apache-2.0
"""``flexarm resonance``: finds what rings in an arm, and the shaper for it."""
