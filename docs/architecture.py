# SPDX-License-Identifier: Apache-2.0
"""Draws architecture.svg and lists the modules of architecture.md, both from the sources' imports and docstrings."""

import ast
from collections import Counter
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

from flexarm_studies.markdown import write_between

HERE = Path(__file__).resolve().parent
SOURCE = HERE.parent / "src"
PACKAGES = (
    "flexarm_dynamics", "flexarm_msgs", "flexarm_ros", "flexarm_sim", "flexarm_control", "flexarm_studies",
    "flexarm_tools", "flexarm_bringup",
)  # fmt: skip
BEGIN, END = "<!-- modules: begin -->", "<!-- modules: end -->"
#: Size of a box, distance of boxes and of rows of them, height of a line of text [drawing units].
WIDTH, LINE, GAP, ROW = 3.2, 0.26, 0.9, 0.95


def modules():
    """Every module: its path below src/<package>/, by package."""
    return {
        p: sorted(path.relative_to(SOURCE / p) for path in (SOURCE / p / p).rglob("*.py"))
        for p in PACKAGES
    }


def part(path):
    """Folder of a module within its package, empty for the package itself: what the drawing has a line for."""
    return path.parts[1] if len(path.parts) > 2 else ""


def imports():
    """How many modules of a part of a package import another package: {(package, part, package): count}."""
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
            for other in {name.split(".")[0] for name in names} & set(PACKAGES) - {package}:
                found[package, part(path), other] += 1
    return found


def levels(needs):
    """Row of each package: one above the highest that it imports."""

    def level(package):
        return 1 + max((level(other) for other in needs[package]), default=-1)

    return {package: level(package) for package in needs}


def labels(package):
    """Lines in the box of a package."""
    parts = Counter(map(part, modules()[package]))
    return [
        f"{name}/ {count}" if name else f"{count} modules" for name, count in sorted(parts.items())
    ]


def draw(file):
    """Packages as boxes with their folders, in rows by what they import; thin arrows: their nodes alone do."""
    found = imports()
    needs = {p: {other for of, _, other in found if of == p} for p in PACKAGES}
    rows = levels(needs)
    figure, axes = plt.subplots(figsize=(10.0, 7.2))
    boxes, bottom = {}, 0.0
    for row in range(max(rows.values()) + 1):
        here = [p for p in PACKAGES if rows[p] == row]
        height = max(LINE * (len(labels(p)) + 1.6) for p in here)
        left = -0.5 * (len(here) * (WIDTH + GAP) - GAP)
        for i, package in enumerate(here):
            boxes[package] = left + i * (WIDTH + GAP), bottom, height
        bottom += height + ROW
    for package, (left, low, height) in boxes.items():
        axes.add_patch(
            plt.Rectangle((left, low), WIDTH, height, fc="#eef3f8", ec="#34526f", lw=1.2, zorder=2)
        )
        axes.text(left + 0.12, low + height - 0.27, package, weight="bold", size=10, zorder=3)
        for i, text in enumerate(labels(package)):
            axes.text(
                left + 0.3, low + height - 0.27 - LINE * (i + 1), text, size=8, color="#444444"
            )
    for package, others in needs.items():
        for other in others:
            core = any(
                of == package and to == other and where != "nodes" for of, where, to in found
            )
            x0, y0, _ = boxes[package]
            x1, y1, height = boxes[other]
            axes.annotate(
                "", (x1 + 0.5 * WIDTH + 0.12 * (x0 - x1), y1 + height), (x0 + 0.5 * WIDTH + 0.12 * (x1 - x0), y0),
                arrowprops={"arrowstyle": "-|>", "color": "#34526f", "lw": 1.6 if core else 0.8,
                            "ls": "-" if core else "--", "connectionstyle": "arc3,rad=0.06"}, zorder=1,
            )  # fmt: skip
    axes.set_title("Who imports whom; dashed: the nodes alone", size=10, loc="left")
    axes.autoscale_view()
    axes.set_aspect("equal")
    axes.axis("off")
    matplotlib.rcParams |= {"svg.hashsalt": "flexarm", "svg.fonttype": "none"}
    figure.savefig(file, bbox_inches="tight", metadata={"Date": None})
    plt.close(figure)


def table():
    """A list of all modules, with the first line of what each says of itself."""
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
    """Write both."""
    write_between(HERE / "architecture.md", BEGIN, END, f"\n{table()}")
    draw(HERE / "architecture.svg")


if __name__ == "__main__":
    main()
