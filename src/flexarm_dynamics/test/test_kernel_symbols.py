# SPDX-License-Identifier: Apache-2.0
"""Compiled code of two memory layouts never has one symbol, whichever process made it."""

import json
import subprocess
import sys

import pytest

#: Symbols of an entry and of what it calls, for layouts in the order of the command line.
SYMBOLS = """
import json, sys
import numpy as np
from numba import typeof
from numba.core.itanium_mangler import mangle
from flexarm_dynamics.kernels.load import named_by_layout
named_by_layout()
found = {}
for text in sys.argv[1:]:
    n, m = json.loads(text)
    data = np.zeros(1, [("first", float, (n,)), ("second", float, (m,))])
    kinds = [typeof(data), typeof(data[0]), *(field.type for field in typeof(data).dtype.fields.values())]
    found[text] = [mangle("f", [kind]) for kind in kinds]
print(json.dumps(found))
"""
LAYOUTS = ["[1, 2]", "[2, 1]", "[2, 4]", "[3, 3]"]


def symbols(layouts):
    command = [sys.executable, "-c", SYMBOLS, *layouts]
    return json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)


def test_a_layout_has_one_symbol_in_every_process_and_shares_it_with_no_other():
    pytest.importorskip("numba")
    found = symbols(LAYOUTS)
    assert symbols(LAYOUTS[::-1]) == found
    for k in range(2):  # the array of records, and the record
        assert len({names[k] for names in found.values()}) == len(LAYOUTS)
    lengths = {names[2] for names in found.values()} | {names[3] for names in found.values()}
    assert len(lengths) == 4  # nested arrays of 1 to 4
