# SPDX-License-Identifier: Apache-2.0
"""Scalars that record what is done to them: running a kernel on them gives straight-line code for one structure.

A constant stays a Python float, so that whatever depends on constants alone is computed while tracing, and
what is exactly zero or one leaves no trace. Equal operations on equal operands are one node.
"""

import numpy as np

#: Floats that are written into the code; all others go to a table, so that arms of one structure share code.
LITERALS = (1.0, 2.0, 0.5)


class Graph:
    """Operations recorded so far, in the order of evaluation."""

    def __init__(self):
        self.nodes = []
        self._known = {}

    def symbol(self, op, *operands):
        """The node of an operation; the one there is if it has been recorded before."""
        key = (op, *(o.index if isinstance(o, Symbol) else ("c", float(o)) for o in operands))
        if key not in self._known:
            self._known[key] = Symbol(self, len(self.nodes))
            self.nodes.append((op, operands))
        return self._known[key]

    def inputs(self, name, count):
        """Symbols ``name[0]``, ``name[1]`` ... as an array."""
        out = np.empty(count, dtype=object)
        for i in range(count):
            out[i] = self.symbol(f"{name}[{i}]")
        return out


def _is(value, number):
    return not isinstance(value, Symbol) and value == number


def is_zero(value):
    """Whether a scalar is the number zero."""
    return _is(value, 0.0)


class Symbol:
    """A scalar of a `Graph`."""

    __slots__ = ("graph", "index")

    def __init__(self, graph, index):
        self.graph, self.index = graph, index

    def _pair(self, op, a, b):
        # A sum or product has one node whatever the order of its operands.
        if op in "+*" and isinstance(a, Symbol) and isinstance(b, Symbol) and a.index > b.index:
            a, b = b, a
        return self.graph.symbol(op, a, b)

    def _factors(self):
        """``(("np.sin", a), ("np.cos", b))`` if this is sin(a) cos(b), and so on; else nothing."""
        op, operands = self.graph.nodes[self.index]
        if op != "*" or not all(isinstance(o, Symbol) for o in operands):
            return ()
        pair = [self.graph.nodes[o.index] for o in operands]
        if not all(name in ("np.sin", "np.cos") for name, _ in pair):
            return ()
        return tuple((name, inner[0]) for name, inner in pair)

    def _angle_sum(self, op, other):
        """cos a cos b - sin a sin b = cos(a + b), sin a cos b + cos a sin b = sin(a + b), and the differences."""
        mine = self._factors()
        its = other._factors() if mine and isinstance(other, Symbol) else ()
        if not its:
            return None
        (f, a), (g, b) = mine
        for (h, c), (k, d) in (its, its[::-1]):
            if c is not a or d is not b:
                continue
            if op == "-" and (f, g, h, k) == ("np.cos", "np.cos", "np.sin", "np.sin"):
                return (a + b).cos()
            if op == "+" and (f, g, h, k) in (
                ("np.sin", "np.cos", "np.cos", "np.sin"),
                ("np.cos", "np.sin", "np.sin", "np.cos"),
            ):
                return (a + b).sin()
        return None

    def _negated(self):
        """What this is the negative of, if it is one."""
        op, operands = self.graph.nodes[self.index]
        return operands[0] if op == "neg" else None

    def _difference(self):
        """Operands (a, b) if this is a - b."""
        op, operands = self.graph.nodes[self.index]
        return operands if op == "-" else (None, None)

    def __neg__(self):
        inner = self._negated()
        return self.graph.symbol("neg", self) if inner is None else inner

    def __add__(self, other):
        if _is(other, 0.0):
            return self
        if isinstance(other, Symbol):
            if (its := other._negated()) is not None:
                return self - its
            if (mine := self._negated()) is not None:
                return other - mine
            if other._difference()[1] is self:  # a + (b - a)
                return other._difference()[0]
            if self._difference()[1] is other:
                return self._difference()[0]
        return self._angle_sum("+", other) or self._pair("+", self, other)

    __radd__ = __add__

    def __sub__(self, other):
        if _is(other, 0.0):
            return self
        if other is self:
            return 0.0
        if isinstance(other, Symbol) and (its := other._negated()) is not None:
            return self + its
        if (mine := self._negated()) is not None:
            return -(mine + other)
        return self._angle_sum("-", other) or self._pair("-", self, other)

    def __rsub__(self, other):
        return -self if _is(other, 0.0) else self._pair("-", other, self)

    def __mul__(self, other):
        if _is(other, 0.0):
            return 0.0
        if _is(other, 1.0):
            return self
        if _is(other, -1.0):
            return -self
        # Signs go outwards, where they meet a sum.
        if (mine := self._negated()) is not None:
            return -(mine * other)
        if isinstance(other, Symbol):
            if (its := other._negated()) is not None:
                return -(self * its)
            if self._is_inverse_of(other) or other._is_inverse_of(self):
                return 1.0
        elif other < 0.0:
            return -(self * -other)
        return self._pair("*", self, other)

    __rmul__ = __mul__

    def _is_inverse_of(self, other):
        op, operands = self.graph.nodes[self.index]
        return op == "/" and operands[1] is other and _is(operands[0], 1.0)

    def __truediv__(self, other):
        if isinstance(other, Symbol):
            return self._pair("/", self, other)
        return self * (1.0 / other)

    def __rtruediv__(self, other):
        return 0.0 if _is(other, 0.0) else self._pair("/", other, self)

    def sin(self):
        """The sine, as numpy asks it of an object."""
        return self.graph.symbol("np.sin", self)

    def cos(self):
        """The cosine, as numpy asks it of an object."""
        return self.graph.symbol("np.cos", self)

    def arcsin(self):
        """The arcsine, as numpy asks it of an object."""
        return self.graph.symbol("np.arcsin", self)

    def exp(self):
        """The exponential, as numpy asks it of an object."""
        return self.graph.symbol("np.exp", self)

    def tanh(self):
        """The hyperbolic tangent, as numpy asks it of an object."""
        return self.graph.symbol("np.tanh", self)

    def __abs__(self):
        return self.graph.symbol("abs", self)

    def sqrt(self):
        """The square root, as numpy asks it of an object."""
        return self.graph.symbol("np.sqrt", self)


def program(graph, outputs):
    """What computes `outputs`, as text for `native`: a line for each operation, in order.

    A line has the operation's name and its operands: the number of an earlier line, ``c3`` for a constant, a float of
    `LITERALS`; an input is ``x 3``. The last line, ``out``, has the outputs.

    Parameters
    ----------
    graph : Graph
    outputs : sequence of Symbol or float

    Returns
    -------
    text : str
    constants : list of float
        What c0, c1 ... stand for.
    operations : int
        Lines without the last.
    """
    stack, seen = [o for o in outputs if isinstance(o, Symbol)], set()
    while stack:
        index = stack.pop().index
        if index not in seen:
            seen.add(index)
            stack += [o for o in graph.nodes[index][1] if isinstance(o, Symbol)]
    number = {index: k for k, index in enumerate(sorted(seen))}
    constants, places = [], {}

    def word(operand):
        if isinstance(operand, Symbol):
            return str(number[operand.index])
        value = float(operand)
        if value in LITERALS:
            return repr(value)
        if value not in places:
            places[value] = len(constants)
            constants.append(value)
        return f"c{places[value]}"

    lines = []
    for index in number:
        name, operands = graph.nodes[index]
        lines.append(" ".join([name.replace("[", " ").replace("]", ""), *map(word, operands)]))
    lines.append(" ".join(["out", *map(word, outputs)]))
    return "\n".join(lines), constants, len(number)
