# SPDX-License-Identifier: Apache-2.0
"""A driver that lies, and what its lies do to an arm: ``flexarm attack``."""
