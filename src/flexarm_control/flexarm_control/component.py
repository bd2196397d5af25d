# SPDX-License-Identifier: Apache-2.0
"""Base classes of slow laws, fast laws, manifolds, feed-forwards and observers, and their construction by name."""

from types import SimpleNamespace

import numpy as np

from flexarm_dynamics import registry
from flexarm_dynamics.parameters import check_all, sizes


class Component:
    """A part of the control that is found by name, designed once, and called once per sample.

    The constructor does all design work. `reset` begins a session. After a redesign, `resume` lets the new component
    go on from the old one's states. A component without states of its own implements neither.

    Parameters
    ----------
    model : ArmModel
        The arm.
    parameters : mapping, optional
        Checked values of `PARAMETERS`, arrays at full length.
    """

    #: Declared parameters; their names in a node begin with the component's prefix, such as ``slow.``.
    PARAMETERS = ()

    def __init__(self, model, parameters=()):
        self.model = model
        self.parameters = dict(parameters)

    def warnings(self):
        """What a user should know about this component on this arm; each a sentence."""
        return ()

    def reset(self):
        """Begin a new session: forget the states of the last one."""

    def resume(self, other):
        """Go on from the states of another component, perhaps of another kind: a redesign does not start over."""


class Law(Component):
    """A component whose states, if it has any, advance separately from its output."""

    def advance(self, dt):
        """Advance the law's own states by the time since the last sample.

        It is called before `torque`, once for every new sample except the first. A repeated sample advances nothing.

        Parameters
        ----------
        dt : float
            True time since the last sample [s].
        """


def at_rest(q):
    """A reference that rests at the joint position q, shape (n,) [rad]."""
    q = np.array(q, float)
    state = np.stack([q, np.zeros_like(q), np.zeros_like(q)])
    return SimpleNamespace(
        position=state[0],
        velocity=state[1],
        acceleration=state[2],
        near=lambda offset: state.copy(),
    )


def make(group, name, model, values, prefix, *known):
    """Find a component by its `name` in an entry-point `group`, check its parameters and design it.

    `values` are the parameters of this component alone, by names without the `prefix` that errors put before them.
    `known` is what the component is designed for besides the model, such as the slow law for a manifold.

    Raises
    ------
    UnknownComponentError, ParameterError, DesignError
    """
    kind = registry.find(group, name)
    return kind(model, *known, check_all(kind.PARAMETERS, values, sizes(model), prefix))
