# SPDX-License-Identifier: Apache-2.0
"""Applies changed parameters of the controller node, after a design if they need one, or sets them back."""

from collections import deque
from concurrent.futures import CancelledError, ThreadPoolExecutor
from threading import Event
from time import monotonic

from rclpy.parameter import Parameter as RosParameter

from flexarm_dynamics.errors import FlexarmError

from .controller_parameters import of_design, of_limits

#: After a design the next one waits for as long as that design took, but at most for this time [s].
MAX_PAUSE = 0.2


def _difference(values, active):
    """Text of the values that differ from the active ones."""
    return ", ".join(f"{k} {v} (was {active[k]})" for k, v in values.items() if v != active[k])


class Designs:
    """Applies changed parameters, or sets them back to the active ones.

    If changes come faster than designs are made, as from a slider, the newest is designed. If it is refused, the newest
    earlier one that is not refused is taken. A pause between two designs leaves the processor to the control path.

    Parameters
    ----------
    node : ArmNode
        Node with the parameters; their changes come to `changed`.
    core : ArmController
    designer : Designer

    Attributes
    ----------
    last_change : str
        The last parameters that were set, and the result; empty before.
    """

    def __init__(self, node, core, designer):
        self._node, self._core, self._designer = node, core, designer
        self._waiting = deque()  # values to design for, the newest last
        self._closed = Event()
        self._carries = False  # a design for another payload is under way
        # Designs are made one at a time.
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="design")
        values = node.parameters.values()
        self._limits, self._design = of_limits(values), of_design(values)
        self.last_change = ""
        node.parameters.on_change(self.changed)

    def changed(self, names):
        """Take note that the parameters of these `names` have been set."""
        if of_limits(dict.fromkeys(names)):
            self._take_limits()
        if of_design(dict.fromkeys(names)):
            values = of_design(self._node.parameters.values())
            if values != self._design or self._waiting:
                self.last_change = f"{_difference(values, self._design)}: being designed"
            self._waiting.append(values)
            self._thread.submit(self._redesign)

    def _take_limits(self):
        limits = of_limits(self._node.parameters.values())
        try:
            self._core.configure(limits)
        except FlexarmError as error:
            self.last_change = f"{_difference(limits, self._limits)}: refused: {error}"
            self._node.get_logger().error(f"limits refused, the old ones stay: {error}")
            self._set_back(limits, self._limits)
        else:
            self._report(limits, self._limits)
            self._limits = limits

    def _report(self, values, active):
        """Report that values are active now, and which were before."""
        if values != active:
            self.last_change = f"{_difference(values, active)}: active"
            self._node.get_logger().info(self.last_change)

    def _redesign(self):
        """In the design thread: replace the old control as a whole by the new one, or set the parameters back."""
        newest_first = [self._waiting.popleft() for _ in range(len(self._waiting))][::-1]
        if not newest_first:  # an earlier call has taken this change, too
            return
        begun, newest = monotonic(), newest_first[0]
        any(self._designed(values) for values in newest_first)
        if self._design != newest and not self._designer.closed:
            self._set_back(newest, self._design)
        if self._waiting:
            self._closed.wait(min(monotonic() - begun, MAX_PAUSE))

    def _designed(self, values):
        """Design for values and hand the control over; False when they are refused."""
        log = self._node.get_logger()
        try:
            law = self._designer.design(values)
            for warning in law.warnings():
                log.warning(warning)
            self._node.hand_over(self._core.replace_law, law)
            self._report(values, self._design)
            self._design = values
        except CancelledError:
            pass
        except Exception as error:
            # A user's law may raise anything, and a thread drops what it raises.
            if not self._designer.closed:
                kind = "" if isinstance(error, FlexarmError) else f"{type(error).__name__}: "
                self.last_change = f"{_difference(values, self._design)}: refused: {kind}{error}"
                log.error(f"design refused, the old law goes on: {kind}{error}")
                return False
        return True

    def _set_back(self, values, active):
        """Set the parameters that differ from the active ones back to those."""
        old = [RosParameter(name, value=v) for name, v in active.items() if values[name] != v]
        self._node.hand_over(self._node.set_parameters_atomically, old)

    def carry(self, payload):
        """Have the control designed for another payload, a multiple of the arm file's; it is taken if the arm rests."""
        if not self._carries:
            self._carries = True
            self._thread.submit(self._carry, payload)

    def _carry(self, payload):
        """In the design thread: design the control for another payload."""
        try:
            law = self._designer.design({**self._design, "payload_scale": payload})
        except CancelledError:
            return
        except Exception as error:  # a user's law may raise anything
            self._node.hand_over(self._carried, None, payload, str(error))
        else:
            self._node.hand_over(self._carried, law, payload)

    def _carried(self, law, payload, refused=""):
        """In the node's thread: take the control for another payload, or the reason why it is refused."""
        self._carries = False
        if refused:
            self._core.payload.discard(f"no control for a payload of {payload:g}: {refused}")
        elif self._core.carry(law):
            self._design = {**self._design, "payload_scale": payload}
            self._node.parameters.adopt({"payload_scale": payload})

    def close(self):
        """Take no more changes; a design under way is not waited for."""
        self._closed.set()
        self._thread.shutdown(wait=False, cancel_futures=True)
