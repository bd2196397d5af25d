# SPDX-License-Identifier: Apache-2.0
"""Malformed input for every reader of messages and files; see ``python -m fuzz --help``."""
