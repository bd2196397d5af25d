"""``flexarm view``: an arm in the browser. `link` talks to the nodes, `page` shows what it hears, `command` has both."""
