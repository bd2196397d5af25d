# SPDX-License-Identifier: Apache-2.0
"""What `flexarm view` costs the loop it looks on at: ``python -m benchmarks.view``, three minutes, in real time.

Two loops run on separate domains, and a view is attached to one of them. They take turns of 1.5 s while the arm moves.
The latency from measurement to torque is measured as in `flexarm latency`. A client of the page receives everything
that a browser on another machine would receive, and draws nothing.
"""

import contextlib
import os
import re
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.latency import measure as latency

ROUNDS = 12
TWO_LINK = latency.Case("two_link", "two_link", 1000.0, (0.0, 0.0), (1.0, 1.0), 1.5, pace=0.25)
#: Receives messages from the page's server as fast as they come, and prints their number at the end.
CLIENT = """
import signal, sys, viser
from websockets.sync.client import connect

taken = 0
signal.signal(signal.SIGINT, lambda *_: sys.exit(print(taken, "messages taken")))
name = f"viser-v{viser.__version__}"
with connect(sys.argv[1].replace("http", "ws"), subprotocols=[name], max_size=None) as page:
    for message in page:
        taken += 1
"""


def main(case, rounds=ROUNDS):
    """Print the latency percentiles of both loops, and their ratios turn by turn."""
    name = next(n for n in latency.CHAINS if n != "relay")
    windows = {"alone": [], "viewed": []}
    with TemporaryDirectory() as folder, contextlib.ExitStack() as stack:
        loops = {
            key: latency.Chain(stack, name, case, Path(folder) / key, "executor") for key in windows
        }
        viewed = loops["viewed"]
        words = ["view", "--attach", "--no-open", "--port", "0"]
        viewed.processes.start("view", [sys.executable, "-m", "flexarm_bringup.cli", *words])
        viewed.wait_for("the page", lambda: "http://" in viewed.processes.log("view"))
        url = re.search(r"http://[0-9.:]+", viewed.processes.log("view"))[0]
        viewed.processes.start("client", [sys.executable, "-c", CLIENT, url])
        for loop in loops.values():
            loop.get_ready()
            loop.offer((rounds + 0.5) * case.window * case.pace)
        for i in range(rounds):
            for key in list(loops)[:: 1 - 2 * (i % 2)]:
                windows[key].append(loops[key].window(case.window))
        viewed.processes.stop()
        client = viewed.processes.log("client").strip()
    print(f"{case.name}; the client: {client}")
    found = {key: latency.percentiles(each) for key, each in windows.items()}
    for key, each in found.items():
        p50, p95, p99 = 1e3 * np.median(each, axis=0)
        print(f"{key:8} p50 {p50:.3f} ms, p95 {p95:.3f} ms, p99 {p99:.3f} ms")
    p50, p95, p99 = np.median(found["viewed"] / found["alone"], axis=0)
    print(f"viewed / alone, median of {rounds} turns: p50 {p50:.3f}, p95 {p95:.3f}, p99 {p99:.3f}")
    print(
        f"load of the machine in the last minute: {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores"
    )


if __name__ == "__main__":
    for each in (next(c for c in latency.CASES if c.name == "R, 500 Hz"), TWO_LINK):
        main(each)
