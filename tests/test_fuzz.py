# SPDX-License-Identifier: Apache-2.0
"""No malformed input does more than be refused: a few of every reader here, a million with `make fuzz`."""

import sys
from array import array
from pathlib import Path

import numpy as np
import pytest
from rclpy.serialization import serialize_message

sys.path.insert(
    0, str(Path(__file__).resolve().parents[1])
)  # the folder is no package of the workspace

from flexarm_control.composite.design import design
from flexarm_control.loop.samples import ArmSample
from flexarm_control.observers.arm_observer import observe
from flexarm_control.trajectory import files
from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.errors import (
    DesignError,
    FlexarmError,
    MessageError,
    ParameterError,
    TrajectoryError,
)
from flexarm_dynamics.models import model
from flexarm_dynamics.parameters import Parameter
from flexarm_msgs.msg import ArmState
from flexarm_ros.messages import StateReader
from flexarm_studies.identification import recording
from flexarm_studies.loop import parameter_files
from flexarm_tools.identification.recording import of_contents
from flexarm_tools.recording import bag
from fuzz import __main__ as command
from fuzz import reader

#: Inputs of each reader here; the dear ones get fewer.
INPUTS = {"arm file": 10, "arm's model": 5, "written motion": 6, "parameter file": 20}
READERS = list(command.readers())


@pytest.mark.parametrize("name", READERS)
def test_a_reader_takes_or_refuses_whatever_it_is_given(name):
    tally = command.fuzz(command.readers()[name], INPUTS.get(name, 60), 1)
    assert not tally.first, "\n".join(tally.first.values())
    assert tally.accepted or name in INPUTS  # where nothing is read, nothing was checked


def test_every_reader_has_a_weight_of_its_own():
    assert all("weight" in vars(kind) for kind in command.readers().values())


class Broken(reader.Reader):
    """A reader with every fault there is."""

    name, error, words = "broken", ParameterError, ("field",)

    def __init__(self):
        self.kept = 0

    def make(self, rng):
        return rng.randrange(6)

    def state(self):
        return self.kept

    def read(self, given):
        if given == 0:
            raise ValueError("not on purpose")
        if given == 1:
            raise ParameterError("something is wrong")
        if given == 2:
            raise ParameterError("field " + "x" * 10_000)
        if given == 3:
            self.kept += 1
            raise ParameterError("field: half of it was kept")
        if given == 4:
            raise ParameterError("field: refused")
        return given

    def check(self, given, result):
        reader.demand(result != 5, "what was read is not valid")


def test_every_kind_of_failure_is_found_and_can_be_repeated():
    tally = command.fuzz(Broken, 60, 1)
    text = "\n".join(tally.first.values())
    for wanted in (
        "ValueError: not on purpose",
        "names no field",
        "a message of 10006 characters",
        "has changed the reader",
        "what was read is not valid",
    ):
        assert wanted in text
    assert 0 < tally.failures < tally.inputs == 60
    number = int(tally.first[next(iter(tally.first))].split("--at ")[1])
    with pytest.raises((reader.Violation, ValueError)):
        command.again(Broken, 1, number)


# What was found so, one test each --------------------------------------------------------------------


def sample(k, torque):
    """A sample of arm R at rest."""
    out = ArmSample(1, 2)
    out.stamp_ns, out.session, out.sequence = 10**9 + k * 10**6, 1, k
    out.amplitude, out.torque[:] = np.zeros(2), torque
    return out


@pytest.mark.parametrize("torque", [np.inf, 1e300, -1e9])
def test_a_torque_that_is_none_does_not_poison_an_observer(torque):
    core = observe(model.build(arm_file.load("R")), "kalman", {})
    for k in range(5):
        core.step(sample(k, 0.0))
    with pytest.raises(MessageError, match="joint_torque of joint1"):
        core.step(sample(5, torque))
    for k in range(6, 10):
        core.step(sample(k, 0.0))
    assert np.isfinite(core.amplitude).all() and np.isfinite(core.rate).all()


def test_a_file_of_an_integer_too_long_to_write_is_refused():
    kind = Parameter("kp", "bool", True, "A number.")
    with pytest.raises(ParameterError, match="kp: a int is not a boolean"):
        kind.check(16**5000)
    with pytest.raises(ParameterError, match="kp: "):
        Parameter("kp", "float", 1.0, "A number.").check(16**5000)


def test_an_array_without_dimensions_is_no_list():
    with pytest.raises(ParameterError, match=r"kp: .* is not a list of numbers"):
        Parameter("kp", "float_array", [1.0], "Numbers.").check(np.array(1.0))


@pytest.mark.parametrize("text", ["!!timestamp x", "!!bool x", "[" * 400, "!!int ''", "2001-13-45"])
def test_what_yaml_stumbles_over_is_refused(tmp_path, text):
    path = tmp_path / "a.yaml"
    path.write_text(text)
    with pytest.raises(TrajectoryError, match=r"a\.yaml"):
        files.read(path, ["joint1"])
    with pytest.raises(ParameterError, match=r"a\.yaml"):
        parameter_files.load(path)


@pytest.mark.parametrize("data", [b"t,q1\n\xff,1", b"t,q1\n" + b"1" * 200_000])
def test_a_table_that_is_none_is_refused(tmp_path, data):
    path = tmp_path / "a.csv"
    path.write_bytes(data)
    with pytest.raises(TrajectoryError, match=r"a\.csv"):
        files.read(path, ["joint1"])
    with pytest.raises(FlexarmError, match=r"a\.csv"):
        recording.read_csv(path, arm_file.load("R"))


def test_names_without_values_enough_are_refused_in_a_recording():
    arm = arm_file.load("two_link")
    states = [ArmState(session=1, sequence=k, joint_names=list(arm.joint_names)) for k in range(3)]
    for msg in states:
        msg.joint_position = array("d", [0.0])
    raw = {"arm_state": [serialize_message(m) for m in states]}
    with pytest.raises(FlexarmError) as error:
        of_contents(bag.from_messages(raw, arm), arm)
    assert error.value.field == "joint_position"


def test_a_thousand_wrong_names_make_no_log_of_a_thousand_names():
    arm = arm_file.load("two_link")
    msg = ArmState(joint_names=[f"wrong{k}" for k in range(1000)])
    with pytest.raises(
        MessageError, match=r"missing joint1, joint2; unknown .* and 988 more"
    ) as refused:
        StateReader(arm).read(msg, ArmSample(2, 4, 4))
    assert len(str(refused.value)) < 1000


def test_gains_beyond_what_a_double_holds_are_a_design_error():
    slow = {"type": "computed_torque", "kv": [1e4]}
    fast = {"type": "pole_placement", "configuration": [-73.26806609422196], "damping": [0.99]}
    settings = {"feedforward": "none", "rate": 20000.0}
    with pytest.raises(DesignError, match="full-order"):
        design(
            model.build(arm_file.load("R")), slow, fast, {"type": "corrected", "order": 6}, settings
        )


def test_a_damaged_line_whose_checksum_is_right_is_no_frame():
    from flexarm_driver_template import protocol

    good = protocol.seal("S", 1, 1000, 5, 7, 7, 3)
    assert protocol.frame(good.rstrip(b"\n"), 1, 2).encoder == [5]
    for numbers in ((1, 1000, 10**400, 7, 7, 3), (-1, 1000, 5, 7, 7, 3), (1, 2**70, 5, 7, 7, 3)):
        line = protocol.seal("S", *numbers).rstrip(b"\n")
        assert protocol.frame(line, 1, 2) is None
