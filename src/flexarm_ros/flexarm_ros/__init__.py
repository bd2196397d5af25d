# SPDX-License-Identifier: Apache-2.0
"""Gives the nodes what they share: parameters, life cycle, quality of service, messages to arrays and back."""
