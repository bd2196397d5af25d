# SPDX-License-Identifier: Apache-2.0
"""Runs the closed loop in one process: plant, observer and controller, described by a scenario."""
