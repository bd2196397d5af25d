# SPDX-License-Identifier: Apache-2.0
"""Recorded operations as machine code, written out for numba without passing them through its front end.

numba takes a millisecond and more for each operation of a long function in Python: most of what a new arm's first run
would take. Here operations become instructions of LLVM at once. A program is what `symbols.program` gives.
"""

import math
import operator

#: What the operations of one operand are, for floats and, by the same name, for numba.
FUNCTIONS = {
    "np.sin": math.sin,
    "np.cos": math.cos,
    "np.arcsin": math.asin,
    "np.exp": math.exp,
    "np.tanh": math.tanh,
    "np.sqrt": math.sqrt,
    "abs": abs,
}
ARITHMETIC = {
    "+": ("fadd", operator.add),
    "-": ("fsub", operator.sub),
    "*": ("fmul", operator.mul),
    "/": ("fdiv", operator.truediv),
}


def values(program, known, literal, compute):
    """Outputs of a program.

    Parameters
    ----------
    program : str
        See `symbols.program`.
    known : callable
        ``known("x", 3)``: an input or constant.
    literal : callable
        ``literal(2.0)``: a number.
    compute : callable
        ``compute(operation, operands)``.

    Returns
    -------
    list
    """
    found = []

    def operand(word):
        if word.isdigit():
            return found[int(word)]
        return known("c", int(word[1:])) if word.startswith("c") else literal(float(word))

    *lines, last = program.strip().split("\n")
    for line in lines:
        name, *words = line.split()
        if name in ("x", "u", "m"):
            found.append(known(name, int(words[0])))
        else:
            found.append(compute(name, [operand(word) for word in words]))
    return [operand(word) for word in last.split()[1:]]


def run(program, **arrays):
    """Outputs of a program for arrays x, u, c and m, in plain Python."""

    def compute(name, operands):
        if name == "neg":
            return -operands[0]
        function = ARITHMETIC[name][1] if name in ARITHMETIC else FUNCTIONS[name]
        return function(*operands)

    return values(program, lambda name, i: arrays[name][i], float, compute)


def into_array(program):
    """``evaluate(x, u, c, m, out)`` of arrays, for compiled functions."""
    from numba.core import types, typing
    from numba.extending import intrinsic

    @intrinsic
    def evaluate(typingctx, x, u, c, m, out):
        def code(context, builder, signature, args):
            results = _instructions(program, context, builder, signature.args, args)
            for i, value in enumerate(results):
                builder.store(value, _place(context, builder, signature.args[4], args[4], i))
            return context.get_dummy_value()

        return typing.signature(types.void, x, u, c, m, out), code

    return evaluate


def as_tuple(program, count):
    """``evaluate(x, u, c, m)``, a tuple of `count` floats, of tuples x and u, for compiled functions."""
    from numba.core import types, typing
    from numba.extending import intrinsic

    @intrinsic
    def evaluate(typingctx, x, u, c, m):
        def code(context, builder, signature, args):
            results = _instructions(program, context, builder, signature.args, args)
            return context.make_tuple(builder, signature.return_type, results)

        return typing.signature(types.UniTuple(types.float64, count), x, u, c, m), code

    return evaluate


def _place(context, builder, kind, array, i):
    """Pointer to an element of an array."""
    from numba.core import cgutils, types

    parts = context.make_array(kind)(context, builder, array)
    index = context.get_constant(types.intp, i)
    return cgutils.get_item_pointer(context, builder, kind, parts, [index])


def _instructions(program, context, builder, kinds, args):
    """Outputs of a program as values of LLVM; its inputs are the first four arguments."""
    from numba.core import types

    kinds, args = dict(zip("xucm", kinds, strict=False)), dict(zip("xucm", args, strict=False))
    one, loaded = types.float64, {}

    def known(name, i):
        if (name, i) not in loaded:
            if isinstance(kinds[name], types.UniTuple):
                value = builder.extract_value(args[name], i)
            else:
                value = builder.load(_place(context, builder, kinds[name], args[name], i))
            loaded[name, i] = value
        return loaded[name, i]

    def compute(name, operands):
        if name in ARITHMETIC:
            return getattr(builder, ARITHMETIC[name][0])(*operands)
        if name == "neg":
            return builder.fneg(operands[0])
        function = context.typing_context.resolve_value_type(FUNCTIONS[name])
        signature = function.get_call_type(context.typing_context, (one,), {})
        return context.get_function(function, signature)(builder, operands)

    return values(program, known, lambda number: context.get_constant(one, number), compute)
