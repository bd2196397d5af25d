# SPDX-License-Identifier: Apache-2.0
"""``flexarm attack``: lets a driver send wrong data on purpose ("lies"), and measures what the lies do to an arm."""
