# SPDX-License-Identifier: Apache-2.0
"""``flexarm view``: shows an arm in the browser; `link` serves the nodes, `page` is the page, `command` joins them."""
