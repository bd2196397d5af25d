# SPDX-License-Identifier: Apache-2.0
"""``flexarm analyze``: what can be said of a design before the arm moves. One subject per module, no ROS.

`scales`: time scales and reachability; `bound`: how large mu may be; `margins`: what the loop withstands;
`attraction`: from how far off it comes back; `monte_carlo`: many runs of an arm that is not quite as told.
"""
