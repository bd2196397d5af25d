# SPDX-License-Identifier: Apache-2.0
"""Puts one error at a time into a copy of the sources, and runs the tests that must fail: `make mutants`.

Each mutation is one replacement in one file. It is caught when a named test fails; a test run that cannot start, or
ends otherwise, is an error. The named tests must pass in a copy without mutations; they are run there first.
``-k TEXT`` chooses those whose name or file has the text in it.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from . import MUTANTS

ROOT = Path(__file__).resolve().parents[2]
#: What a copy needs: sources and what their tests read.
COPIED = ("src", "tests", "config", "pyproject.toml", "conftest.py")
LEFT_OUT = shutil.ignore_patterns("__pycache__", "*.egg-info", ".pytest_cache", ".hypothesis")
#: Of one mutation [s].
TIMEOUT = 1800.0


def places(mutant, root=ROOT):
    """How often the old text occurs."""
    return (root / "src" / mutant.file).read_text(encoding="utf-8").count(mutant.old)


def run(mutant, mutated=True):
    """Run the tests of one mutant in a copy: ``caught``, ``SURVIVED``, or what went wrong."""
    if places(mutant) != 1:
        return f"ERROR: its text occurs {places(mutant)} times"
    with tempfile.TemporaryDirectory(prefix="flexarm-mutant-") as folder:
        copy = Path(folder, "copy")
        for name in COPIED:
            source = ROOT / name
            if source.is_dir():
                shutil.copytree(source, copy / name, ignore=LEFT_OUT)
            else:
                shutil.copy(source, copy / name)
        file = copy / "src" / mutant.file
        text = file.read_text(encoding="utf-8")
        if mutated:
            file.write_text(text.replace(mutant.old, mutant.new), encoding="utf-8")
        try:
            done = run_tests(mutant, copy, Path(folder, "cache") if mutated else None)
        except subprocess.TimeoutExpired:
            return f"ERROR: no end after {TIMEOUT:g} s"
    if done.returncode in (0, 1):
        return "caught" if done.returncode else "SURVIVED"
    tail = "\n".join((done.stdout + done.stderr).splitlines()[-10:])
    return f"ERROR: pytest ended with {done.returncode}\n{tail}"


def run_tests(mutant, copy, cache):
    """Run the tests of a mutant on a copy of the sources; `cache` is for what its kernels are compiled to."""
    packages = [str(path.parent) for path in (copy / "src").glob("*/setup.py")]
    environment = dict(os.environ, OPENBLAS_NUM_THREADS="1")
    environment["PYTHONPATH"] = os.pathsep.join([*packages, os.environ["PYTHONPATH"]])
    if cache is not None and "/kernels/" in mutant.file:  # compiled anew, and never run again
        environment |= {"FLEXARM_CACHE": str(cache), "NUMBA_OPT": "1"}
    words = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider"]
    words += ["--hypothesis-profile=first_failure"]
    words += [f"src/{w}" if w.startswith("flexarm_") else w for w in mutant.tests.split()]
    return subprocess.run(
        words, cwd=copy, env=environment, capture_output=True, text=True, timeout=TIMEOUT
    )


def main():
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-k", default="", help="only mutants with this text in name or file")
    parser.add_argument("--processes", type=int, default=2)
    options = parser.parse_args()
    chosen = [m for m in MUTANTS if options.k in f"{m.file} {m.name}"]
    with ThreadPoolExecutor(options.processes) as executor:
        sound = {m.tests: m for m in chosen}  # one of each set of tests
        for mutant, result in zip(
            sound.values(),
            executor.map(lambda m: run(m, mutated=False), sound.values()),
            strict=True,
        ):
            if result != "SURVIVED":
                print(f"these tests fail without a mutation: {mutant.tests}\n{result}")
                return 1
        results = list(executor.map(lambda m: (m, report(m, run(m))), chosen))
    caught = sum(result == "caught" for _, result in results)
    print(f"{caught} of {len(results)} mutants are caught")
    return 0 if results and caught == len(results) else 1


def report(mutant, result):
    """Print one result as it comes."""
    print(f"{result.splitlines()[0]:8}  {mutant.file}: {mutant.name}", flush=True)
    for line in result.splitlines()[1:]:
        print(f"          {line}")
    return result


if __name__ == "__main__":
    sys.exit(main())
