# SPDX-License-Identifier: Apache-2.0
r"""Runs the checks of an arm's readings, and decides what follows from them.

`judge` checks a sample before the observer takes it, and replaces a single outlier. `take` checks it again once the
estimate is sent, as the past of the next sample. The next sample then carries what is found:

============================================  =======================================================
a joint position that jumps or stands still   DISTRUSTED: the loop can't do without it
a joint velocity that does not fit            STOP; the estimate is used in its place
a gauge that jumps, or stands still           STOP, without that gauge; DISTRUSTED if the others don't suffice
strains of wrong sign, exchanged gauges       the same
a gauge whose zero drifts                     STOP, without that gauge, or with its drift taken out
strains and a joint that contradict           STOP
modal amplitudes that jump                    STOP, amplitudes from the strains; DISTRUSTED without strains
modal rates that do not fit                   STOP; they are not used
amplitudes and strains that contradict        STOP, amplitudes from the strains, if the amplitudes have jumped;
                                              otherwise DISTRUSTED, as it does not show which of the two is wrong
more than `jumps.FREQUENT` outliers           STOP
============================================  =======================================================
"""

import numpy as np

from flexarm_dynamics.parameters import parameter

from ...arrays import some
from ...loop.samples import ArmSample
from .agreement import Agreement
from .amplitudes import SourceAmplitudes
from .channels import Channels
from .doubts import Doubts
from .jumps import BRIDGED, LEARNT, Jumps
from .standstill import Standstill
from .strain_law import StrainLaw
from .zero_drift import TOLERANCE

PARAMETERS = (
    parameter("plausibility", True).described(
        "Whether readings are compared with each other, with the last ones and with the model: single outliers are"
        " replaced, a sensor in doubt is named, and the arm is stopped or its torque switched off."
    ),
    parameter("payload_tolerance", TOLERANCE, "-", 0.0, 100.0, read_only=True).described(
        "Fraction by which the payload may differ from the arm file's before strains and motion count as contradictory;"
        " 2.0: from none to three times as much. A smaller value finds a gauge that drifts sooner."
    ),
)

#: The mean intervals of the stamps over a short and a long time may differ by this factor.
RATE_CHANGE = 1.5
#: Name of the doubt about gauges whose zero drifts.
DRIFT = "strain of drifting gauges"
#: Weight of the short mean in the long one, and number of samples for which they must differ.
SLOWLY, RATE_SAMPLES = 0.002, 100


class Monitor:
    """Judges the readings of an arm, sample by sample.

    Parameters
    ----------
    model : ArmModel
    strain_map : StrainMap or None
    gauges : GaugeHealth or None
        It leaves out gauges in doubt.
    payload : float
        Fraction by which the payload may differ from the arm file's [-].

    Attributes
    ----------
    doubts : Doubts
    jumps : Jumps
    stamp_ns : int
        Stamp of the last sample that was taken [ns].
    """

    def __init__(self, model, strain_map, gauges, payload=TOLERANCE):
        c = self.channels = Channels(model, strain_map)
        self._map, self._gauges = strain_map, gauges
        self.doubts, self.jumps = Doubts(), Jumps(c)
        self._agreement, self._standstill = Agreement(c), Standstill(c)
        self._law = StrainLaw(c, strain_map, payload) if c.g and c.m else None
        self._amplitudes = SourceAmplitudes(c, strain_map) if c.g and c.m else None
        self._value, self._raw = np.zeros(c.size), np.zeros(2 * c.n + c.g)
        self._strain, self._amplitude, self._rates = np.zeros(c.g), np.zeros(c.m), np.zeros(c.m)
        self.stamp_ns = 0
        self.reset()

    def reset(self):
        """Forget the past, doubts included, for a new session or after a gap."""
        self.doubts.forget()
        self.jumps.reset()
        self._agreement.reset()
        self._standstill.reset()
        if self._law is not None:
            self._law.reset()
            self._amplitudes.reset()
        self._long_period, self._off_rate, self._samples = 0.0, 0, 0
        self._has_strain = False
        if self._gauges is not None:
            self._gauges.doubted[:] = False

    @property
    def bridged(self):
        """Number of replaced readings by sensor, for sensors with at least one."""
        names, counts = self.channels.names, self.jumps.bridged
        return {names[i]: int(counts[i]) for i in np.flatnonzero(counts)}

    def judge(self, sample, dt, steps):
        """Judge a new sample; `take` remembers it.

        Parameters
        ----------
        sample : ArmSample
            Readings that can't be true are replaced, or taken out.
        dt : float
            Time since the last one [s]; 0.0 at a start.
        steps : int
            Number of samples since then.

        Returns
        -------
        bool
            Whether the observer must start again because a joint's position has jumped for good.
        """
        c, value = self.channels, self._value
        c.read(sample, value, self._raw)
        self._has_strain = sample.strain is not None
        self._dt, self._steps = dt, steps
        if dt == 0.0:
            self.reset()
            self._torque = sample.torque
            return False
        outliers, lasting = self.jumps.judge(value, sample.torque, dt, steps)
        if outliers is not None and outliers.size:
            self._replace(sample, value)
        afresh = False
        if lasting is not None:
            afresh = self._jumped(sample, lasting)
        for i in self.jumps.frequent:
            text = f"{c.names[i]} has many outliers: {self.jumps.bridged[i]} so far"
            self.doubts.add(c.names[i], ArmSample.STOP, text, sample.stamp_ns)
        self._take_out(sample)
        return afresh

    def _replace(self, sample, value):
        """Write replaced readings into the sample, in the monitor's own arrays."""
        c = self.channels
        sample.position[:] = value[c.position]
        if sample.velocity_known:
            sample.velocity[:] = value[c.velocity]
        for name, part, own in (
            ("strain", c.strain, self._strain),
            ("amplitude", c.amplitude, self._amplitude),
            ("rate", c.rate, self._rates),
        ):
            if getattr(sample, name) is not None:
                own[:] = value[part]
                setattr(sample, name, own)

    def _jumped(self, sample, lasting):
        """Note doubts about readings that jumped for good; returns whether the observer must start again."""
        c, jumps, stamp = self.channels, self.jumps, sample.stamp_ns
        strains = [int(i) - c.strain.start for i in lasting if c.strain.start <= i < c.strain.stop]
        still = self._standstill.still
        if c.g and (still[: c.n + c.g] >= BRIDGED - 1).all():
            self._frozen(stamp)
            return self._afresh(lasting)
        for i in lasting:
            name, unit = c.names[i], f" {c.units[i]}".rstrip()
            by = jumps.read(i) - jumps.line(i)
            text = f"{name} jumped by {by:.3g}{unit}, {jumps.bound(i):.2g}{unit} are possible"
            if i < c.n:
                if still[i] >= BRIDGED - 1:
                    text = (
                        f"{name} stands still in the middle of a motion, {abs(by):.2g} rad behind"
                    )
                elif not c.count[i]:
                    text += "; state encoder_counts in the arm file if it is rounded"
                self.doubts.add(name, ArmSample.DISTRUSTED, text, stamp)
            elif c.velocity.start <= i < c.velocity.stop:
                self.doubts.add(name, ArmSample.STOP, text, stamp)
            elif c.amplitude.start <= i < c.amplitude.stop:
                degree = ArmSample.STOP if self._has_strain else ArmSample.DISTRUSTED
                self.doubts.add(name, degree, text, stamp)
            elif i >= c.rate.start:
                self.doubts.add(name, ArmSample.STOP, text, stamp)
        if strains:
            names = self._named(strains)
            by = ", ".join(
                f"{1e6 * (jumps.read(c.strain.start + i) - jumps.line(c.strain.start + i)):.3g}"
                for i in strains
            )
            if (still[c.n + np.array(strains)] >= BRIDGED - 1).all():
                text = f"strain of {names} stands still in the middle of a motion"
            else:
                text = self._wiring(strains) or f"strain of {names} jumped by {by} microstrain"
            self._without(strains, text, stamp)
        return self._afresh(lasting)

    def _afresh(self, lasting):
        """Whether the observer must start again after these jumps."""
        if not (lasting < self.channels.n).any():
            return False
        self._agreement.reset()
        if self._law is not None:
            self._law.reset()
        return True

    def _wiring(self, strains):
        """Text that names the wiring that explains jumped strains; empty if none does."""
        jumps, first = self.jumps, self.channels.strain.start
        was = np.array([jumps.line(first + i) for i in strains])
        now = np.array([jumps.read(first + i) for i in strains])
        bound = 3.0 * np.array([jumps.bound(first + i) for i in strains]) + 0.1 * np.abs(now - was)
        names = self._named(strains)
        if (np.abs(now + was) < bound).all():
            return f"strain of {names} has the wrong sign since it jumped"
        if len(strains) == 2 and (np.abs(now - was[::-1]) < bound).all():
            return f"strain of {names}: the gauges are exchanged since it jumped"
        return ""

    def _named(self, indices):
        """Names of gauges."""
        if len(indices) == self.channels.g > 2:
            return "all gauges"
        return " and ".join(self.channels.model.arm.gauge_names[i] for i in indices)

    def _without(self, indices, text, stamp_ns):
        """Leave gauges out, or distrust the state if the others don't suffice."""
        self._gauges.doubt(indices)
        lost = tuple(np.flatnonzero(self._gauges.doubted).tolist())
        enough = self._map.possible_without(lost)
        degree = ArmSample.STOP if enough else ArmSample.DISTRUSTED
        self.doubts.add(f"strain of {self._named(indices)}", degree, text, stamp_ns)

    def _take_out(self, sample):
        """Take readings in doubt out of the sample, if the loop can do without them."""
        c, doubts = self.channels, self.doubts
        if doubts.trust == ArmSample.TRUSTED:
            return
        if sample.velocity_known and any(doubts.about(c.names[i]) for i in _range(c.velocity)):
            sample.velocity_known = False
        if sample.strain is not None and any(doubts.about(c.names[i]) for i in _range(c.amplitude)):
            sample.amplitude = None
        if sample.rate is not None and any(doubts.about(c.names[i]) for i in _range(c.rate)):
            sample.rate = None

    def take(self, sample):
        """Remember a sample that the observer has taken, and look for errors that show over several samples.

        Parameters
        ----------
        sample : ArmSample
        """
        stamp = sample.stamp_ns
        if self._dt > 0.0:
            self._compare(sample, stamp)
        self.jumps.take(self._value, 1e-9 * stamp) if self._dt > 0.0 else self._begin(stamp)
        self._samples += 1
        self.doubts.expire(stamp)
        if (
            self._gauges is not None
            and some(self._gauges.doubted)
            and not self.doubts.about_any("strain of")
        ):
            self._gauges.doubted[:] = False
        self.stamp_ns = stamp

    def mark(self, sample):
        """Set `trust` and `doubt` of a sample, or of its repetition, unless those of its source are as severe."""
        if self.doubts.trust > sample.trust:
            sample.trust, sample.doubt = self.doubts.trust, self.doubts.text

    def _begin(self, stamp_ns):
        """Remember the first sample."""
        self.jumps.judge(self._value, self._torque, 1.0, 1)
        self.jumps.take(self._value, 1e-9 * stamp_ns)
        self._agreement.update(self._value, 1.0, 0.0, self.jumps.torque_change)

    def _compare(self, sample, stamp):
        c, dt, jumps = self.channels, self._dt, self.jumps
        noise = jumps.rms[c.strain]
        joints, gauges, speeds, frame = self._standstill.update(
            self._raw, sample.torque, noise, dt, sample.amplitude
        )
        pairs = self._agreement.update(self._value, dt, jumps.jitter, jumps.torque_change)
        compared, wiring = False, None
        if self._law is not None and self._has_strain:
            strain = self._value[c.strain]
            compared, wiring = self._law.update(sample.position, strain, sample.velocity, dt, noise)
        self._watch_rate(stamp)
        if self._samples < LEARNT:
            return
        if self._amplitudes is not None:
            self._compare_amplitudes(stamp)
        still = self._standstill.still
        if frame:
            self._frozen(stamp)
        for j in joints:
            text = f"{c.names[j]} does not answer the torque: the same for {still[j]} samples"
            self.doubts.add(c.names[j], ArmSample.DISTRUSTED, text, stamp)
        if gauges.size and not frame:
            count = still[c.n + gauges].min()
            text = f"strain of {self._named(gauges)} stands still for {count} samples"
            self._without(gauges, text, stamp)
        for j in speeds:
            name, count = c.names[c.velocity.start + j], still[c.n + c.g + j]
            text = f"{name} stands still for {count} samples in the middle of a motion"
            self.doubts.add(name, ArmSample.STOP, text, stamp)
        if pairs is not None:
            self._disagree(pairs, stamp)
        if wiring is not None:
            words, members, _ = self._law.hypotheses[wiring]
            before, after = self._law.misfits
            text = f"{words}; misfit to the motion {before:.2g}, so read {after:.2g}"
            self._without(members, text, stamp)
        elif compared:
            self._drifting(stamp)

    def _compare_amplitudes(self, stamp):
        """Note a doubt about amplitudes that the source's own strains contradict."""
        c, check = self.channels, self._amplitudes
        if self._gauges is not None and some(self._gauges.doubted):
            check.reset()
            return
        if not check.update(self._value, self._dt):
            return
        jumped = [name for name in c.names[c.amplitude] if self.doubts.about(name)]
        if jumped:  # this jump was the beginning, and the source's own strains did not show it
            for name in jumped:
                self.doubts.add(name, ArmSample.STOP, "", stamp, for_good=True)
        else:
            modes = [c.model.mode_names[i] for i in range(c.m)]
            of = modes[0] if c.m == 1 else f"{', '.join(modes[:-1])} and {modes[-1]}"
            text = (
                f"modal_amplitude of {of} and the strains contradict each other: by"
                f" {1e6 * check.difference:.3g} microstrain, {1e6 * check.bound:.2g} are possible"
            )
            self.doubts.add("modal_amplitude or strain", ArmSample.DISTRUSTED, text, stamp)

    def _drifting(self, stamp):
        """Note doubts about strains that the motion does not explain."""
        c, law = self.channels, self._law
        drift = law.drift
        if not drift.found.size:
            if some(drift.doubted) and not self.doubts.about_any(DRIFT):
                drift.doubted[:] = False
            return
        worst = drift.found[np.argmax((np.abs(drift.residual) / drift.bound)[drift.found])]
        by = f"{1e6 * drift.residual[worst]:.3g} microstrain, {1e6 * drift.bound[worst]:.2g} are possible"
        joint = law.drift.joint(law.drive)
        gauges = self._named(drift.found)
        if joint is not None:
            text = f"{c.names[joint]} and strain of {gauges} contradict each other, or something pushes the arm: {by}"
            self.doubts.add(f"{c.names[joint]} or strain", ArmSample.STOP, text, stamp)
            return
        text = f"strain of {gauges} drifts, or something pushes the arm: the motion leaves {by}"
        self.doubts.add(DRIFT, ArmSample.STOP, text, stamp)
        lost = tuple(np.flatnonzero(self._gauges.doubted).tolist())
        if self._map.possible_without(tuple(sorted({*lost, *drift.found.tolist()}))):
            self._gauges.doubt(drift.found)
        else:
            drift.doubted[drift.found] = True

    def correct(self, amplitude, inverse):
        """Subtract drifts of gauges that can't be left out from the modal amplitudes, shape (m,).

        Parameters
        ----------
        amplitude : ndarray, shape (m,)
            Amplitudes from the strains.
        inverse : ndarray, shape (m, g)
            Inverse of the strain map that gave them.
        """
        if self._law is not None and some(self._law.drift.correction):
            amplitude -= inverse @ self._law.drift.correction

    def calibrated(self):
        """Learn the zeros of the gauges again, since they have another bias now."""
        if self._law is not None:
            self._law.reset()
            self._amplitudes.reset()

    def _frozen(self, stamp_ns):
        text = "the frame is frozen: joint positions and strains stand still together"
        self.doubts.add("frame", ArmSample.DISTRUSTED, text, stamp_ns)

    def _disagree(self, pairs, stamp):
        """Note doubts about rates that do not fit their values."""
        c, agreement = self.channels, self._agreement
        for j in pairs:
            value, rate = (c.names[i] for i in agreement.pairs[:, j])
            if agreement.stands(j) or (j < c.n and self._standstill.still[j] >= BRIDGED):
                text = f"{value} stands still, {rate} is not zero"
                spare = j >= c.n and self._has_strain
                degree = ArmSample.STOP if spare else ArmSample.DISTRUSTED
                self.doubts.add(value, degree, text, stamp)
            else:
                text = f"{rate} {agreement.words(j)}"
                self.doubts.add(rate, ArmSample.STOP, text, stamp, for_good=True)

    def _watch_rate(self, stamp_ns):
        period = self.jumps.period
        if self._samples < LEARNT:
            self._long_period = period
            return
        if 1.0 / RATE_CHANGE < period / self._long_period < RATE_CHANGE:
            self._long_period += SLOWLY * (period - self._long_period)
            self._off_rate = 0
            return
        self._off_rate += 1
        if self._off_rate < RATE_SAMPLES:
            return
        text = (
            f"header.stamp: samples are {1e3 * period:.3g} ms apart,"
            f" and were {1e3 * self._long_period:.3g} ms"
        )
        self.doubts.add("header.stamp", ArmSample.STOP, text, stamp_ns)
        self._long_period, self._off_rate = period, 0


def _range(part):
    return range(part.start, part.stop)
