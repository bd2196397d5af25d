# SPDX-License-Identifier: Apache-2.0
"""The payload, estimated from strains and joint torques."""
