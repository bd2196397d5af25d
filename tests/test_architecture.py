# SPDX-License-Identifier: Apache-2.0
"""Dependencies point one way, without circles; packages without ROS import none, found by importing them without it."""

import ast
import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
SOURCE = ROOT / "src"
DOCS = ROOT / "docs"
#: What a package may import of the others.
MAY = {
    "flexarm_dynamics": set(),
    "flexarm_control": {"flexarm_dynamics"},
    "flexarm_sim": {"flexarm_dynamics"},
    "flexarm_studies": {"flexarm_dynamics", "flexarm_control", "flexarm_sim"},
    "flexarm_ros": {"flexarm_dynamics"},
    "flexarm_tools": {
        "flexarm_dynamics",
        "flexarm_control",
        "flexarm_sim",
        "flexarm_studies",
        "flexarm_ros",
    },
    "flexarm_bringup": {
        "flexarm_dynamics",
        "flexarm_control",
        "flexarm_sim",
        "flexarm_studies",
        "flexarm_ros",
        "flexarm_tools",
    },
}
#: Packages without ROS, outside of their folder `nodes`.
WITHOUT_ROS = ("flexarm_dynamics", "flexarm_control", "flexarm_sim", "flexarm_studies")

#: Imports every module of a package in an interpreter that has neither ROS nor the packages above: whatever is found
#: in a path of ROS, or is one of ours that needs ROS, is refused.
IMPORT_ALL = """
import importlib, pkgutil, sys
top, *refused = sys.argv[1:]

class Refuse:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in refused:
            raise ModuleNotFoundError(f"{name} is refused here", name=name)

sys.meta_path.insert(0, Refuse())
package = importlib.import_module(top)
names = [m.name for m in pkgutil.walk_packages(package.__path__, top + ".")]
names = [n for n in names if "nodes" not in n.split(".")]
for name in names:
    importlib.import_module(name)
print(len(names))
"""


def ros_packages():
    """Every Python package of an installed ROS package, found by its place in the ament index or beside rclpy."""
    found = {"flexarm_msgs", "flexarm_ros", "flexarm_tools", "flexarm_bringup"}
    for prefix in os.environ["AMENT_PREFIX_PATH"].split(os.pathsep):
        index = Path(prefix, "share", "ament_index", "resource_index", "packages")
        if index.is_dir():
            found |= {path.name for path in index.iterdir()}
    return found - set(WITHOUT_ROS)


def files(package):
    return sorted((SOURCE / package / package).rglob("*.py"))


def module_of(path, top):
    """Dotted name of a file below `top`, and whether it is a package."""
    parts = path.relative_to(top).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts), parts[-1] == "__init__"


def imports(path, name, is_package):
    """Dotted names that a file imports, wherever in it."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                parts = name.split(".") if is_package else name.split(".")[:-1]
                parts = parts[: len(parts) - node.level + 1]
                base = ".".join([*parts, *([node.module] if node.module else [])])
            yield base
            yield from (f"{base}.{alias.name}" for alias in node.names)


@pytest.mark.parametrize("package", MAY)
def test_a_package_imports_only_what_stands_below_it(package):
    assert files(package)
    for path in files(package):
        name, is_package = module_of(path, SOURCE / package)
        allowed = MAY[package] | {package}
        if "nodes" in name.split("."):
            allowed = allowed | {"flexarm_ros"}
        found = {n.split(".")[0] for n in imports(path, name, is_package)}
        beyond = (found & set(MAY)) - allowed
        assert not beyond, f"{path.relative_to(SOURCE)} imports {', '.join(sorted(beyond))}"


@pytest.mark.parametrize("package", WITHOUT_ROS)
def test_every_module_outside_nodes_imports_where_there_is_no_ros(package):
    refused = ros_packages()
    assert {"rclpy", "std_msgs", "builtin_interfaces", "rosidl_runtime_py"} & refused
    done = subprocess.run(
        [sys.executable, "-c", IMPORT_ALL, package, *sorted(refused)],
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) > 5
    # An import inside a function is not tried above.
    for path in files(package):
        name, is_package = module_of(path, SOURCE / package)
        if "nodes" not in name.split("."):
            found = {n.split(".")[0] for n in imports(path, name, is_package)} & refused
            assert not found, f"{name} imports {', '.join(sorted(found))}"


def circles(graph):
    """Groups of modules that import one another (strongly connected components, Tarjan 1972)."""
    index, low, stack, found = {}, {}, [], []

    def visit(node):
        index[node] = low[node] = len(index)
        stack.append(node)
        for other in graph[node]:
            if other not in index:
                visit(other)
                low[node] = min(low[node], low[other])
            elif other in stack:
                low[node] = min(low[node], index[other])
        if low[node] == index[node]:
            group = stack[stack.index(node) :]
            del stack[stack.index(node) :]
            if len(group) > 1:
                found.append(sorted(group))

    for node in graph:
        if node not in index:
            visit(node)
    return found


def graph(tops):
    """Modules of some packages, each package as (folder above it, name), and what they import of each other."""
    paths = {}
    for top, folder in tops:
        paths |= {module_of(path, top): path for path in sorted((top / folder).rglob("*.py"))}
    names = {name for name, _ in paths}
    out = {}
    for (name, is_package), path in paths.items():
        # `from package import module` is an import of the module, not of what else its folder holds.
        wanted = {n for n in imports(path, name, is_package) if n in names and n != name}
        out[name] = {n for n in wanted if not any(o.startswith(f"{n}.") for o in wanted)}
    return out


def test_modules_import_one_another_in_no_circle():
    packages = [(SOURCE / package, package) for package in MAY]
    packages += [(ROOT, folder) for folder in ("benchmarks", "fuzz", "soak")]
    found = graph(packages)
    assert len(found) > 200
    assert not circles(found)


def test_circles_are_found():
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"b"}}) == [["b", "c"]]
    assert not circles({"a": {"b", "c"}, "b": {"c"}, "c": set()})


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
