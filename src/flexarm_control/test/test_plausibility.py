# SPDX-License-Identifier: Apache-2.0
"""Wrong units and unsuitable choices are reported before the arm moves."""

from dataclasses import replace

import numpy as np
import pytest

from flexarm_control.composite.design import FAST, SLOW, design_law
from flexarm_control.loop.samples import ArmSample
from flexarm_control.observers.arm_observer import observe
from flexarm_dynamics import registry
from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.errors import ArmFileError, MessageError, UnknownComponentError
from flexarm_dynamics.models import model


def test_strain_in_microstrain_is_refused_by_name(arm_r):
    observer = observe(arm_r, "filtered_derivative", {})
    sample = ArmSample(1, 2, 2)
    sample.amplitude, sample.strain = None, np.array([0.0, 250.0])
    with pytest.raises(MessageError, match="strain of middle: 250"):
        observer.step(sample)
    sample.strain = np.array([0.0, 250e-6])
    observer.step(sample)


def test_a_surface_distance_in_millimetres_is_refused_with_its_path():
    text = arm_file.find("one_link").read_text()
    with pytest.raises(ArmFileError, match=r"gauges\[0\]\.surface_distance: .*in mm"):
        arm_file.parse(text.replace("surface_distance: 0.00238125", "surface_distance: 2.38125", 1))


def test_only_a_law_without_compensation_warns_of_gravity(arm_r):
    lying = arm_file.load("one_link")
    standing = replace(lying, gravity=(0.0, -9.81, 0.0))
    for arm, name, warns in (
        (lying, "linear_model_following", False),
        (standing, "linear_model_following", True),
        (standing, "model_following", False),
    ):
        assert bool(design_law(SLOW, name, model.build(arm), {}).warnings()) is warns
    assert not design_law(FAST, "none", arm_r, {}).warnings()


def test_a_broken_package_is_an_error_only_for_those_who_ask_for_it(monkeypatch):
    good = registry.find(SLOW, "none")

    def find(group, name):
        if name == "gone":
            raise UnknownComponentError("'gone' can't be imported")
        return good

    monkeypatch.setattr(registry, "find", find)
    monkeypatch.setattr(registry, "names", lambda group: ("gone", "none"))
    with pytest.warns(UserWarning, match="'gone' can't be imported"):
        assert registry.importable(SLOW) == {"none": good}
