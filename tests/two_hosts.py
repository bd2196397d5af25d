# SPDX-License-Identifier: Apache-2.0
"""Two hosts on one machine, each a network namespace with a cable to a switch, which is a third one.

Nothing of it has a name in the file system or on the machine's own network: the namespaces live while this
process or one that was started in them does, and the cables go with them. Two runs at once do not meet, and a
run that is killed leaves nothing behind.

``python tests/two_hosts.py`` runs the loop with the arm on one host and its control on the other, cuts the network
for several times, and prints the table of docs/two_hosts.md.
"""

import contextlib
import ctypes
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

from pyroute2 import IPRoute

from flexarm_control.loop.supervisor import State
from flexarm_msgs.msg import JointTorque
from flexarm_tools.running.processes import (
    NODES,
    Processes,
    arguments,
    environment,
    executable,
    own_domain,
)

CLONE_NEWNET = 0x40000000  # of sched.h
LIBC = ctypes.CDLL(None, use_errno=True)

#: Addresses meant for examples (RFC 5737): on no network that this machine may be on.
ADDRESSES = {"arm": "192.0.2.1", "desk": "192.0.2.2"}

WHAT_TO_DO = (
    "network namespaces can't be made here ({error}): run as root, as in `sudo make test`, in a container with"
    " `--privileged`, or, where users may make namespaces, under `unshare --map-root-user --net`"
)


class TwoHosts:
    """The hosts of `ADDRESSES`, joined by a switch, as a context.

    Raises
    ------
    PermissionError
        Without the right to make namespaces; says what to do.
    """

    def __init__(self):
        self._stack = contextlib.ExitStack()

    def __enter__(self):
        with contextlib.ExitStack() as stack:
            self._home = _namespace(stack)
            self._spaces = {}
            for name in (*ADDRESSES, "switch"):
                try:
                    _enter(LIBC.unshare, CLONE_NEWNET)
                except PermissionError as error:
                    raise PermissionError(WHAT_TO_DO.format(error=error)) from None
                self._spaces[name] = _namespace(stack)
                _enter(LIBC.setns, self._home, CLONE_NEWNET)
            self._wire(stack)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_):
        self._stack.close()

    def _wire(self, stack):
        with self.on("switch"):
            self._switch = stack.enter_context(IPRoute())
        ip = self._switch
        # Multicast goes to every port: no host asks who listens.
        ip.link("add", ifname="switch", kind="bridge", br_mcast_snooping=0)
        (bridge,) = ip.link_lookup(ifname="switch")
        self._ports = {}
        for name, address in ADDRESSES.items():
            peer = {"ifname": "eth0", "net_ns_fd": self._spaces[name]}
            ip.link("add", ifname=name, kind="veth", peer=peer)
            (self._ports[name],) = ip.link_lookup(ifname=name)
            ip.link("set", index=self._ports[name], master=bridge, state="up")
            with self.on(name), IPRoute() as own:
                (eth0,) = own.link_lookup(ifname="eth0")
                own.addr("add", index=eth0, address=address, prefixlen=24)
                for index in (*own.link_lookup(ifname="lo"), eth0):
                    own.link("set", index=index, state="up")
        self._bridge = bridge
        self.heal()

    @contextlib.contextmanager
    def on(self, host):
        """This thread on a host: processes started and sockets made in here stay there."""
        _enter(LIBC.setns, self._spaces[host], CLONE_NEWNET)
        try:
            yield ADDRESSES.get(host)
        finally:
            _enter(LIBC.setns, self._home, CLONE_NEWNET)

    def cut(self):
        """Stop the switch; the hosts are not notified."""
        self._switch.link("set", index=self._bridge, state="down")

    def heal(self):
        """The switch forwards again."""
        self._switch.link("set", index=self._bridge, state="up")

    def unplug(self, host):
        """Pull a host's cable: its interface has no carrier."""
        self._switch.link("set", index=self._ports[host], state="down")

    def plug(self, host):
        """Put it back."""
        self._switch.link("set", index=self._ports[host], state="up")


def _enter(call, *arguments):
    """Call unshare or setns, which move this thread."""
    if call(*arguments):
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))


def _namespace(stack):
    """Descriptor of the namespace that this thread is in."""
    descriptor = os.open("/proc/thread-self/ns/net", os.O_RDONLY | os.O_CLOEXEC)
    stack.callback(os.close, descriptor)
    return descriptor


# A loop on them ------------------------------------------------------------------------------

#: Where each node runs. A slow machine copes with this rate, and a short sleep of a busy one is no fault.
HOST_OF = {"simulator": "arm", "observer": "desk", "controller": "desk"}
RATE, TORQUE_TIMEOUT, STATE_TIMEOUT = 100.0, 0.2, 0.3
PARAMETERS = {
    "simulator": {"arm": "R", "rate": RATE, "torque_timeout": TORQUE_TIMEOUT},
    "observer": {"arm": "R"},
    "controller": {"arm": "R", "fast.type": "none", "state_timeout": STATE_TIMEOUT},
}
#: The discovery of two machines, and no shared memory, which two machines do not have.
SUBNET = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET", "FASTDDS_BUILTIN_TRANSPORTS": "UDPv4"}
WITNESS = Path(__file__).with_name("host_witness.py")


class Witness:
    """A `host_witness` on a host; `received` has each topic's messages as (seconds, values).

    Each message sets the event `arrived`.
    """

    def __init__(self, hosts, host, settings, domain, log, arrived):
        with hosts.on(host), open(log, "wb") as errors:
            self._process = subprocess.Popen(
                [sys.executable, str(WITNESS)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=errors,
                env={**environment(domain), **settings},
                text=True,
            )
        self.received, self._arrived = {}, arrived
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self):
        for line in self._process.stdout:
            topic, at, values = json.loads(line)
            self.received.setdefault(topic, []).append((at, values))
            self._arrived.set()

    def tell(self, *command):
        """Have it move the arm or recover the controller."""
        self._process.stdin.write(json.dumps(command) + "\n")
        self._process.stdin.flush()

    def all(self, topic, since=0):
        """Values on a topic after the first `since` messages."""
        return [values for _, values in self.received.get(topic, [])[since:]]

    def count(self, topic):
        """How many messages there were."""
        return len(self.received.get(topic, ()))

    def newest(self, topic, key):
        """A value of the last message; None before the first."""
        received = self.received.get(topic)
        return received[-1][1].get(key) if received else None

    def diagnosis(self, name, since=0):
        """(level, message) of a node's last diagnostics; None where there are none."""
        reported = [d[name] for d in self.all("/diagnostics", since) if name in d]
        return tuple(reported[-1]) if reported else None

    @property
    def alive(self):
        """Whether it goes on; why not stands in its log."""
        return self._process.poll() is None

    def close(self):
        """End it."""
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.close()
        try:
            self._process.wait(10.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._reader.join()
        self._process.stdout.close()


class Loop:
    """Simulator on `arm`, observer and controller on `desk`, a witness on each; as a context.

    Parameters
    ----------
    hosts : TwoHosts
    directory : Path
        For log files.
    settings : mapping, optional
        Environment of all processes; a function of the host's name for different ones.
    """

    #: Longest wait for any one thing [s]; generous, so that a loaded machine fails no test.
    PATIENCE = float(os.environ.get("FLEXARM_TEST_PATIENCE", "120"))

    def __init__(self, hosts, directory, settings=SUBNET):
        self.hosts, self.directory = hosts, Path(directory)
        self._settings = settings if callable(settings) else lambda host: settings
        self._stack = contextlib.ExitStack()

    def __enter__(self):
        with contextlib.ExitStack() as stack:
            self._domain = stack.enter_context(own_domain())
            self.processes = stack.enter_context(Processes(self._domain, self.directory))
            self.witness, self._arrived = {}, threading.Event()
            for host in ADDRESSES:
                log = self.directory / f"witness_{host}.log"
                settings = self._settings(host)
                witness = Witness(self.hosts, host, settings, self._domain, log, self._arrived)
                stack.callback(witness.close)
                self.witness[host] = witness
            self.arm, self.desk = self.witness["arm"], self.witness["desk"]
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_):
        self._stack.close()

    def start(self, *names):
        """Start nodes, each on its host."""
        for name in names:
            host = HOST_OF[name]
            settings = [f"{key}={value}" for key, value in self._settings(host).items()]
            node = [executable(NODES[name], name), *arguments(PARAMETERS[name])]
            with self.hosts.on(host):
                self.processes.start(name, ["env", *settings, *node])

    def wait_for(self, what, condition):
        """Until `condition` holds; its value."""
        end = time.monotonic() + self.PATIENCE
        while not (value := condition()):
            self.processes.check()
            late = time.monotonic() > end
            if late or not all(witness.alive for witness in self.witness.values()):
                logs = "\n".join(
                    f"--- {path.stem}\n" + "\n".join(path.read_text().splitlines()[-8:])
                    for path in sorted(self.directory.glob("*.log"))
                )
                raise AssertionError(f"waited up to {self.PATIENCE:g} s in vain for {what}\n{logs}")
            self._arrived.wait(0.05)
            self._arrived.clear()
        return value

    # What an operator does at the desk ---------------------------------------------------------

    @property
    def state(self):
        """The supervisor's state; None before the first."""
        return self.desk.newest("controller/state", "state")

    def recover(self):
        """Call the controller's ~/recover where it is in fault, until there is torque."""
        again = 0.0

        def running():
            nonlocal again
            if self.state == State.FAULT and time.monotonic() > again:
                again = time.monotonic() + 1.0
                self.desk.tell("recover")
            return self.state in range(State.READY, State.STOPPING + 1)

        self.wait_for("torque", running)

    def _offer(self, by, duration, there):
        """Move until `there`, a function of the goal; after a stop of its own, as of a busy machine, again."""
        goal, again = None, 0.0

        def done():
            nonlocal goal, again
            if goal is not None and there(goal):
                return True
            resting = self.state in (State.READY, State.HOLDING)
            if self.state == State.FAULT or (resting and time.monotonic() > again):
                self.recover()
                at = self.desk.newest("controller/state", "reference")
                goal = at - by if at > 0.3 else at + by
                self.desk.tell("move", goal, duration)
                again = time.monotonic() + duration + 1.0
            return False

        self.recover()
        self.wait_for("a motion", done)

    def move(self):
        """A small motion, to its end."""

        def there(goal):
            newest = self.desk.received["controller/state"][-1][1]
            arrived = abs(newest["reference"] - goal) < 1e-12 and abs(newest["error"]) < 0.05
            return arrived and newest["state"] == State.HOLDING

        self._offer(0.2, 1.0, there)

    def set_in_motion(self):
        """A long motion, until it is well under way, with torque."""

        def under_way(goal):
            left = abs(goal - self.desk.newest("controller/state", "reference"))
            moved = self.arm.newest("arm_state", "torque") != 0.0
            return self.state == State.TRACKING and 0.3 < left < 0.7 and moved

        self._offer(0.8, 3.0, under_way)

    def cut_for(self, seconds, until=lambda cut: True):
        """Cut the network for so long, and on until a condition of the `Cut` holds; it is returned."""
        cut = Cut(self)
        self.hosts.cut()
        try:
            self.wait_for("the cut to last", lambda: time.monotonic() > cut.began + seconds)
            self.wait_for("what the cut is to bring about", lambda: until(cut))
        finally:
            self.hosts.heal()
            cut.ended = time.monotonic()
        return cut


class Cut:
    """What had arrived before a cut, and what arrived after it."""

    def __init__(self, loop):
        self._loop = loop
        self.began = self.ended = time.monotonic()
        topics = ("arm_state", "joint_torque", "controller/state", "/diagnostics")
        self.since = {
            host: {topic: loop.witness[host].count(topic) for topic in topics} for host in ADDRESSES
        }

    def after(self, host, topic):
        """(seconds, values) of all messages since."""
        return self._loop.witness[host].received.get(topic, [])[self.since[host][topic] :]

    @property
    def unanswered(self):
        """Samples from the last one that was answered to the first one moved by the safe action; None: no such."""
        enabled = [
            m["sequence"]
            for m in self._loop.arm.all("joint_torque")
            if m["mode"] == JointTorque.ENABLED
        ]
        states = [m for _, m in self.after("arm", "arm_state")]
        safe = next((m["sequence"] for m in states if m["torque"] == 0.0), None)
        return None if safe is None else safe - max(s for s in enabled if s < safe)

    @property
    def disabled_after(self):
        """From the cut to the controller's DISABLED, as received at the desk [s]; None: it continued."""
        return self._first("desk", "joint_torque", lambda m: m["mode"] == JointTorque.DISABLED)

    @property
    def received_again_after(self):
        """From the end of the cut to the first state that comes to the desk [s]; None: none yet."""
        came = (at for at, _ in self.after("desk", "arm_state"))
        return next((at - self.ended for at in came if at > self.ended), None)

    def _first(self, host, topic, holds):
        return next((at - self.began for at, m in self.after(host, topic) if holds(m)), None)


#: The cuts of the table [s]; after 20 s without a word hosts forget each other.
CUTS = (0.02, 0.05, 0.1, 0.15, 0.5, 2.0, 30.0)
HEAD = (
    "| cut | first sample under the safe action | controller `DISABLED` | first state after the cut | then |",
    "|---|---|---|---|---|",
)


def main():
    """Measure, and print the table."""
    print(*HEAD, sep="\n")
    with tempfile.TemporaryDirectory() as folder, TwoHosts() as hosts, Loop(hosts, folder) as loop:
        loop.start(*HOST_OF)
        loop.move()
        for seconds in CUTS:
            loop.set_in_motion()
            cut = loop.cut_for(seconds)
            again = loop.wait_for("states at the desk", lambda cut=cut: cut.received_again_after)
            seen = loop.desk.count("controller/state")
            loop.wait_for(
                "half a second of states",
                lambda seen=seen: loop.desk.count("controller/state") > seen + RATE / 2,
            )
            safe = None if cut.unanswered is None else cut.unanswered / RATE
            times = (_ms(t) for t in (safe, cut.disabled_after, again))
            print(
                f"| {_ms(cut.ended - cut.began)} |",
                " | ".join(times),
                f"| {State(loop.state).name} |",
                flush=True,
            )
            loop.move()
        print(loop.processes.stop(signal.SIGINT))


def _ms(seconds):
    return "-" if seconds is None else f"{1e3 * seconds:.0f} ms"


if __name__ == "__main__":
    main()
