# SPDX-License-Identifier: Apache-2.0
"""``flexarm analyze``: computes what follows from a design before the arm moves. One topic per module, no ROS.

`scales`: time scales and reachability; `bound`: how large mu may be; `margins`: what the loop withstands; `attraction`:
offsets from which it comes back; `monte_carlo`: many runs of arms that differ from the model.
"""
