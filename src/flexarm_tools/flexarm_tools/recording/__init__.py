# SPDX-License-Identifier: Apache-2.0
"""Recordings: bags written and read."""
