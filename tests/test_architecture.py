# SPDX-License-Identifier: Apache-2.0
"""Dependencies point one way: bringup to sim and control, these to dynamics; ROS in the nodes alone."""

import ast
import importlib.util
from pathlib import Path

import pytest

SOURCE = Path(__file__).resolve().parents[1] / "src"
DOCS = SOURCE.parent / "docs"
ROS = {"rclpy", "flexarm_msgs", "flexarm_ros", "rcl_interfaces", "std_msgs", "std_srvs"}
ROS |= {"sensor_msgs", "trajectory_msgs", "diagnostic_msgs", "builtin_interfaces", "launch"}
OURS = {"flexarm_dynamics", "flexarm_control", "flexarm_sim", "flexarm_bringup"}
#: What a package may import of the others.
MAY = {
    "flexarm_dynamics": set(),
    "flexarm_control": {"flexarm_dynamics"},
    "flexarm_sim": {"flexarm_dynamics"},
    "flexarm_ros": {"flexarm_dynamics"},
    "flexarm_bringup": {"flexarm_dynamics", "flexarm_control", "flexarm_sim"},
}


def imported(path):
    """Top-level packages that a file imports, wherever in it."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            found.add(node.module.split(".")[0])
    return found


@pytest.mark.parametrize("package", MAY)
def test_a_package_imports_only_what_stands_below_it(package):
    files = list((SOURCE / package / package).rglob("*.py"))
    assert files
    for path in files:
        beyond = (imported(path) & OURS) - MAY[package] - {package}
        assert not beyond, f"{path.relative_to(SOURCE)} imports {', '.join(sorted(beyond))}"


@pytest.mark.parametrize("package", ["flexarm_dynamics", "flexarm_control", "flexarm_sim"])
def test_ros_is_imported_in_nodes_alone(package):
    for path in (SOURCE / package / package).rglob("*.py"):
        inside = "nodes" in path.parts and package != "flexarm_dynamics"
        found = imported(path) & ROS
        assert inside or not found, f"{path.relative_to(SOURCE)} imports {', '.join(sorted(found))}"


def test_the_page_on_the_architecture_is_what_the_sources_are():
    """Else: python docs/architecture.py."""
    spec = importlib.util.spec_from_file_location("architecture", DOCS / "architecture.py")
    architecture = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(architecture)
    page = (DOCS / "architecture.md").read_text(encoding="utf-8")
    assert architecture.table() in page
    drawing = (DOCS / "architecture.svg").read_text(encoding="utf-8")
    for package in MAY:
        assert package in drawing
        assert all(label in drawing for label in architecture.labels(package))
