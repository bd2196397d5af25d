# SPDX-License-Identifier: Apache-2.0
r"""Predicts measurements with the arm's own model under the recorded torque, from an initial state.

.. math::
    \dot x = f(x, u_k; \theta), \qquad
    \hat y_k = \begin{bmatrix} q(t_k)\\ g\,R\,\delta(t_k) + b\end{bmatrix}

with the full equations of motion (2) and the torque :math:`u_k` constant over the interval that ends at
:math:`t_k`, integrated by the compiled stepper. Nothing is linearised: friction and products of deflections are
included. The initial state x_0 is unknown and estimated with the parameters.
"""

import numpy as np

from flexarm_dynamics.arm.strain_map import reading_rows
from flexarm_dynamics.errors import FlexarmError
from flexarm_dynamics.models import model
from flexarm_dynamics.models.chain import Chain
from flexarm_sim import integrators

#: Integrator of the prediction: few steps of high order.
METHOD = "dop853"
#: The fitted highest mode may be this much faster than the file's [-].
MARGIN = 1.3
#: Steps are longer than those of the simulator by this factor: the error stays below a thousandth of a microstrain
#: (tested).
LONGER = 2.0
#: Largest product of friction's rate and step: the method is stable up to about 6 [-].
STABLE = 3.0


class Predictor:
    """Predicts the measurements of a `recording` for arms with the same structure.

    `arm` is the arm of the file; it determines the number of integration steps.
    """

    def __init__(self, arm, recording):
        self.recording = recording
        first = model.build(arm)
        self.n, self.m = first.n_joints, first.n_modes
        bending = integrators.substeps(first, MARGIN / LONGER * recording.period, METHOD)
        friction = int(np.ceil(_friction_rate(first, recording) * recording.period / STABLE))
        self.substeps = max(bending, min(friction, integrators.MAX_SUBSTEPS))
        # Row k of a recording has the torque that moved the arm to row k.
        self.torque = np.ascontiguousarray(recording.torque[1:])

    def states(self, arm, initial, samples=None):
        """States at the first `samples`, or at all, shape (s, 2 (n + m)), from the `initial` one; and the model.

        States are NaN where the model diverges. The model is None if none can be built for the arm.
        """
        try:
            built = model.build(arm)
        except FlexarmError:
            built = None
        return self.run(built, initial, samples), built

    def run(self, built, initial, samples=None):
        """As `states`, for a given model."""
        count = len(self.recording.position) if samples is None else samples
        states = np.full((count, 2 * (self.n + self.m)), np.nan)
        if built is not None:
            states[0] = initial
            torque, step = self.torque[: count - 1], self.recording.period / self.substeps
            with np.errstate(all="ignore"):
                stepper(built).trajectory(states, torque, torque, step, self.substeps)
        return states

    def outputs(self, arm, states, built):
        """Joint angles and strains, shape (s, n + g), of states."""
        count = len(arm.gauges)
        out = np.full((len(states), self.n + count), np.nan)
        if built is None:
            return out
        out[:, : self.n] = states[:, : self.n]
        bias = np.array([g.bias for g in arm.gauges])
        if count:
            delta = states[:, self.n : self.n + self.m]
            out[:, self.n :] = delta @ reading_rows(built, arm.gauges).T + bias
        return out

    def predict(self, arm, initial, samples=None):
        """Joint angles and strains, shape (s, n + g)."""
        return self.outputs(arm, *self.states(arm, initial, samples))

    def guess(self, arm):
        """An initial state from the first samples: angles, speeds, and amplitudes by least squares."""
        r, n, m = self.recording, self.n, self.m
        state, built = np.zeros(2 * (n + m)), model.build(arm)
        few = min(10, len(r.position))
        state[:n] = r.position[0]
        state[n + m : 2 * n + m] = np.polyfit(r.time[:few], r.position[:few], 1)[0]
        ok = np.isfinite(r.strain[0])
        if m and ok.any():
            bias = np.array([g.bias for g in arm.gauges])[ok]
            rows = reading_rows(built, arm.gauges)[ok]
            state[n : n + m] = np.linalg.lstsq(rows, r.strain[0][ok] - bias, rcond=None)[0]
        elif m:
            state[n : n + m] = built.static_deflection(r.position[0])
        return state


def _friction_rate(built, recording):
    """Largest rate at which friction alone may stop a joint [1/s], for twice the file's friction.

    At low speed Coulomb friction acts as viscous friction with the coefficient coulomb / smoothing. For a joint with
    little inertia this is fast compared with the bending. Steps that are too long for it make the prediction useless.
    """
    n = built.n_joints
    viscous, coulomb, smoothing = built.friction_table().T
    # At least a friction that would have an effect in this motion, in case the file has none.
    coulomb = np.maximum(coulomb, 0.02 * np.abs(recording.torque).max(axis=0))
    give = np.diag(built.terms(recording.position[0], np.zeros(n)).H)[:n]
    return 2.0 * float(np.max(give * (viscous + coulomb / smoothing)))


def stepper(built):
    """The compiled stepper of a `built` model that is used only once.

    The straight-line code of a chain contains the chain's numbers. To compile it for each set of parameters would take
    longer than to simulate the motion, so the general code is used.
    """
    method = integrators.METHODS[METHOD]
    return built.stepper(method, False) if isinstance(built, Chain) else built.stepper(method)
