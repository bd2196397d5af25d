# SPDX-License-Identifier: Apache-2.0
"""Arms that nobody tuned for: a seeded generator, trials on plants that are not the model, and the table of both."""
