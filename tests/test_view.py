# SPDX-License-Identifier: Apache-2.0
"""The page of `flexarm view` in a real browser: what is shown is what the nodes say, what is clicked they do."""

import os
import re
import signal
import sys
from pathlib import Path
from urllib.request import urlopen

import pytest
from harness import Arm, Bench

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.models import model
from flexarm_msgs.msg import CompositeState
from flexarm_tools.shape.drawing import Drawer

CHROMIUM = Path("/usr/bin/chromium")
#: Nothing of the network, no GPU; WebGL in software.
FLAGS = [
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
]
#: Of the browser's own waits [ms].
PATIENCE = 1000.0 * Bench.PATIENCE


@pytest.fixture(scope="module")
def browser():
    """A headless Chromium; without one the test is skipped, but not in CI."""
    why = "" if CHROMIUM.is_file() else f"{CHROMIUM} is missing: apt-get install chromium"
    try:
        from playwright.sync_api import sync_playwright
    except ModuleNotFoundError:
        why = "playwright is missing: make build"
    if why and os.environ.get("CI"):
        pytest.fail(why)
    if why:
        pytest.skip(why)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=str(CHROMIUM), args=FLAGS, timeout=PATIENCE
        )
        yield browser
        browser.close()


class Screen:
    """The page, by what a person sees and clicks, while the bench is served."""

    def __init__(self, bench, browser, url):
        self.bench = bench
        self.page = browser.new_page(viewport={"width": 800, "height": 600})
        self.page.set_default_timeout(PATIENCE)
        self.requests, self.errors = [], []
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.goto(url)

    def text(self, name):
        """Text of an element by its id; empty where there is none."""
        return self.page.evaluate(f"document.getElementById('{name}')?.textContent ?? ''")

    def wait_for(self, name, *parts):
        """Until an element's text has all these parts."""
        what = f"{parts} in #{name} of the page"
        self.bench.wait_for(what, lambda: all(p in self.text(name) for p in parts))

    def wait_for_value(self, label, value):
        """Until the number beside a slider is this."""
        field = self.field(label)
        what = f"{value} beside {label}"
        self.bench.wait_for(what, lambda: field.input_value() == value)

    def click(self, label):
        """Click a button, however busy the machine draws."""
        self.page.get_by_role("button", name=label, exact=True).dispatch_event("click")

    def field(self, label):
        """What is labelled so: a checkbox, or the number beside a slider."""
        row = f"//label[normalize-space(.)='{label}']/ancestor::div[.//input][1]"
        return self.page.locator(f"xpath={row}//input[not(@type='hidden')]")

    def joint(self, number):
        """What the table shows of a joint."""
        row = f"document.querySelectorAll('#joints tr')[{number + 1}]"
        return self.page.evaluate(f"[...({row}?.children ?? [])].map(e => e.textContent)")


@pytest.fixture
def arm(bench):
    """Page and nodes, in lockstep at 100 Hz, at which designs may be refused; paused at the tenth sample."""
    bench.start_loop(
        {"lockstep": True, "pause_at": 0.1, "resend_period": 0.02},
        controller={"state_timeout": 60.0},
        arm="R",
        rate=100.0,
    )
    command = [sys.executable, "-m", "flexarm_bringup.cli", "view"]
    bench.processes.start(
        "view", [*command, *["--attach", "--no-open", "--port", "0", "--rate", "4"]]
    )
    return Arm(bench, pauses_at=10)


@pytest.fixture
def screen(bench, arm, browser):
    """The page in the browser, at the first picture; there are few, as it is drawn without a GPU."""
    found = bench.wait_for(
        "the page's address", lambda: re.search(r"R at (http://\S+),", bench.log("view"))
    )
    arm.wait_standing()
    screen = Screen(bench, browser, found[1])
    screen.wait_for("state", "READY")
    return screen


def test_view_starts_nodes_and_page_and_ends_them(bench):
    words = ["view", "R", "--lockstep", "--no-open", "--port", "0", "--rate", "2"]
    bench.processes.start("view", [sys.executable, "-m", "flexarm_bringup.cli", *words])
    found = bench.wait_for(
        "the page's address", lambda: re.search(r"R at (http://\S+),", bench.log("view"))
    )
    assert found[1].startswith("http://127.0.0.1:")
    Arm(bench).wait_ready()
    with urlopen(found[1]) as answer:
        assert answer.status == 200 and b"<html" in answer.read().lower()
    view = bench.processes.running["view"].pid
    children = Path(f"/proc/{view}/task/{view}/children").read_text().split()
    assert len(children) >= 3
    assert bench.stop("view", signal.SIGINT) == 0
    assert not [pid for pid in children if Path(f"/proc/{pid}").exists()]


@pytest.mark.long
def test_what_is_clicked_the_nodes_do_and_what_they_say_is_shown(bench, arm, screen):
    page = screen.page

    # Move: to where the sliders point, a radian from here.
    screen.wait_for_value("joint1", "1")
    screen.field("duration").fill("10")
    screen.field("duration").dispatch_event("blur")
    screen.click("Move there")
    bench.wait_for("the motion to be accepted", lambda: arm.state.accepted_trajectory_id == 1)
    arm.run(4.0)
    screen.wait_for("state", "TRACKING")
    at = arm.estimated.newest
    q, delta = list(at.joint_position), list(at.modal_amplitude)
    assert 0.2 < q[0] < 0.9
    reference = arm.state.reference_position
    drawer = Drawer(model.build(arm_file.load("R")))
    shown = [
        "joint1",
        f"{q[0]:.3f}",
        f"{1e3 * (reference[0] - q[0]):.2f}",
        f"{arm.state.slow_torque[0]:.2f}",
        f"{arm.state.fast_torque[0]:.2f}",
    ]
    bench.wait_for(f"{shown} in the table", lambda: screen.joint(0) == shown)
    screen.wait_for("tip", f"{1e3 * drawer.tip_error(q, delta, reference):.2f}")
    screen.wait_for("trajectory", "1")
    canvases = "[...document.querySelectorAll('canvas')].filter(c => c.width > 99).length"
    bench.wait_for("the scene and three plots", lambda: page.evaluate(canvases) == 4)

    # Stop, half-way: the arm is brought to rest and held where it is.
    screen.click("Stop")
    screen.wait_for("message", "STOPPING: the arm is brought to rest")
    arm.run(2.0)
    assert arm.state.supervisor_state == CompositeState.HOLDING
    screen.wait_for("state", "HOLDING")
    assert abs(arm.state.position_error[0]) < 0.05 and arm.state.reference_position[0] < 0.95

    # A gain: taken where it can be, refused with the reason and put back where it can't.
    def turn(value):
        screen.field("fast.alpha [1/s]").fill(value)
        screen.field("fast.alpha [1/s]").dispatch_event("blur")

    assert bench.get("controller", "fast.alpha") == 5.0
    screen.wait_for_value("fast.alpha [1/s]", "5")
    turn("6")
    screen.wait_for("message", "set: fast.alpha = 6")
    assert bench.get("controller", "fast.alpha") == 6.0
    turn("20")
    screen.wait_for("message", "sampled at 100 Hz", "lower the gains")
    screen.wait_for_value("fast.alpha [1/s]", "6")
    assert bench.get("controller", "fast.alpha") == 6.0
    # What somebody else sets is shown.
    assert bench.set("controller", slow__kp=[9.0])[0].successful
    screen.wait_for_value("slow.kp joint1 [1/s^2]", "9")

    # A fault, in red with its reason; recover leaves it.
    screen.click("Recover")
    screen.wait_for("message", "not in fault: HOLDING")
    assert bench.set("controller", tracking_error_limit=1e-12)[0].successful
    arm.pause(False)
    bench.wait_for("a fault", lambda: arm.state.supervisor_state == CompositeState.FAULT)
    screen.wait_for("state", "FAULT")
    screen.wait_for("reason", "tracking error of joint1")
    colour = "getComputedStyle(document.getElementById('state').parentElement).backgroundColor"
    assert page.evaluate(colour) == "rgb(201, 42, 42)"
    assert bench.set("controller", tracking_error_limit=0.5)[0].successful
    screen.click("Recover")
    bench.wait_for("torque again", arm.ready)
    screen.wait_for("state", "READY")

    # Fast control off and on.
    screen.field("fast control").dispatch_event("click")
    screen.wait_for("message", "fast control off")

    # Back to where the arm was found.
    screen.click("Move back")
    bench.wait_for("the motion back", lambda: arm.state.accepted_trajectory_id == 2)
    arm.stand()

    # It works without a network, and no script failed.
    away = [u for u in screen.requests if not re.match(r"(http|ws)://127\.0\.0\.1|blob:|data:", u)]
    assert not away and not screen.errors
