# SPDX-License-Identifier: Apache-2.0
"""Latency of the running loop, beside a bare relay of the same messages."""
