# SPDX-License-Identifier: Apache-2.0
"""Makes figures without a screen, in one style, with the same file for the same numbers."""

from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt

SLOW, COMPOSITE, DESIGNED, REFERENCE = "#c1502e", "#1f5a94", "#2e7d4f", "#555555"
STYLE = {
    "figure.figsize": (7.0, 3.8),
    "figure.dpi": 100,
    "savefig.dpi": 150,
    "axes.grid": True,
    "grid.alpha": 0.3,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "font.size": 10,
    "axes.titlesize": 11,
    "legend.frameon": False,
    "lines.linewidth": 1.3,
    "svg.hashsalt": "flexarm",
}
#: Metadata about date and program, which files must not contain.
_NOTHING = {".png": {"Software": None}, ".svg": {"Date": None}, ".pdf": {"CreationDate": None}}


def save(figure, *paths, **options):
    """Write a figure to each of the `paths`, making their folders, and close it; return the first path.

    `options` are those of `savefig`.
    """
    for path in map(Path, paths):
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, metadata=_NOTHING.get(path.suffix), **options)
    plt.close(figure)
    return Path(paths[0])
