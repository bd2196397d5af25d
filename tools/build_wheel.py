#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Build one wheel, ``flexarm``, of everything that needs no ROS: ``make wheel``.

With ROS the workspace is built by colcon, from the packages' own setup.py. This wheel holds the same modules, so
nothing is written twice: names, versions and entry points are read from the setup.py files, what it depends on from
``requirements/``. A module is left out if it imports ROS when it is imported, itself or through another module. Shipped
arms, controllers and mappings of recordings go with it.
"""

import argparse
import ast
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
#: All packages of the workspace whose modules may need no ROS.
PACKAGES = (
    "flexarm_dynamics", "flexarm_control", "flexarm_sim", "flexarm_studies", "flexarm_ros", "flexarm_tools",
    "flexarm_bringup",
)  # fmt: skip
#: Top names of what only a ROS installation or the workspace has.
ROS = re.compile(r"(rclpy|rcl_interfaces|.*_msgs|builtin_interfaces|launch.*|ament_.*|rosidl.*)$")
#: Files that go with the wheel, and where they are looked for (`flexarm_dynamics.arm.arm_file.arms_directories`).
CONFIG, CONFIG_TO = ("arms", "controllers", "recordings"), "flexarm_dynamics/config"
#: Definitions of the messages, which bags are read by (`flexarm_tools.recording.types`).
MESSAGES, MESSAGES_TO = "src/flexarm_msgs/msg", "flexarm_tools/recording/msg"
#: Needed by the nodes or the page of ``flexarm view`` alone.
NOT_NEEDED = ("viser", "foxglove-sdk")
PROJECT = """\
[build-system]
requires = ["setuptools>=70.1"]
build-backend = "setuptools.build_meta"

[project]
name = "flexarm"
version = "{version}"
description = "Models, simulates, observes and controls robot arms whose links bend (Siciliano & Book 1986)."
readme = "README.md"
license = {{text = "Apache-2.0"}}
requires-python = ">=3.10"
dependencies = [{dependencies}]

[project.optional-dependencies]
cluster = [{cluster}]
gym = ["gymnasium>=1.1"]

[project.scripts]
flexarm = "flexarm_bringup.cli:main"
{entry_points}
[tool.setuptools]
packages = [{packages}]
include-package-data = false

[tool.setuptools.package-data]
flexarm_dynamics = ["config/*/*.yaml"]
flexarm_tools = ["recording/msg/*.msg"]
"""


def modules(source=ROOT / "src"):
    """Every module of the packages: path of its file, by name."""
    found = {}
    for package in PACKAGES:
        for path in sorted((source / package / package).rglob("*.py")):
            parts = path.relative_to(source / package).with_suffix("").parts
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def imported(name, path):
    """Names of the modules that a module imports when it is imported; those inside functions are not."""
    package = name if path.name == "__init__.py" else name.rpartition(".")[0]
    waiting, names = list(ast.parse(path.read_text(encoding="utf-8")).body), set()
    while waiting:
        node = waiting.pop()
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                above = package.split(".")[: len(package.split(".")) - node.level + 1]
                base = ".".join([*above, base] if base else above)
            names.add(base)
            names.update(f"{base}.{alias.name}" for alias in node.names)
        elif not isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda)):
            waiting.extend(ast.iter_child_nodes(node))
    return names


def without_ros(found):
    """The modules that can be imported without ROS: those that import none, and none of those that do."""
    needs = {name: imported(name, path) for name, path in found.items()}
    kept = {n for n in found if not any(ROS.match(i.split(".")[0]) for i in needs[n])}
    kept -= {n for n in kept if "nodes" in n.split(".")}  # they start a node, whatever they import
    while True:
        lost = {n for n in kept if any(i in found and i not in kept for i in needs[n])}
        lost |= {n for n in kept if "." in n and n.rpartition(".")[0] not in kept}
        if not lost:
            return {name: found[name] for name in sorted(kept)}
        kept -= lost


def setup_arguments(package):
    """What a package's setup.py gives to `setup`, as far as it is written there as plain values."""
    tree = ast.parse((ROOT / "src" / package / "setup.py").read_text(encoding="utf-8"))
    call = next(n for n in ast.walk(tree) if isinstance(n, ast.Call) and n.func.id == "setup")
    plain = {}
    for keyword in call.keywords:
        if keyword.arg in ("version", "entry_points"):
            plain[keyword.arg] = ast.literal_eval(keyword.value)
    return plain


def entry_points(kept):
    """Sections of components by name, of modules that the wheel has; the nodes' executables are not among them."""
    groups = {}
    for package in PACKAGES:
        for group, lines in setup_arguments(package).get("entry_points", {}).items():
            if group == "console_scripts":
                continue
            for line in lines:
                name, target = (text.strip() for text in line.split("="))
                if target.partition(":")[0] in kept:
                    groups.setdefault(group, []).append(f'{name} = "{target}"')
    return "\n".join(
        "\n".join([f'[project.entry-points."{group}"]', *lines, ""])
        for group, lines in groups.items()
    )


def requirements(name):
    """Name and version of each pin in the first block of a requirements file: what flexarm itself imports."""
    text = (ROOT / "requirements" / name).read_text(encoding="utf-8").split("\n\n")[0]
    return re.findall(r"^([\w.-]+)==([\w.]+)", text, re.M)


def project(kept):
    """Text of the wheel's pyproject.toml."""
    oldest = dict(requirements("low-watermark.txt"))
    packages = sorted({n for n, path in kept.items() if path.name == "__init__.py"})
    return PROJECT.format(
        version=setup_arguments("flexarm_dynamics")["version"],
        dependencies=", ".join(f'"{n}>={v}"' for n, v in oldest.items() if n not in NOT_NEEDED),
        cluster=", ".join(f'"{n}>={v}"' for n, v in requirements("cluster.txt")),
        entry_points=entry_points(kept),
        packages=", ".join(f'"{name}"' for name in packages),
    )


def stage(folder):
    """Write what the wheel is built from into a folder; the modules' names."""
    kept = without_ros(modules())
    for name, path in kept.items():
        to = folder / Path(*name.split("."))
        to = to / "__init__.py" if path.name == "__init__.py" else to.with_suffix(".py")
        to.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(path, to)
    for part in CONFIG:
        to = folder / CONFIG_TO / part
        to.mkdir(parents=True)
        for path in sorted((ROOT / "config" / part).glob("*.yaml")):
            shutil.copy(path, to)
    (folder / MESSAGES_TO).mkdir()
    for path in sorted((ROOT / MESSAGES).glob("*.msg")):
        shutil.copy(path, folder / MESSAGES_TO)
    for name in ("README.md", "LICENSE"):
        shutil.copy(ROOT / name, folder)
    (folder / "pyproject.toml").write_text(project(kept), encoding="utf-8")
    return list(kept)


def build(out):
    """Build the wheel into a folder; its path."""
    out.mkdir(parents=True, exist_ok=True)
    for old in out.glob("flexarm-*.whl"):
        old.unlink()
    with tempfile.TemporaryDirectory() as folder:
        stage(Path(folder))
        quiet = ["-q", "--disable-pip-version-check", "--no-deps", "--no-build-isolation"]
        command = [sys.executable, "-m", "pip", "wheel", *quiet, "-w", str(out), folder]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"the wheel can't be built:\n{done.stdout}{done.stderr}")
    return next(out.glob("flexarm-*.whl"))


def main():
    """Build, and print where the wheel is."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    add = parser.add_argument
    add("--out", type=Path, default=ROOT / "results" / "wheel", help="folder (results/wheel)")
    add("--list", action="store_true", help="list its modules instead")
    options = parser.parse_args()
    print("\n".join(without_ros(modules())) if options.list else build(options.out.resolve()))


if __name__ == "__main__":
    main()
