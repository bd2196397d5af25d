# SPDX-License-Identifier: Apache-2.0
from setuptools import find_packages, setup

name = "flexarm_sim"

setup(
    name=name,
    version="0.1.0",
    description="Simulator of arms with flexible links: integrators, plant, sensor models.",
    license="Apache-2.0",
    maintainer="flexarm maintainers",
    maintainer_email="maintainers@flexarm.invalid",
    packages=find_packages(exclude=["test", "test.*"]),
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{name}"]),
        (f"share/{name}", ["package.xml"]),
    ],
    zip_safe=False,
    entry_points={
        "console_scripts": [
            "simulator = flexarm_sim.nodes:start_simulator",
            "hardware = flexarm_sim.nodes:start_hardware",
        ],
    },
)
