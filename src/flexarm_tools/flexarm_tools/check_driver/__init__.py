# SPDX-License-Identifier: Apache-2.0
"""Checks whether a driver keeps its contract (`docs/driver.md`), by messages and by pushes; ROS only in `command`."""
