# SPDX-License-Identifier: Apache-2.0
"""The code that runs at every sample: samples, controller and supervisor."""
