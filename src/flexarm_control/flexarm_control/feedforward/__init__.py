# SPDX-License-Identifier: Apache-2.0
"""Feed-forward: the motion that the composite control holds the arm to. One kind per file."""
