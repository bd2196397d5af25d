# SPDX-License-Identifier: Apache-2.0
"""Components found by name through entry points."""

from importlib.metadata import EntryPoint

import pytest

from flexarm_dynamics import registry
from flexarm_dynamics.errors import UnknownComponentError
from flexarm_dynamics.models.one_link import OneLink
from flexarm_dynamics.models.paper_appendix import PaperAppendix


@pytest.fixture
def provided(monkeypatch):
    """Sets what the installed packages provide."""

    def provide(*entries):
        points = [EntryPoint(name, value, "flexarm.things") for name, value in entries]
        monkeypatch.setattr(
            registry, "entry_points", lambda group: [e for e in points if e.group == group]
        )
        registry.names.cache_clear()
        registry.find.cache_clear()

    yield provide
    registry.names.cache_clear()
    registry.find.cache_clear()


def test_models_of_this_package_are_found():
    assert registry.find("flexarm.models", "one_link") is OneLink
    assert registry.find("flexarm.models", "paper_appendix") is PaperAppendix
    assert {"one_link", "paper_appendix"} <= set(registry.names("flexarm.models"))


def test_a_users_component_is_found_beside_those_of_this_project(provided):
    provided(
        ("mine", "fractions:Fraction"), ("also", "decimal:Decimal"), ("mine", "decimal:Decimal")
    )
    assert list(registry.names("flexarm.things")) == ["also", "mine"]
    assert registry.find("flexarm.things", "mine").__name__ == "Fraction"


def test_names_are_sorted(provided):
    wanted = [f"law{i}" for i in range(9)]
    provided(*((name, "fractions:Fraction") for name in reversed(wanted)))
    assert list(registry.names("flexarm.things")) == wanted


def test_an_unknown_name_lists_what_there_is_and_guesses(provided):
    provided(("composite", "fractions:Fraction"), ("rigid", "fractions:Fraction"))
    with pytest.raises(UnknownComponentError) as error:
        registry.find("flexarm.things", "compsite")
    assert str(error.value) == (
        "flexarm.things: 'compsite' is provided by no installed package (there are: composite, rigid);"
        " did you mean 'composite'?"
    )


def test_a_workspace_that_is_not_built_is_suspected_when_there_is_nothing(provided):
    provided()
    with pytest.raises(UnknownComponentError, match="none; is the workspace built and sourced"):
        registry.find("flexarm.things", "anything")


@pytest.mark.parametrize(
    "value, words",
    [
        ("no_such_module_at_all:Law", "ModuleNotFoundError: No module named"),
        ("fractions:NoSuchClass", "AttributeError: "),
    ],
)
def test_a_component_that_cannot_be_imported_says_why(provided, value, words):
    provided(("broken", value))
    with pytest.raises(UnknownComponentError) as error:
        registry.find("flexarm.things", "broken")
    assert str(error.value).startswith(f"flexarm.things: 'broken' ({value}) can't be imported: ")
    assert words in str(error.value)
