# SPDX-License-Identifier: Apache-2.0
"""From parameters to components: what is chosen, what is left out, what is refused; and where designs are made."""

from concurrent.futures import CancelledError

import numpy as np
import pytest

from flexarm_control.composite import assembly
from flexarm_control.composite.design_process import AwayError
from flexarm_control.composite.designer import Designer
from flexarm_dynamics.errors import ParameterError

NESTED = {
    "slow": {"type": "model_following", "kp": [4.0], "gain": "m11"},
    "fast": {"type": "none", "alpha": 5.0},
    "feedforward": "none",
    "torque_limit": [2.0],
}


def test_flat_and_nested_parameters_are_the_same():
    values = assembly.flat(NESTED)
    assert values["slow.kp"] == [4.0] and values["feedforward"] == "none"
    assert assembly.flat(values) == values
    mixed = {"slow.type": "model_following", "slow": {"kp": [4.0]}}
    assert assembly.flat(mixed) == {"slow.type": "model_following", "slow.kp": [4.0]}


def test_parameters_of_components_that_are_not_chosen_are_left_out():
    made = assembly.choices(assembly.flat(NESTED))
    assert made["slow"] == {"type": "model_following", "kp": [4.0]}  # gain: linear_model_following
    assert made["fast"] == {"type": "none"}
    assert made["manifold"] == {"type": "corrected"}  # as in the nodes
    assert made["settings"] == {"feedforward": "none"}


def test_what_no_component_knows_is_refused(arm_r):
    with pytest.raises(ParameterError) as refused:
        assembly.control(arm_r, {"slow.kpp": [4.0]})
    assert refused.value.field == "slow.kpp"
    with pytest.raises(ParameterError) as refused:
        assembly.type_of("fast", {"fast.type": 3})
    assert (refused.value.field, refused.value.value) == ("fast.type", 3)


@pytest.mark.parametrize("name", assembly.COMPONENTS)
def test_a_node_declares_the_choice_and_the_parameters_of_every_component(name):
    declared = {p.name: p for p in assembly.declarations(name)}
    assert assembly.type_of(name, {}) in declared["type"].choices
    for kind in declared["type"].choices:
        assert {p.name for p in assembly.declared(name, {f"{name}.type": kind})} <= set(declared)


class Away:
    """A design process that is gone."""

    closed = False

    def call(self, function, *arguments, waits=None):
        raise AwayError("it has died")

    def close(self):
        self.closed = True


@pytest.fixture
def designer(arm_r):
    """A designer without process, and its warnings."""
    warnings = []
    made = Designer(arm_r, warnings.append, process=False)
    return made, warnings


def test_a_design_in_the_calling_thread_has_a_model_of_its_own(arm_r, designer):
    made, warnings = designer
    law = made.design({"slow.kp": [4.0], "feedforward": "none"})
    np.testing.assert_array_equal(law.slow.kp, [4.0])
    assert law.model is not arm_r and not warnings


def test_without_its_process_the_designer_warns_and_designs_itself(designer):
    made, warnings = designer
    made._process = Away()
    made.warm_up()
    assert made.design({"fast.type": "none", "feedforward": "none"}).feedforward is None
    assert len(warnings) == 2 and "in a thread of the controller" in warnings[1]


def test_a_designer_that_is_closed_neither_designs_nor_warns(designer):
    made, warnings = designer
    process = made._process = Away()
    made.close()
    with pytest.raises(CancelledError):
        made.design({})
    assert process.closed and not warnings
