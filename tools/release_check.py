#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""What must hold before a release: ``make release-check``.

- one version: every package.xml and setup.py, CITATION.cff, and the newest section of every changelog;
- style, licence headers and links;
- the packages without ROS install into a new environment, and all their modules but the nodes import, on every
  Python at hand that they are for (PATH and pyenv).

The documents (`make docs`) and the tests (`make test`) are Make's business. Standard library alone.
"""

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
WITHOUT_ROS = ("flexarm_dynamics", "flexarm_control", "flexarm_sim", "flexarm_studies")
OLDEST = (3, 10)
IMPORT_ALL = """
import importlib, pkgutil, sys
for top in sys.argv[1:]:
    package = importlib.import_module(top)
    for found in pkgutil.walk_packages(package.__path__, top + "."):
        if ".nodes" not in found.name:
            importlib.import_module(found.name)
from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.models import model
from flexarm_control.composite.design import design
arm = model.build(arm_file.load(sys.path[0] + "/R.yaml"))
design(arm, {"type": "linear_model_following"}, {"type": "lqr"})
"""


def versions():
    """Every version that is written down, by where."""
    found = {}
    for file, pattern in (
        ("package.xml", r"<version>(.+?)</version>"),
        ("setup.py", r'version="(.+?)"'),
    ):
        for path in sorted(ROOT.glob(f"src/*/{file}")):
            found[path] = re.search(pattern, path.read_text(encoding="utf-8"))
    for path in sorted([ROOT / "CHANGELOG.rst", *ROOT.glob("src/*/CHANGELOG.rst")]):
        text = path.read_text(encoding="utf-8")
        if not re.search(r"^Forthcoming\n-+$", text, re.M):  # what is yet to be given a number
            found[path] = re.search(r"^(\d+\.\d+\.\d+)\b", text, re.M)
    path = ROOT / "CITATION.cff"
    found[path] = re.search(r"^version: (\S+)", path.read_text(encoding="utf-8"), re.M)
    return {str(p.relative_to(ROOT)): m.group(1) if m else None for p, m in found.items()}


def disagreements():
    """Where another version stands than in most places."""
    found = versions()
    most = max(set(found.values()), key=list(found.values()).count)
    return [
        f"{where}: version {v or 'missing'}, elsewhere {most}"
        for where, v in found.items()
        if v != most
    ]


def pythons():
    """Interpreters at hand, one for each version."""
    names = [shutil.which(f"python3.{minor}") for minor in range(OLDEST[1], 20)]
    names += sorted(
        Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")).glob("versions/3.*/bin/python3")
    )
    found = {}
    for name in names:
        if name is None:
            continue
        asked = subprocess.run(
            [str(name), "-c", "import sys, venv, ensurepip; print(*sys.version_info[:2])"],
            capture_output=True, text=True, check=False,
        )  # fmt: skip
        if asked.returncode == 0 and tuple(map(int, asked.stdout.split())) >= OLDEST:
            found.setdefault(tuple(map(int, asked.stdout.split())), str(name))
    return [found[version] for version in sorted(found)]


def install(python):
    """Install and import the packages without ROS with one interpreter; what went wrong, or nothing."""
    with tempfile.TemporaryDirectory() as folder:
        folder = Path(folder)
        shutil.copy(ROOT / "config" / "arms" / "R.yaml", folder)
        (folder / "all.py").write_text(IMPORT_ALL, encoding="utf-8")
        inside = str(folder / "env" / "bin" / "python")
        quiet = ["-m", "pip", "install", "-q", "--disable-pip-version-check"]
        packages = []
        for name in WITHOUT_ROS:  # copies: a build writes beside the sources
            packages.append(str(shutil.copytree(ROOT / "src" / name, folder / name)))
        for command in (
            [python, "-m", "venv", str(folder / "env")],
            [inside, *quiet, "setuptools==79.0.1", "wheel"],
            [inside, *quiet, "-r", str(ROOT / "requirements" / "python.txt")],
            [inside, *quiet, "--no-build-isolation", "--no-deps", *packages],
            [inside, str(folder / "all.py"), *WITHOUT_ROS],
        ):
            done = subprocess.run(
                command, capture_output=True, text=True, cwd=folder, env=_clean(), check=False
            )
            if done.returncode:
                return f"{' '.join(command[:4])}…\n{done.stderr.strip()}"
    return ""


def _clean():
    """The environment without what leads to other installations."""
    away = ("PYTHONPATH", "VIRTUAL_ENV", "AMENT_PREFIX_PATH", "PYTHONHOME", "LD_LIBRARY_PATH")
    return {k: v for k, v in os.environ.items() if k not in away}


def main():
    """Check; the exit code is 1 when something does not hold."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--no-install", action="store_true", help="leave the new environments out")
    options = parser.parse_args()
    wrong = disagreements()
    for command in (
        ["ruff", "check", "-q"],
        ["ruff", "format", "-q", "--check"],
        [sys.executable, "tools/licences.py", "--check"],
        [sys.executable, "docs/links.py"],
    ):
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
        if done.returncode:
            wrong.append(f"{' '.join(command)}\n{done.stdout}{done.stderr}".strip())
    for python in () if options.no_install else pythons():
        error = install(python)
        print(f"{python}: {'not installed' if error else 'installs, imports, designs'}", flush=True)
        wrong += [f"{python}: {error}"] if error else []
    for text in wrong:
        print(text)
    print("ready for a release" if not wrong else f"{len(wrong)} things to fix first")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
