# SPDX-License-Identifier: Apache-2.0
"""Commands of `flexarm` that need an arm file and no ROS."""
