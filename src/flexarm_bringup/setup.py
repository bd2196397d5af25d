# SPDX-License-Identifier: Apache-2.0
from glob import glob

from setuptools import find_packages, setup

name = "flexarm_bringup"

setup(
    name=name,
    version="0.1.0",
    description="Launch files, arm and controller files and the command line of flexarm.",
    license="Apache-2.0",
    maintainer="flexarm maintainers",
    maintainer_email="maintainers@flexarm.invalid",
    packages=find_packages(exclude=["test", "test.*"]),
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{name}"]),
        (f"share/{name}", ["package.xml"]),
        (f"share/{name}/launch", sorted(glob("launch/*.py") + glob("launch/*.yaml"))),
        (f"share/{name}/layouts", sorted(glob("layouts/*"))),
        # `config` here is a link to the project's own: setuptools takes no file from above the package.
        (
            f"share/{name}/config/arms",
            sorted(glob("config/arms/*.yaml") + glob("config/arms/*.npz")),
        ),
        (f"share/{name}/config/controllers", sorted(glob("config/controllers/*.yaml"))),
        (f"share/{name}/config/recordings", sorted(glob("config/recordings/*.yaml"))),
    ],
    zip_safe=False,
    entry_points={
        "console_scripts": [
            "flexarm = flexarm_bringup.cli:entry",
            "publish_trajectory = flexarm_tools.publish_trajectory:entry",
            "shape = flexarm_tools.shape:start_shape",
            "replay = flexarm_tools.replay:start_replay",
            "ros2_control_adapter = flexarm_tools.adapters:start_ros2_control_adapter",
        ],
    },
)
