# SPDX-License-Identifier: Apache-2.0
r"""Detects failed strain gauges, and calibrates their bias at rest.

A reading :math:`\varepsilon_i` of gauge i is

- missing when it is not finite,
- saturated when it is at an end of the bridge's range,
- stuck when it has been the same to the last bit for `stuck_samples` samples, while another gauge of its link and
  direction (two others, if there are two) moved so far that it must have moved too. Even in the mode that strains it
  least relative to the other gauge, it must have moved by more than 8 of its resolutions,
- suspect when it does not fit the others: with more gauges than modes, the residual
  :math:`r = \varepsilon - b - R\hat\delta` of weighted least squares has the variance
  :math:`\sigma_i^2(1-H_{ii})`, with :math:`H = R(R^TWR)^{-1}R^TW`; the mean square of
  :math:`r_i/(\sigma_i\sqrt{1-H_{ii}})` is one for a good gauge, and largest for the wrong gauge.

Missing, saturated and stuck gauges are left out of the strain map if the others still give every observed mode.
Otherwise the sample is refused, since fewer gauges than modes give no amplitudes. A gauge with a suspect residual is
reported but still used: unobserved modes cause residuals too.

The bias of a gauge on an arm at rest is what it reads beyond the strain of the arm's own weight,

.. math:: b = \bar\varepsilon - R\,\delta_s(q) ,

where :math:`\delta_s` is the static deflection with held joints. Its rms error is that of one reading divided by
:math:`\sqrt N`.
"""

import numpy as np

from flexarm_dynamics.errors import MessageError, ModelError
from flexarm_dynamics.parameters import parameter

from .. import kernels
from ..arrays import some

#: Values as in flexarm_msgs/ObserverState.
GOOD, MISSING, STUCK, SATURATED, SUSPECT = range(5)
WORDS = ("good", "missing", "stuck", "saturated", "suspect")

PARAMETERS = (
    parameter("calibration_samples", 200, "-", 2, 100_000, read_only=True).described(
        "Number of samples at rest that ~/calibrate_gauges averages."
    ),
    parameter("stuck_samples", 50, "-", 2, 100_000, read_only=True).described(
        "A gauge is stuck after this many equal readings while the others move; a bad gauge is used again"
        " after as many good readings."
    ),
)


def resolution(gauges):
    """Noise and rounding of each gauge, (gauges,) [strain]; if the arm file has neither, 1/1000 of full scale."""
    return np.array([g.uncertainty or 1e-3 * g.full_scale for g in gauges])


def min_travel(rows, gauges):
    """Smallest strain of gauge i per strain of gauge j, over the modes that strain both, shape (gauges, gauges).

    It is zero for gauges of different links or directions, and on the diagonal. `rows` are the strain map's.
    """
    count = len(gauges)
    least = np.zeros((count, count))
    for i, a in enumerate(gauges):
        for j, b in enumerate(gauges):
            if i == j or (a.link, a.direction) != (b.link, b.direction):
                continue
            strains = np.abs(rows[j]) > 1e-9 * np.abs(rows[j]).max(initial=0.0)
            if strains.any():
                least[i, j] = (np.abs(rows[i, strains]) / np.abs(rows[j, strains])).min()
    return least


class GaugeHealth:
    """Judges the gauges sample by sample, and maps the strains of those that can be trusted.

    Parameters
    ----------
    model : ArmModel
    strain_map : StrainMap
        Strain map of the same model.
    stuck_samples : int
        See `PARAMETERS`.

    Attributes
    ----------
    health : ndarray of uint8, shape (gauges,)
        `GOOD`, `MISSING`, `STUCK`, `SATURATED` or `SUSPECT`.
    lost : tuple of int
        Gauges left out of the last amplitudes; indices, ascending.
    doubted : ndarray of bool, shape (gauges,)
        Gauges that other checks have found wrong. They are suspect, and left out if the others suffice.
    """

    #: A gauge is stuck if it should have moved by this many resolutions; noise spans about as many.
    TRAVEL = 8.0
    #: Rms residual, in its own standard deviations, beyond which a gauge is suspect.
    RESIDUAL = 6.0

    def __init__(self, model, strain_map, stuck_samples=50):
        gauges = model.arm.gauges
        self.strain_map, self.stuck_samples = strain_map, stuck_samples
        self.names = model.arm.gauge_names
        self._low, self._high = np.array([g.range for g in gauges]).reshape(-1, 2).T
        self._resolution = resolution(gauges)
        self._min_travel = min_travel(strain_map.rows, gauges)
        places = [(g.link, g.direction) for g in gauges]
        # A single gauge that jumps may itself be broken; two that jump have seen the arm move.
        self._witnesses = np.clip((self._min_travel > 0.0).sum(axis=1), 1, min(2, len(gauges)))
        self._mates = np.array([[a == b for b in places] for a in places])
        free = 1.0 - np.einsum("ij,ji->i", strain_map.rows, strain_map.inverse)
        redundant = free > 1e-6
        # Makes the mean square of a residual one; a gauge that no other one checks has no residual.
        self._weight = np.where(
            redundant, 1.0 / (self._resolution**2 * np.maximum(free, 1e-6)), 0.0
        )
        self._redundant = bool(redundant.any())
        self._mapped = np.zeros(len(strain_map.mode_names))
        self._kernels = kernels.compiled()
        self.health = np.zeros(len(gauges), np.uint8)
        self.doubted = np.zeros(len(gauges), bool)
        self.reset()

    def reset(self):
        """Forget the past, for a new session of the source."""
        count = self.health.size
        self.health[:] = GOOD
        self.lost = ()
        self._last, self._same = np.full(count, np.nan), np.zeros(count, int)
        self._hold, self._holding = np.zeros(count, int), False
        self._seen = np.full((2, count, count), np.nan)
        self._min_seen, self._max_seen = self._seen
        self._square = np.zeros(count)

    def doubt(self, indices):
        """Leave out the gauges with these `indices`, until `doubted` is cleared."""
        self.doubted[list(indices)] = True

    def update(self, strain):
        """Judge the readings, shape (gauges,), of a new sample; runs on the control path."""
        self.health[:] = GOOD
        if self._all_well(strain):
            return
        outside = ~((strain > self._low) & (strain < self._high))  # NaN too
        self.health[self._stuck(strain, outside)] = STUCK
        if some(outside):
            self.health[outside] = SATURATED
            self.health[~np.isfinite(strain)] = MISSING
        if some(self.doubted):
            self.health[self.doubted & (self.health == GOOD)] = SUSPECT
        if self._holding or some(self.health):
            self._hold -= 1
            np.maximum(self._hold, 0, out=self._hold)
            self._hold[self.health != GOOD] = self.stuck_samples
            self._holding = bool(self._hold.any())
        if self._redundant and not self._holding:
            self._judge_residual(strain)

    def _all_well(self, strain):
        """Whether all gauges are good, as in nearly all samples; if so, the readings are noted."""
        if self._holding or np.count_nonzero(self.doubted):
            return False
        if not self._kernels.all_well(
            strain, self._low, self._high, self._last, self._same, self._seen
        ):
            return False
        if self._redundant:
            self._judge_residual(strain)
        return True

    def _stuck(self, strain, bad):
        moved = strain != self._last
        self._last[:] = strain
        if moved.all():
            self._same[:] = 0
            self._max_seen[:] = self._min_seen[:] = np.where(bad, np.nan, strain)
            return []
        self._same += 1
        self._same[moved] = 0
        # How far every gauge has travelled since gauge i last moved.
        seen = np.where(bad, np.nan, strain)
        self._max_seen[moved] = seen
        self._min_seen[moved] = seen
        np.fmax(self._max_seen, seen, out=self._max_seen)
        np.fmin(self._min_seen, seen, out=self._min_seen)
        still = self._same >= self.stuck_samples
        if not still.any():
            return []
        travel = self._max_seen - self._min_seen - self.TRAVEL * self._resolution
        travel = np.sort(np.nan_to_num(self._min_travel * travel), axis=1)
        travel = travel[np.arange(travel.shape[0]), -self._witnesses]
        return still & (travel > self.TRAVEL * self._resolution)

    def _judge_residual(self, strain):
        strain_map = self.strain_map
        residual = strain - strain_map.bias
        residual -= strain_map.rows @ strain_map.amplitudes(strain, self._mapped)
        self._square += (residual**2 * self._weight - self._square) / self.stuck_samples
        if not np.count_nonzero(self._square > self.RESIDUAL**2):
            return
        # A wrong gauge spoils the others' residuals too, so only the largest of its link and direction is suspect.
        largest = np.where(self._mates, self._square, 0.0).max(axis=1)
        suspect = (self._square > self.RESIDUAL**2) & (self._square > 0.99 * largest)
        self.health[suspect] = SUSPECT

    def amplitudes(self, strain, out=None):
        """Modal amplitudes from the usable gauges, shape (modes,) [m, rad]; `strain` and `out` as in `StrainMap`.

        If the usable gauges don't give all observed modes, a `MessageError` names the others and the missing modes.
        """
        self.lost = self._left_out(strain) if self._holding else ()
        return self.strain_map.amplitudes_without(self.lost, strain, out)

    def _left_out(self, strain):
        # A bad gauge is used again only after a while, so that a loose wire does not switch maps at each contact.
        held = tuple(np.flatnonzero(self._hold).tolist())
        if self.strain_map.possible_without(held):
            return held
        bad = tuple(np.flatnonzero((self.health != GOOD) & (self.health != SUSPECT)).tolist())
        if self.strain_map.possible_without(bad):
            return bad
        lost = ", ".join(f"{self.names[i]} ({WORDS[self.health[i]]})" for i in bad)
        modes = ", ".join(self.strain_map.unobservable_without(bad))
        left = ", ".join(n for i, n in enumerate(self.names) if i not in bad)
        raise MessageError(
            f"can't be used: without {lost} the gauges ({left or 'none'}) can't give {modes}",
            field=f"strain of {self.names[bad[0]]}",
            value=float(strain[bad[0]]),
        )

    def warnings(self):
        """One sentence for every gauge that is not good."""
        found = []
        for i, name in enumerate(self.names):
            state = self.health[i]
            if state == SUSPECT:
                found.append(
                    f"gauge {name} does not fit the others ({np.sqrt(self._square[i]):.0f} times its noise):"
                    " calibrate, check its gain, or the arm bends in modes that are not observed"
                )
            elif state != GOOD:
                left_out = ", left out" if i in self.lost else ""
                found.append(f"gauge {name} is {WORDS[state]}{left_out}")
            elif i in self.lost:
                found.append(f"gauge {name} was bad, left out")
        return found


class BiasCalibration:
    """Computes the bias of the gauges from the last samples of an arm at rest.

    Parameters
    ----------
    model : ArmModel
    strain_map : StrainMap
        Strain map with the rows of the gauges.
    samples : int
        Number of samples that are averaged.
    """

    #: Mean joint speed [rad/s], and span of the joint angle beyond two encoder counts [rad], of an arm at rest.
    REST_SPEED, REST_ANGLE = 0.01, 2e-3
    #: Rms strain about the mean, in resolutions, and span of a torque as a fraction of its limit, at rest.
    REST_STRAIN, REST_TORQUE = 4.0, 0.05

    def __init__(self, model, strain_map, samples=200):
        arm = model.arm
        self.model, self.strain_map, self.samples = model, strain_map, samples
        n = len(arm.joints)
        self._kept = np.zeros((samples, 3 * n + len(arm.gauges)))
        self._position, self._velocity, self._torque, self._strain = np.split(
            self._kept, (n, 2 * n, 3 * n), axis=1
        )
        self._keep = kernels.compiled().keep
        counts = np.array([j.encoder_counts or np.inf for j in arm.joints])
        self._span = self.REST_ANGLE + 4.0 * np.pi / counts
        self._resolution = resolution(arm.gauges)
        self._ranges = np.array([g.range for g in arm.gauges]).reshape(-1, 2).T
        self.reset()

    def reset(self):
        """Forget the samples, for a new session of the source."""
        self.count, self._next = 0, 0

    def push(self, sample):
        """Keep a sample that has strains; runs on the control path."""
        row = self._kept[self._next]
        self._keep(sample.position, sample.velocity, sample.torque, sample.strain, row)
        self._next = (self._next + 1) % self.samples
        self.count = min(self.count + 1, self.samples)

    @property
    def last(self):
        """The newest strains, shape (gauges,)."""
        return self._strain[self._next - 1]

    def bias(self):
        """The new bias, shape (gauges,) [strain].

        Raises a `MessageError` if there are too few samples, a gauge is bad, or the arm is not at rest, and a
        `ModelError` if it has no static deflection here.
        """
        if self.count < self.samples:
            raise MessageError(
                "are not enough samples yet",
                field="calibration_samples",
                value=self.count,
                limit=self.samples,
                hint="call again",
            )
        self._check_gauges()
        self._check_rest()
        q = self._position.mean(axis=0)
        found = self._strain.mean(axis=0) - self.strain_map.rows @ self._static(q)
        for name, b, high in zip(self.model.arm.gauge_names, found, self._ranges[1], strict=True):
            if not abs(b) < high:
                raise MessageError(
                    "microstrain is beyond full scale",
                    field=f"bias of {name}",
                    value=float(1e6 * b),
                    limit=float(1e6 * high),
                    hint="check the bridge, and the payload and gravity of the arm file",
                )
        return found

    def _static(self, q):
        """Amplitudes of the observed modes under the arm's own weight [m, rad]."""
        delta = self.model.static_deflection(q)
        if not np.isfinite(delta).all():
            raise ModelError(
                f"has no static deflection of {self.model.arm.name}", field="q", value=q.tolist()
            )
        names = self.model.mode_names
        return np.array([delta[names.index(n)] for n in self.strain_map.mode_names])

    def _check_gauges(self):
        for name, values, low, high in zip(
            self.model.arm.gauge_names, self._strain.T, *self._ranges, strict=True
        ):
            field = f"strain of {name}"
            if not np.isfinite(values).all():
                raise MessageError("is missing", field=field, hint="check the wires of the gauge")
            if values.min() <= low or values.max() >= high:
                problem, hint = "microstrain is at the end of the range", "balance the bridge first"
                raise MessageError(problem, field=field, value=float(1e6 * values[-1]), hint=hint)

    def _check_rest(self):
        arm = self.model.arm
        max_torque = self.REST_TORQUE * arm.torque_limits
        max_strain = self.REST_STRAIN * self._resolution
        speed = np.abs(self._velocity.mean(axis=0))
        torque = np.ptp(self._torque, axis=0)  # NaN where the source does not know it
        rest_speed = np.full(speed.size, self.REST_SPEED)
        for field, names, values, limits, unit in (
            ("velocity", arm.joint_names, speed, rest_speed, "rad/s"),
            ("change of position", arm.joint_names, np.ptp(self._position, axis=0), self._span, "rad"),
            ("change of torque", arm.joint_names, np.where(np.isnan(torque), 0.0, torque), max_torque, "N m"),
            ("rms strain", arm.gauge_names, 1e6 * self._strain.std(axis=0), 1e6 * max_strain, "microstrain"),
        ):  # fmt: skip
            moving = ~(values <= limits)  # NaN too
            if moving.any():
                i = int(np.argmax(moving))
                raise MessageError(
                    f"{unit} is not rest",
                    field=f"{field} of {names[i]}",
                    value=float(f"{values[i]:.3g}"),
                    limit=float(f"{limits[i]:.3g}"),
                    hint="call again at rest",
                )


def calibration_text(names, old, new, samples):
    """Describe a calibration, in microstrain."""
    each = ", ".join(
        f"{n} {1e6 * b:+.2f} (was {1e6 * a:+.2f})" for n, a, b in zip(names, old, new, strict=True)
    )
    return f"bias [microstrain]: {each}; mean of {samples} samples"


def calibration_yaml(names, bias):
    """Lines for the gauges of the arm file."""
    return "\n".join(f"bias: {b:.4e}  # gauge {n}" for n, b in zip(names, bias, strict=True))
