# SPDX-License-Identifier: Apache-2.0
"""``flexarm record``: records a bag of a running arm, of a driver as well as of the simulator.

It writes each message of the arm's topics as it arrives, so memory use stays small in a recording of any length. It
asks the nodes for the arm's name and puts the text of the arm file into the bag.
"""

import datetime
import json
import sys
import time

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.errors import FlexarmError
from flexarm_studies.commands.options import new_path

#: Timeout for the first message [s].
PATIENCE = 10.0
#: Time between two checks of the middleware's queues, and between two lines on a terminal [s].
POLL_PERIOD, SHOW_PERIOD = 0.005, 0.5
#: Nodes that know the arm; the first answer is taken.
ASKED = ("observer", "controller", "observer_controller", "simulator")


def add_arguments(parser):
    """Arguments of the sub-command."""
    parser.description = (
        "Subscribes to the arm's topics and writes what comes to a rosbag2 bag (MCAP), with "
        "the arm file in it; nothing of the running nodes changes."
    )
    parser.epilog = "example: flexarm record --out results/run1 --duration 20"
    add = parser.add_argument
    add(
        "--out", metavar="FOLDER", help="of the bag, a new one (results/bag-DATE-TIME if not given)"
    )
    add("--namespace", default="", metavar="NS", help="of the arm's topics")
    add("--duration", type=float, metavar="S", help="seconds to record; until Ctrl-C if not given")
    add("--arm", help="arm file that goes into the bag; asked of the nodes if not given")
    add("--json", action="store_true", help="say what was recorded as JSON")


def record(options):
    """Run ``record``; return the bag's folder.

    Raises
    ------
    FlexarmError
        If nothing comes, or if the folder exists.
    """
    duration = options.duration
    if duration is not None and not duration > 0.0:
        raise FlexarmError(
            "is out of range", field="--duration", value=duration, limit="greater than 0"
        )
    stamp = datetime.datetime.now().strftime("%Y%m%d-%H%M%S")
    out = new_path(options.out or f"results/bag-{stamp}", "--out")
    if options.arm:
        arm_file.load(options.arm)  # refuse a wrong one before the recording
    with Listener(options.namespace) as listener:
        listener.wait_for_first(PATIENCE)
        _take(listener, out, options.arm, duration, options.json)
    return out


def _take(listener, out, arm, duration, as_json=False):
    """Record until the duration is over, Ctrl-C or SIGTERM; return what was counted."""
    from .recorder import BagWriter

    began, shown, ended = time.monotonic(), 0.0, None
    asked = None if arm else listener.ask_arm()
    with BagWriter(out, arm or "", listener.namespace) as bag:
        taken = Taken(bag, arm or "")
        print(f"recording to {out}{'' if duration else '; Ctrl-C ends it'}", file=sys.stderr)
        try:
            while duration is None or time.monotonic() < began + duration:
                taken.take(listener.poll(), time.time_ns())
                if asked is not None and not taken.arm:
                    taken.put_arm(asked())
                if time.monotonic() > shown + SHOW_PERIOD:
                    shown = time.monotonic()
                    taken.show(shown - began)
        except (KeyboardInterrupt, SystemExit) as end:  # Ctrl-C, the normal end; SIGTERM
            ended = end
        taken.take(listener.poll(), time.time_ns())
    if sys.stderr.isatty():
        print(file=sys.stderr)
    taken.report(out, as_json)
    if isinstance(ended, SystemExit):
        raise ended
    return taken


class Taken:
    """What was recorded so far.

    Parameters
    ----------
    bag : BagWriter
    arm : str
        The bag's arm so far.
    """

    def __init__(self, bag, arm=""):
        from .recorder import TOPICS

        self.bag, self.arm, self._unusable = bag, arm, None
        self.counts = dict.fromkeys(TOPICS, 0)
        self._from = self._to = None

    def take(self, messages, now_ns):
        """Write messages, topic to list of bytes."""
        for topic, rows in messages.items():
            for raw in rows:
                self.bag.write(topic, now_ns, raw)
            self.counts[topic] += len(rows)
            if rows:
                self._from, self._to = self._from or now_ns, now_ns

    def put_arm(self, arm):
        """Put the arm that a node has named into the bag, if its file is on this machine."""
        if not arm or arm == self._unusable:
            return
        try:
            arm_file.load(arm)
            self.bag.put_arm(arm)
            self.arm = arm
        except FlexarmError as error:
            self._unusable = arm
            print(
                f"the nodes' arm {arm} is not in the bag: {error}; --arm names it", file=sys.stderr
            )

    @property
    def seconds(self):
        """From the first message to the last [s]."""
        return 0.0 if self._from is None else 1e-9 * (self._to - self._from)

    def show(self, elapsed):
        """Write the status line over the last one, on a terminal."""
        if sys.stderr.isatty():
            n = self.counts["arm_state"]
            sys.stderr.write(
                f"\r\x1b[K{elapsed:7.1f} s  {n} states  {n / max(elapsed, 1e-3):.0f} Hz"
            )
            sys.stderr.flush()

    def report(self, out, as_json=False):
        """Print what is in the bag and what to do with it."""
        if as_json:
            summary = {"out": str(out), "arm": self.arm or None, "seconds": self.seconds}
            print(json.dumps(summary | {"messages": self.counts}))
            return
        there = [f"{count} {topic}" for topic, count in self.counts.items() if count]
        missing = [topic for topic, count in self.counts.items() if not count]
        print(f"{out}: {self.seconds:.1f} s; {', '.join(there)}")
        if missing:
            print(f"no messages on {', '.join(missing)}")
        without = "" if self.arm else " --arm ARM"
        if not self.arm:
            print("no node reported its arm: give it to the report with --arm")
        print(f"next: flexarm report {out}{without}")


class Listener:
    """A session that collects an arm's topics and asks its nodes for the arm; a context manager."""

    def __init__(self, namespace=""):
        from flexarm_ros.session import Session

        from .recorder import Recorder

        self.namespace = namespace.strip("/")
        self._session = Session("flexarm_record", namespace=self.namespace)
        self._recorder = Recorder(self._session)

    def poll(self):
        """What has arrived since the last call, topic to list of bytes."""
        self._session.serve(POLL_PERIOD)
        out = {topic: list(messages) for topic, messages in self._recorder.raw.items()}
        for messages in self._recorder.raw.values():
            messages.clear()
        return out

    def wait_for_first(self, seconds):
        """Wait until something has arrived.

        Raises
        ------
        FlexarmError
            After `seconds`, with the topics that exist.
        """
        if not self._session.serve(seconds, lambda: any(self._recorder.raw.values())):
            raise self._silence(seconds)

    def _silence(self, seconds):
        node = self._session.node
        others = sorted(
            topic
            for topic, kinds in node.get_topic_names_and_types()
            if node.count_publishers(topic)
            and any(kind.startswith("flexarm_msgs/msg/") for kind in kinds)
        )
        where = f"/{self.namespace}" if self.namespace else "no namespace"
        hint = "start the driver (or simulator), in the same ROS_DOMAIN_ID"
        if others:
            hint += f"; there are {', '.join(others)}: give their --namespace"
        return FlexarmError(f"no message of an arm in {where} for {seconds:g} s", hint=hint)

    def ask_arm(self):
        """Ask the nodes for their parameter ``arm``; return a function that gives it, or '' while it is unknown."""
        from rcl_interfaces.srv import GetParameters

        questions = [
            self._session.ask(GetParameters, f"{name}/get_parameters", names=["arm"])
            for name in ASKED
        ]

        def answer():
            for question in questions:
                values = question.answer.values if question.answer else ()
                if values and values[0].string_value:
                    return values[0].string_value
            return ""

        return answer

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._session.close()
