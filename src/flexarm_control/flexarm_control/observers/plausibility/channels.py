# SPDX-License-Identifier: Apache-2.0
r"""Collects the readings of an arm in one vector, with the noise of each and bounds of its change.

The vector is :math:`x = (q, \varepsilon, \delta, \dot q, \dot\delta)`: joint positions, strains, modal amplitudes and
their rates. Values that a source does not give are NaN. With H the inverse of the mass matrix (3) and R the rows of the
strain map, a step :math:`\Delta u` of the torque changes the accelerations by

.. math:: |\Delta\ddot q| \le 2|H_{11}||\Delta u|, \qquad |\Delta\ddot\delta| \le 2|H_{21}||\Delta u|, \qquad
          |\Delta\ddot\varepsilon| \le 2|R H_{21}||\Delta u| ,

where the 2 allows for errors of the model. The step goes on to act on the deflections while the modes turn. For a gauge
in the middle of a link the modes' parts of :math:`R H_{21}` may cancel at first. A part of a period later they add up.
So the bounds of strains and deflections are at least twice the sum of all parts,

.. math:: |\Delta\ddot\delta_i| \le 2\sum_k |\phi_{k,i}|\,|\phi_{k,1}|^T|\Delta u|, \qquad
          |\Delta\ddot\varepsilon_i| \le 2\sum_k |R_i\phi_{k,2}|\,|\phi_{k,1}|^T|\Delta u| ,

with the normal modes :math:`\phi_k` of unit modal mass, their joints' part 1 and their deflections' part 2.

The end of a light link has hardly any inertia of its own. A motor on it is
therefore turned back by modes that the arm file leaves out. Gauges feel these modes, too. So for an arm with a light
joint the bounds for joints and gauges are also computed in a second way: with one more mode in every direction and,
instead of H, with the mean acceleration that a constant torque causes over a time t:

.. math:: \bar H = \begin{pmatrix} M_{11}^{-1} & 0 \\ 0 & 0 \end{pmatrix}
          + \sum_k s_k^2\,\phi_k\phi_k^T , \qquad s_k = \frac{\sin(\omega_k t/2)}{\omega_k t/2}

with the frequencies :math:`\omega_k` of the modes. So positions move by
:math:`\tfrac12 t^2\bar H\Delta u` in the time t. Velocities change in half of that time by
:math:`\tfrac12 t\bar H\Delta u` with s_k instead of its square. The larger of the two bounds holds. Without the average
the sum would grow with each mode; with it, it converges. The time t fits sampling at up to 1000 samples per second.

Everything else that acts (pushes, gravity, brakes) is assumed to change the joints' accelerations by at most
:math:`2|M_{11}^{-1}|u_{max}`, with the torque limit or the brake's torque, whichever is larger. The accelerations of
the deflections change by at most a twentieth of what that torque would cause.
"""

from itertools import pairwise

import numpy as np

from flexarm_dynamics.arm.strain_map import reading_rows

from ... import kernels

#: Rms noise if the arm file states none: joint positions [rad], joint velocities [rad/s], and strains as a
#: fraction of full scale [-]. If the first samples show more noise, that counts.
UNSTATED_POSITION, UNSTATED_VELOCITY, UNSTATED_STRAIN = 1e-5, 1e-3, 1e-5
#: The same for modal amplitudes of an arm without gauges [m, rad].
UNSTATED_AMPLITUDE = 1e-5
#: Factor for a payload, a configuration, or a torque between two samples, that differs from the model's [-].
MARGIN = 2.0
#: Time over which accelerations after a step of the torque are averaged: two samples at 1 kHz [s].
AVERAGED = 2e-3
#: A joint is light if the ratio of its acceleration with flexible links to that with rigid links is larger [-]. It then
#: turns little more than the end of a bending link.
LIGHT = 3.0
#: Number of configurations over which the largest accelerations are taken.
CONFIGURATIONS = 16


class Channels:
    """Names, noise and bounds of the readings.

    Parameters
    ----------
    model : ArmModel
        n joints, m modes; its arm has g gauges.
    strain_map : StrainMap or None
        None without gauges.

    Attributes
    ----------
    names : tuple of str, length N = 2 n + g + 2 m
        Field and joint, gauge or mode.
    position, strain, amplitude, velocity, rate : slice
        Where each group is in the vector.
    is_rate : ndarray of bool, shape (N,)
        True for velocities and modal rates.
    noise : ndarray, shape (N,)
        Rms noise.
    range : tuple of ndarray, shape (g,)
        Middle and half width of the gauges' ranges [strain].
    fastest : float
        Highest frequency of the model's modes; 0 for a rigid arm [rad/s].
    count : ndarray, shape (n,)
        Steps of the encoders; zero where the arm file states none [rad].
    gain : ndarray, shape (N, n)
        Magnitude of the change of acceleration per torque: `MARGIN` times the largest over the configurations, for
        strains and amplitudes also while the modes turn. With a light joint, the mean acceleration with one more mode
        counts if it is larger than the model's.
    push : ndarray, shape (N,)
        Change of acceleration by causes that are not reported; infinite if a joint has no torque limit.
    heavy : bool
        Whether no joint is light: none accelerates more than `LIGHT` times as much as with rigid links, in any of the
        configurations.
    strength : ndarray, shape (n,)
        Largest torque of motor or brake [N m].
    """

    def __init__(self, model, strain_map):
        arm = model.arm
        n, m, g = model.n_joints, model.n_modes, len(arm.gauges)
        self.model, self.n, self.m, self.g = model, n, m, g
        ends = np.cumsum([0, n, g, m, n, m])
        parts = [slice(int(a), int(b)) for a, b in pairwise(ends)]
        self.position, self.strain, self.amplitude, self.velocity, self.rate = parts
        self.size = int(ends[-1])
        fields = ("joint_position", "strain", "modal_amplitude", "joint_velocity", "modal_rate")
        owners = (
            arm.joint_names,
            arm.gauge_names,
            model.mode_names,
            arm.joint_names,
            model.mode_names,
        )
        self.names = tuple(
            f"{f} of {o}" for f, all_ in zip(fields, owners, strict=True) for o in all_
        )
        self.units = ("rad",) * n + ("",) * (g + m) + ("rad/s",) * n + ("",) * m
        self.is_rate = np.arange(self.size) >= ends[3]
        counts = np.array([j.encoder_counts for j in arm.joints], float)
        self.count = np.divide(2.0 * np.pi, counts, out=np.zeros(n), where=counts > 0.0)
        self.strength = np.array([max(j.limits.torque, j.brake_torque or 0.0) for j in arm.joints])
        ends = np.array([g.range for g in arm.gauges]).reshape(-1, 2)
        self.range = ends.mean(axis=1), 0.5 * np.ptp(ends, axis=1)
        self.fastest = float(self.model.frequencies().max(initial=0.0))
        self.noise = self._noise(strain_map)
        self.gain, self.push = self._accelerations(strain_map)
        self._no_velocity, self._no_strain, self._no_modes = (np.full(k, np.nan) for k in (n, g, m))
        self._gather = kernels.compiled().gather

    def _noise(self, strain_map):
        noise = np.empty(self.size)
        noise[self.position] = np.where(self.count > 0.0, 0.0, UNSTATED_POSITION)
        noise[self.velocity] = UNSTATED_VELOCITY
        gauges = self.model.arm.gauges
        noise[self.strain] = [g.uncertainty or UNSTATED_STRAIN * g.full_scale for g in gauges]
        if strain_map is None:
            noise[self.amplitude] = UNSTATED_AMPLITUDE
        else:
            noise[self.amplitude] = np.linalg.norm(strain_map.inverse * noise[self.strain], axis=1)
        noise[self.rate] = self.fastest * noise[self.amplitude]
        return noise

    def _accelerations(self, strain_map):
        """`gain` and `push`."""
        model, n = self.model, self.n
        random = np.random.default_rng(0)
        places = [np.zeros(n), *random.uniform(-1.5, 1.5, (CONFIGURATIONS - 1, n))]
        masses = [model.terms(q, np.zeros(n)).M.copy() for q in places]
        rigid = [np.linalg.inv(M[:n, :n]) for M in masses]
        H = [np.linalg.inv(M) for M in masses]
        light = [(np.diag(h)[:n] / np.diag(r)).max() for h, r in zip(H, rigid, strict=True)]
        self.heavy = bool(max(light) <= LIGHT)
        joints = _largest([h[:n, :n] for h in H])
        bends = _largest([h[n:, :n] for h in H])
        strains = np.zeros((self.g, n))
        if strain_map is not None:
            strains = _largest([strain_map.rows @ h[n:, :n] for h in H])
        strength, push = self.strength, np.full(self.size, np.inf)
        if np.isfinite(strength).all():
            soft = [0.05 * part @ strength for part in (strains, bends)]
            hard = 2.0 * _largest(rigid) @ strength
            push = np.concatenate([hard, *soft, hard, soft[1]])
        if self.m:
            modes = [model.normal_modes(q)[1] for q in places]
            bends = np.maximum(bends, _largest([added_up(one, one[n:]) for one in modes]))
            if strain_map is not None:
                shown = [added_up(one, strain_map.rows @ one[n:]) for one in modes]
                strains = np.maximum(strains, _largest(shown))
        speeds, rates = joints, bends
        if not self.heavy:
            fuller, gauges = model.fuller(model.arm.most_modes + 1), model.arm.gauges
            means = [mean_accelerations(fuller, q, AVERAGED) for q in places]
            begun = [mean_accelerations(fuller, q, AVERAGED, of_velocity=True) for q in places]
            speeds = np.maximum(joints, _largest([each for each, _ in begun]))
            joints = np.maximum(joints, _largest([each for each, _ in means]))
            if strain_map is not None:
                rows = reading_rows(fuller, gauges)
                strains = np.maximum(strains, _largest([rows @ each for _, each in means]))
                shown = strain_map.inverse @ rows
                rates = np.maximum(bends, _largest([shown @ each for _, each in begun]))
                bends = np.maximum(bends, _largest([shown @ each for _, each in means]))
        return MARGIN * np.vstack([joints, strains, bends, speeds, rates]), push

    def read(self, sample, out, raw):
        """Read an `ArmSample` into `out`, shape (N,), and its (q, strain, qd) into `raw`, (2 n + g,)."""
        self._gather(
            sample.position,
            self._no_strain if sample.strain is None else sample.strain,
            self._no_modes if sample.amplitude is None else sample.amplitude,
            sample.velocity if sample.velocity_known else self._no_velocity,
            self._no_modes if sample.rate is None else sample.rate,
            out,
            raw,
        )


def _largest(arrays):
    """Largest magnitude of each element."""
    return np.abs(arrays).max(axis=0)


def added_up(shapes, parts):
    """Largest accelerations of readings after a step of the torques, per torque, (g, n), if all modes' parts add up.

    Parameters
    ----------
    shapes : ndarray, shape (n + m, k)
        Normal modes of unit modal mass; k is at most m.
    parts : ndarray, shape (g, k)
        Reading of each mode.
    """
    n = len(shapes) - shapes.shape[1]
    return np.abs(parts) @ np.abs(shapes[:n]).T


def mean_accelerations(model, q, time, of_velocity=False):
    """Mean accelerations after a step of the torques, per torque: the two blocks of the module's averaged H.

    Parameters
    ----------
    model : ArmModel
        n joints, m modes.
    q : ndarray, shape (n,)
        Joint angles [rad].
    time : float
        Time t over which they are averaged: a motion from rest covers half of them times its square [s].
    of_velocity : bool
        Whether to average over half of the time, for the change of the velocities.

    Returns
    -------
    joints : ndarray, shape (n, n)
        Of the joints [1/(kg m^2)].
    bends : ndarray, shape (m, n)
        Of the modal amplitudes, in their unit per s^2 and N m.
    """
    n = model.n_joints
    omega, shapes = model.normal_modes(q)
    weighted = shapes * np.sinc(omega * time / (2.0 * np.pi)) ** (1 if of_velocity else 2)
    both = weighted @ shapes[:n].T
    both[:n] += np.linalg.inv(model.terms(q, np.zeros(n)).M[:n, :n])
    return both[:n], both[n:]
