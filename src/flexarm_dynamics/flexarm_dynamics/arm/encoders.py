# SPDX-License-Identifier: Apache-2.0
"""Computes what encoders read: the angle of a joint's motor, or of its link behind the transmission."""

import numpy as np

from .description import TRANSMISSION, Mode

#: Iterations that find the motor angles for given link angles; few suffice, as the load changes little within the play.
REST_ROUNDS = 5


def encoder_rows(model):
    """Matrix from (q, delta) to the encoders' readings, and from (qd, delta_d) to their rates, shape (n, n + m)."""
    n, joints = model.n_joints, model.arm.joints
    rows = np.eye(n, n + model.n_modes)
    for i, joint in enumerate(joints):
        if joint.transmission is not None and joint.encoder == "link":
            deflection = Mode(joint.name, TRANSMISSION, 1).name
            rows[i, n + model.mode_names.index(deflection)] = 1.0
    return rows


def motors_at_rest(model, reading):
    """Motor angles (n,) [rad] and delta (m,) of the arm at rest for which its encoders have this `reading`."""
    motors = np.asarray(reading, float)
    delta = model.static_deflection(motors)
    slack = encoder_rows(model)[:, model.n_joints :]
    if slack.any():
        for _ in range(REST_ROUNDS):
            motors = reading - slack @ delta
            delta = model.static_deflection(motors)
    return motors, delta
