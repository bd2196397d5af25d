# SPDX-License-Identifier: Apache-2.0
"""Plants that are not the controller's model, runs of controllers on them, and baselines tuned for them."""
