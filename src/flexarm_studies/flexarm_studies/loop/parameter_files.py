# SPDX-License-Identifier: Apache-2.0
"""Reads ROS parameter files without ROS, so the loop without ROS runs from the same file as the nodes."""

from pathlib import Path

import yaml

from flexarm_control.composite import assembly
from flexarm_control.robust.default import PAPER_ARMS
from flexarm_dynamics.arm.arm_file import arms_directories
from flexarm_dynamics.errors import ParameterError

#: Components whose parameters each node has.
PREFIXES = {"controller": assembly.CONTROL, "observer": ("observer",), "simulator": ()}


def directory():
    """Folder of the shipped controller files."""
    return arms_directories()[0].parent / "controllers"


def find(name):
    """Path of a controller file, from its path or shipped `name`; an error lists the shipped ones."""
    for path in (Path(name).expanduser(), directory() / f"{name}.yaml"):
        if path.is_file():
            return path
    shipped = ", ".join(sorted(p.stem for p in directory().glob("*.yaml")))
    raise ParameterError(
        "is neither a file nor shipped", field="controller file", value=str(name), limit=shipped
    )


def of_arm(arm):
    """Path of the shipped controller file of an arm, by its name or path; None if the arm gets a design instead."""
    if arm in PAPER_ARMS:
        return find("composite")
    shipped = directory() / f"{arm}.yaml"
    return shipped if shipped.is_file() else None


def load(name):
    """Parameters of each node from a ROS parameter file, by its path or shipped `name`; wildcards are applied.

    Node name to flat parameters: ``{"controller": {"slow.kp": [6.25], …}, …}``.
    """
    path = find(name)
    try:
        data = yaml.safe_load(path.read_text(encoding="utf-8")) or {}
        sections = {key: assembly.flat(section["ros__parameters"]) for key, section in data.items()}
    except (yaml.YAMLError, OSError, ValueError, RecursionError) as error:
        # ValueError: text that is not UTF-8, or a scalar that looks valid but is not, such as a 13th month.
        raise ParameterError(f"can't be read: {error}", field=str(path)) from None
    except (TypeError, KeyError, AttributeError, IndexError):
        hint = "write node name: ros__parameters: …"
        raise ParameterError("not a ROS parameter file", field=str(path), hint=hint) from None
    return {
        node: {
            name: value
            for key, section in sections.items()
            if key == "/**" or key.rsplit("/", 1)[-1] == node
            for name, value in section.items()
        }
        for node in PREFIXES
    }
