# SPDX-License-Identifier: Apache-2.0
"""Design work for one arm, off the control path: in a separate process, or in the thread that asks for it."""

from concurrent.futures import CancelledError
from dataclasses import replace

from flexarm_dynamics.errors import DesignError
from flexarm_dynamics.models.model import build

from ..robust import default
from ..trajectory import refuse_torque
from .assembly import control
from .design_process import AwayError, DesignProcess


def ready(model):
    """Do nothing; the call starts the process, which imports this module and builds the model."""


def prepare_next(model, feedforward, *arguments):
    """``feedforward.prepare_next(*arguments)``, callable in the design process; `model` is not needed."""
    return feedforward.prepare_next(*arguments)


def find(model, settings, uncertainty):
    """`default.find` for the model's arm, callable in the design process."""
    return default.find(model.arm.whole, settings, uncertainty)


def judge(model, trajectory, start, limit):
    """`refuse_torque`, callable in the design process."""
    refuse_torque(model, trajectory, start, limit)


class Designer:
    """Designs controls and prepares trajectories; called from threads that may wait.

    If the process does not answer, or arguments or results can't be sent, the calling thread does the work.

    Parameters
    ----------
    model : ArmModel
        The control path's model; controls that the process designs hold it.
    warn : callable
        Called with a sentence when the process can't be used.
    process : bool
        Whether to design in a separate process. A thread sometimes delays the control path, since both need the
        interpreter's lock.
    cpus : collection of int
        CPUs that the process runs on; empty: as this one.
    """

    def __init__(self, model, warn, process=True, cpus=()):
        self.model, self._warn, self.closed = model, warn, False
        self._own = None
        self._process = DesignProcess(model, cpus=cpus) if process else None

    def start(self):
        """Start the process, which ends with the calling thread; then other threads may design, and end."""
        if self._process is not None:
            self._process.start(ready)

    def warm_up(self):
        """Start the process, so that the first design need not wait for its imports."""
        if self._process is not None:
            try:
                self._process.call(ready)
            except AwayError as error:
                if not self.closed:
                    self._warn(str(error))

    def design(self, values):
        """The control that flat parameters describe, as `assembly.control`; raises a `CancelledError` after `close`."""
        try:
            return self._in_process(control, values)
        except AwayError:
            # With a separate model, because the control path uses the other one meanwhile.
            return control(build(self.model.arm), values)

    def prepare(self, feedforward, trajectory, start, waits=None):
        """Result of `Feedforward.prepare` of the `feedforward` for a `trajectory` and its `start`.

        Raises a `CancelledError` after `close`.

        If `waits` is given, the work goes on only while ``waits()`` is true. Parts that are not ready by then are left
        out, and the note names them. If no part is ready, a `DesignError` is raised.
        """
        found = None
        while found is None or found.left:
            try:
                found = self._in_process(
                    prepare_next, feedforward, trajectory, start, found, waits=waits
                )
            except AwayError:
                found = feedforward.prepare_next(trajectory, start, found)
            except TimeoutError:
                if found is None:
                    problem = "the motion begins before its regulators are ready"
                    raise DesignError(problem, hint="send it earlier, or with stamp 0") from None
                missing = f"the motion begins before it is ready: {', '.join(found.left)}"
                note = "; ".join(filter(None, (found.note, missing)))
                return replace(found, left=(), note=note)
            if found is None:
                return None
        return found

    def find(self, settings, uncertainty):
        """Result of `default.find` for `settings` and `uncertainty`; raises a `CancelledError` after `close`."""
        try:
            return self._in_process(find, settings, uncertainty)
        except AwayError:
            return find(self.model, settings, uncertainty)

    def judge(self, trajectory, start, limit):
        """As `refuse_torque`: in the process if one is idle, otherwise in this thread, which takes little time."""
        if self._process is not None and self._process.idle:
            try:
                return self._in_process(judge, trajectory, start, limit)
            except AwayError:
                pass
        if self._own is None:
            self._own = build(self.model.arm)  # the control path uses the other one
        refuse_torque(self._own, trajectory, start, limit)

    def _in_process(self, function, *arguments, waits=None):
        """``function(model, *arguments)`` in the process; warns and raises an `AwayError` if this is not possible."""
        if self._process is None:
            raise AwayError("there is no design process")
        try:
            return self._process.call(function, *arguments, waits=waits)
        except AwayError as error:
            if self.closed:
                raise CancelledError from error
            self._warn(f"{error}; it is made in a thread of the controller")
            raise

    def close(self):
        """End the process, even in the middle of a design."""
        self.closed = True
        if self._process is not None:
            self._process.close()
