# SPDX-License-Identifier: Apache-2.0
"""``flexarm report``: reads recorded runs and writes them on one page of HTML."""

import json
import time
import webbrowser
from pathlib import Path

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.errors import FlexarmError
from flexarm_studies.progress import Progress
from flexarm_studies.recordings import mapping as mappings

from ..identification import recording as recordings


def add_arguments(parser):
    """Arguments of the sub-command."""
    parser.description = (
        "Reads bags of `flexarm record`, `flexarm simulate --bag`, `flexarm demo` or `ros2 "
        "bag record`, and CSV files, and writes one page that needs no network."
    )
    parser.epilog = "example: flexarm report results/run1 results/run2 --out results/report.html"
    add = parser.add_argument
    add(
        "bags",
        nargs="+",
        metavar="BAG|CSV",
        help="folder of a rosbag2 bag, a folder with one in it, a .mcap, .db3 or .csv file; several are compared",
    )
    mappings.add_option(parser)
    add(
        "--out",
        default="results/report.html",
        metavar="FILE.html",
        help="the page (results/report.html)",
    )
    add("--arm", help="arm file: a shipped name or a path; not needed where the bag has its own")
    add(
        "--namespace",
        metavar="NS",
        help="of the one arm that is wanted; all in the bag if not given",
    )
    add("--json", action="store_true", help="print the summary's numbers of each run as JSON")
    add("--open", action="store_true", help="open the page in a browser")


def report(options):
    """Run ``report``; return the page's path."""
    progress, out = Progress(), _page_file(options.out)
    runs = read(
        options.bags, options.arm, options.namespace, progress, mappings.of_options(options)
    )
    made = _write(runs, out, progress)
    if options.json:
        from .analysis import summary

        numbers = {run.label: {"bag": str(run.contents.path)} | summary(run) for run in runs}
        print(json.dumps({"report": str(made), "runs": numbers}, allow_nan=False))
    else:
        print(f"report {made} ({made.stat().st_size / 1e6:.2f} MB): open it in a browser")
    if options.open:
        webbrowser.open(made.resolve().as_uri())
    return made


def make(bags, out, arm=None, namespace=None, progress=None, names=None, opening=""):
    """Write the report of some bags; return the page's path.

    Parameters
    ----------
    bags : sequence of str or Path
    out : str or Path
        The page.
    arm, namespace : str, optional
        See `bag.read`.
    progress : Progress, optional
    names : sequence of str, optional
        Names of the runs on the page; if not given, those of their folders.
    opening : str
        Sentences before the numbers: what one sees on the page.

    Raises
    ------
    FlexarmError
        For a bag without states of an arm, and for a page that can't be written.
    """
    out = _page_file(out)
    runs = read(bags, arm, namespace, progress)
    for run, name in zip(runs, names or (), strict=bool(names)):
        run.label = name
    return _write(runs, out, progress, opening)


def _page_file(out):
    out = Path(out)
    if out.suffix not in (".html", ".htm"):
        raise FlexarmError(
            "is no name of a page", field="--out", value=str(out), hint="it ends in .html"
        )
    return out


def _write(runs, out, progress, opening=""):
    if progress is not None:
        progress.step("figures and page")
    # Imported here: matplotlib and jinja2 are needed for drawing only.
    from . import page

    text = page.write(runs, opening)
    if progress is not None:
        progress.done()
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(text, encoding="utf-8")
    except OSError as error:
        raise FlexarmError(
            f"can't be written: {error.strerror or error}", field="--out", value=str(out)
        ) from None
    return out


def read(bags, arm=None, namespace=None, progress=None, mapping=None):
    """The runs in some bags or CSV files, a list of `Run`; each has a label of its own.

    `arm`, `namespace` and `progress` are as in `make`; `mapping` says what the columns of CSV files are.
    """
    from ..recording import bag
    from .run import Run

    found = []
    for path in bags:
        if progress is not None:
            progress.step(f"read {path}")
        shown = time.monotonic()

        def fraction(done):
            nonlocal shown
            if progress is not None and time.monotonic() > shown + 0.1:
                shown = time.monotonic()
                progress.fraction(done)

        if Path(path).suffix == ".csv" or (mapping is not None and not recordings.is_bag(path)):
            of = arm_file.load(arm) if isinstance(arm, str) else arm
            table = recordings.read(path, of, mapping=mapping)
            found.append((recordings.to_contents(table, Path(path), of), str(path)))
            continue
        for contents in bag.read(path, arm, namespace, fraction):
            found.append((contents, str(path)))
    names = labels([p for _, p in found], [c.namespace for c, _ in found])
    return [Run(c, name) for (c, _), name in zip(found, names, strict=True)]


def labels(paths, namespaces):
    """Labels of runs: as many last parts of their paths as distinguish them, and the namespace if paths do not."""
    parts = []
    for path in paths:
        path = Path(path).resolve()
        path = path.with_suffix("") if path.suffix in (".mcap", ".db3", ".csv") else path
        pieces = [p for p in path.parts if p != path.anchor] or [str(path)]
        # The demo's bags are called `bag`, and a file in a bag has the same name as the bag.
        if len(pieces) > 1 and pieces[-1] == "bag":
            pieces = pieces[:-1]
        parts.append(pieces)
    for depth in range(1, max(map(len, parts)) + 1):
        names = ["/".join(p[-depth:]) for p in parts]
        if len(set(names)) == len({tuple(p) for p in parts}):
            break
    names = [
        f"{name} {space}" if names.count(name) > 1 and space else name
        for name, space in zip(names, namespaces, strict=True)
    ]
    again = [f"{n} ({names[: i + 1].count(n)})" for i, n in enumerate(names)]
    return [a if names.count(n) > 1 else n for n, a in zip(names, again, strict=True)]
