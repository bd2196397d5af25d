# SPDX-License-Identifier: Apache-2.0
"""Puts faults into what the simulator publishes, to test how observer and controller respond to them.

A fault is one line, "SIGNAL KIND [key=value ...]", see docs/fault_injection.md. Times are simulated seconds since
the start of the session. The same lines and seeds give the same messages. The plant is not affected. This module
needs no ROS.
"""

import math
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from flexarm_dynamics.errors import ParameterError
from flexarm_dynamics.shown import show

#: Value of the kind `huge`.
HUGE = 1e12
#: [s]
MAX_DELAY = 10.0

#: Field to the names of its entries.
FIELDS = {
    "joint_position": "joint_names",
    "joint_velocity": "joint_names",
    "joint_torque": "joint_names",
    "strain": "gauge_names",
    "modal_amplitude": "mode_names",
    "modal_rate": "mode_names",
}
WINDOW = ("from", "for")
#: Range of the number of each key.
RANGES = {
    "from": (0.0, 1e9),
    "at": (0.0, 1e9),
    "for": (1e-9, 1e9),
    "by": (-1e9, 1e9),
    "share": (0.0, 1.0),
    "seed": (0, 2**31 - 1),
}
#: Kinds for one or all entries of a field: their keys, and those that are required.
VALUE_KINDS = {
    "nan": ((), ()),
    "inf": ((), ()),
    "huge": ((), ()),
    "stick": ((), ()),
    "bias": (("by",), ("by",)),
    "drift": (("by",), ("by",)),
    "scale": (("by",), ("by",)),
    "exchange": ((), ()),
    "saturate": (("at",), ("at",)),
    "delay": (("by",), ("by",)),
}
#: Kinds for a whole field.
FIELD_KINDS = {"drop": ((), ()), "short": ((), ()), "long": ((), ())}
#: Kinds for the other signals.
OTHER_KINDS = {
    "state": {
        "drop": (("share", "seed"), ()),
        "delay": (("by",), ("by",)),
        "duplicate": ((), ()),
        "swap": ((), ()),
        "future": (("by",), ("by",)),
        "jitter": (("by", "seed"), ("by",)),
        "freeze": ((), ()),
        "repeat": ((), ()),
    },
    "clock": {"jump": (("by", "at"), ("by", "at"))},
    "session": {"change": (("at",), ("at",)), "alternate": ((), ())},
    "names": {"reorder": ((), ()), "wrong": ((), ())},
}

#: Latest stamp that a message can hold, in 2038; the earliest is 0, in 1970 [ns].
LAST_NS = (2**31 - 1) * 1_000_000_000
#: Faults that begin `at` a time and have no end.
EVENTS = (("clock", "jump"), ("session", "change"))


@dataclass
class Sample:
    """Contents of one `arm_state`.

    Attributes
    ----------
    sequence, stamp_ns : int
    names : dict of str to list of str
        ``joint_names``, ``gauge_names``, ``mode_names``.
    values : dict of str to ndarray or None
        `FIELDS`; None: unknown, empty on the topic.
    session : int
        Added to the session of the source; 0 while there is one source that does not restart.
    """

    sequence: int
    stamp_ns: int
    names: dict = field(default_factory=dict)
    values: dict = field(default_factory=dict)
    session: int = 0

    def copy(self):
        """The same, in lists and arrays of its own."""
        return Sample(
            self.sequence,
            self.stamp_ns,
            {k: list(v) for k, v in self.names.items()},
            {k: None if v is None else np.array(v) for k, v in self.values.items()},
            self.session,
        )


@dataclass(frozen=True)
class Fault:
    """One fault.

    Attributes
    ----------
    signal, kind : str
    entry : str
        Joint, gauge or mode; empty: the whole field.
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
        """The value of a key, or `default`."""
        return dict(self.keys).get(key, default)

    def acts(self, time):
        """Whether it acts at `time` [s], which counts to the nanosecond."""
        begin = self.get("at" if (self.signal, self.kind) in EVENTS else "from", 0.0)
        return begin - 1e-9 <= time < begin + self.get("for", math.inf) - 1e-9


def parse(text, arm):
    """One fault from its line.

    Parameters
    ----------
    text : str
    arm : Arm
        Its joints, gauges and modes may be named.

    Returns
    -------
    Fault

    Raises
    ------
    ParameterError
        With the word as its value, and what is allowed there.
    """

    def refuse(word, problem, limit=None):
        raise ParameterError(f"in {show(text)}: {problem}", field="faults", value=word, limit=limit)

    words = text.split()
    if len(words) < 2:
        refuse(text, 'a fault is "SIGNAL KIND [key=value ...]"')
    signal, dot, entry = words[0].partition(".")
    if signal not in FIELDS and signal not in OTHER_KINDS:
        refuse(words[0], "no such signal", ", ".join((*FIELDS, *OTHER_KINDS)))
    if dot and signal not in FIELDS:
        refuse(words[0], f"{signal} has no parts")
    if dot:
        names = _names(arm)[FIELDS[signal]]
        if entry not in names:
            refuse(words[0], f"{signal} has no such entry", ", ".join(names) or "none on this arm")
    kinds = OTHER_KINDS.get(signal) or (VALUE_KINDS if dot else {**FIELD_KINDS, **VALUE_KINDS})
    if words[1] not in kinds:
        more = ": one entry can't be missing, use nan" if dot and words[1] in FIELD_KINDS else ""
        refuse(words[1], f"no kind of {words[0]}{more}", ", ".join(kinds))
    allowed, needed = kinds[words[1]]
    if (signal, words[1]) not in EVENTS:
        allowed = (*allowed, *WINDOW)
    keys = {}
    for word in words[2:]:
        key, equals, value = word.partition("=")
        if key not in allowed or not equals:
            refuse(word, f"no key of {words[1]}", ", ".join(f"{k}=…" for k in allowed))
        if key in keys:
            refuse(word, f"{key} is given twice")
        keys[key] = _number(key, value, words[1], partial(refuse, word))
    for key in needed:
        if key not in keys:
            refuse(words[1], f"needs {key}=…")
    return Fault(signal, words[1], entry, tuple(keys.items()))


def _number(key, text, kind, refuse):
    """The value of a key, checked."""
    try:
        value = int(text) if key == "seed" else float(text)
    except (ValueError, OverflowError):
        refuse("a seed is an integer" if key == "seed" else "not a number")
    if not math.isfinite(value):
        refuse("not finite")
    low, high = (1e-9, MAX_DELAY) if (key, kind) == ("by", "delay") else RANGES[key]
    if not low <= value <= high:
        refuse("out of range", f"from {low:g} to {high:g}")
    return value


def _names(arm):
    return {
        "joint_names": arm.joint_names,
        "gauge_names": arm.gauge_names,
        "mode_names": arm.observed_modes,
    }


class FaultInjector:
    """Turns each sample into the messages to send.

    Parameters
    ----------
    arm : Arm
    lines : sequence of str
        Faults, which act in this order; those of `state` act last.

    Attributes
    ----------
    faults : tuple of Fault
    session : int
        Number by which faults have raised the source's session so far, as a driver that restarts does.
    """

    def __init__(self, arm, lines=()):
        self._arm = arm
        self.faults = ()
        self.set(lines)

    def set(self, lines):
        """Replace the faults, all or none, and forget what the old ones held.

        Raises
        ------
        ParameterError
        """
        self.faults = tuple(parse(line, self._arm) for line in lines)
        self.reset()

    def reset(self):
        """Begin a new session: times start again."""
        self.session = 0
        self._kept = {}  # number of a fault to what it holds
        self._waiting = []  # (due [ns], sample), in the order they came
        self._swapped = None

    def outgoing(self, sample, time):
        """The messages to send now, in order: none, one or several.

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
        out = sample.copy()
        for number, fault in enumerate(self.faults):
            if fault.signal in FIELDS:
                self._value_fault(number, fault, out, time)
        for number, fault in enumerate(self.faults):
            if fault.kind in ("freeze", "repeat"):
                out = self._held(number, fault, out, fault.acts(time))
        acting = [f for f in self.faults if f.acts(time)]
        for fault in acting:
            _whole_fault(fault, out)
        self.session = out.session
        return _with_second_source(acting, self._messages(out, now, time))

    def _held(self, number, fault, out, acts):
        """The message from the fault's start: all of it, or with the present number and stamp."""
        if not acts:
            self._kept.pop(number, None)
            return out
        kept = self._kept.setdefault(number, out).copy()
        if fault.kind == "freeze":
            kept.sequence, kept.stamp_ns = out.sequence, out.stamp_ns
        return kept

    def _value_fault(self, number, fault, out, time):
        """Apply a fault of one field."""
        values, acts = out.values.get(fault.signal), fault.acts(time)
        if values is None or not values.size:
            return
        names = out.names[FIELDS[fault.signal]]
        where = [names.index(fault.entry)] if fault.entry else slice(None)
        if fault.kind == "delay":  # it needs the values from before it acts
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
        elif fault.kind == "drift":
            values[where] += fault.get("by", 0.0) * (time - fault.get("from", 0.0))
        elif fault.kind == "scale":
            values[where] *= fault.get("by", 0.0)
        elif fault.kind == "exchange":
            _exchange(values, where)
        elif fault.kind == "saturate":
            level = fault.get("at", 0.0)
            values[where] = np.clip(values[where], -level, level)
        else:
            values[where] = {"nan": np.nan, "inf": np.inf, "huge": HUGE}[fault.kind]

    def _past(self, number, fault, values, time):
        """The values as they were one delay of the fault ago; the first ones if none is that old."""
        past = self._kept.setdefault(number, [])
        past.append((time, values.copy()))
        while len(past) > 1 and past[1][0] <= time - fault.get("by", 0.0) + 1e-9:
            past.pop(0)
        return past[0][1]

    def _messages(self, sample, now, time):
        """Apply faults of messages: lost, late, twice, out of order."""
        ready, acting = [sample], [f for f in self.faults if f.signal == "state" and f.acts(time)]
        kinds = {f.kind for f in acting}
        if any(_lost(f, sample.sequence) for f in acting):
            ready = []
        delay = sum(f.get("by", 0.0) for f in acting if f.kind == "delay")
        # No message overtakes another, as on the topic.
        due = max([now + round(1e9 * delay), *(d for d, _ in self._waiting[-1:])])
        self._waiting += [(due, s) for s in ready]
        ready = [s for d, s in self._waiting if d <= now]
        self._waiting = [(d, s) for d, s in self._waiting if d > now]
        if "duplicate" in kinds:
            ready = [s for s in ready for _ in range(2)]
        return self._swap(ready, "swap" in kinds)

    def _swap(self, ready, acts):
        """Hold every other message back until the next one has been sent."""
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


def _exchange(values, where):
    """Exchange an entry with the next one, the last with the first; for the whole field: reverse it."""
    if isinstance(where, list):
        pair = [where[0], (where[0] + 1) % values.size]
        values[pair] = values[pair[::-1]]
    else:
        values[:] = values[::-1].copy()


def _with_second_source(acting, ready):
    """With `session alternate`, each message is followed by that of a second source."""
    if not any((f.signal, f.kind) == ("session", "alternate") for f in acting):
        return ready
    return [s for own in ready for s in (own, replace(own, session=own.session + 1))]


def _lost(fault, sequence):
    if fault.kind != "drop":
        return False
    fraction = fault.get("share", 1.0)
    # It depends on the sequence alone: the same samples are lost whenever the fault was set.
    random = np.random.default_rng([fault.get("seed", 0), sequence])
    return fraction >= 1.0 or random.random() < fraction


def _shift_stamp(out, by):
    """Shift the stamp of a sample by a time [s], as far as a message can hold it."""
    out.stamp_ns = min(max(0, out.stamp_ns + round(1e9 * by)), LAST_NS)


def _whole_fault(fault, out):
    """Apply a fault of stamps or names."""
    if fault.signal == "clock" or fault.kind == "future":
        _shift_stamp(out, fault.get("by", 0.0))
    elif fault.kind == "jitter":
        random = np.random.default_rng([fault.get("seed", 0), out.sequence])
        _shift_stamp(out, fault.get("by", 0.0) * random.uniform(-1.0, 1.0))
    elif (fault.signal, fault.kind) == ("session", "change"):
        out.session += 1
    elif fault.signal == "names" and fault.kind == "wrong":
        out.names["joint_names"][0] = f"not_{out.names['joint_names'][0]}"
    elif fault.signal == "names":
        for key, names in out.names.items():
            names.reverse()
            for name, of in FIELDS.items():
                if of == key and out.values.get(name) is not None:
                    out.values[name] = out.values[name][::-1].copy()
