# SPDX-License-Identifier: Apache-2.0
"""Observers, which reconstruct the rates of the deflections; one observer per file."""
