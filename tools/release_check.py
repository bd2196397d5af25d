#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""What must hold before a release: ``make release-check``.

- one version: every package.xml and setup.py, CITATION.cff, and the newest section of every changelog;
- style, licence headers and links;
- the wheel of what needs no ROS installs into a new environment with all that it depends on, its modules import, and
  it designs a control, on every Python at hand that it is for (PATH and pyenv).

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
OLDEST = (3, 10)
IMPORT_ALL = """
import importlib, sys
for name in sys.argv[1:]:
    importlib.import_module(name)
from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.models import model
from flexarm_control.composite.design import design
arm = model.build(arm_file.load("R"))
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


def install(python, built, modules):
    """Install the wheel with one interpreter and import what is in it; what went wrong, or nothing."""
    with tempfile.TemporaryDirectory() as folder:
        folder = Path(folder)
        (folder / "all.py").write_text(IMPORT_ALL, encoding="utf-8")
        inside = str(folder / "env" / "bin" / "python")
        for command in (
            [python, "-m", "venv", str(folder / "env")],
            [inside, "-m", "pip", "install", "-q", "--disable-pip-version-check", str(built)],
            [inside, str(folder / "all.py"), *modules],
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
    if not options.no_install:
        import build_wheel  # beside this file

        modules = build_wheel.without_ros(build_wheel.modules())
        with tempfile.TemporaryDirectory() as folder:
            built = build_wheel.build(Path(folder))
            for python in pythons():
                error = install(python, built, modules)
                end = "not installed" if error else "installs, imports, designs"
                print(f"{python}: {end}", flush=True)
                wrong += [f"{python}: {error}"] if error else []
    for text in wrong:
        print(text)
    print("ready for a release" if not wrong else f"{len(wrong)} things to fix first")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
