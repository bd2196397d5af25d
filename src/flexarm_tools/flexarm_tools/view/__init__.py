# SPDX-License-Identifier: Apache-2.0
"""``flexarm view``: an arm in the browser. `link` speaks with the nodes, `page` is the page, `command` joins them."""
