# SPDX-License-Identifier: Apache-2.0
"""Feed-forwards, which give the motion that the composite control holds the arm to; one kind per file."""
