# SPDX-License-Identifier: Apache-2.0
"""Simulator on one host, observer and controller on another, over a network that is cut.

Needs the right to make network namespaces, see `two_hosts`. What is judged is counted in samples and read from
states; a machine that is too slow for the loop in real time stops it safely, and it recovers.
"""

import os
import signal
import socket

import pytest
import two_hosts
from diagnostic_msgs.msg import DiagnosticStatus
from pyroute2 import IPRoute
from two_hosts import ADDRESSES, RATE, SUBNET, TORQUE_TIMEOUT, Loop, TwoHosts

from flexarm_control.loop.supervisor import FIRST_RUNNING, LAST_RUNNING, State

WARN, ERROR = DiagnosticStatus.WARN[0], DiagnosticStatus.ERROR[0]
#: Without torque; HOLDING where a controller comes back by itself.
STOPPED = (State.INACTIVE, State.FAULT, State.HOLDING)
#: What the witness may have missed of the last torques, and the sample in which the safe action begins.
SLACK = 12


# The network itself --------------------------------------------------------------------------


def socket_on(hosts, host):
    with hosts.on(host) as address:
        made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        made.bind((address, 5000))
    return made


def test_two_hosts_exchange_messages_until_the_network_is_cut_and_again_when_it_heals():
    with TwoHosts() as hosts, socket_on(hosts, "arm") as arm, socket_on(hosts, "desk") as desk:

        def arrives(text, wait):
            arm.settimeout(wait)
            desk.sendto(text, (ADDRESSES["arm"], 5000))
            try:
                return arm.recv(10) == text
            except TimeoutError:
                return False

        assert arrives(b"before", 10.0)
        hosts.cut()
        assert not arrives(b"cut", 0.1)
        hosts.heal()
        assert arrives(b"healed", 10.0)
        hosts.unplug("arm")
        assert not arrives(b"pulled", 0.1)


def test_nothing_is_left_and_two_networks_do_not_meet():
    def links():
        with IPRoute() as ip:
            return {link.get("ifname") for link in ip.get_links()}

    before, here = links(), os.readlink("/proc/thread-self/ns/net")
    with TwoHosts() as one, TwoHosts() as other:
        # The same address twice: each network is alone.
        with socket_on(one, "arm") as mine, socket_on(other, "arm") as other_arm:
            with socket_on(one, "desk") as desk:
                desk.sendto(b"hello", (ADDRESSES["arm"], 5000))
            mine.settimeout(10.0)
            assert mine.recv(10) == b"hello"
            other_arm.settimeout(0.05)
            with pytest.raises(TimeoutError):
                other_arm.recv(10)
        assert links() == before
    assert (links(), os.readlink("/proc/thread-self/ns/net")) == (before, here)


def test_without_the_right_to_make_namespaces_it_says_what_to_do(monkeypatch):
    def refused(flags):
        two_hosts.ctypes.set_errno(1)
        return -1

    monkeypatch.setattr(two_hosts.LIBC, "unshare", refused)
    with pytest.raises(PermissionError, match=r"not permitted.*: run as root.*unshare"), TwoHosts():
        pass


# The loop on it ------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def started(tmp_path_factory):
    """The loop, discovered by multicast."""
    with TwoHosts() as hosts, Loop(hosts, tmp_path_factory.mktemp("log")) as loop:
        yield loop


@pytest.fixture
def loop(started):
    """The loop, whole, on a network that is whole."""
    started.hosts.heal()
    started.hosts.plug("arm")
    missing = [n for n in two_hosts.HOST_OF if n not in started.processes.running]
    started.start(*missing)
    return started


@pytest.mark.real_time
def test_a_trajectory_from_the_other_host_is_tracked(loop):
    loop.move()
    assert loop.arm.count("joint_torque") > 0
    assert loop.desk.count("arm_state") > 0


@pytest.mark.real_time
def test_a_cut_of_50_ms_is_bridged_or_stops_the_arm_and_it_recovers(loop):
    loop.set_in_motion()
    cut = loop.cut_for(0.05)
    loop.wait_for(
        "the motion's end, or a stop",
        lambda: loop.desk.received["controller/state"][-1][0] > cut.ended and loop.state in STOPPED,
    )
    if cut.unanswered is None and cut.disabled_after is None:
        assert loop.state == State.HOLDING
    else:  # a machine that was too slow
        assert cut.unanswered is None or cut.unanswered <= RATE * TORQUE_TIMEOUT + SLACK
    loop.move()


@pytest.mark.real_time
def test_a_cut_of_500_ms_is_safe_on_both_hosts_and_the_arm_moves_again_after_recovery(loop):
    loop.set_in_motion()
    # The arm and the controller know by themselves: nothing reaches either of them.
    cut = loop.cut_for(
        0.5, lambda cut: cut.unanswered is not None and cut.disabled_after is not None
    )
    assert cut.unanswered <= RATE * TORQUE_TIMEOUT + SLACK
    loop.wait_for("states at the desk", lambda: cut.received_again_after is not None)
    assert loop.state in STOPPED
    assert "no fresh torque: the safe action is applied" in loop.processes.log("simulator")
    log = loop.processes.log("controller")
    assert "no arm_state_estimate for" in log or "beyond max_gap" in log
    loop.move()
    assert FIRST_RUNNING <= loop.state <= LAST_RUNNING


@pytest.mark.real_time
def test_a_cable_that_is_pulled_for_good_is_reported_on_both_hosts_and_all_end_cleanly(loop):
    loop.set_in_motion()
    since = {host: loop.witness[host].count("/diagnostics") for host in ADDRESSES}
    cut = two_hosts.Cut(loop)
    loop.hosts.unplug("arm")

    def reported(host, name, level, text):
        diagnosis = loop.witness[host].diagnosis(name, since[host])
        return diagnosis and diagnosis[0] >= level and text in diagnosis[1]

    loop.wait_for(
        "the simulator's warning", lambda: reported("arm", "simulator", WARN, "no fresh torque")
    )
    loop.wait_for("the observer's error", lambda: reported("desk", "observer", ERROR, "no usable"))
    loop.wait_for("the controller's error", lambda: reported("desk", "controller", ERROR, ""))
    assert cut.unanswered <= RATE * TORQUE_TIMEOUT + SLACK
    assert loop.arm.newest("arm_state", "torque") == 0.0
    assert loop.state in (State.INACTIVE, State.FAULT)
    codes = loop.processes.stop(signal.SIGINT)
    assert codes == {"simulator": 0, "observer": 0, "controller": 0}


@pytest.mark.real_time
def test_hosts_find_each_other_by_static_peers_where_there_is_no_multicast(tmp_path):
    def settings(host):
        (other,) = set(ADDRESSES) - {host}
        peer = {"ROS_STATIC_PEERS": ADDRESSES[other]}
        return {**SUBNET, "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", **peer}

    with TwoHosts() as hosts, Loop(hosts, tmp_path, settings) as loop:
        loop.start("simulator")
        loop.wait_for("states at the desk", lambda: loop.desk.count("arm_state") > 10)
