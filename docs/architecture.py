# SPDX-License-Identifier: Apache-2.0
"""Draws architecture.svg and lists the modules in architecture.md, from the sources' imports and docstrings."""

import ast
import re
from collections import Counter
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

from flexarm_studies.markdown import write_between

HERE = Path(__file__).resolve().parent
SOURCE = HERE.parent / "src"
#: Column and row of each package in the drawing. Column 2 is that of the packages with ROS.
PLACES = {
    "flexarm_dynamics": (0.5, 0), "flexarm_msgs": (2, 0),
    "flexarm_control": (0, 1), "flexarm_sim": (1, 1), "flexarm_ros": (2, 1),
    "flexarm_studies": (0.5, 2), "flexarm_tools": (2, 2),
    "flexarm_bringup": (2, 3),
}  # fmt: skip
PACKAGES = tuple(PLACES)
BEGIN, END = "<!-- modules: begin -->", "<!-- modules: end -->"
#: Width of a box, distance of columns, height of a line of text, distance of rows [in].
WIDTH, PITCH, LINE, ROW = 2.1, 2.5, 0.19, 0.5
WITHOUT, WITH = (
    ("#34526f", "#eaf1f8"),
    ("#9a5b13", "#fdf1e0"),
)  # edge and face, without ROS and with it


def modules():
    """Every module: its path below src/<package>/, by package."""
    return {
        p: sorted(path.relative_to(SOURCE / p) for path in (SOURCE / p / p).rglob("*.py"))
        for p in PACKAGES
    }


def part(path):
    """Folder of a module within its package; empty for the package itself."""
    return path.parts[1] if len(path.parts) > 2 else ""


def imports():
    """Count the modules of a part of a package that import another package: {(package, part, package): count}.

    Modules that are loaded by their names in strings count, too: the command line does so.
    """
    found = Counter()
    for package, paths in modules().items():
        for path in paths:
            tree = ast.parse((SOURCE / package / path).read_text(encoding="utf-8"))
            names = {
                a.name
                for node in ast.walk(tree)
                if isinstance(node, ast.Import)
                for a in node.names
            }
            names |= {
                node.module
                for node in ast.walk(tree)
                if isinstance(node, ast.ImportFrom) and not node.level and node.module
            }
            names |= {
                node.value
                for node in ast.walk(tree)
                if isinstance(node, ast.Constant)
                and re.fullmatch(r"flexarm_\w+(\.\w+)+", str(node.value))
            }
            for other in {name.split(".")[0] for name in names} & set(PACKAGES) - {package}:
                found[package, part(path), other] += 1
    return found


def direct(needs):
    """Leave out the imports that a longer way implies: {package: packages}."""

    def below(package):
        return needs[package].union(*(below(other) for other in needs[package]))

    return {
        package: others - set().union(*(below(other) for other in others))
        for package, others in needs.items()
    }


def labels(package):
    """Lines in the box of a package."""
    parts = Counter(map(part, modules()[package]))
    return [
        f"{name}/ {count}" if name else f"{count} modules" for name, count in sorted(parts.items())
    ]


def draw(file):
    """Draw packages as boxes with their folders, and who imports whom; what another arrow implies is left out."""
    found = imports()
    every = {p: {to for of, _, to in found if of == p} for p in PACKAGES}
    core = {p: {to for of, part, to in found if of == p and part != "nodes"} for p in PACKAGES}
    short, plain = direct(every), direct(core)
    lines = {p: labels(p) for p in PACKAGES}
    bottoms, top = [], 0.0
    for row in range(1 + max(row for _, row in PLACES.values())):
        bottoms.append(top)
        top += LINE * (2.2 + max(len(lines[p]) for p in PACKAGES if PLACES[p][1] == row)) + ROW
    figure = plt.figure(figsize=(3 * PITCH, top))
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set(xlim=(-0.2, 3 * PITCH - 0.2), ylim=(-0.1, top - 0.1))
    axes.axis("off")
    boxes = {}  # left, bottom, height
    for package, (column, row) in PLACES.items():
        left, low = PITCH * column, bottoms[row]
        height = LINE * (2.0 + len(lines[package]))
        boxes[package] = left, low, height
        edge, face = WITH if column == 2 else WITHOUT
        axes.add_patch(
            plt.Rectangle((left, low), WIDTH, height, fc=face, ec=edge, lw=1.2, zorder=2)
        )
        style = {"va": "top", "zorder": 3}
        axes.text(
            left + 0.1, low + height - 0.08, package, weight="bold", size=10, color=edge, **style
        )
        for i, text in enumerate(lines[package], start=1):
            colour = WITH[0] if text.startswith("nodes/") else "#444444"
            at = low + height - 0.12 - LINE * i
            axes.text(left + 0.2, at, text, size=8.5, color=colour, **style)
    for package in PACKAGES:
        for other in sorted(plain[package]):  # of a set, whose order differs from run to run
            _arrow(axes, boxes[package], boxes[other], "-")
        for other in sorted(short[package] - core[package]):
            _arrow(axes, boxes[package], boxes[other], "--")
    axes.text(
        0, top - 0.3, "blue: without ROS      brown: with ROS      dashed: nodes/ only", size=8.5
    )
    matplotlib.rcParams |= {"svg.hashsalt": "flexarm", "svg.fonttype": "none"}
    figure.savefig(file, metadata={"Date": None} if str(file).endswith("svg") else None)
    plt.close(figure)


def _arrow(axes, box, target, line):
    """Draw an arrow from a box to one beside it or below it."""
    (x, y, height), (left, low, tall) = box, target
    lean = max(-0.8, min(0.8, 0.3 * (left - x)))
    if y == low:  # from the side that faces the target, over what stands between them
        near = abs(left - x) < 2 * PITCH
        start = (
            x + (WIDTH if left > x else 0.0),
            y + 0.5 * min(height, tall) if near else y + 0.75 * height,
        )
        end = (left + (0.0 if left > x else WIDTH), start[1]) if near else (left + 0.3, low + tall)
    else:
        start, end = (x + 0.5 * WIDTH + lean, y), (left + 0.5 * WIDTH - lean, low + tall)
    width = 1.4 if line == "-" else 0.9
    style = {
        "arrowstyle": "-|>",
        "color": "#34526f",
        "lw": width,
        "ls": line,
        "shrinkA": 0,
        "shrinkB": 0,
    }
    axes.annotate("", end, start, arrowprops=style, zorder=4)


def table():
    """Return a list of all modules with the first line of each docstring."""
    lines = []
    for package, paths in modules().items():
        if not paths:
            continue
        lines += [f"### {package}", "", "| module | what it is |", "|---|---|"]
        for path in paths:
            doc = ast.get_docstring(
                ast.parse((SOURCE / package / path).read_text(encoding="utf-8"))
            )
            if doc:
                what = doc.split("\n\n")[0].replace("\n", " ").replace("|", "\\|")
                if path.name == "__init__.py":
                    path = path.parent
                where = f"{path.relative_to(package)}"
                lines.append(f"| [`{where}`](../src/{package}/{path}) | {what} |")
        lines.append("")
    return "\n".join(lines)


def main():
    """Write the list and the drawing."""
    write_between(HERE / "architecture.md", BEGIN, END, f"\n{table()}")
    draw(HERE / "architecture.svg")


if __name__ == "__main__":
    main()
