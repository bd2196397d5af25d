# SPDX-License-Identifier: Apache-2.0
"""Tools for a running arm: recording, report, live view, driver checks, adapters."""
