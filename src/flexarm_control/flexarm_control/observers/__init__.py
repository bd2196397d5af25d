# SPDX-License-Identifier: Apache-2.0
"""Observers: what reconstructs the rates of the deflections. One observer per file."""
