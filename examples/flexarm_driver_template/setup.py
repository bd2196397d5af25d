# SPDX-License-Identifier: Apache-2.0
from glob import glob

from setuptools import find_packages, setup

name = "flexarm_driver_template"

setup(
    name=name,
    version="0.1.0",
    description="A driver to start from: an arm behind a serial line, and a fake one to try it with.",
    license="Apache-2.0",
    maintainer="flexarm maintainers",
    maintainer_email="maintainers@flexarm.invalid",
    packages=find_packages(),
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{name}"]),
        (f"share/{name}", ["package.xml"]),
        (f"share/{name}/config", sorted(glob("config/*.yaml"))),
    ],
    zip_safe=False,
    entry_points={
        "console_scripts": [
            "driver = flexarm_driver_template.driver:main",
            "fake_device = flexarm_driver_template.fake_device:main",
        ],
    },
)
