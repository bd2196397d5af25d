# SPDX-License-Identifier: Apache-2.0
"""Errors that tests must find, in a file for each part of the sources; `python -m tools.mutants` puts them in."""

from . import dynamics, laws, loop, observers, others, robust

MUTANTS = [
    error for module in (dynamics, laws, observers, robust, loop, others) for error in module.ERRORS
]
