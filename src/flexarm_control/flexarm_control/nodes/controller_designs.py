# SPDX-License-Identifier: Apache-2.0
"""Changed parameters of the controller node: applied, after a design where they need one, or set back."""

from concurrent.futures import CancelledError, ThreadPoolExecutor

from rclpy.parameter import Parameter as RosParameter

from flexarm_dynamics.errors import FlexarmError

from .controller_parameters import of_design, of_limits


class Designs:
    """Applies changed parameters, or sets them back to the active ones.

    Parameters
    ----------
    node : ArmNode
        With its parameters, whose changes come to `changed`.
    core : ArmController
    designer : Designer
    """

    def __init__(self, node, core, designer):
        self._node, self._core, self._designer = node, core, designer
        # Designs are made one at a time, in the order of the changes.
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="design")
        values = node.parameters.values()
        self._limits, self._design = of_limits(values), of_design(values)
        node.parameters.on_change(self.changed)

    def changed(self, names):
        """Parameters of these names have been set."""
        if of_limits(dict.fromkeys(names)):
            self._take_limits()
        if of_design(dict.fromkeys(names)):
            self._thread.submit(self._redesign, of_design(self._node.parameters.values()))

    def _take_limits(self):
        limits = of_limits(self._node.parameters.values())
        try:
            self._core.configure(limits)
        except FlexarmError as error:
            self._node.get_logger().error(f"limits refused, the old ones stay: {error}")
            self._set_back(limits, self._limits)
        else:
            self._limits = limits

    def _redesign(self, values):
        """In the design thread: the new control replaces the old one whole, or the parameters are set back."""
        log = self._node.get_logger()
        try:
            law = self._designer.design(values)
            for warning in law.warnings():
                log.warning(warning)
            self._node.hand_over(self._core.replace_law, law)
            self._design = values
        except CancelledError:
            return
        except Exception as error:
            # A user's law may raise anything, and a thread drops what it raises.
            if self._designer.closed:
                return
            kind = "" if isinstance(error, FlexarmError) else f"{type(error).__name__}: "
            log.error(f"design refused, the old law goes on: {kind}{error}")
            self._set_back(values, self._design)

    def _set_back(self, values, active):
        """Set the parameters that differ from the active ones back to those."""
        old = [RosParameter(name, value=v) for name, v in active.items() if values[name] != v]
        self._node.hand_over(self._node.set_parameters_atomically, old)

    def close(self):
        """Take no more changes; a design under way is not waited for."""
        self._thread.shutdown(wait=False, cancel_futures=True)
