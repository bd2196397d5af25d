# SPDX-License-Identifier: Apache-2.0
"""``flexarm compare``: composite control and baselines with the same arms, motions, limits, sensors and observers."""
