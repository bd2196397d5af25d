"""Whether a driver keeps its contract (`docs/driver.md`): messages judged, the arm pushed; ROS in `command` alone."""
