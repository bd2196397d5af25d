# SPDX-License-Identifier: Apache-2.0
"""Draws an arm and its natural modes."""

import numpy as np

from .options import chain_of, check_file

#: Maximum number of drawn modes.
MAX_MODES = 4


def draw(arm_model, q, path):
    """Draw the arm of `arm_model` at rest, and its lowest modes, joints locked, as PNG, SVG or PDF; return the path."""
    from ..plotting import plt, save

    path = check_file(path)
    arm, chain = arm_model.arm, chain_of(arm_model)
    omega, shapes = arm_model.normal_modes(q, locked=True)
    shown = min(MAX_MODES, omega.size)
    straight = axis_points(chain, q, np.zeros(chain.n_modes))
    reach = max(np.abs(straight).max(), arm.reach)
    long = np.argmax(np.ptp(np.concatenate(straight), axis=0))
    figure, axes = plt.subplots(
        1, shown + 1, figsize=(3.2 * (shown + 1), 3.4), squeeze=False, layout="constrained"
    )
    rest = arm_model.static_deflection(q)
    for k, ax in enumerate(axes[0]):
        if k:
            delta, small = shapes[chain.n_joints :, k - 1], 1e-6
            moved = np.subtract(axis_points(chain, q, small * delta), straight)
            scale = 0.12 * reach / max(np.abs(moved).max() / small, 1e-12)
            lines = axis_points(chain, q, scale * delta)
            ax.set_title(f"mode {k}: {omega[k - 1] / (2.0 * np.pi):.3g} Hz", fontsize=10)
        else:
            lines = axis_points(chain, q, rest)
            ax.set_title(f"{arm.name}, at rest", fontsize=10)
        # The view is along the direction in which the arm neither extends nor moves.
        moves = np.abs(np.concatenate(lines) - np.concatenate(straight)).max(axis=0)
        moves += 1e-3 * np.ptp(np.concatenate(straight), axis=0) + 1e-9 * np.array([3, 2, 1])
        a, b = sorted((long, next(i for i in np.argsort(moves)[::-1] if i != long)))
        for line in straight:
            ax.plot(line[:, a], line[:, b], color="0.75", lw=2.0)
        if not k:
            for gauge in arm.gauges:
                p = chain.point(gauge.link, gauge.position, q, rest)
                ax.plot(p[a], p[b], "s", color="tab:orange", ms=4)
        for line in lines:
            ax.plot(line[:, a], line[:, b], color="tab:blue", lw=1.5)
        for line in lines:  # over all links
            ax.plot(line[0, a], line[0, b], "o", color="black", ms=4)
        ax.plot(lines[-1][-1, a], lines[-1][-1, b], "D", color="tab:red", ms=4)
        ax.set_aspect("equal", adjustable="datalim")
        ax.set_xlabel(f"{'xyz'[a]} [m]")
        ax.set_ylabel(f"{'xyz'[b]} [m]")
        ax.grid(alpha=0.3)
    figure.suptitle(
        "joints locked; grey: straight, dots: joints, diamond: tip, squares: gauges; modes scaled to be visible",
        fontsize=8,
    )
    return str(save(figure, path, dpi=120))


def axis_points(chain, q, delta, count=25):
    """Points along each link's axis, a list of arrays of shape (count, 3)."""
    return [
        np.array(
            [chain.point(link.name, x, q, delta) for x in np.linspace(0.0, link.length, count)]
        )
        for link in chain.arm.links
    ]
