# SPDX-License-Identifier: Apache-2.0
"""The nodes as processes: started, run in lockstep, ended."""
