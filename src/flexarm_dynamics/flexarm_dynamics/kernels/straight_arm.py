# SPDX-License-Identifier: Apache-2.0
r"""The terms of (2) of a straight arm, recorded once for each structure of arm and replayed by `kernels.tape`.

The control model's terms (assumptions a) and b): no deflections) are the mass matrix, the forces
:math:`f(q,\dot q)`, and their derivatives by the deflections and by their rates at :math:`\delta = 0`. `kernels.chain`
is run once on symbols that carry derivatives (`kernels.duals`). What is zero, one, or equal to something else then
leaves no operation. The constants of an arm are symbols as well: arms of one structure share one record, and what
depends on constants alone is computed once for each arm.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from . import chain, load, symbols, tape
from .duals import Dual

#: Constants that the forces of a straight arm at the first order do not depend on.
UNUSED = {
    *("node_x", "node_mass", "node_phi", "node_slope", "node_bend", "node_ei", "cumulate", "bishop"),
    *("transmission", "slip"),
}
#: Numbers that are part of the structure.
STRUCTURAL = (0.0, 1.0, -1.0)
#: The first values of a tape.
ZERO, ONE = 0, 1


class Record(NamedTuple):
    """What `tape.evaluate` replays; indices into its work space, which begins with 0, 1, the constants and the inputs."""

    size: int
    inputs: int
    numbers: tuple
    counts: np.ndarray
    places: np.ndarray
    signs: np.ndarray
    functions: np.ndarray
    outputs: np.ndarray


def kernel():
    """The compiled `tape`."""
    return load.joined("tape", (load.source(tape),), inline=("run",))


class Tape:
    """Terms of one arm.

    Parameters
    ----------
    data : chain.Data
        At the first order.
    work : callable
        Makes work space of a dtype.
    friction : ndarray, shape (n, 3)
    """

    def __init__(self, data, work, friction):
        pattern, constants = _pattern(data)
        record = self._record = _record(pattern, _Structure(data, work))
        self._run, self._friction = kernel(), friction
        v = self._v = np.zeros(record.size)
        v[2 : 2 + len(constants)] = constants
        for place, number in record.numbers:
            v[place] = number
        known, first = record.counts[0], record.counts[2]
        self._run.run(v, first, record.places[:known], record.signs[:known])
        self._n = data.links
        self._m = int(data.count.sum()) + int((data.spring >= 0).sum())

    def __call__(self, q, qd):
        """Forces (n + m,), K and C (n + m, m), M (n + m, n + m) at q, qd (n,); each call has arrays of its own."""
        r, size, m = self._record, self._n + self._m, self._m
        out = np.empty(r.outputs.size)
        self._run.evaluate(
            self._v, r.inputs, r.counts, r.places, r.signs, r.functions, r.outputs, self._friction, q, qd, out
        )  # fmt: skip
        K, C = size, size + size * m
        M = C + size * m
        return (
            out[:size],
            out[K:C].reshape(size, m),
            out[C:M].reshape(size, m),
            out[M:].reshape(size, size),
        )


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
    fields = data._asdict().items()
    return [n for n, v in fields if getattr(v, "dtype", None) == float and n not in UNUSED]


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
def _record(pattern, structure):
    """The `Record` of a structure."""
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
    return _assembled(graph, outputs, place, data.links)


def _outputs(data, fields, work, graph):
    """Forces, K, C and M, one after the other, as symbols; `fields` are the names of the constants in `data`."""
    n = data.links
    m = int(data.count.sum()) + int((data.spring >= 0).sum())
    q, qd = graph.inputs("q", n), graph.inputs("v", n)
    zero, modal_zero, none = (np.zeros(size, object) for size in (n, m, 3))
    directions = np.array([Dual(0.0, {j: 1.0}) for j in range(2 * m)] or [], object)
    out = np.zeros(n + m, object)
    dual = data._replace(**{name: _duals(getattr(data, name)) for name in fields})
    chain.bias_forces(
        (dual,), (work(object),), _duals(q), directions[:m], _duals(qd), directions[m:], zero, modal_zero, out
    )  # fmt: skip
    forces = [Dual.of(x) for x in out]
    M = np.zeros((n + m, n + m), object)
    chain.mass_matrix((data,), (work(object),), q, modal_zero, zero, modal_zero, none, M)
    for i in range(n + m):
        M[i, :i] = M[:i, i]
    K, C = ([f.slopes.get(j + k, 0.0) for f in forces for j in range(m)] for k in (0, m))
    return [f.value for f in forces] + K + C + M.ravel().tolist()


def _duals(array):
    """An array of scalars without derivatives."""
    out = np.empty(array.size, object)
    out[:] = [Dual(x) for x in array.ravel()]
    return out.reshape(array.shape)


#: When a node can be computed: with the constants, before the functions of angles, or after them.
_KNOWN, _EARLY, _LATE = 0, 1, 2


def _assembled(graph, outputs, constants, joints):
    """The `Record` that computes `outputs` of a graph with so many constants and joints."""
    seen, uses = _needed(graph, outputs)
    when = _times(graph, seen)
    inputs = 2 + constants
    places = {f"c[{i}]": 2 + i for i in range(constants)}
    places |= {f"q[{i}]": inputs + i for i in range(joints)}
    places |= {f"v[{i}]": inputs + joints + i for i in range(joints)}
    numbers, at = {0.0: ZERO, 1.0: ONE}, {}
    next_place = inputs + 2 * joints

    def operand(o):
        nonlocal next_place
        if isinstance(o, symbols.Symbol):
            return at[o.index]
        if float(o) not in numbers:
            numbers[float(o)] = next_place
            next_place += 1
        return numbers[float(o)]

    def product(o, time):
        """Operands of a product that only this operation needs, and that can wait for it."""
        if not isinstance(o, symbols.Symbol) or uses[o.index] > 1 or when[o.index] < time:
            return None
        op, pair = graph.nodes[o.index]
        return pair if op == "*" else None

    def operation(index):
        """(a, b, c, s, t) of a node."""
        op, operands = graph.nodes[index]
        time = when[index]
        if op == "*":
            return *operands, 0.0, 1.0, 0.0
        x, y = operands if len(operands) == 2 else (operands[0], 0.0)
        sx, sy = {"+": (1.0, 1.0), "-": (1.0, -1.0), "neg": (-1.0, 0.0)}[op]
        if (pair := product(x, time)) is not None:
            return *pair, y, sx, sy
        if (pair := product(y, time)) is not None:
            return *pair, x, sy, sx
        return x, 1.0, y, sx, sy

    work, angles, fused = [], [], set()
    for index in seen:
        op, operands = graph.nodes[index]
        if op in places:
            at[index] = places[op]
        elif op in ("np.sin", "np.cos"):
            angles.append(index)
        else:
            work.append((index, operation(index)))
    for _, (a, b, c, _, _) in work:
        for o in (a, b, c):
            operand(o) if not isinstance(o, symbols.Symbol) else None
    for o in outputs:
        operand(o) if not isinstance(o, symbols.Symbol) else None
    used = {o.index for _, parts in work for o in parts[:3] if isinstance(o, symbols.Symbol)}
    used |= {o.index for o in outputs if isinstance(o, symbols.Symbol)}
    used |= {graph.nodes[i][1][0].index for i in angles}
    work = [(i, parts) for i, parts in work if i in used]
    work.sort(key=lambda item: when[item[0]])  # stable: in order within each time
    for index in angles:
        at[index], next_place = next_place, next_place + 1
    first = next_place
    for k, (index, _) in enumerate(work):
        at[index] = first + k
    return Record(
        size=first + len(work),
        inputs=inputs,
        numbers=tuple((place, value) for value, place in numbers.items()),
        counts=np.array(
            [sum(when[i] <= t for i, _ in work) for t in (_KNOWN, _EARLY)] + [first], np.int64
        ),
        places=np.array([[operand(o) for o in parts[:3]] for _, parts in work], np.int32).reshape(-1, 3),
        signs=np.array([parts[3:] for _, parts in work], float).reshape(-1, 2),
        functions=np.array(
            [[operand(graph.nodes[i][1][0]), at[i], graph.nodes[i][0] == "np.sin"] for i in angles], np.int32
        ).reshape(-1, 3),
        outputs=np.array([operand(o) for o in outputs], np.int32),
    )  # fmt: skip


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
        if op in ("np.sin", "np.cos"):
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
