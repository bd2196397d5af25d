# SPDX-License-Identifier: Apache-2.0
"""Arm files: what is read, and how every kind of malformed file is refused."""

import copy
import math
import re
from dataclasses import fields, is_dataclass
from functools import reduce
from operator import getitem

import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.arm.description import Arm, Friction, Transmission
from flexarm_dynamics.arm.units import FOOT, POUND_FORCE, POUND_FORCE_FOOT
from flexarm_dynamics.errors import ArmFileError, ModelError
from flexarm_dynamics.models import model

FULL = """
name: full
description: every field
source: a test
units: si
model: one_link
foreshortening: true
finite_slope: true
gravity: [0.0, -9.81, 0.0]
joints:
  - name: shoulder
    axis: [0, 0, 2]
    origin: {xyz: [0.1, 0.2, 0.3], rpy: [0.0, 0.1, 0.0]}
    hub_inertia: 0.5
    motor_mass: 1.5
    housing_inertia: [1.0e-3, 2.0e-3, 3.0e-3, 0.0, 0.0, 1.0e-4]
    rotor_inertia: 1.0e-4
    gear_ratio: 100.0
    friction: {viscous: 0.1, coulomb: 0.2, smoothing: 0.05, breakaway: 0.3, stribeck: 0.2, load: 0.1}
    limits: {position: [-2.0, 1.0], velocity: 3.0, torque: 12.0}
    safe_action: brake
    brake_torque: 20.0
    damp_coefficient: 0.7
    damp_torque: 2.5
    damp_time: 0.2
    encoder_counts: 4096
    transmission: {stiffness: 850.0, damping: 3.0, play: 0.012, load_damping: 0.7}
    encoder: link
  - name: elbow
links:
  - name: upper
    length: 1.2
    mass_per_length: 0.25
    EI_y: 11.0
    EI_z: 12.0
    GJ: 5.0
    polar_inertia_per_length: 1.0e-5
    flexible:
      y: {modes: 2, shape: loaded, damping: [0.01, 0.02]}
      z: {modes: 1, shape: from_frequencies, frequencies: [2.0, 11.0], damping: 0.03}
      twist: {modes: 1}
  - name: fore
    length: 0.5
    section: {shape: rectangle, size_y: 0.002, size_z: 0.02, density: 2700.0, youngs_modulus: 7.0e10}
    flexible:
      y: {modes: 1}
payload: {mass: 0.2, inertia: [1.0e-3, 2.0e-3, 3.0e-3, 0.0, 0.0, 1.0e-4], offset: [0.05, 0.0, 0.0]}
gauges:
  - {name: g1, link: upper, position: 0.0, direction: y, surface_distance: 0.002, gain: 1.1, bias: 1.0e-6, noise: 2.0e-7,
     bits: 12, full_scale: 2.0e-3, drift: 1.0e-8}
  - {name: g2, link: upper, position: 0.6, direction: y, surface_distance: -0.002}
  - {name: g3, link: fore, position: 0.1, surface_distance: 0.001}
observed_modes: [fore_y_mode1, upper_y_mode1, upper_y_mode2]
"""  # noqa: E501
TREE = yaml.safe_load(FULL)


def dumped(tree):
    """As YAML, by the C library: ten times as fast."""
    return yaml.dump(tree, Dumper=yaml.CSafeDumper, allow_unicode=True)


def all_paths(node, path=()):
    """Path of every node below the root."""
    items = node.items() if isinstance(node, dict) else enumerate(node)
    for key, child in items:
        yield (*path, key)
        if isinstance(child, (dict, list)):
            yield from all_paths(child, (*path, key))


def parent(tree, path):
    """The collection in which a path ends."""
    return reduce(getitem, path[:-1], tree)


def changed(path, value):
    """`FULL` with one field set; a path ends in a key or an index, value None-able."""
    tree = copy.deepcopy(TREE)
    parent(tree, path)[path[-1]] = value
    return dumped(tree)


def without(path):
    tree = copy.deepcopy(TREE)
    del parent(tree, path)[path[-1]]
    return dumped(tree)


def refused(text):
    """Message of the error that this text must give; it starts with the path."""
    with pytest.raises(ArmFileError) as error:
        arm_file.parse(text)
    assert str(error.value).startswith(f"{error.value.field}: ")
    return str(error.value)


def spelled(path):
    """``links[0].length`` from its steps."""
    return re.sub(
        r"^\.", "", "".join(f"[{step}]" if isinstance(step, int) else f".{step}" for step in path)
    )


# --- what is read ------------------------------------------------------------------------------


def test_every_field_is_read():
    arm = arm_file.parse(FULL)
    assert (arm.name, arm.description, arm.source) == ("full", "every field", "a test")
    assert arm.gravity == (0.0, -9.81, 0.0)
    assert (arm.foreshortening, arm.finite_slope, arm.model) == (True, True, "one_link")
    joint = arm.joints[0]
    assert joint.axis == (0.0, 0.0, 1.0)  # scaled to length one
    assert joint.origin_xyz == (0.1, 0.2, 0.3)
    assert joint.origin_rpy == (0.0, 0.1, 0.0)
    assert joint.inertia == pytest.approx(0.5 + 1e-4 * 100.0**2)
    assert joint.motor_mass == 1.5
    assert joint.housing_inertia == ((1e-3, 0.0, 0.0), (0.0, 2e-3, 1e-4), (0.0, 1e-4, 3e-3))
    assert (joint.friction.viscous, joint.friction.coulomb) == (0.1, 0.2)
    assert joint.friction == Friction(0.1, 0.2, 0.05, 0.3, 0.2, 0.1)
    assert joint.limits.position == (-2.0, 1.0)
    assert (joint.limits.velocity, joint.limits.torque) == (3.0, 12.0)
    assert (joint.safe_action, joint.brake_torque, joint.damp_coefficient) == ("brake", 20.0, 0.7)
    assert (joint.damp_torque, joint.damp_time) == (2.5, 0.2)
    assert joint.encoder_counts == 4096
    assert joint.transmission == Transmission(850.0, 3.0, 0.012, 0.7)
    assert (joint.encoder, arm.joints[1].encoder) == ("link", "motor")
    upper, fore = arm.links
    assert upper.stiffness == {"y": 11.0, "z": 12.0, "twist": 5.0}
    assert upper.polar_inertia_per_length == 1e-5
    assert upper.flexible["y"].damping == (0.01, 0.02)
    assert upper.flexible["z"].frequencies == (2.0, 11.0)
    assert upper.flexible["z"].damping == (0.03,)
    assert fore.mass_per_length == pytest.approx(2700.0 * 0.002 * 0.02)
    assert arm.payload.offset == (0.05, 0.0, 0.0)
    assert arm.payload.inertia[1] == (0.0, 2e-3, 1e-4)
    gauge = arm.gauges[0]
    assert (gauge.gain, gauge.bias, gauge.noise) == (1.1, 1e-6, 2e-7)
    assert (gauge.bits, gauge.full_scale, gauge.drift) == (12, 2e-3, 1e-8)
    assert gauge.step == 4e-3 / 4096
    arm = arm_file.parse(changed(("payload", "inertia"), 2.0e-3))  # one number for every axis
    np.testing.assert_array_equal(arm.payload.inertia, 2.0e-3 * np.eye(3))


def test_what_is_left_out_takes_its_default():
    arm = arm_file.parse(
        "name: a\njoints: [{name: j}]\nlinks: [{name: l, length: 1, mass_per_length: 1}]"
    )
    joint = arm.joints[0]
    assert joint.axis == (0.0, 0.0, 1.0)
    assert joint.limits.position == (-math.inf, math.inf)
    assert joint.limits.torque == math.inf
    assert joint.safe_action == "damp"
    assert joint.brake_torque is joint.damp_torque is joint.damp_time is None
    assert arm.payload.mass == 0.0
    assert joint.transmission is None
    assert arm.modes == () and arm.observed_modes == () and arm.gauges == ()
    assert (arm.foreshortening, arm.finite_slope, arm.model) == (False, False, "chain")
    gauge = arm_file.parse(FULL).gauges[2]
    assert (gauge.direction, gauge.bits, gauge.full_scale, gauge.drift) == ("y", 0, 1e-3, 0.0)
    assert (gauge.step, gauge.range, gauge.uncertainty) == (0.0, (-1e-3, 1e-3), 0.0)


def test_observed_modes_come_in_the_order_of_the_modal_coordinates():
    arm = arm_file.parse(FULL)
    assert arm.mode_names == (
        "upper_y_mode1",
        "upper_y_mode2",
        "upper_z_mode1",
        "upper_twist_mode1",
        "fore_y_mode1",
        "shoulder_transmission",
    )
    assert arm.observed_modes == ("upper_y_mode1", "upper_y_mode2", "fore_y_mode1")
    tree = copy.deepcopy(TREE)  # all, unless the file names some
    del tree["observed_modes"], tree["gauges"]
    arm = arm_file.parse(dumped(tree))
    assert arm.observed_modes == arm.mode_names[:-1]  # no gauge sees a transmission


def test_sections_have_the_stiffnesses_of_the_textbook():
    link = arm_file.parse(FULL).links[1]
    b, h, E = 0.002, 0.02, 7.0e10  # along y, along z
    assert link.stiffness["y"] == pytest.approx(E * h * b**3 / 12.0, rel=1e-14)
    assert link.stiffness["z"] == pytest.approx(E * b * h**3 / 12.0, rel=1e-14)
    # Ten to one: torsion constant 0.312 a b^3.
    assert link.stiffness["twist"] == pytest.approx(E / 2.6 * 0.312 * h * b**3, rel=2e-3)
    assert link.polar_inertia_per_length == pytest.approx(2700.0 * b * h * (b**2 + h**2) / 12.0)

    def link_of(**section):
        return arm_file.parse(changed(("links", 1, "section"), section)).links[1]

    square = link_of(shape="rectangle", size_y=0.01, size_z=0.01, density=1.0,
                     youngs_modulus=2.6, shear_modulus=3.0)  # fmt: skip
    assert square.stiffness["twist"] == pytest.approx(3.0 * 0.1406 * 0.01**4, rel=5e-3)
    assert square.stiffness["y"] == square.stiffness["z"]
    material = {"shape": "tube", "density": 1600.0, "youngs_modulus": 1e11}
    tube = link_of(outer_diameter=0.02, wall=0.002, **material)
    moment = math.pi * (0.02**4 - 0.016**4) / 64.0
    assert tube.stiffness["y"] == tube.stiffness["z"] == pytest.approx(1e11 * moment, rel=1e-13)
    assert tube.stiffness["twist"] == pytest.approx(1e11 / 2.6 * 2.0 * moment, rel=1e-13)
    assert tube.mass_per_length == pytest.approx(1600 * math.pi * (0.01**2 - 0.008**2), rel=1e-12)
    solid = link_of(outer_diameter=0.02, wall=0.01, **material)
    assert solid.mass_per_length == pytest.approx(1600 * math.pi * 0.01**2, rel=1e-13)


IMPERIAL = """
name: same
units: imperial
gravity: [0.0, -32.174, 0.0]
joints:
  - name: j
    origin: {xyz: [1.0, 0.0, 0.0]}
    hub_inertia: 1.0
    motor_mass: 2.0
    friction: {viscous: 0.5, coulomb: 0.25}
    limits: {torque: 10.0, position: [-1.0, 1.0], velocity: 4.0}
    brake_torque: 3.0
links:
  - name: l
    length: 4.0
    mass_per_length: 0.005124
    EI_y: 28.6
    flexible: {y: {modes: 2, shape: from_frequencies, frequencies: [2.12, 14.3]}}
payload: {mass: 3.1e-3, inertia: 8.52e-5, offset: [0.5, 0.0, 0.0]}
gauges:
  - {name: g, link: l, position: 2.0, surface_distance: 0.0078125, bias: 1.0e-6}
observed_modes: [l_y_mode1]
"""


def leaves(thing, path=""):
    """Every scalar of an arm with its path."""
    if is_dataclass(thing):
        for f in fields(thing):
            yield from leaves(getattr(thing, f.name), f"{path}.{f.name}")
    elif isinstance(thing, dict):
        for key, value in thing.items():
            yield from leaves(value, f"{path}.{key}")
    elif isinstance(thing, tuple):
        for i, value in enumerate(thing):
            yield from leaves(value, f"{path}[{i}]")
    else:
        yield path, thing


def test_imperial_and_si_describe_the_same_arm():
    slug = POUND_FORCE / FOOT
    tree = yaml.safe_load(IMPERIAL)
    tree["units"] = "si"
    tree["gravity"] = [0.0, -32.174 * FOOT, 0.0]
    joint, link, gauge = tree["joints"][0], tree["links"][0], tree["gauges"][0]
    joint["origin"] = {"xyz": [FOOT, 0.0, 0.0]}
    joint["hub_inertia"] *= POUND_FORCE_FOOT
    joint["motor_mass"] *= slug
    joint["friction"] = {"viscous": 0.5 * POUND_FORCE_FOOT, "coulomb": 0.25 * POUND_FORCE_FOOT}
    joint["limits"]["torque"] *= POUND_FORCE_FOOT
    joint["brake_torque"] *= POUND_FORCE_FOOT
    link["length"] *= FOOT
    link["mass_per_length"] *= slug / FOOT
    link["EI_y"] *= POUND_FORCE * FOOT**2
    tree["payload"] = {
        "mass": 3.1e-3 * slug,
        "inertia": 8.52e-5 * POUND_FORCE_FOOT,
        "offset": [0.5 * FOOT, 0.0, 0.0],
    }
    gauge["position"] *= FOOT
    gauge["surface_distance"] *= FOOT
    imperial, si = arm_file.parse(IMPERIAL), arm_file.parse(dumped(tree))
    for (path, a), (same, b) in zip(leaves(imperial), leaves(si), strict=True):
        assert path == same
        assert a == (pytest.approx(b, rel=1e-14) if isinstance(b, float) else b), path


def test_imperial_section_is_converted():
    section = {"shape": "rectangle", "size_y": 0.015625, "size_z": 0.0625, "density": 5.25}
    tree = yaml.safe_load(IMPERIAL)
    link = tree["links"][0]
    del link["mass_per_length"], link["EI_y"]
    link["section"] = section | {"youngs_modulus": 1.44e9}
    converted = arm_file.parse(dumped(tree)).links[0]
    assert converted.mass_per_length == pytest.approx(
        5.25 * 0.015625 * 0.0625 * POUND_FORCE / FOOT**2, rel=1e-13
    )
    EI = 1.44e9 * 0.0625 * 0.015625**3 / 12.0 * POUND_FORCE * FOOT**2
    assert converted.stiffness["y"] == pytest.approx(EI, rel=1e-13)


# --- shipped files -----------------------------------------------------------------------------


def test_every_shipped_arm_is_valid_and_loads_by_name_and_by_path():
    files = [p for d in arm_file.arms_directories() for p in d.glob("*.yaml")]
    assert {"R", "P3", "one_link"} <= {path.stem for path in files}
    for path in files:
        arm = arm_file.load(path)
        assert arm.name == path.stem and arm_file.load(path.stem) == arm
        assert arm.description and arm.source


def test_printed_masses_are_converted_with_the_rest():
    options, slug = arm_file.load("P3").model_options, POUND_FORCE / FOOT
    assert options["beam_mass"] == pytest.approx(0.0205 * slug, rel=1e-14)
    assert options["beam_inertia"] == pytest.approx(0.109 * POUND_FORCE_FOOT, rel=1e-14)
    assert options["m23_fit"] == pytest.approx(2.0631e-3 * slug, rel=1e-14)


def test_shipped_one_link_arm_has_the_data_of_R_in_si():
    R, si = arm_file.load("R"), arm_file.load("one_link")
    assert si.joints[0].hub_inertia == pytest.approx(R.joints[0].hub_inertia, rel=1e-12)
    for name in ("length", "mass_per_length"):
        assert getattr(si.links[0], name) == pytest.approx(getattr(R.links[0], name), rel=1e-12)
    assert si.links[0].stiffness["y"] == pytest.approx(R.links[0].stiffness["y"], rel=1e-12)
    assert si.payload.mass == pytest.approx(R.payload.mass, rel=1e-12)
    np.testing.assert_allclose(si.payload.inertia, R.payload.inertia, rtol=1e-12)
    for a, b in zip(si.gauges, R.gauges, strict=True):
        assert (a.position, a.surface_distance) == pytest.approx((b.position, b.surface_distance))


def test_an_unknown_name_lists_the_shipped_arms():
    with pytest.raises(ArmFileError, match=r"^arm: 'Q' is neither a file .*P3, R, .*one_link"):
        arm_file.load("Q")


@pytest.mark.parametrize("name", ["", "x" * 5000, "~no_such_user_here/arm.yaml", "a\0b", "."])
def test_a_name_that_is_no_file_is_refused(name):
    with pytest.raises(ArmFileError, match=r"^arm: "):
        arm_file.load(name)


def test_errors_of_a_file_name_the_file_first(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text(changed(("links", 0, "length"), -1.0))
    with pytest.raises(ArmFileError) as error:
        arm_file.load(path)
    assert error.value.field == "mine.yaml: links[0].length"
    path.write_bytes(b"name: \xff\xfe")
    with pytest.raises(ArmFileError, match="can't be read"):
        arm_file.load(path)


# --- what is refused ---------------------------------------------------------------------------

COUNTS_AND_FLAGS = ("foreshortening", "finite_slope", "modes", "bits", "encoder_counts")
ANY_SIGN = ("position", "surface_distance", "gain", "bias")
ABOVE_ZERO = (
    "gear_ratio", "smoothing", "velocity", "torque", "length", "mass_per_length", "EI_y", "EI_z", "GJ",
    "size_y", "size_z", "density", "youngs_modulus", "full_scale", "stiffness", "stribeck",
)  # fmt: skip
#: Path of every number in `FULL`.
NUMBERS = [
    path
    for path in all_paths(TREE)
    if isinstance(reduce(getitem, path, TREE), (int, float)) and path[-1] not in COUNTS_AND_FLAGS
]
NOT_NEGATIVE = [p for p in NUMBERS if isinstance(p[-1], str) and p[-1] not in ANY_SIGN]
POSITIVE = [p for p in NUMBERS if p[-1] in ABOVE_ZERO]
#: One of each reader: a number, and one in a list.
READERS = [("links", 0, "length"), ("gravity", 1)]


@pytest.mark.parametrize("path", NOT_NEGATIVE, ids=spelled)
def test_a_negative_number_is_refused(path):
    assert refused(changed(path, -0.5)).startswith(f"{spelled(path)}: ")


@pytest.mark.parametrize("path", POSITIVE, ids=spelled)
def test_zero_is_refused_where_it_has_no_meaning(path):
    message = refused(changed(path, 0.0))
    assert message.startswith(f"{spelled(path)}: 0.0 is too small (greater than 0")
    assert refused(changed(path, 1e-200)).endswith("is too small (at least 1e-30)")


@pytest.mark.parametrize("path", NUMBERS, ids=spelled)
def test_every_number_is_checked(path):
    field = re.escape(spelled(path))
    assert re.match(rf"{field}: nan is not finite$", refused(changed(path, math.nan)))
    assert re.match(
        rf"{field}: 1e\+31 is too large \(at most 1e\+30\)$", refused(changed(path, 1e31))
    )
    assert re.match(rf"{field}(\[0\])?: .*number", refused(changed(path, "1.0 m")))


@pytest.mark.parametrize("path", READERS, ids=spelled)
@pytest.mark.parametrize(
    ("values", "problem"),
    [
        ((math.inf, -math.inf), "is not finite"),
        ((-1e200, 10**400), "is too large (at most 1e+30)"),
        (("long", "", True, {"a": 1}, [[1.0]], "1,5", "2020-01-01"), "is not a number"),
    ],
)
def test_what_is_not_a_number_of_an_arm_is_refused(path, values, problem):
    for value in values:
        message = refused(changed(path, value))
        assert message.startswith(f"{spelled(path)}: ") and message.endswith(problem), message


@pytest.mark.parametrize(
    "path",
    [
        ("name",),
        ("joints",),
        ("links",),
        ("joints", 0, "name"),
        ("links", 0, "name"),
        ("links", 0, "length"),
        ("links", 0, "mass_per_length"),
        ("links", 0, "EI_y"),
        ("links", 0, "GJ"),
        ("links", 0, "polar_inertia_per_length"),  # as the link twists
        ("links", 0, "flexible", "y", "modes"),
        ("links", 0, "flexible", "z", "frequencies"),
        ("links", 1, "section", "shape"),
        ("links", 1, "section", "size_z"),
        ("gauges", 0, "name"),
        ("gauges", 0, "link"),
        ("gauges", 0, "position"),
        ("gauges", 0, "surface_distance"),
    ],
    ids=spelled,
)
def test_a_missing_field_is_named(path):
    message = refused(without(path))
    assert message.startswith(f"{spelled(path)}: ")
    assert "missing" in message or "give one each" in message
    # A field that is there without a value is as good as missing.
    assert refused(changed(path, None)).startswith(f"{spelled(path)}: ")


@pytest.mark.parametrize(
    "path, wrong, hint",
    [
        (("links", 0, "length"), "lenght", "'lenght'"),
        (("joints", 0, "transmission", "stiffness"), "stifness", "'stifness'"),
        (("joints", 0, "hub_inertia"), "hub_intertia", "'hub_inertia'"),
        (("joints", 0, "limits", "torque"), "torqe", "'torque'"),
        (("links", 0, "flexible", "y", "damping"), "dampng", "'damping'"),
        (("payload", "mass"), "mas", "'mass'"),
        (("gauges", 0, "gain"), "gian", "'gain'"),
        (("gauges", 0, "full_scale"), "full_scal", "'full_scale'"),
        (("observed_modes",), "observed_mode", "'observed_modes'"),
        (("gravity",), "gravitiy", "'gravity'"),
    ],
    ids=lambda p: spelled(p) if isinstance(p, tuple) else None,
)
def test_a_misspelt_field_is_named_with_what_is_meant(path, wrong, hint):
    tree = copy.deepcopy(TREE)
    node = parent(tree, path)
    node[wrong] = node.pop(path[-1])
    message = refused(dumped(tree))
    missing = spelled(path) + ": missing"
    assert message.startswith((spelled((*path[:-1], wrong)) + ": no such field", missing))
    assert hint in message


def test_an_unknown_field_is_refused_with_what_there_is():
    message = refused(changed(("payload", "colour"), "red"))
    assert message == "payload.colour: no such field (known here: inertia, mass, offset)"


def test_an_unknown_field_with_an_endless_name_is_cut_short():
    message = refused(changed(("payload", "x" * 5000), "red"))
    assert message.startswith("payload.xxx") and len(message) < 200


@pytest.mark.parametrize(
    "text, start",
    [
        ("name: a\nname: b", "name: given twice (line 2)"),
        (
            "links:\n  - name: a\n    length: 1.0\n    length: 2.0",
            "links[0].length: given twice (line 4)",
        ),
        ("joints: [{name: a, limits: {torque: 1, torque: 2}}]", "joints[0].limits.torque: given"),
    ],
)
def test_a_field_given_twice_is_refused(text, start):
    assert refused(text).startswith(start)


@pytest.mark.parametrize(
    "path, value, words",
    [
        (("units",), "metric", "'metric' is not one of the choices (si, imperial)"),
        (("units",), "imperail", "did you mean 'imperial'?"),
        (("name",), 5, "5 is not text"),
        (("name",), "", "empty"),
        (("name",), ["a"], "a list is not text"),
        (("joints", 1, "name"), " ", "empty"),
        (("links", 0, "name"), "", "empty"),
        (("gauges", 0, "name"), "", "empty"),
        (("gravity",), [0.0, 1.0], "a list of 3 numbers is wanted, not 2 values"),
        (("gravity",), -9.81, "a list of 3 numbers is wanted, not -9.81"),
        (("joints",), {"name": "a"}, "a list is wanted, not a mapping"),
        (("joints",), "a", "a list is wanted, not 'a'"),
        (("joints", 0), "a", "a mapping is wanted, not 'a'"),
        (("joints", 0), None, "a mapping is wanted, not nothing"),
        (("joints", 0, "axis"), [0, 0, 0], "is of length zero"),
        (("joints", 0, "axis"), [0, 1], "3 numbers is wanted, not 2 values"),
        (("joints", 0, "origin"), [0, 0, 0], "a mapping is wanted, not a list"),
        (("joints", 0, "limits", "position"), [1.0, -1.0], "low must be below high"),
        (("joints", 0, "limits", "position"), [1.0, 1.0], "low must be below high"),
        (("joints", 0, "safe_action"), "stop", "'stop' is not one of the choices (brake, damp, zero)"),
        (("joints", 0, "encoder_counts"), 1.5, "1.5 is not an integer"),
        (("joints", 0, "transmission", "play"), 0.7, "0.7 rad is too large (at most 0.2 rad); the whole way"),
        (("joints", 0, "friction", "breakaway"), 0.1, "0.1 N m is below the Coulomb friction (at least 0.2 N m)"),
        (("joints", 0, "friction", "load"), 1.5, "1.5 of the transmitted torque is too much (at most 0.9)"),
        (("joints", 0, "encoder"), "load", "'load' is not one of the choices (motor, link)"),
        (("joints", 0, "rotor_inertia"), 0.0, "must be greater than 0 kg m^2; with a transmission"),
        (("observed_modes", 0), "shoulder_transmission", "is not a mode of this arm"),
        (("joints", 0, "encoder_counts"), True, "True is not an integer"),
        (("joints", 0, "encoder_counts"), -1, "-1 is out of range (0 to"),
        (("joints", 0, "encoder_counts"), 10**400, "more than 64 bits is out of range (0 to"),
        (("links",), [], "empty; an arm has at least one link"),
        (("links", 0, "flexible", "y", "modes"), 0, "0 is out of range (1 to 20)"),
        (("links", 0, "flexible", "y", "modes"), 21, "21 is out of range (1 to 20)"),
        (("links", 0, "flexible", "y", "modes"), 2.0, "2.0 is not an integer"),
        (("links", 0, "flexible", "y", "shape"), "free", "is not one of the choices (clamped_free, loaded"),
        (("links", 0, "flexible", "y", "damping"), [0.1, 1.0], "is out of range (from 0 to below 1)"),
        (("links", 0, "flexible", "y", "damping"), [-0.1], "is out of range (from 0 to below 1)"),
        (("links", 0, "flexible", "z", "frequencies"), [11.0, 2.0], "positive and ascending"),
        (("links", 0, "flexible", "z", "frequencies"), [2.0, 2.0], "positive and ascending"),
        (("links", 0, "flexible", "z", "frequencies"), [0.0, 2.0], "positive and ascending"),
        (("links", 0, "flexible", "z", "frequencies"), [], "0 frequencies for 1 modes"),
        (("links", 0, "flexible", "z", "frequencies"), 2.0, "a list of 1 numbers is wanted"),
        (("links", 0, "flexible", "x"), {"modes": 1}, "no such field"),
        (("links", 1, "section", "shape"), "disc", "'disc' is not one of the choices (rectangle, tube)"),
        (("links", 1, "EI_y"), 1.0, "beside a section; give either a section or the stiffnesses"),
        (("links", 1, "mass_per_length"), 1.0, "give either a section or the stiffnesses"),
        (("payload", "inertia"), -1.0, "not positive semi-definite"),
        (("joints", 0, "housing_inertia"), -1.0, "not positive semi-definite"),
        (("payload", "inertia"), [1.0, 1.0, 1.0], "a list of 6 numbers is wanted, not 3 values"),
        (("payload", "inertia"), [1, 1, 1, 2, 0, 0], "not positive semi-definite"),
        (("gauges", 0, "link"), "uper", "'uper' is not one of the choices (upper, fore); did you mean 'upper'?"),
        (("gauges", 0, "position"), 1.3, "1.3 m is outside upper (0 to 1.2 m)"),
        (("gauges", 0, "position"), -0.1, "-0.1 m is outside upper"),
        (("gauges", 0, "direction"), "x", "'x' is not one of the choices (y, z, twist)"),
        (("gauges", 0, "surface_distance"), 0.0, "a gauge on the neutral axis sees nothing"),
        (("gauges", 0, "surface_distance"), 2.0, "at most half the length of upper, 0.6 m); in mm?"),
        (("gauges", 0, "gain"), 0.0, "such a gauge sees nothing"),
        (("gauges", 0, "bits"), -1, "-1 is out of range (0 to 32)"),
        (("gauges", 0, "bits"), 33, "33 is out of range (0 to 32)"),
        (("gauges", 0, "full_scale"), 1e3, "1000.0 is too large (at most 0.1); in microstrain?"),
        (("gauges", 0, "bias"), 20.0, "20.0 is not within full_scale (0.002); in microstrain?"),
        (("gauges", 0, "bias"), -2e-3, "is not within full_scale"),
        (("gauges", 0, "noise"), 0.5, "0.5 is not within full_scale"),
        (("observed_modes",), "upper_y_mode1", "a list of mode names is wanted"),
        (("observed_modes", 0), "upper_y_mode9", "'upper_y_mode9' is not a mode of this arm"),
        (("observed_modes", 1), "fore_y_mode1", "'fore_y_mode1' given twice"),
        (("observed_modes", 0), ["a"], "a list is not a mode of this arm"),
        (("observed_modes", 0), {"a": 1}, "a mapping is not a mode of this arm"),
        (("paper_appendix",), {"beam_mass": 1.0}, "belongs to model paper_appendix"),
        (("model",), 1, "1 is not text"),
        (("foreshortening",), "yes please", "'yes please' is neither true nor false"),
        (("finite_slope",), 1, "1 is neither true nor false"),
    ],
    ids=lambda v: spelled(v) if isinstance(v, tuple) else None,
)  # fmt: skip
def test_a_value_without_meaning_is_refused(path, value, words):
    message = refused(changed(path, value))
    assert message.startswith(f"{spelled(path)}: ")
    assert words in message


@pytest.mark.parametrize(
    ("things", "index", "taken"),
    [("joints", 1, "shoulder"), ("links", 1, "upper"), ("gauges", 2, "g1")],
)
def test_names_must_differ(things, index, taken):
    message = refused(changed((things, index, "name"), taken))
    assert message == f"{things}[{index}].name: {taken!r} is the name of {things}[0], too"


def test_friction_of_the_transmitted_torque_needs_a_transmission():
    message = refused(without(("joints", 0, "transmission")))
    assert message.startswith("joints[0].friction.load: 0.1 needs a transmission; give the joint a")


def test_joints_and_links_come_in_pairs():
    assert refused(without(("joints", 1))) == (
        "joints: 1 joints for 2 links; a serial arm has one joint each"
    )


def test_observed_modes_need_gauges_of_their_link_and_direction():
    assert refused(without(("gauges", 1))) == (
        "gauges: 1 on upper in direction y for 2 observed modes; add gauges or list fewer"
        " observed_modes"
    )
    assert refused(changed(("gauges", 2, "direction"), "z")).startswith("gauges: 0 on fore in")


def test_a_wall_thicker_than_the_radius_is_refused():
    section = {"shape": "tube", "outer_diameter": 0.02, "wall": 0.011, "density": 1.0}
    message = refused(changed(("links", 1, "section"), section | {"youngs_modulus": 1.0}))
    assert message.startswith("links[1].section.wall: 0.011 m is more than the radius")


def test_the_appendix_needs_its_section():
    assert refused(changed(("model",), "paper_appendix")).startswith("paper_appendix: missing")
    tree = copy.deepcopy(TREE)
    tree["model"], tree["paper_appendix"] = "paper_appendix", {"beam_mass": 0.3}
    assert refused(dumped(tree)).startswith("paper_appendix.beam_inertia: missing")
    tree["paper_appendix"]["beam_inertia"] = 0.1
    options = arm_file.parse(dumped(tree)).model_options
    assert options == {"beam_mass": 0.3, "beam_inertia": 0.1, "m23_fit": 0.0}


@pytest.mark.parametrize(
    "text, start",
    [
        ("", "file: a mapping is wanted, not nothing"),
        ("# only a comment\n", "file: a mapping is wanted, not nothing"),
        ("just text", "file: a mapping is wanted, not 'just text'"),
        ("- a\n- b", "file: a mapping is wanted, not a list"),
        ("name: a\nlinks: [", "here.yaml line 2: not YAML: "),
        ("name: a\n\tlinks: 1", "here.yaml line 2: not YAML: "),
        ("name: 'a", "here.yaml line 1: not YAML: "),
        ("a: 1\n---\nb: 2", "here.yaml line 2: not YAML: "),
        ("name: *unknown", "here.yaml line 1: not YAML: found undefined alias"),
        ("name: !!python/object:os.system a", "here.yaml line 1: not YAML: "),
        ("name: \x01", "here.yaml: not YAML: "),
        ("name: !!timestamp x", "here.yaml: not YAML: "),
        ("name: !!bool x", "here.yaml: not YAML: "),
        ("name: !!int ''", "here.yaml: not YAML: "),
        ("name: 2020-13-45", "here.yaml: not YAML: "),
        ("joints: !!map [a]", "here.yaml line 1: not YAML: "),
        ("1: a", "line 1: the key '1' (line 1) is not a name"),
        ("name: a\nyes: b", "line 2: the key 'yes' (line 2) is not a name"),
        ("'': a", "line 1: the key '' (line 1) is not a name"),
        ("payload: {[a]: b}", "payload: the key a collection (line 1) is not a name"),
        ("? {a: b}\n: c", "line 1: the key a collection"),
        ("<<: {name: a}", "line 1: the key '<<'"),
        ("[" * 2000, "here.yaml: not YAML: RecursionError"),
        ("{a: " * 2000, "here.yaml: not YAML: RecursionError"),
        ("a: &a [*a]\njoints: *a", "joints[0]: a mapping is wanted, not a list"),
        ("&a {joints: [*a], links: []}", "joints[0].name: missing"),
    ],
    ids=lambda text: repr(text[:20]),
)
def test_what_is_not_an_arm_file_at_all_is_refused(text, start):
    with pytest.raises(ArmFileError) as error:
        arm_file.parse(text, "here.yaml")
    assert str(error.value).startswith(start)
    assert len(str(error.value)) < 400


def test_aliases_that_multiply_are_refused_at_once():
    """Nine levels of ten: a message that spelled it out would not fit into memory."""
    lines = ["a0: &a0 [x]"]
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]" for i in range(1, 10)]
    assert refused("\n".join([*lines, "units: *a9"])) == "units: a list is not text"


def test_one_description_may_serve_twice():
    """Aliases are YAML's way of saying so."""
    text = changed(("description",), "x").replace("description: x", "description: &d x")
    assert arm_file.parse(text.replace("source: a test", "source: *d")).source == "x"


@pytest.mark.parametrize("text", ["1e-3", "1E-3", "+1e-3", ".001", "1.0e-3"])
def test_numbers_are_read_as_people_write_them(text):
    """YAML 1.1 takes 1e-3, without a dot, for text."""
    arm = arm_file.parse(FULL.replace("hub_inertia: 0.5", f"hub_inertia: {text}"))
    assert arm.joints[0].hub_inertia == 1e-3


# --- anything else -----------------------------------------------------------------------------

SCALARS = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-3, 30),
    st.integers(),
    st.just(10**400),
    st.floats(),
    st.sampled_from(
        ["", "y", "si", "imperial", "upper", "nan", "1e-3", "tube", "loaded", "upper_y_mode1", "~"]
    ),
    st.text(max_size=8),
    st.dates(),
    st.binary(max_size=4),
)
JUNK = st.recursive(
    SCALARS,
    lambda inner: st.one_of(
        st.lists(inner, max_size=6),
        st.dictionaries(st.one_of(st.text(max_size=6), st.integers()), inner, max_size=4),
    ),
    max_leaves=8,
)


BASES = [TREE, yaml.safe_load(IMPERIAL)]
KEYS = sorted({p[-1] for base in BASES for p in all_paths(base) if isinstance(p[-1], str)})


def mutate(draw, tree):
    """Delete, replace, rename, add or repeat one node."""
    path = draw(st.sampled_from(list(all_paths(tree))))
    node = parent(tree, path)
    kind = draw(st.sampled_from(["delete", "replace", "rename", "add", "repeat"]))
    if kind == "delete":
        del node[path[-1]]
    elif kind == "replace":
        node[path[-1]] = draw(JUNK)
    elif kind == "repeat":
        if isinstance(node, list):
            node.append(copy.deepcopy(node[path[-1]]))
    elif isinstance(node, dict):
        key = draw(st.one_of(st.sampled_from(KEYS), st.text(max_size=6), st.integers(0, 3)))
        node[key] = node.pop(path[-1]) if kind == "rename" else draw(JUNK)
    else:
        node.insert(0, draw(JUNK))


@settings(
    max_examples=250,
    deadline=None,
    derandomize=True,
    database=None,
    suppress_health_check=list(HealthCheck),
)
@given(st.data())
@pytest.mark.slow
def test_a_damaged_file_gives_an_arm_or_an_arm_file_error(data):
    tree = copy.deepcopy(data.draw(st.sampled_from(BASES)))
    for _ in range(data.draw(st.integers(1, 3))):
        if any(True for _ in all_paths(tree)):
            mutate(data.draw, tree)
    text = dumped(tree)
    try:
        arm = arm_file.parse(text)
    except ArmFileError as error:
        assert str(error).startswith(f"{error.field}: ")
        assert error.field and error.problem
    else:
        assert isinstance(arm, Arm)
        for path, value in leaves(arm):
            if isinstance(value, float) and ".limits" not in path:
                assert math.isfinite(value), path
        for g in arm.gauges:
            assert -g.full_scale <= g.range[0] < 0.0 <= g.range[1] <= g.full_scale <= 0.1
            assert 0 <= g.bits <= 32 and g.drift >= 0.0 and abs(g.bias) < g.full_scale


@settings(max_examples=300, deadline=None, derandomize=True, database=None)
@given(st.data())
@pytest.mark.slow
def test_a_file_with_damaged_characters_gives_an_arm_or_an_arm_file_error(data):
    text = list(FULL)
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(text) - 1))
        text[at : at + data.draw(st.integers(0, 3))] = data.draw(
            st.one_of(st.text(max_size=3), st.sampled_from(list("[]{}:,-&*!|>'\"%@`#?\n\t")))
        )
    try:
        assert isinstance(arm_file.parse("".join(text)), Arm)
    except ArmFileError as error:
        assert error.field and error.problem


@settings(max_examples=300, deadline=None, derandomize=True, database=None)
@given(st.text(max_size=60))
def test_any_text_is_an_arm_file_error(text):
    with pytest.raises(ArmFileError):
        arm_file.parse(text)


# --- arms of several links ------------------------------------------------------------------------


@pytest.mark.parametrize("text", ["joints: &a [*a]", "joints: &a [{name: j, origin: *a}]"])
def test_a_file_that_contains_itself_is_refused_by_path(text):
    with pytest.raises(ArmFileError, match=r"^joints\[0\].*a mapping is wanted, not a list"):
        arm_file.parse(f"name: loop\n{text}\nlinks: [{{name: l, length: 1, mass_per_length: 1}}]")


def test_a_joint_that_turns_without_moving_mass_is_refused_by_path():
    data = yaml.safe_load(arm_file.find("two_link").read_text())
    data["joints"][1] |= {"axis": [1, 0, 0], "hub_inertia": 0.0}
    data["payload"] = {}
    with pytest.raises(ModelError) as error:
        model.build(arm_file.parse(dumped(data)))
    assert (error.value.field, error.value.value) == ("joints[1]", "joint2")


def test_the_published_frequencies_of_the_two_link_arm():
    """De Luca and Siciliano (1991): 0.48, 1.80 Hz and 2.18, 15.91 Hz, each link with its load."""
    arm = arm_file.load("two_link")
    chain = model.build(arm)
    found = []
    for link in arm.links:
        beta = chain.mode_shapes(link.name, "y").beta
        omega = (beta / link.length) ** 2 * np.sqrt(link.stiffness["y"] / link.mass_per_length)
        found += list(omega / (2.0 * np.pi))
    np.testing.assert_allclose(found, [0.48, 1.80, 2.18, 15.91], atol=0.005)
