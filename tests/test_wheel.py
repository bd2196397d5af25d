# SPDX-License-Identifier: Apache-2.0
"""The wheel of what needs no ROS: what is in it, and that it works where nothing else of flexarm is."""

import importlib.util
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
_spec = importlib.util.spec_from_file_location("build_wheel", ROOT / "tools" / "build_wheel.py")
wheel_tool = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(wheel_tool)

#: In place of ROS, which the tests' environment has: nothing of it can be imported.
NO_ROS = """
import re, sys
class NoRos:
    def find_spec(self, name, path=None, target=None):
        if re.match(r"(rclpy|rcl_interfaces|builtin_interfaces|\\w+_msgs)(\\.|$)", name):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
sys.meta_path.insert(0, NoRos())
"""
#: The five lines of docs/python.md.
FIVE_LINES = """
import matplotlib; matplotlib.use("Agg"); import matplotlib.pyplot as plt
from flexarm_studies.loop.arm import SimulatedArm

with SimulatedArm("R") as arm, arm.recording() as run:
    arrival = arm.move(0.3, duration=1.0)
plt.plot(run.record.time, run.record.position)
plt.savefig("figure.png")
print(f"{arrival.seconds:.2f} s")
"""


def test_modules_with_ros_are_left_out_and_all_others_are_in():
    everything = wheel_tool.modules()
    kept = wheel_tool.without_ros(everything)
    assert {"flexarm_dynamics.models.chain", "flexarm_studies.loop.arm"} <= set(kept)
    assert {"flexarm_bringup.cli", "flexarm_tools.report.command"} <= set(kept)
    # They import ROS: at the top, and through another module.
    assert not {"flexarm_ros.messages", "flexarm_tools.shape.amplitudes"} & set(kept)
    assert not any("nodes" in name.split(".") for name in kept)
    # Packages that promise to need no ROS are whole.
    for name in everything:
        if name.startswith(("flexarm_dynamics", "flexarm_studies")):
            assert name in kept


def test_entry_points_are_those_of_the_packages():
    text = wheel_tool.project(wheel_tool.without_ros(wheel_tool.modules()))
    assert 'lqr = "flexarm_control.fast.lqr:Lqr"' in text
    assert 'chain = "flexarm_dynamics.models.chain:Chain"' in text
    assert "console_scripts" not in text and "nodes" not in text
    assert '"numpy>=' in text and "viser" not in text


def test_imports_inside_functions_do_not_count(tmp_path):
    path = tmp_path / "module.py"
    path.write_text("from . import a\nfrom .b import c\ntry:\n    import d\nfinally:\n    pass\n"
                    "def f():\n    import rclpy\n")  # fmt: skip
    found = wheel_tool.imported("pack.module", path)
    assert found == {"pack", "pack.a", "pack.b", "pack.b.c", "d"}


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """An environment with the wheel, and of the tests' own what the wheel depends on; runs its programs."""
    folder = tmp_path_factory.mktemp("wheel")
    built = wheel_tool.build(folder)
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", folder / "env"], check=True)
    site = next((folder / "env" / "lib").glob("python*/site-packages"))
    with zipfile.ZipFile(built) as archive:
        archive.extractall(site)
    # `flexarm_*` of the workspace is not there: colcon's folders are on PYTHONPATH alone.
    others = next(p for p in sys.path if p.endswith("site-packages") and sys.prefix in p)
    (site / "others.pth").write_text(f"{others}\n")
    (site / "no_ros.py").write_text(NO_ROS)
    (site / "a_no_ros.pth").write_text("import no_ros\n")
    away = ("PYTHONPATH", "AMENT_PREFIX_PATH", "FLEXARM_ROOT", "LD_LIBRARY_PATH", "VIRTUAL_ENV")
    environment = {k: v for k, v in os.environ.items() if k not in away}
    environment["_ROS_WHEELS_BOOTSTRAP_COMPLETE"] = "1"

    def run(*words):
        done = subprocess.run(
            [folder / "env" / "bin" / "python", *words],
            cwd=folder, env=environment, capture_output=True, text=True, check=False,
        )  # fmt: skip
        return done.returncode, done.stdout, done.stderr

    return folder, run


@pytest.mark.long
@pytest.mark.slow
def test_five_lines_of_python_make_a_figure(installed):
    folder, run = installed
    code, out, error = run("-c", FIVE_LINES)
    assert code == 0, error
    assert 1.0 <= float(out.split()[0]) < 3.0
    assert (folder / "figure.png").stat().st_size > 5000


@pytest.mark.slow
def test_commands_work_without_ros_or_say_that_they_need_it(installed):
    _, run = installed
    code, out, error = run("-m", "flexarm_bringup.cli", "show", "two_link")
    assert code == 0 and "joint" in out, error
    code, out, error = run("-m", "flexarm_bringup.cli", "record")
    assert code == 1 and "needs ROS 2" in error and "./flexarm record" in error
    assert "Traceback" not in error


@pytest.mark.long
@pytest.mark.slow
def test_a_bag_is_read_without_ros(installed, flexarm):
    folder, run = installed
    motion = "quintic:to=0.2,duration=0.5"
    words = ("simulate", "R", "--controller", "paper_composite", "--duration", 1)
    code, _, error = flexarm(*words, "--trajectory", motion, "--bag", folder / "bag")
    assert code == 0, error
    code, _, error = run("-m", "flexarm_bringup.cli", "report", "bag", "--out", "report.html")
    assert code == 0 and "Traceback" not in error, error
    assert "Largest tracking error" in (folder / "report.html").read_text()
