# SPDX-License-Identifier: Apache-2.0
"""What the adapter makes of other people's names and orders."""

import math

import numpy as np
import pytest
from sensor_msgs.msg import JointState

from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.errors import MessageError, ParameterError
from flexarm_tools.adapters.ros2_control import Readings, permutation


@pytest.fixture(scope="module")
def arm():
    return arm_file.load("two_link")


def test_joints_are_found_by_name_among_others_and_put_in_order(arm):
    readings = Readings(arm, ["shoulder", "elbow"])
    message = JointState(name=["elbow", "gripper", "shoulder"], position=[2.0, 9.0, 1.0])
    np.testing.assert_array_equal(readings.joints(message, "position"), [1.0, 2.0])
    assert readings.joints(message, "velocity") is None
    message = JointState(name=["shoulder", "elbow"], position=[3.0, 4.0])  # another order, later
    np.testing.assert_array_equal(readings.joints(message, "position"), [3.0, 4.0])


def test_a_joint_that_is_missing_and_a_length_that_is_wrong_are_named(arm):
    readings = Readings(arm)
    with pytest.raises(MessageError, match="lacks joint2; set joint_names") as error:
        readings.joints(JointState(name=["joint1"], position=[1.0]), "position")
    assert (error.value.field, error.value.value) == ("name", ["joint1"])
    message = JointState(name=["joint1", "joint2"], position=[1.0, 2.0], effort=[1.0])
    with pytest.raises(MessageError) as error:
        readings.joints(message, "effort")
    assert str(error.value) == "effort: 1 values (2 names)"
    with pytest.raises(ParameterError) as error:
        Readings(arm, ["a", "a"])
    assert (error.value.field, error.value.limit) == ("joint_names", ["joint1", "joint2"])


def test_strains_are_put_in_order_and_are_missing_when_they_are_old(arm):
    names = ["link2_root", "link2_middle", "link1_root", "link1_middle"]
    readings = Readings(arm, gauge_names=names, strain_timeout=0.02)
    assert np.isnan(readings.strain_at(0.0)).all()
    readings.take_strain([3e-6, 4e-6, 1e-6, 2e-6], 1.0)
    np.testing.assert_array_equal(readings.strain_at(1.0199), [1e-6, 2e-6, 3e-6, 4e-6])
    assert np.isnan(readings.strain_at(1.021)).all()
    with pytest.raises(MessageError) as error:
        readings.take_strain([0.0, 0.0, math.nan], 1.1)
    assert (error.value.field, error.value.value, error.value.limit) == ("strain", 3, "4 gauges")


def test_a_permutation_is_of_the_arm_files_names(arm):
    np.testing.assert_array_equal(permutation("x", [""], arm.joint_names), [0, 1])
    np.testing.assert_array_equal(permutation("x", ["joint2", "joint1"], arm.joint_names), [1, 0])
    with pytest.raises(ParameterError) as error:
        permutation("effort_joints", ["joint1"], arm.joint_names)
    assert (error.value.field, error.value.value) == ("effort_joints", ["joint1"])
