# SPDX-License-Identifier: Apache-2.0
"""How tests are spread over processes, which of them get a second try, and which long ones run."""

import os
import re
import zlib
from pathlib import Path

import pytest
from hypothesis import Phase, settings

# For `make mutants`: one example that fails is enough. To make it smaller takes minutes.
settings.register_profile("first_failure", phases=[Phase.explicit, Phase.generate])


def pytest_addoption(parser):
    """`--long`, as `make test` gives it."""
    parser.addoption(
        "--long",
        default="all",
        metavar="all|none|K/N",
        help="which of the tests marked long run: all, none, or the K-th of N parts",
    )


def part_of(text):
    """K and N of ``K/N``; (1, 1) for all and (0, 1) for none."""
    found = {"all": "1/1", "none": "0/1"}.get(text, text)
    numbers = re.fullmatch(r"([0-9]+)/([0-9]+)", found)
    part, parts = map(int, numbers.groups()) if numbers else (1, 0)
    if not part <= parts or (part == 0 and text != "none"):
        raise pytest.UsageError(f"--long {text}: write all, none, or a part such as 2/6")
    return part, parts


def in_part(name, part, parts):
    """Whether a name is in a part, the same on every machine; part 0 is empty."""
    return zlib.crc32(name.encode()) % parts == part - 1


@pytest.hookimpl(wrapper=True)  # before and after xdist reads the groups
def pytest_collection_modifyitems(config, items):
    """Keep the tests that share a fixture in one process and one part; let the tests in real time try again.

    With ``--dist loadgroup`` a test without a group goes wherever there is room. Those of a module that share a
    module's fixture, for instance running nodes, are one group, so that the fixture is set up once.
    """
    grouped, (part, parts), left = [], part_of(config.option.long), []
    for item in items:
        fixtures = item._fixtureinfo.name2fixturedefs.values()
        if any(found[-1].scope in ("module", "class") for found in fixtures):
            item.add_marker(pytest.mark.xdist_group(item.path.stem))
            grouped.append(item)
        if item.get_closest_marker("real_time"):
            item.add_marker(pytest.mark.flaky(reruns=2))
        name = item.path.stem if item in grouped[-1:] else item.nodeid
        if item.get_closest_marker("long") and not in_part(name, part, parts):
            left.append(item)
    if left:
        config.hook.pytest_deselected(items=left)
        left = set(left)
        items[:] = [item for item in items if item not in left]
        grouped = [item for item in grouped if item not in left]
    result = yield
    if getattr(config.option, "loadgroup", False) and not all("@" in i.nodeid for i in grouped):
        raise pytest.UsageError(
            "this pytest-xdist ignores groups under this pytest: see requirements"
        )
    return result


@pytest.fixture
def flexarm(capsys):
    """Runs a command in this process: exit code, standard output, standard error."""
    from flexarm_bringup import cli

    def run(*words):
        with pytest.raises(SystemExit) as stop:
            cli.main([str(word) for word in words])
        return stop.value.code, *capsys.readouterr()

    return run


@pytest.fixture(scope="session")
def domain():
    """A ROS_DOMAIN_ID of this test process alone.

    FastDDS 2.14 can wait for ever in `destroy_node` if another process of the domain starts or ends just then.
    """
    from flexarm_tools.running.processes import own_domain

    with own_domain() as number:
        yield number


@pytest.fixture(scope="session")
def real_arm():
    """Folder of the measured data of a real arm, which are not part of this project; the test is skipped without."""
    folder = Path(
        os.environ.get("FLEXARM_REAL_ARM") or Path(__file__).parents[1] / "shared" / "real_arm"
    )
    if not (folder / "exp1.csv").is_file():
        pytest.skip(f"no measured data in {folder}: set FLEXARM_REAL_ARM to their folder")
    return folder
