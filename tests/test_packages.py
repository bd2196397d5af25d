# SPDX-License-Identifier: Apache-2.0
"""What a package says of itself: keys for what it imports and nothing else, licences, changelogs."""

import ast
import importlib.util
import re
import sys
from pathlib import Path

import pytest
from catkin_pkg.changelog import Changelog, populate_changelog_from_rst
from catkin_pkg.package import parse_package
from catkin_pkg.package_version import get_forthcoming_label

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = sorted(path.parent for path in (ROOT / "src").glob("*/package.xml"))
TEMPLATE = ROOT / "examples" / "flexarm_driver_template"
PYTHON = [path for path in (*PACKAGES, TEMPLATE) if (path / "setup.py").is_file()]
OURS = {path.name for path in (*PACKAGES, TEMPLATE)}

#: Key of rosdistro (rosdep/python.yaml) for what a module is imported as.
KEYS = {
    "control": "python-control-pip",
    "hypothesis": "python3-hypothesis",
    "jinja2": "python3-jinja2",
    "matplotlib": "python3-matplotlib",
    "mujoco": "python3-mujoco-pip",
    "numba": "python3-numba",
    "numpy": "python3-numpy",
    "pytest": "python3-pytest",
    "rosbags": "python3-rosbags-pip",
    "ruamel": "python3-ruamel.yaml",
    "scipy": "python3-scipy",
    "sympy": "python3-sympy",
    "yaml": "python3-yaml",
}
#: Packages of Jazzy, whose key is their name.
JAZZY = {
    "action_msgs",
    "builtin_interfaces",
    "diagnostic_msgs",
    "launch",
    "launch_ros",
    "rcl_interfaces",
    "rclpy",
}
JAZZY |= {
    "geometry_msgs",
    "lifecycle_msgs",
    "rosgraph_msgs",
    "sensor_msgs",
    "std_msgs",
    "std_srvs",
    "trajectory_msgs",
    "visualization_msgs",
}
#: Needed and not imported.
USED_OTHERWISE = {("flexarm_bringup", "ros2launch"), ("flexarm_bringup", "flexarm_tools")}
#: Options that only their own commands or modules need, without a key; llvmlite is part of numba.
WITHOUT = {"distributed", "foxglove", "gymnasium", "llvmlite", "viser", "websockets"}
#: Tests of a package below that look at one above: a key would make a circle, which colcon refuses.
CIRCLES = {
    ("flexarm_ros", "flexarm_control"),
    ("flexarm_studies", "flexarm_bringup"),
    ("flexarm_studies", "flexarm_tools"),
    ("flexarm_tools", "flexarm_bringup"),
}


def names(paths):
    """Names of packages, for test ids."""
    return [path.name for path in paths]


def imported(folders):
    """Top-level modules that files import, but those of the standard library and their own neighbours."""
    found, own = set(), set()
    for path in (path for folder in folders for path in folder.rglob("*.py")):
        own |= {path.stem}
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                found |= {alias.name.split(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.level == 0:
                found.add(node.module.split(".")[0])
    return found - set(sys.stdlib_module_names) - (own - set(KEYS) - JAZZY - OURS) - WITHOUT


def keys(package, folders):
    """The keys of what files import."""
    modules = imported(folders) - {package}
    unknown = modules - set(KEYS) - JAZZY - OURS
    assert not unknown, f"no rosdep key known of {', '.join(sorted(unknown))}: add it to KEYS"
    return {KEYS.get(module, module) for module in modules}


@pytest.mark.parametrize("path", PYTHON, ids=names(PYTHON))
def test_keys_are_those_of_what_a_package_imports(path):
    package = parse_package(path)
    declared = {dependency.name for dependency in package.exec_depends}
    otherwise = {key for name, key in USED_OTHERWISE if name == path.name}
    needed = keys(path.name, [path / path.name, path / "launch"])
    manifest = f"{path.relative_to(ROOT)}/package.xml"
    assert not needed - declared, f"add as exec_depend to {manifest}"
    assert not declared - needed - otherwise, f"not imported, take from {manifest}"
    tests = {dependency.name for dependency in package.test_depends}
    circles = {key for name, key in CIRCLES if name == path.name}
    needed = keys(path.name, [path / "test"])
    assert not needed - declared - circles - tests, f"add as test_depend to {manifest}"
    assert not tests - needed, f"not imported by tests, take from {manifest}"


def test_keys_of_the_messages_are_those_of_their_build():
    path = ROOT / "src" / "flexarm_msgs"
    package = parse_package(path)
    text = (path / "CMakeLists.txt").read_text()
    found = set(re.findall(r"find_package\((\w+)", text))
    tools = {d.name for d in package.buildtool_depends}
    assert found == tools | {d.name for d in package.build_depends}
    files = [*path.glob("msg/*.msg"), *path.glob("action/*.action")]
    types = re.findall(r"^(\w+)/\w+", "".join(p.read_text() for p in files), re.M)
    assert any(p.suffix == ".action" for p in files)
    types += ["action_msgs"]  # of the services that an action is made of
    assert set(types) == {d.name for d in package.build_depends}
    assert set(types) <= {d.name for d in package.exec_depends}


@pytest.mark.parametrize("path", PACKAGES, ids=names(PACKAGES))
def test_a_manifest_is_valid_and_its_licence_is_the_projects(path):
    warnings = []
    package = parse_package(path, warnings=warnings)
    package.validate(warnings=warnings)
    assert not warnings
    assert package.licenses == ["Apache-2.0"] and package.licenses[0].file == "LICENSE"
    licence = (ROOT / "LICENSE").read_text()
    assert "Apache License" in licence and (path / "LICENSE").read_text() == licence


@pytest.mark.parametrize("path", PYTHON, ids=names(PYTHON))
def test_setup_py_agrees_with_the_manifest(path):
    package = parse_package(path)
    given = {}
    for node in ast.walk(ast.parse((path / "setup.py").read_text())):
        if isinstance(node, ast.keyword) and isinstance(node.value, ast.Constant):
            given[node.arg] = node.value.value
    assert given["version"] == package.version
    assert given["license"] == str(package.licenses[0])
    assert given["maintainer"] == package.maintainers[0].name
    assert given["maintainer_email"] == package.maintainers[0].email


@pytest.mark.parametrize("path", PACKAGES, ids=names(PACKAGES))
def test_a_changelog_can_be_tagged_for_a_release(path):
    text = (path / "CHANGELOG.rst").read_text()
    assert get_forthcoming_label(text) == "Forthcoming"
    # As catkin_prepare_release does.
    released = text.replace("Forthcoming\n-----------", "0.1.0 (2026-01-31)\n------------------")
    changelog = Changelog(path.name)
    populate_changelog_from_rst(changelog, released)
    ((version, _, entries),) = changelog.foreach_version()
    assert version == parse_package(path).version and len(entries) >= 1
    assert text.splitlines()[1] == f"Changelog for package {path.name}"


def test_every_topic_of_the_nodes_is_in_the_documentation_and_overridable():
    text = (ROOT / "docs" / "ros.md").read_text()
    for path in (*(ROOT / "src").glob("*/*/nodes/*.py"),):
        for call in ast.walk(ast.parse(path.read_text())):
            name = getattr(getattr(call, "func", None), "attr", "")
            if name not in ("make_publisher", "make_subscription"):
                continue
            topic = call.args[1]
            if isinstance(topic, ast.Constant):
                assert f"| `{topic.value}` |" in text, topic.value
                profile_given = len(call.args) > (2 if name == "make_publisher" else 3)
                overridable = any(k.arg == "qos_overriding_options" for k in call.keywords)
                assert overridable or not profile_given, topic.value


def _tool(name):
    spec = importlib.util.spec_from_file_location(name, ROOT / "tools" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_one_version_is_written_everywhere():
    check = _tool("release_check")
    assert len(check.versions()) >= 13
    assert not check.disagreements()


def test_every_python_file_begins_with_its_licence():
    tool = _tool("licences")
    assert len(tool.files()) > 300
    wrong = [p for p in tool.files() if tool.lacks(p.read_text(encoding="utf-8"))]
    assert not wrong, "run tools/licences.py"
    assert tool.lacks('"""Text."""\n') and not tool.lacks(tool.headed('"""Text."""\n'))
    shell = tool.headed('#!/usr/bin/env python3\n"""Text."""\n')
    assert shell.startswith("#!") and not tool.lacks(shell)


def test_every_package_that_is_installed_has_a_hash():
    tool = _tool("bootstrap")
    for name in ("python.txt", "low-watermark.txt", "dev.txt", "ros-wheels.txt"):
        path = str(ROOT / "requirements" / name)
        lines = [line for pinned in tool.pins(path).values() for line in pinned]
        locked = tool.locked(lines, [tool.lock_of(path)])  # it raises where a hash is missing
        assert len(locked) == len(lines) > 10
        assert all(re.search(r" --hash=sha256:[0-9a-f]{64}( |$)", line) for line in locked), name
        # Nothing is left of versions that are no longer asked for.
        asked = {re.match(r"([\w.-]+?)(\[.*\])?==([^\s;]+)", line).group(1, 3) for line in lines}
        asked = {(tool.normal(package), version) for package, version in asked}
        assert set(tool.hashes(tool.lock_of(path))) == asked, f"{name}: run `make lock`"


def test_a_package_without_a_hash_is_not_installed(tmp_path):
    tool = _tool("bootstrap")
    lock = tmp_path / "lock.txt"
    lock.write_text("a-b==1.0 \\\n    --hash=sha256:12 \\\n    --hash=sha256:34\n")
    asked = 'A_b[x]==1.0; python_version < "3.11"'
    assert tool.locked([asked], [str(lock)]) == [f"{asked} --hash=sha256:12 --hash=sha256:34"]
    with pytest.raises(tool.SetupError, match=r"no hash of a-b 1\.1: run `make lock`"):
        tool.locked(["a-b==1.1"], [str(lock)])
