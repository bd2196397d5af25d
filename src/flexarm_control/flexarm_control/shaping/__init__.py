# SPDX-License-Identifier: Apache-2.0
"""Shapes motions for arms that take positions: trajectories and streams in, the same without vibration out.

No model of the arm, no torque and no gauges are needed: frequencies and damping of the modes that ring are enough.
"""
