# SPDX-License-Identifier: Apache-2.0
"""A driver to start from: an arm behind a serial line, and a fake one to try it with."""
