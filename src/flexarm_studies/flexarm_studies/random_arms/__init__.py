# SPDX-License-Identifier: Apache-2.0
"""Random arms: a seeded generator, trials on plants that are not the model, and the table of both."""
