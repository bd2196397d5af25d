"""Laws, observers and trajectories for arms with flexible links; ROS only in `nodes`."""
