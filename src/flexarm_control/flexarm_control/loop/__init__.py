# SPDX-License-Identifier: Apache-2.0
"""What runs at every sample: samples, controller and supervisor."""
