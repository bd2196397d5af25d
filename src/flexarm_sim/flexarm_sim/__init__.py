"""Simulation of arms with flexible links; ROS only in `nodes`."""
