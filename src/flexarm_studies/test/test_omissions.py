# SPDX-License-Identifier: Apache-2.0
"""What the appendix leaves out, and what that does: the figures of docs/paper.md, computed."""

from dataclasses import replace

import numpy as np
import pytest

from flexarm_control.motions import profiles
from flexarm_dynamics.arm import arm_file
from flexarm_dynamics.arm.units import POUND_FORCE
from flexarm_dynamics.models.paper_appendix import PaperAppendix
from flexarm_studies.case_study import runs as case_study
from flexarm_studies.loop import closed_loop, metrics

RUN = case_study.Run("R", "m11", "composite")


def beam_terms(model, c):
    """The beam's own m in m11(delta) and in K2."""
    return replace(c, G=c.G + model.arm.model_options["beam_mass"] * np.eye(2))


def payload_couplings(model, c):
    """J_p in m11, J_p phi' in m12 and m13."""
    J = model.arm.payload.inertia[2][2]
    return replace(c, rigid=c.rigid + J, h=c.h + J * model.slope_tip)


def study(*additions):
    """Arm R with terms added: m12, second damping ratio, first gain, peak joint error of the composite."""

    class Extended(PaperAppendix):
        def derive(self):
            c = super().derive()
            for add in additions:
                c = add(self, c)
            return c

    model = Extended(arm_file.load("R"))
    law = case_study.law_of(RUN, model)
    record = closed_loop.continuous_loop(
        model, law, profiles.paper_profile(), np.arange(0.0, 3.0, 1e-3)
    )
    linear = metrics.linear_metrics(model, law, case_study.FINAL)
    error = np.degrees(np.abs(record.reference - record.position)).max()
    m12 = model.coefficients.h[0] / POUND_FORCE
    return m12, linear["closed_loop_damping"][1], linear["k_f"][0], error


@pytest.mark.parametrize(
    ("additions", "m12", "zeta2", "k1", "peak"),
    [
        ((), 0.071435, 0.4052, -127.04, 3.457),
        ((beam_terms,), 0.071435, 0.4052, -127.04, 3.449),
        ((beam_terms, payload_couplings), 0.071493, 0.3995, -127.56, 3.443),
    ],
    ids=["as printed", "with the beam's terms", "with the payload's couplings too"],
)
def test_each_omission_has_the_effect_that_the_docs_state(additions, m12, zeta2, k1, peak):
    found = study(*additions)
    assert found[0] == pytest.approx(m12, abs=6e-7)
    assert found[1] == pytest.approx(zeta2, abs=6e-5)
    assert found[2] == pytest.approx(k1, abs=6e-3)
    assert found[3] == pytest.approx(peak, abs=6e-4)
