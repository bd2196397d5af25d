"""Dynamics of arms with flexible links; no ROS anywhere in this package."""
