# SPDX-License-Identifier: Apache-2.0
"""An arm without modes: the composite control is its slow law, and there is no deflection to wait for."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from flexarm_control.loop.samples import ArmSample
from flexarm_control.observers.arm_observer import observe
from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.errors import MessageError
from flexarm_dynamics.models import model
from flexarm_studies.loop import scenario

END = np.array([0.3, 0.2])


def weight(q, g=9.81):
    """Of arm `rigid`, by hand: two bars, the second joint's motor, the payload [N m]."""
    bar, motor, payload, length = 0.1, 1.0, 0.1, 0.5
    outer = (0.5 * bar + payload) * length * np.cos(q[0] + q[1])
    inner = (0.5 * bar + motor + bar + payload) * length * np.cos(q[0])
    return g * np.array([inner + outer, outer])


@pytest.mark.parametrize(
    ("observer", "fast", "feedforward"),
    [
        ("filtered_derivative", "none", "none"),
        ("luenberger", "lqr", "model"),
        ("kalman", "output_feedback", "none"),
    ],
)
def test_it_is_controlled_with_any_observer(observer, fast, feedforward):
    values = {
        "slow.type": "model_following",
        "slow.kp": [100.0, 100.0],
        "slow.kv": [20.0, 20.0],
        "fast.type": fast,
        "observer.type": observer,
        "feedforward": feedforward,
    }
    if fast == "output_feedback":
        values["fast.period"] = 0.005
    motion = "quintic:to=0.3;0.2,duration=0.6"
    record, metrics = scenario.run(
        scenario.Scenario("rigid", values, motion, rate=200.0, window=0.6)
    )
    assert not metrics["lost"], metrics["reason"]
    assert record.amplitude.shape[1] == record.rate.shape[1] == 0
    assert not record.fast_torque.any()
    assert_allclose(record.position[-1], END, atol=1e-4)
    assert_allclose(record.torque[-1], weight(END), atol=5e-3)


def sample(n_modes=0):
    s = ArmSample(2 if not n_modes else 1, n_modes)
    s.stamp_ns, s.session, s.amplitude = 10**9, 1, None
    s.torque[:] = 0.0
    return s


def test_only_an_arm_without_modes_needs_no_amplitudes():
    rigid, bent = (model.build(arm_file.load(name)) for name in ("rigid", "R"))
    core, s = observe(rigid, "filtered_derivative", {}), sample()
    core.step(s)
    assert s.amplitude.shape == core.amplitude.shape == core.rate.shape == (0,)
    with pytest.raises(MessageError, match="neither strain nor modal_amplitude"):
        observe(bent, "filtered_derivative", {}).step(sample(2))
