"""``flexarm view``: an arm in the browser, live, of nodes that it starts or that run."""


def add_arguments(parser):
    """Arguments of the sub-command."""
    add = parser.add_argument
    add(
        "arm",
        metavar="ARM",
        nargs="?",
        help="arm file: a shipped name or a path (default: the controller file's, or two_link)",
    )
    add(
        "--controller",
        metavar="FILE",
        help="parameter file of the nodes: a shipped name or a path (default: the arm's own, or composite)",
    )
    add(
        "--attach",
        action="store_true",
        help="start nothing: show the nodes that run on this ROS_DOMAIN_ID",
    )
    add("--namespace", default="", help="with --attach: of the nodes that run")
    add("--port", type=int, default=8080, help="of the page (default 8080); 0: a free one")
    add("--no-open", action="store_true", help="open no browser, only say where the page is")
