# SPDX-License-Identifier: Apache-2.0
"""What ``ros2 param dump`` writes of a node starts the node again, with the same values."""

import pytest
import yaml
from in_process import InProcess

SETTINGS = {
    "simulator": {"arm": "two_link", "lockstep": True, "pause_at": -1.0},
    "observer": {"arm": "two_link", "observer.type": "kalman"},
    "controller": {"arm": "R", "slow.kp": [4.0], "feedforward": "none"},
}


def dumped(node):
    """The file that ``ros2 param dump`` makes: all parameters of the node, nested by their dots."""
    names = sorted(p for p in node._parameters if not p.startswith("qos_overrides"))
    tree = {}
    for name in names:
        *path, last = name.split(".")
        at = tree
        for part in path:
            at = at.setdefault(part, {})
        value = node.get_parameter(name).value
        # A list of its own each, as the service's answer has: YAML would write an alias.
        value = value.tolist() if hasattr(value, "tolist") else value
        at[last] = list(value) if isinstance(value, list) else value
    return yaml.dump({f"/{node.get_name()}": {"ros__parameters": tree}}, default_flow_style=False)


@pytest.mark.long
@pytest.mark.parametrize("name", SETTINGS)
def test_a_dump_of_all_parameters_starts_the_node_again(tmp_path, name):
    with InProcess() as nodes:
        nodes.start(name, SETTINGS[name])
        text, values = dumped(nodes.nodes[name]), nodes.nodes[name].parameters.values()
    path = tmp_path / "dump.yaml"
    path.write_text(text)
    with InProcess() as nodes:
        nodes.start(name, file=path)
        assert nodes.nodes[name].parameters.values() == values
