# SPDX-License-Identifier: Apache-2.0
"""Fast control laws: what damps the bending around its quasi-steady state. One law per file."""
