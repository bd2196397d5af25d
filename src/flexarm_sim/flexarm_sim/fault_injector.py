# SPDX-License-Identifier: Apache-2.0
"""Faults put into what the simulator publishes, so that the answers to them can be tested; the plant knows nothing.

A fault is one line, "SIGNAL KIND [key=value ...]", as docs/fault_injection.md lists them. Times are simulated
seconds since the start of the session; the same lines and seeds give the same messages. Nothing here knows ROS.
"""

import math
from dataclasses import dataclass, field

import numpy as np

from flexarm_dynamics.errors import ParameterError
from flexarm_dynamics.shown import show

#: What the kind `huge` reads.
HUGE = 1e12
#: The longest delay [s].
LONGEST_DELAY = 10.0

#: Field to the names of its entries.
FIELDS = {
    "joint_position": "joint_names",
    "joint_velocity": "joint_names",
    "joint_torque": "joint_names",
    "strain": "gauge_names",
    "modal_amplitude": "mode_names",
}
WINDOW = ("from", "for")
#: Of one or all entries of a field: keys, and which of them have to be there.
VALUE_KINDS = {
    "nan": ((), ()),
    "inf": ((), ()),
    "huge": ((), ()),
    "stick": ((), ()),
    "bias": (("by",), ("by",)),
    "saturate": (("at",), ("at",)),
    "delay": (("by",), ("by",)),
}
#: Of a whole field.
FIELD_KINDS = {"drop": ((), ()), "short": ((), ()), "long": ((), ())}
#: Of the other signals.
OTHER_KINDS = {
    "state": {
        "drop": (("share", "seed"), ()),
        "delay": (("by",), ("by",)),
        "duplicate": ((), ()),
        "swap": ((), ()),
        "future": (("by",), ("by",)),
    },
    "clock": {"jump": (("by", "at"), ("by", "at"))},
    "names": {"reorder": ((), ()), "wrong": ((), ())},
}


@dataclass
class Sample:
    """What one `arm_state` says.

    Attributes
    ----------
    sequence, stamp_ns : int
    names : dict of str to list of str
        ``joint_names``, ``gauge_names``, ``mode_names``.
    values : dict of str to ndarray or None
        `FIELDS` and ``modal_rate``; None: not known, empty on the topic.
    """

    sequence: int
    stamp_ns: int
    names: dict = field(default_factory=dict)
    values: dict = field(default_factory=dict)


@dataclass(frozen=True)
class Fault:
    """One fault.

    Attributes
    ----------
    signal, kind : str
    entry : str
        Joint, gauge or mode; empty: all of the field.
    keys : tuple of (str, float)
        As given.
    """

    signal: str
    kind: str
    entry: str = ""
    keys: tuple = ()

    def __str__(self):
        where = f"{self.signal}.{self.entry}" if self.entry else self.signal
        return " ".join([where, self.kind, *(f"{k}={v!r}" for k, v in self.keys)])

    def get(self, key, default):
        """Value of a key."""
        return dict(self.keys).get(key, default)

    def acts(self, time):
        """Whether it acts at `time` [s]; a sample's time is taken to the nanosecond."""
        begin = self.get("at", 0.0) if self.signal == "clock" else self.get("from", 0.0)
        return begin - 1e-9 <= time < begin + self.get("for", math.inf) - 1e-9


def parse(text, arm):
    """One fault from its line.

    Parameters
    ----------
    text : str
    arm : Arm
        Whose joints, gauges and modes there are.

    Returns
    -------
    Fault

    Raises
    ------
    ParameterError
        Naming the line, the word, and what may stand there.
    """

    def refuse(word, allowed):
        raise ParameterError(f"faults: {show(text)}: {show(word)}: {allowed}")

    words = text.split()
    if len(words) < 2:
        refuse(text, 'a fault is "SIGNAL KIND [key=value ...]"')
    signal, dot, entry = words[0].partition(".")
    if signal not in FIELDS and signal not in OTHER_KINDS:
        refuse(words[0], f"no such signal; there are {', '.join((*FIELDS, *OTHER_KINDS))}")
    if dot and signal not in FIELDS:
        refuse(words[0], f"{signal} has no parts")
    if dot:
        names = _names(arm)[FIELDS[signal]]
        if entry not in names:
            refuse(words[0], f"{signal} is of {', '.join(names) or 'nothing on this arm'}")
    kinds = OTHER_KINDS.get(signal) or (VALUE_KINDS if dot else {**FIELD_KINDS, **VALUE_KINDS})
    if words[1] not in kinds:
        more = " (one entry can't be missing: take nan)" if dot and words[1] in FIELD_KINDS else ""
        refuse(words[1], f"{words[0]} can be {', '.join(kinds)}{more}")
    allowed, needed = kinds[words[1]]
    if signal != "clock":
        allowed = (*allowed, *WINDOW)
    keys = {}
    for word in words[2:]:
        key, equals, value = word.partition("=")
        if key not in allowed or not equals:
            refuse(word, f"{words[1]} takes {', '.join(f'{k}=…' for k in allowed)}")
        if key in keys:
            refuse(word, f"{key} is given twice")
        keys[key] = _number(key, value, signal, words[1], lambda why, word=word: refuse(word, why))
    for key in needed:
        if key not in keys:
            refuse(words[1], f"needs {key}=…")
    return Fault(signal, words[1], entry, tuple(keys.items()))


def _number(key, text, signal, kind, refuse):
    """The checked value of a key."""
    try:
        value = int(text) if key == "seed" else float(text)
    except (ValueError, OverflowError):
        refuse("a seed is an integer" if key == "seed" else "not a number")
    if not math.isfinite(value):
        refuse("not finite")
    low, high = -1e9, 1e9
    if key in ("from", "at"):
        low = 0.0
    elif key == "for":
        low = 1e-9
    elif key == "share":
        low, high = 0.0, 1.0
    elif key == "seed":
        low, high = 0, 2**31 - 1
    elif kind == "delay":
        low, high = 1e-9, LONGEST_DELAY
    if not low <= value <= high:
        refuse(f"must lie between {low:g} and {high:g}")
    return value


def _names(arm):
    return {
        "joint_names": arm.joint_names,
        "gauge_names": arm.gauge_names,
        "mode_names": arm.observed_modes,
    }


class FaultInjector:
    """Turns each sample into the messages that are sent.

    Parameters
    ----------
    arm : Arm
    lines : sequence of str
        Faults; they act in this order, those of `state` last.

    Attributes
    ----------
    faults : tuple of Fault
    """

    def __init__(self, arm, lines=()):
        self._arm = arm
        self.faults = ()
        self.set(lines)

    @property
    def idle(self):
        """Whether there is nothing that could change a message, now or later."""
        return not self.faults

    def set(self, lines):
        """Take other faults, all or none; what the ones before have kept is forgotten.

        Raises
        ------
        ParameterError
        """
        self.faults = tuple(parse(line, self._arm) for line in lines)
        self.reset()

    def reset(self):
        """A new session: times start anew."""
        self._kept = {}  # number of a fault to what it keeps
        self._waiting = []  # (due [ns], sample), in the order they came
        self._swapped = None

    def outgoing(self, sample, time):
        """Messages to be sent now, in order; none, one, or several.

        Parameters
        ----------
        sample : Sample
            The true one; its arrays are copied, not changed.
        time : float
            Since the start of the session [s].

        Returns
        -------
        list of Sample
        """
        now = sample.stamp_ns
        out = Sample(
            sample.sequence,
            sample.stamp_ns,
            {k: list(v) for k, v in sample.names.items()},
            {k: None if v is None else np.array(v) for k, v in sample.values.items()},
        )
        for number, fault in enumerate(self.faults):
            if fault.signal in FIELDS:
                self._value_fault(number, fault, out, time)
        for fault in self.faults:
            if fault.acts(time):
                _whole_fault(fault, out)
        return self._line(out, now, time)

    def _value_fault(self, number, fault, out, time):
        """A fault of one field."""
        values, acts = out.values.get(fault.signal), fault.acts(time)
        if values is None or not values.size:
            return
        names = out.names[FIELDS[fault.signal]]
        where = [names.index(fault.entry)] if fault.entry else slice(None)
        if fault.kind == "delay":  # it has to know what was before it acts
            held = self._past(number, fault, values, time)
            if acts:
                values[where] = held[where]
        elif not acts:
            self._kept.pop(number, None)
        elif fault.kind == "drop":
            out.values[fault.signal] = None
        elif fault.kind == "short":
            out.values[fault.signal] = values[:-1]
        elif fault.kind == "long":
            out.values[fault.signal] = np.append(values, values[-1])
        elif fault.kind == "stick":
            values[where] = self._kept.setdefault(number, values.copy())[where]
        elif fault.kind == "bias":
            values[where] += fault.get("by", 0.0)
        elif fault.kind == "saturate":
            level = fault.get("at", 0.0)
            values[where] = np.clip(values[where], -level, level)
        else:
            values[where] = {"nan": np.nan, "inf": np.inf, "huge": HUGE}[fault.kind]

    def _past(self, number, fault, values, time):
        """Values of so long ago; before the start those of the start."""
        past = self._kept.setdefault(number, [])
        past.append((time, values.copy()))
        while len(past) > 1 and past[1][0] <= time - fault.get("by", 0.0) + 1e-9:
            past.pop(0)
        return past[0][1]

    def _line(self, sample, now, time):
        """What is lost, late, twice or out of order on the way."""
        ready, acting = [sample], [f for f in self.faults if f.signal == "state" and f.acts(time)]
        kinds = {f.kind for f in acting}
        if any(_lost(f, sample.sequence) for f in acting):
            ready = []
        delay = sum(f.get("by", 0.0) for f in acting if f.kind == "delay")
        # A message is never overtaken on its way, as on the topic.
        due = max([now + round(1e9 * delay), *(d for d, _ in self._waiting[-1:])])
        self._waiting += [(due, s) for s in ready]
        ready = [s for d, s in self._waiting if d <= now]
        self._waiting = [(d, s) for d, s in self._waiting if d > now]
        if "duplicate" in kinds:
            ready = [s for s in ready for _ in range(2)]
        return self._swap(ready, "swap" in kinds)

    def _swap(self, ready, acts):
        """Every other message is kept back until the next one has gone."""
        out = []
        for s in ready:
            if self._swapped is not None:
                out += [s, self._swapped]
                self._swapped = None
            elif acts:
                self._swapped = s
            else:
                out.append(s)
        return out


def _lost(fault, sequence):
    if fault.kind != "drop":
        return False
    share = fault.get("share", 1.0)
    # Of the number alone: the same samples are lost whenever the fault was set.
    return share >= 1.0 or np.random.default_rng([fault.get("seed", 0), sequence]).random() < share


def _whole_fault(fault, out):
    """Faults of stamps and names."""
    if fault.signal == "clock" or fault.kind == "future":
        # A stamp of before 1970 can't be sent.
        out.stamp_ns = max(0, out.stamp_ns + round(1e9 * fault.get("by", 0.0)))
    elif fault.signal == "names" and fault.kind == "wrong":
        out.names["joint_names"][0] = f"not_{out.names['joint_names'][0]}"
    elif fault.signal == "names":
        for key, names in out.names.items():
            names.reverse()
            for name in [
                f for f, of in (*FIELDS.items(), ("modal_rate", "mode_names")) if of == key
            ]:
                if out.values.get(name) is not None:
                    out.values[name] = out.values[name][::-1].copy()
