# SPDX-License-Identifier: Apache-2.0
"""Whether a driver keeps its contract (`docs/driver.md`): messages judged, the arm pushed; ROS in `command` alone."""
