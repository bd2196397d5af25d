# SPDX-License-Identifier: Apache-2.0
"""Handles recordings from any source: the meaning of a file's columns, and what a recording shows."""
