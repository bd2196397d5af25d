# SPDX-License-Identifier: Apache-2.0
"""``flexarm compare``: composite control against baselines, with the same arms, motions, limits, sensors, observers."""
