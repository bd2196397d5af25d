# SPDX-License-Identifier: Apache-2.0
"""Fast control laws, which damp the bending about its quasi-steady state; one law per file."""
