# SPDX-License-Identifier: Apache-2.0
from setuptools import find_packages, setup

name = "flexarm_dynamics"

setup(
    name=name,
    version="0.1.0",
    description="Beams, assumed modes and equations of motion of arms with flexible links.",
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
        "flexarm.models": [
            "chain = flexarm_dynamics.models.chain:Chain",
            "one_link = flexarm_dynamics.models.one_link:OneLink",
            "paper_appendix = flexarm_dynamics.models.paper_appendix:PaperAppendix",
        ],
    },
)
