# SPDX-License-Identifier: Apache-2.0
"""Whether the readings of an arm can be true together: one check per file, `monitor` runs them."""
