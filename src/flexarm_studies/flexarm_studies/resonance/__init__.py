# SPDX-License-Identifier: Apache-2.0
"""``flexarm resonance``: finds frequencies and damping of ringing modes in recordings, and the shaper against them."""
