# SPDX-License-Identifier: Apache-2.0
"""The closed loop in one process: plant, observer and controller, described by a scenario."""
