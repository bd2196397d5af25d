# SPDX-License-Identifier: Apache-2.0
"""ROS parameter files read without ROS: which section is whose, what is refused."""

import pytest

from flexarm_control.composite import assembly
from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.errors import ParameterError
from flexarm_dynamics.models import model
from flexarm_studies.loop import parameter_files

R = {"arm": "R"}
BOTH = (
    "{0}: {{ros__parameters: {{arm: first, rate: 1.0}}}}\n{1}: {{ros__parameters: {{arm: last}}}}"
)
LAST = {"arm": "last", "rate": 1.0}
NESTED = {"slow.gain": "m11", "slow.a.b": 1}
NAMES = ("controller", "/controller", "/left/controller", "/**/controller")


@pytest.mark.parametrize(
    ("text", "controller", "observer"),
    [
        (
            "/**: {ros__parameters: {arm: R, slow: {kp: [6.25]}}}",
            R | {"slow.kp": [6.25]},
            R | {"slow.kp": [6.25]},
        ),
        *((f"{name}: {{ros__parameters: {{arm: R}}}}", R, {}) for name in NAMES),
        (BOTH.format("/**", "controller"), LAST, {"arm": "first", "rate": 1.0}),
        (BOTH.format("controller", "/**"), LAST, {"arm": "last"}),
        ("camera: {ros__parameters: {arm: R}}", {}, {}),
        ("/**: {ros__parameters: {slow: {gain: m11, a: {b: 1}}}}", NESTED, NESTED),
        ("/**: {ros__parameters: {slow.gain: m11, slow.a.b: 1}}", NESTED, NESTED),
        ("# nothing", {}, {}),
    ],
)
def test_a_node_gets_the_sections_with_its_name_and_with_wildcards_the_later_one_wins(
    tmp_path, text, controller, observer
):
    path = tmp_path / "some.yaml"
    path.write_text(text)
    found = parameter_files.load(path)
    assert found == {"controller": controller, "observer": observer, "simulator": observer}


def test_under_takes_a_prefix_and_no_namesake():
    values = {"slow.kp": [1.0], "slow.a.b": 2, "slower.kp": 3, "slow": 4, "fast.r": 5}
    assert assembly.under(values, "slow") == {"kp": [1.0], "a.b": 2}


NONE_OF_PARAMETERS = (
    "- a list", "just text", "controller: {arm: R}", "controller: {ros__parameters: [1, 2]}",
    "controller: {ros__parameters: }", "controller:", "controller: {ros__parameters: {slow: {1: 2}}}",
)  # fmt: skip
MALFORMED = ("a: [1, 2", "a: b: c", "\tx: 1", "a: !!python/object:x {}", b"\xff\xfe\x00\xd8")


@pytest.mark.parametrize("content", (*NONE_OF_PARAMETERS, *MALFORMED))
def test_what_is_no_parameter_file_is_refused_naming_it(tmp_path, content):
    path = tmp_path / "some.yaml"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(ParameterError) as refused:
        parameter_files.load(path)
    problem = "can't be read" if content in MALFORMED else "not a ROS parameter file"
    assert refused.value.field == str(path) and refused.value.problem.startswith(problem)


@pytest.mark.parametrize("name", ["paper_composit", "/nowhere/x.yaml", "", "."])
def test_a_name_that_is_neither_file_nor_shipped_lists_the_shipped_ones(name):
    with pytest.raises(
        ParameterError, match=r"neither a file nor shipped.*paper_composite, .*paper_slow"
    ):
        parameter_files.load(name)


@pytest.mark.parametrize("name", ["paper_composite", "paper_slow"])
def test_a_shipped_file_designs_a_controller_for_every_shipped_arm(name):
    values = parameter_files.load(name)["controller"]
    for arm in ("R", "P3", "one_link"):
        law = assembly.control(model.build(arm_file.load(arm)), values)
        assert type(law.fast).__name__ == ("Lqr" if name == "paper_composite" else "NoFastLaw")
    assert parameter_files.load(parameter_files.find(name)) == parameter_files.load(name)
