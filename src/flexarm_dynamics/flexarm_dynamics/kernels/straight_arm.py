# SPDX-License-Identifier: Apache-2.0
r"""The terms of (2) of a straight arm, recorded once for each structure of arm and replayed by `kernels.tape`.

The control model's terms (assumptions a) and b): no deflections) are the mass matrix, the forces
:math:`f(q,\dot q)`, and their derivatives by the deflections and by their rates at :math:`\delta = 0`. `kernels.chain`
is run once on symbols that carry derivatives (`kernels.duals`). What is zero, one, or equal to something else then
leaves no operation. The constants of an arm are symbols as well: arms of one structure share one record, and what
depends on constants alone is computed once for each arm.
"""

from functools import cache, lru_cache
from typing import NamedTuple

import numpy as np

from . import chain, load, rigid, symbols, tape
from .duals import Dual

#: Constants that the forces of a straight arm at the first order do not depend on.
UNUSED = {
    *(
        "node_x",
        "node_mass",
        "node_phi",
        "node_slope",
        "node_bend",
        "node_ei",
        "cumulate",
        "bishop",
        "body_bishop",
    ),
    *("transmission", "slip"),
}
#: Numbers that are part of the structure.
STRUCTURAL = (0.0, 1.0, -1.0)
#: The first values of a tape.
ZERO, ONE = 0, 1


class Record(NamedTuple):
    """What `tape.evaluate` replays, by places in its work space: 0, 1, constants, inputs, other numbers, results."""

    size: int
    inputs: int
    numbers: tuple
    counts: np.ndarray
    places: np.ndarray
    signs: np.ndarray
    functions: np.ndarray
    outputs: np.ndarray


@cache
def kernel():
    """The compiled `tape`."""
    return load.joined("tape", (load.source(rigid), load.source(tape)), inline=("run", "solve"))


class _Tape:
    """A record with the constants of one arm in its work space.

    Parameters
    ----------
    data : chain_data.Data
        At the first order.
    work : callable
        Makes work space of a dtype.
    friction : ndarray, shape (n, 3)
    """

    #: Names of `_outputs` that are recorded.
    WANTED = ()

    def __init__(self, data, work, friction):
        pattern, constants = _pattern(data)
        record = self._record = _record(pattern, _Structure(data, work), self.WANTED)
        self._run, self._friction = kernel(), friction
        v = self._v = np.zeros(record.size)
        v[2 : 2 + len(constants)] = constants
        for place, number in record.numbers:
            v[place] = number
        known, first = record.counts[0], record.counts[2]
        self._run.run(v, first, record.places[:known], record.signs[:known])
        self._n = data.links
        self._m = int(data.count.sum()) + int((data.spring >= 0).sum())


class Terms(_Tape):
    """Terms of one arm; parameters as of `_Tape`."""

    WANTED = ("forces", "K", "C", "M")

    def __call__(self, q, qd):
        """Forces (n + m,), K and C (n + m, m), M (n + m, n + m) at q, qd (n,); each call has arrays of its own."""
        r = self._record
        out = np.empty(r.outputs.size)
        self._run.evaluate(
            self._v, r.inputs, r.counts, r.places, r.signs, r.functions, r.outputs, self._friction, q, qd, out
        )  # fmt: skip
        return self._parts(out)

    def along(self, motions):
        """As a call, at k states `motions`, (k, 3, n), whose accelerations do not count; a leading axis of k."""
        r = self._record
        out = np.empty((len(motions), r.outputs.size))
        self._run.evaluate_along(
            self._v, r.inputs, r.counts, r.places, r.signs, r.functions, r.outputs, self._friction, motions, out
        )  # fmt: skip
        return self._parts(out)

    def _parts(self, out):
        """Views of what the record gives, (..., number of results)."""
        size, m, several = self._n + self._m, self._m, out.shape[:-1]
        K, C = size, size + size * m
        M = C + size * m
        return (
            out[..., :size],
            out[..., K:C].reshape(*several, size, m),
            out[..., C:M].reshape(*several, size, m),
            out[..., M:].reshape(*several, size, size),
        )


class SlowTorque(_Tape):
    """Torque of the slow subsystem of one arm; parameters as of `_Tape`."""

    WANTED = ("forces", "K", "M1")

    def __init__(self, data, work, friction):
        super().__init__(data, work, friction)
        self._values = np.empty(self._record.outputs.size)

    def __call__(self, q, qd, acceleration):
        """Torque (n,) for an acceleration at q, qd, (n,) each."""
        r = self._record
        return self._run.slow_torque_at(
            self._v, r.inputs, r.counts, r.places, r.signs, r.functions, r.outputs, self._friction, q, qd, acceleration,
            self._m, self._values,
        )  # fmt: skip


class _Structure:
    """An arm of a structure; all are equal, so that the first one's record is kept for all."""

    def __init__(self, data, work):
        self.data, self.work = data, work

    def __eq__(self, other):
        return isinstance(other, _Structure)

    def __hash__(self):
        return 0


def _floats(data):
    """Names of the fields that the forces depend on and that are not whole numbers."""
    arrays = {n: v for n, v in data._asdict().items() if isinstance(v, np.ndarray)}
    return [n for n, v in arrays.items() if v.dtype.kind == "f" and n not in UNUSED]


def _pattern(data):
    """What makes two arms one structure, and the constants.

    Which numbers are zero, one or minus one, and which matrices are symmetric. Each other number is a constant of its
    own: what is equal to another by chance, or but for rounding, is no structure.
    """
    which, constants = [], []
    names = _floats(data)
    for name in names:
        values = getattr(data, name)
        flat = values.ravel()
        place = np.arange(flat.size).reshape(values.shape)
        if values.ndim >= 2 and values.shape[-1] == values.shape[-2]:
            twin = np.swapaxes(place, -1, -2)
            same = (values == np.swapaxes(values, -1, -2)).all(axis=(-1, -2), keepdims=True)
            place = np.where(same, np.minimum(place, twin), place)
        for number, own in zip(flat.tolist(), place.ravel().tolist(), strict=True):
            which.append(number if number in STRUCTURAL else (name, own))
            constants.append(number)
    others = [name for name in data._fields if name not in names and name not in UNUSED]
    whole = [np.asarray(getattr(data, name)).tobytes() for name in others]
    shapes = tuple(getattr(data, name).shape for name in names)
    return (tuple(which), tuple(whole), shapes), constants


@lru_cache(64)
def _record(pattern, structure, wanted):
    """The `Record` of a structure for the `wanted` names of `_outputs`."""
    data, graph, fields, first, place = structure.data, symbols.Graph(), {}, {}, 0
    for name in _floats(data):
        shape = getattr(data, name).shape
        field = np.empty(int(np.prod(shape)), object)
        for i in range(field.size):
            number = pattern[0][place]
            if isinstance(number, tuple):
                number = graph.symbol(f"c[{first.setdefault(number, place)}]")
            field[i], place = number, place + 1
        fields[name] = field.reshape(shape)
    outputs = _outputs(data._replace(**fields), fields, structure.work, graph)
    chosen = [value for name in wanted for value in outputs[name]]
    return _assembled(graph, chosen, place, data.links)


def _outputs(data, fields, work, graph):
    """Forces, K, C, M and M1, its first n columns, as lists of symbols; `fields` names the constants in `data`."""
    n = data.links
    m = int(data.count.sum()) + int((data.spring >= 0).sum())
    q, qd = graph.inputs("q", n), graph.inputs("v", n)
    zero, modal_zero, none = (np.zeros(size, object) for size in (n, m, 3))
    directions = np.array([Dual(0.0, {j: 1.0}) for j in range(2 * m)] or [], object)
    out = np.zeros(n + m, object)
    dual = data._replace(**{name: _duals(getattr(data, name)) for name in fields})
    chain.generalised_forces(
        (dual,), (work(object),), _duals(q), directions[:m], _duals(qd), directions[m:], zero, modal_zero, out
    )  # fmt: skip
    forces = [Dual.of(x) for x in out]
    M = np.zeros((n + m, n + m), object)
    chain.mass_matrix((data,), (work(object),), q, modal_zero, zero, modal_zero, none, M)
    for i in range(n + m):
        M[i, :i] = M[:i, i]
    K, C = ([f.slopes.get(j + k, 0.0) for f in forces for j in range(m)] for k in (0, m))
    return {
        "forces": [f.value for f in forces],
        "K": K,
        "C": C,
        "M": M.ravel().tolist(),
        "M1": M[:, :n].ravel().tolist(),
    }


def _duals(array):
    """An array of scalars without derivatives."""
    out = np.empty(array.size, object)
    out[:] = [Dual(x) for x in array.ravel()]
    return out.reshape(array.shape)


#: What is computed of angles, in the order of their numbers in `tape.evaluate`.
FUNCTIONS = ("np.cos", "np.sin")
#: When a node can be computed: with the constants, before the functions of angles, or after them.
_KNOWN, _EARLY, _LATE = 0, 1, 2


def _assembled(graph, outputs, constants, joints):
    """The `Record` that computes `outputs` of a graph with so many constants and joints."""
    layout = _Layout(graph, outputs, constants, joints)
    work, angles, place = layout.work, layout.angles, layout.place
    size = layout.first + len(work)
    small = np.min_scalar_type(
        max(size, 256)
    )  # a sample reads all of it: what is half as long is read sooner
    return Record(
        size=size,
        inputs=layout.inputs,
        numbers=tuple((place, number) for number, place in layout.numbers.items()),
        counts=np.array([*layout.counts, layout.first], np.int64),
        places=np.array([[place(o) for o in parts[:3]] for _, parts in work], small).reshape(-1, 3),
        signs=np.array([parts[3:] for _, parts in work], np.int8).reshape(-1, 2),
        functions=np.array([[place(a), place(o), kind] for o, a, kind in angles], np.int32).reshape(-1, 3),
        outputs=np.array([place(o) for o in outputs], np.int32),
    )  # fmt: skip


class _Layout:
    """Where each number of a graph is in the work space, and in what order operations run."""

    def __init__(self, graph, outputs, constants, joints):
        self._graph = graph
        seen, self._uses = _needed(graph, outputs)
        self._when = _times(graph, seen)
        self.inputs = 2 + constants
        inputs = {f"c[{i}]": 2 + i for i in range(constants)}
        inputs |= {f"q[{i}]": self.inputs + i for i in range(joints)}
        inputs |= {f"v[{i}]": self.inputs + joints + i for i in range(joints)}
        self.numbers, self._at = {0.0: ZERO, 1.0: ONE}, {}
        self.first = self.inputs + 2 * joints
        self.angles, work = [], []
        for index in seen:
            op, operands = graph.nodes[index]
            node = graph.symbol(op, *operands)
            if op in inputs:
                self._at[index] = inputs[op]
            elif op in FUNCTIONS:
                self.angles.append((node, operands[0], FUNCTIONS.index(op)))
            else:
                work.append((node, self._operation(index)))
        read = [o for _, parts in work for o in parts[:3]] + [a for _, a, _ in self.angles]
        for number in {float(o) for o in read + outputs if not isinstance(o, symbols.Symbol)}:
            if number not in self.numbers:
                self.numbers[number], self.first = self.first, self.first + 1
        for node, _, _ in self.angles:
            self._at[node.index], self.first = self.first, self.first + 1
        # Products that went into a sum have no place.
        read = {o.index for o in read + outputs if isinstance(o, symbols.Symbol)}
        self.work = [(o, parts) for o, parts in work if o.index in read]
        self.work.sort(
            key=lambda item: self._when[item[0].index]
        )  # stable: in order within each time
        for k, (node, _) in enumerate(self.work):
            self._at[node.index] = self.first + k
        when = [self._when[node.index] for node, _ in self.work]
        self.counts = [sum(each <= last for each in when) for last in (_KNOWN, _EARLY)]

    def place(self, operand):
        """Where a symbol or a number is."""
        if isinstance(operand, symbols.Symbol):
            return self._at[operand.index]
        return self.numbers[float(operand)]

    def _operation(self, index):
        """(a, b, c, s, t) of a node."""
        op, operands = self._graph.nodes[index]
        if op == "*":
            return *operands, 0.0, 1.0, 0.0
        x, y = operands if len(operands) == 2 else (operands[0], 0.0)
        s, t = {"+": (1.0, 1.0), "-": (1.0, -1.0), "neg": (-1.0, 0.0)}[op]
        if (pair := self._product(x, self._when[index])) is not None:
            return *pair, y, s, t
        if (pair := self._product(y, self._when[index])) is not None:
            return *pair, x, t, s
        return x, 1.0, y, s, t

    def _product(self, operand, time):
        """Operands of a product that only one operation needs, and that is not known long before it; else None."""
        if not isinstance(operand, symbols.Symbol) or self._uses[operand.index] > 1:
            return None
        op, pair = self._graph.nodes[operand.index]
        return pair if op == "*" and self._when[operand.index] >= time else None


def _needed(graph, outputs):
    """Indices of the nodes that outputs depend on, in the order of evaluation, and how often each is used."""
    stack = [o for o in outputs if isinstance(o, symbols.Symbol)]
    uses = {o.index: 2 for o in stack}  # each has a place of its own
    seen = set()
    while stack:
        index = stack.pop().index
        if index in seen:
            continue
        seen.add(index)
        for o in graph.nodes[index][1]:
            if isinstance(o, symbols.Symbol):
                uses[o.index] = uses.get(o.index, 0) + 1
                stack.append(o)
    return sorted(seen), uses


def _times(graph, seen):
    """When each of the nodes, given in the order of evaluation, is computed."""
    when, early = {}, []
    for index in seen:
        op, operands = graph.nodes[index]
        own = [o.index for o in operands if isinstance(o, symbols.Symbol)]
        if op in FUNCTIONS:
            early += own
            when[index] = _LATE
        elif not own:
            when[index] = _KNOWN if op.startswith("c[") else _LATE
        else:
            when[index] = _LATE if any(when[i] for i in own) else _KNOWN
    while early:  # what angles are made of
        index = early.pop()
        if when[index] == _LATE:
            when[index] = _EARLY
            early += [o.index for o in graph.nodes[index][1] if isinstance(o, symbols.Symbol)]
    return when
