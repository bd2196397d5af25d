# SPDX-License-Identifier: Apache-2.0
"""``flexarm view``: shows an arm live in the browser, from nodes that it starts or that run."""

import contextlib
import os
import tempfile
import time

import numpy as np

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.errors import FlexarmError, MessageError, ParameterError
from flexarm_dynamics.models import model
from flexarm_dynamics.processes import step_back
from flexarm_studies.loop import parameter_files

from .pair import Pair

#: Default and largest number of pictures per second.
RATE, MAX_RATE = 30.0, 100.0
#: Number of points of the tip's path.
TRAIL = 300
#: Niceness of the page's process: the nodes have priority.
NICENESS = 10
#: Distance of the first target from the arm's position [rad].
STEP = 1.0
#: Port to which Foxglove connects by default.
FOXGLOVE = 8765
#: Number of joint positions of a planned motion between two points.
PIECES = 24
#: Time without a state after which the page reports this [s].
SILENCE = 2.0


def add_arguments(parser):
    """Arguments of the sub-command."""
    parser.description = (
        "Starts simulator, observer and controller in real time, and a page on this machine "
        "that shows and handles them; with --attach, the page alone, of nodes that run."
    )
    parser.epilog = "examples:\n  flexarm view two_link\n  flexarm view R --attach --namespace left"
    add = parser.add_argument
    add(
        "arm",
        metavar="ARM",
        nargs="?",
        help="arm file: a shipped name or a path (default: that of the controller, or two_link)",
    )
    add(
        "--controller",
        metavar="FILE",
        help="parameter file of the nodes: a shipped name or a path (default: the arm's own, or a design)",
    )
    add(
        "--attach",
        action="store_true",
        help="start nothing: show the nodes that run on this ROS_DOMAIN_ID",
    )
    add(
        "--lockstep",
        action="store_true",
        help="the simulator waits for each torque: for a machine too busy for real time",
    )
    add("--namespace", default="", help="with --attach: of the nodes that run")
    add(
        "--port",
        type=int,
        default=8080,
        help="of the page, on 127.0.0.1 (default 8080; 0: a free one)",
    )
    add("--rate", type=float, default=RATE, help=f"pictures per second (default {RATE:g}) [Hz]")
    add("--no-open", action="store_true", help="open no browser, only say where the page is")
    add(
        "--foxglove",
        type=int,
        metavar="PORT",
        help=f"of the topics for Foxglove, on 127.0.0.1 (default {FOXGLOVE}, or a free one; 0: a free one)",
    )


def view(options):
    """Run the sub-command until it is stopped.

    Raises
    ------
    FlexarmError
        If there is no such arm or controller file, or if a started node ends.
    """
    check(options)
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    with contextlib.ExitStack() as stack:
        domain, processes = None, None
        if not options.attach:
            domain, processes = start(options, stack)
        step_back(NICENESS)  # after the start of the nodes, which would inherit it
        from .link import Link

        link = Link(options.namespace, domain, processes)
        stack.callback(link.close)
        with contextlib.suppress(KeyboardInterrupt):
            View(link, options, stack).run()


def check(options):
    """Refuse options that are incompatible, and find the files of the others."""
    if not 0.1 <= options.rate <= MAX_RATE:
        raise ParameterError(
            "is out of range",
            field="--rate",
            value=options.rate,
            limit=f"from 0.1 to {MAX_RATE:g} pictures per second",
        )
    if options.attach:
        for name in ("controller", "lockstep"):
            if getattr(options, name):
                raise ParameterError(
                    "is not possible with --attach, where the nodes run already", field=f"--{name}"
                )
        return
    if options.namespace:
        raise ParameterError("is possible only with --attach", field="--namespace")
    options.controller, options.arm = files(options.controller, options.arm)
    arm_file.load(options.arm)


def files(controller, arm):
    """Controller file and arm of the nodes to start, if one or both are not given; no file: a design is made.

    Raises
    ------
    ParameterError
        If there is no such controller file.
    """
    if controller is None:
        arm = arm or "two_link"
        return parameter_files.of_arm(arm), arm
    path = parameter_files.find(controller)
    return path, arm or parameter_files.load(path)["controller"].get("arm", "two_link")


def start(options, stack):
    """Start the three nodes, on the user's domain or, without one, on a free one."""
    from ..running.processes import Processes, own_domain  # here: other commands need no ROS

    given = os.environ.get("ROS_DOMAIN_ID", "")
    domain = int(given) if given.isdigit() else stack.enter_context(own_domain())
    logs = stack.enter_context(tempfile.TemporaryDirectory(prefix="flexarm-view-"))
    processes = stack.enter_context(Processes(domain, logs))
    for name, own in (
        ("simulator", {"lockstep": options.lockstep, "pause_at": -1.0}),
        ("observer", {}),
        ("controller", {}),
    ):
        processes.start_node(name, {"arm": options.arm, **own}, file=options.controller)
    return domain, processes


class View:
    """Shows what the nodes publish and carries out what is done on the page, in one thread."""

    def __init__(self, link, options, stack):
        self.link, self.options, self.stack = link, options, stack
        self.page = None
        self.foxglove, self.pair = None, None
        self.home = None
        self._received_at = 0.0
        self._aimed = None

    def run(self):
        """Serve until it is interrupted."""
        if self.options.arm:
            self._open(self.options.arm)
        else:
            print("flexarm view: asking the controller for its arm", flush=True)
            self.link.find_arm(self._open)
        while True:
            self.link.serve(1.0 / self.options.rate)
            if self.page is not None:
                self._turn()

    def _open(self, name):
        from ..shape.drawing import Drawer, Trail

        arm_model = model.build(arm_file.load(name).known)
        self.drawer = Drawer(arm_model)
        self.trail = Trail(TRAIL, 0.002 * self.drawer.reach)
        self.link.watch(arm_model.arm)
        try:
            from .page import Page

            self.foxglove = self._serve_foxglove(arm_model.arm)
            address = self.foxglove.url if self.foxglove else ""
            self.page = page = Page(arm_model.arm, self.drawer.reach, self.options.port, address)
        except ModuleNotFoundError as error:
            hint = "pip install viser, or make build"
            raise FlexarmError("is missing", field=error.name, hint=hint) from None
        self.stack.callback(page.close)
        self.link.say, self.link.on_values = page.say, page.take_values
        print(f"flexarm view: {arm_model.arm.name} at {page.url}, until Ctrl-C", flush=True)
        if self.foxglove:
            print(f"flexarm view: in Foxglove: {self.foxglove.url}", flush=True)
        if not self.options.no_open:
            import webbrowser

            webbrowser.open(page.url)

    def _serve_foxglove(self, arm):
        """The server of the topics; None if foxglove-sdk is not installed."""
        from ..recording.types import typestore
        from .foxglove import Foxglove

        def definition(kind):
            return typestore().generate_msgdef(kind, ros_version=2)[0]

        wanted = self.options.foxglove
        ports = (FOXGLOVE, 0) if wanted is None else (wanted,)
        for port in ports:
            try:
                server = Foxglove(
                    f"flexarm {arm.name}", port, self.link.sources, definition, arm.reach
                )
            except ModuleNotFoundError:
                return None
            except RuntimeError as error:  # the port is taken
                if port == ports[-1]:
                    hint = "--foxglove 0 takes a free one"
                    raise FlexarmError(
                        f"can't be used: {error}", field="--foxglove", value=port, hint=hint
                    ) from None
                continue
            self.stack.callback(server.close)
            return server
        return None

    def _turn(self):
        """Carry out what was done on the page; show what has arrived since the last turn."""
        now, page = time.monotonic(), self.page
        while not page.done.empty():
            name, *words = page.done.get()
            (getattr(self, f"_do_{name}", None) or getattr(self.link, name))(*words)
        try:
            snapshot = self.link.take()
        except MessageError as error:
            page.say(str(error), True)
            return
        if snapshot is None:
            if now > self._received_at + SILENCE:
                page.silence(now - self._received_at if self._received_at else 0.0)
            return
        self._received_at = now
        if self.home is None:
            self.home = snapshot.q
            page.aim(first_target(self.drawer.arm, snapshot.q))
            # Not earlier: a controller that is still designing has other laws until then.
            self.link.find_gains(page.offer_gains)
        picture = self.drawer.picture(
            snapshot.q, snapshot.delta, snapshot.slow, snapshot.fast, page.exaggeration
        )
        self.trail.add(picture.tip, snapshot.session)
        error = self.drawer.tip_error(snapshot.q, snapshot.delta, snapshot.reference)
        page.show(snapshot, picture, self.trail.points, error)
        page.plot(now)
        self._show_plan(snapshot)
        if self.pair is not None:
            self._go_on_with_pair(snapshot, error)
        if self.foxglove is not None:
            self.foxglove.forward()
            self.foxglove.draw(
                round(1e9 * snapshot.time), picture.beam, picture.ghost, self.trail.points
            )

    def _show_plan(self, snapshot):
        """Show a motion that was published, while it lasts; otherwise the motion to the sliders' target."""
        points = self.link.take_planned()
        if points is not None and len(points):
            self._aimed = self.page.target()
            self.page.draw_plan(self.drawer.plan(between(snapshot.reference, points)))
        resting = snapshot.state in ("HOLDING", "READY")
        if resting and self.page.target() != self._aimed:
            self._aimed = self.page.target()
            self.page.draw_plan(self.drawer.plan(between(snapshot.reference, [self._aimed])))

    def _go_on_with_pair(self, snapshot, error):
        self.pair.turn(snapshot, error)
        if self.pair.ended:
            if len(self.pair.curves) == 2:
                self.page.show_pair(self.pair.curves)
            self.page.say(self.pair.ended, "given up" in self.pair.ended)
            self.pair = None

    def _do_pair(self, target, duration):
        if self.pair is not None or self.home is None:
            self.page.say("wait until the present motions are over", True)
            return
        self.pair = Pair(self.link, self.home, target, duration)
        self.page.say("the same motion twice: with the fast control, then without it", False)

    def _do_back(self, duration):
        if self.home is not None:
            self.link.move(self.home, duration)

    def _do_clear_trail(self):
        self.trail.clear()


def between(start, points):
    """Joint positions on the path from a start (n,) through points (k, n), straight in joint angles, (., n) [rad]."""
    rows = np.vstack([start, points])
    knots = np.linspace(0.0, len(rows) - 1.0, min(PIECES * (len(rows) - 1), 200) + 1)
    return np.array([np.interp(knots, np.arange(len(rows)), column) for column in rows.T]).T


def first_target(arm, q):
    """Target that the page proposes at first: it moves every joint of an arm without weight, the first of others."""
    heavy = np.linalg.norm(arm.gravity) > 0.0
    step = np.zeros(len(q))
    step[: 1 if heavy else None] = STEP
    return q + step
