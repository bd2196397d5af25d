# SPDX-License-Identifier: Apache-2.0
"""Recordings from anywhere: what the columns of a file are, and what a recording shows."""
