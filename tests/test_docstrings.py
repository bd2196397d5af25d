# SPDX-License-Identifier: Apache-2.0
"""Every public name is documented, and what a docstring says of its arguments is true.

Names of the packages' public modules: neither they nor what they are in begins with an underscore. The rules, as
the code has them:

1. A module, class, function or method has a docstring; a method may leave it to the class above, when that is ours.
2. A section "Parameters" names each argument, and nothing that is none.
3. A docstring of several lines names each argument somewhere, itself or its class or module, but for `EVERYWHERE`.
4. With a section "Parameters" and an error raised in so many words, there is a section "Raises" that names it.
"""

import ast
import importlib
import inspect
import re
from dataclasses import dataclass
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = (
    "flexarm_dynamics",
    "flexarm_control",
    "flexarm_sim",
    "flexarm_studies",
    "flexarm_ros",
    "flexarm_tools",
    "flexarm_bringup",
)
#: Arguments that mean the same wherever they stand; docs/theory.md has the symbols.
EVERYWHERE = {
    "q": "joint angles [rad]",
    "qd": "joint velocities [rad/s]",
    "qdd": "joint accelerations [rad/s^2]",
    "delta": "modal amplitudes [m, rad]",
    "delta_d": "modal rates [m/s, rad/s]",
    "delta_dd": "modal accelerations",
    "terms": "`Terms` of (2)",
    "model": "`ArmModel`",
    "arm": "`Arm`",
    "values": "parameters by name",
    "options": "of the command line, as argparse gives them",
    "case": "the analysed or compared loop",
    "message": "a ROS message",
    "msg": "a ROS message",
    "path": "of a file",
    "seed": "of the random numbers",
    "rate": "samples per second [Hz]",
    "duration": "[s]",
    "seconds": "[s]",
    "namespace": "of the nodes",
    "progress": "called with how far it is",
}


@dataclass
class Name:
    """A public name in a source file."""

    where: str
    full: str
    node: ast.AST
    above: tuple  # docstrings of what it is in
    owner: str = ""  # class of a method

    @property
    def doc(self):
        return ast.get_docstring(self.node) or ""


def modules():
    """Dotted names and files of all public modules."""
    for package in PACKAGES:
        top = ROOT / "src" / package / package
        for path in sorted(top.rglob("*.py")):
            parts = (package, *path.relative_to(top).with_suffix("").parts)
            parts = parts[:-1] if parts[-1] == "__init__" else parts
            if not any(part.startswith("_") for part in parts):
                yield ".".join(parts), path


def inside(node, full, path, above, owner=""):
    """Public names in a module or class."""
    for child in node.body:
        if not isinstance(child, ast.FunctionDef | ast.ClassDef) or child.name.startswith("_"):
            continue
        if any(getattr(d, "attr", "") == "setter" for d in child.decorator_list):
            continue  # the getter has the words
        where = f"{path.relative_to(ROOT)}:{child.lineno}"
        name = Name(where, f"{full}.{child.name}", child, above, owner)
        yield name
        if isinstance(child, ast.ClassDef):
            yield from inside(child, name.full, path, (*above, name.doc), name.full)


def public_names():
    """All of them."""
    for full, path in modules():
        tree = ast.parse(path.read_text("utf-8"))
        yield Name(f"{path.relative_to(ROOT)}:1", full, tree, ())
        yield from inside(tree, full, path, (ast.get_docstring(tree) or "",))


NAMES = list(public_names())


def arguments(node):
    """Names of a function's arguments, or of a class's constructor's; None where there is none."""
    if isinstance(node, ast.ClassDef):
        node = next((n for n in node.body if getattr(n, "name", "") == "__init__"), None)
    if not isinstance(node, ast.FunctionDef):
        return None
    a = node.args
    found = [*a.posonlyargs, *a.args, *a.kwonlyargs, *filter(None, (a.vararg, a.kwarg))]
    found = [x.arg for x in found]
    return [n for n in found if n not in ("self", "cls") and not n.startswith("_")]


def section(doc, title):
    """Body of a section of a docstring, or None."""
    match = re.search(rf"^{title}\n-+\n(.*?)(?=^\S[^\n]*\n-{{3,}}$|\Z)", doc, re.M | re.S)
    return match and match[1]


def listed(body):
    """Names that a section lists."""
    lines = re.findall(r"^(\*{0,2}\w[^\n:]*?)(?: : [^\n]*)?$", body, re.M)
    return [name.strip().lstrip("*") for line in lines for name in line.split(",")]


def inherited(name):
    """Docstring that a method has from a class of ours."""
    parts = name.owner.split(".")
    for k in range(len(parts), 0, -1):
        try:
            found = importlib.import_module(".".join(parts[:k]))
        except ModuleNotFoundError:
            continue
        for part in parts[k:]:
            found = getattr(found, part)
        break
    for base in found.__mro__[1:]:
        if base.__module__.split(".")[0] in PACKAGES and name.node.name in vars(base):
            member = vars(base)[name.node.name]
            doc = inspect.getdoc(getattr(member, "fget", None) or member)
            if doc:
                return doc
    return ""


def test_every_public_name_is_documented():
    bare = [n for n in NAMES if not n.doc and not (n.owner and inherited(n))]
    assert not bare, "without a docstring:\n" + "\n".join(f"{n.where} {n.full}" for n in bare)


def test_sections_name_the_arguments_and_nothing_else():
    wrong = []
    for name in NAMES:
        body, given = section(name.doc, "Parameters"), arguments(name.node)
        if body is None or given is None:
            continue
        documented = listed(body)
        missing, strange = set(given) - set(documented), set(documented) - set(given)
        if missing or strange:
            wrong.append(
                f"{name.where} {name.full}: not named {missing or '-'}, none {strange or '-'}"
            )
    assert not wrong, "\n".join(wrong)


def test_a_docstring_of_several_lines_names_each_argument():
    wrong = []
    for name in NAMES:
        if not isinstance(name.node, ast.FunctionDef) or "\n" not in name.doc:
            continue
        text = "\n".join((name.doc, *name.above))
        missing = [
            n
            for n in arguments(name.node)
            if n not in EVERYWHERE and not re.search(rf"\b{n}\b", text)
        ]
        if missing:
            wrong.append(f"{name.where} {name.full}: {', '.join(missing)}")
    assert not wrong, "arguments that no docstring names:\n" + "\n".join(wrong)


def raised(node):
    """Names of the errors that a function raises itself."""
    found = set()
    for n in ast.walk(node):
        if isinstance(n, ast.Raise) and isinstance(n.exc, ast.Call):
            called = n.exc.func
            found.add(getattr(called, "id", getattr(called, "attr", "")))
    return {n for n in found if n.endswith("Error")}


def test_errors_that_are_raised_are_in_the_section():
    wrong = []
    for name in NAMES:
        if not isinstance(name.node, ast.FunctionDef) or section(name.doc, "Parameters") is None:
            continue
        documented = section(name.doc, "Raises") or ""
        missing = [
            e for e in raised(name.node) if e not in documented and "FlexarmError" not in documented
        ]
        if missing:
            wrong.append(f"{name.where} {name.full}: {', '.join(missing)}")
    assert not wrong, "raised, and in no section Raises:\n" + "\n".join(wrong)


def test_there_is_something_to_look_at():
    assert len(NAMES) > 1200
    assert sum(section(n.doc, "Parameters") is not None for n in NAMES) > 150


@pytest.mark.parametrize(
    ("doc", "documented"),
    [
        (
            "A.\n\nParameters\n----------\na : int\n    Text: more.\nb, c\n    More.\n",
            ["a", "b", "c"],
        ),
        ("A.\n\nParameters\n----------\n*rest : tuple\n\nReturns\n-------\nint\n", ["rest"]),
    ],
)
def test_how_a_section_is_read(doc, documented):
    assert listed(section(doc, "Parameters")) == documented
