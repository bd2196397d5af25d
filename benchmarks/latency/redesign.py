# SPDX-License-Identifier: Apache-2.0
"""``flexarm latency --redesign``: the same loop's latency while its fast law is designed anew, beside without.

The loop runs as three processes with a moving arm. Windows without changes take turns with windows in which controller
parameters are set every `EVERY` seconds. The result is the ratio of each round's percentiles. Each setting causes a
whole design: gains, full-order check and feed-forward, or the Riccati gains over the workspace.
"""

import contextlib
import itertools
import time
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from flexarm_dynamics.errors import FlexarmError
from flexarm_studies import markdown

from .measure import Chain, medians, percentiles

#: Time from one setting of parameters to the next [s].
EVERY = 1.0
#: Duration of a window, and of the rest after a window with designs [s].
WINDOW, REST = 3.0, 2.0

NOTHING, ALPHA, GRID = "nothing", "`fast.alpha` set", "`scheduled_lqr` grid built"


@dataclass(frozen=True)
class Redesign:
    """Values of the parameters that are set in turns.

    Attributes
    ----------
    alphas : tuple of float
        Values of `fast.alpha`; the grids are built with the first.
    grids : tuple of int
        Values of `fast.grid`, with `fast.type` scheduled_lqr.
    reach : float
        Half-width of the grid, on either side of the middle of the motion [rad].
    """

    alphas: tuple
    grids: tuple
    reach: float


#: `Redesign` of each arm.
REDESIGNS = {
    "R": Redesign((4.0, 5.0), (3, 4), 1.0),
    "long_reach": Redesign((0.0, 0.05), (3, 4), 0.3),
}


def values_of(case):
    """The settings for `ALPHA` and for `GRID`: lists of mappings of name to value."""
    redesign, middle = REDESIGNS[case.arm], 0.5 * (np.array(case.begin) + np.array(case.end))
    low, high = (middle + side * redesign.reach for side in (-1.0, 1.0))
    # A parameter that is not set keeps its last value, so the grid's settings contain alpha, too.
    ends = {"fast.low": low.tolist(), "fast.high": high.tolist(), "fast.alpha": redesign.alphas[0]}
    return {
        ALPHA: [{"fast.type": "lqr", "fast.alpha": alpha} for alpha in redesign.alphas],
        GRID: [{"fast.type": "scheduled_lqr", "fast.grid": g, **ends} for g in redesign.grids],
    }


class Setter:
    """Sets parameters of a chain's controller; each request waits for the answer to the one before."""

    def __init__(self, chain, case):
        self.chain, self.answers = chain, []
        self._values = {what: itertools.cycle(all_) for what, all_ in values_of(case).items()}

    def set(self, what):
        """Request the next setting of `ALPHA` or `GRID`; return the `Question`."""
        from rcl_interfaces.srv import SetParametersAtomically

        from flexarm_ros.session import parameter_messages

        return self.chain.session.ask(
            SetParametersAtomically,
            "controller/set_parameters_atomically",
            parameters=parameter_messages(next(self._values[what])),
        )

    def window(self, what):
        """Run one window in which `what` is set every `EVERY` seconds; return what the simulator measured."""
        chain, answer, due = self.chain, None, 0.0
        before = len(chain.figures())
        chain.pause(False)
        end = time.monotonic() + WINDOW
        while (now := time.monotonic()) < end:
            if what != NOTHING and now >= due:
                self._take(answer)
                answer, due = self.set(what), now + EVERY
            chain.session.serve(0.05)
        self._take(answer)
        chain.pause(True)
        if what != NOTHING:
            self._wait_for_design()
        return chain.wait_for("the simulator's figures", lambda: chain.figures()[before:])[-1]

    def _wait_for_design(self):
        """Wait for designs that still run, while the loop is paused: the next window must be without them."""
        self.chain.session.serve(REST)

    def _take(self, answer):
        if answer is not None:
            self.chain.wait_for("parameters to be set", answer.poll)
            self.answers.append(answer.answer.result)


def measure(case, rounds, fraction):
    """Measure a case of an arm in `REDESIGNS`, in turns: kind of window to what the simulator measured in each.

    `rounds` is the number of rounds; `fraction` is called with the fraction that is done, from 0 to 1. A value or a
    design that is refused is an error.
    """
    kinds = (NOTHING, ALPHA, GRID)
    found = {kind: [] for kind in kinds}
    with TemporaryDirectory() as folder, contextlib.ExitStack() as stack:
        chain = Chain(stack, "three processes", case, Path(folder), "executor")
        chain.get_ready()
        chain.offer((len(kinds) * rounds + 2) * WINDOW * case.pace)
        setter = Setter(chain, case)
        for kind in kinds:  # the first starts the process of the designs
            setter.window(kind)
        for i in range(rounds):
            for kind in kinds if i % 2 == 0 else kinds[::-1]:
                found[kind].append(setter.window(kind))
            fraction((i + 1) / rounds)
        chain.processes.stop()
        refused = [x for x in chain.processes.log("controller").splitlines() if "refused" in x]
    if refused:
        raise FlexarmError(f"a design was refused: {refused[0]}", field=case.name)
    for answer in setter.answers:
        if not answer.successful:
            raise FlexarmError(f"the controller refused: {answer.reason}", field=case.name)
    return found


def summary(case, found):
    """Rows of the table of one case: percentiles [ms], and their ratio to those without designs in the same round.

    `found` has the windows by kind.

    Returns
    -------
    list of dict
    """
    each = {kind: 1e3 * percentiles(windows) for kind, windows in found.items()}
    return [
        {
            "case": case.name,
            "meanwhile": kind,
            "latency_ms": medians(mine),
            "ratio": medians(mine / each[NOTHING]),
        }
        for kind, mine in each.items()
    ]


def table(rows):
    """Markdown table of `summary` rows."""
    head = ("arm, rate", "meanwhile", "p50 [ms]", "p95", "p99", "ratio of p50", "of p95", "of p99")
    numbers = lambda row: (*row["latency_ms"].values(), *row["ratio"].values())  # noqa: E731
    lines = [(r["case"], r["meanwhile"], *(f"{v:.2f}" for v in numbers(r))) for r in rows]
    return "\n".join(markdown.table(head, lines))
