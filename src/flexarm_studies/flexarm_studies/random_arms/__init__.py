# SPDX-License-Identifier: Apache-2.0
"""Random arms: generates them from a seed, tries controllers on plants that are not the model, and makes the table."""
