# SPDX-License-Identifier: Apache-2.0
"""Design work for one arm, off the control path: in a process of its own, or in the thread that asks for it."""

from concurrent.futures import CancelledError
from dataclasses import replace

from flexarm_dynamics.errors import DesignError
from flexarm_dynamics.models.model import build

from ..robust import default
from ..trajectory import refuse_torque
from .assembly import control
from .design_process import AwayError, DesignProcess


def ready(model):
    """Does nothing: calling it starts the process, which imports this module and builds the model."""


def prepare_next(model, feedforward, *arguments):
    """``feedforward.prepare_next(*arguments)``, callable in the design process; its `model` is not needed."""
    return feedforward.prepare_next(*arguments)


def find(model, settings, uncertainty):
    """`default.find` for the model's arm, callable in the design process."""
    return default.find(model.arm.whole, settings, uncertainty)


def judge(model, trajectory, start, limit):
    """`refuse_torque`, callable in the design process."""
    refuse_torque(model, trajectory, start, limit)


class Designer:
    """Designs controls and prepares trajectories; called from threads that may wait.

    Where the process does not answer, or what it is to make can't be sent, the work is done in the calling thread.

    Parameters
    ----------
    model : ArmModel
        The control path's: controls that the process designs hold it.
    warn : callable
        Called with a sentence when the process can't be used.
    process : bool
        Whether to design in a process of its own. A thread holds up the control path now and then, since both need
        the interpreter's lock.
    cpus : collection of int
        That the process runs on; empty: as this one.
    """

    def __init__(self, model, warn, process=True, cpus=()):
        self.model, self._warn, self.closed = model, warn, False
        self._own = None
        self._process = DesignProcess(model, cpus=cpus) if process else None

    def start(self):
        """Start the process, which ends with the calling thread; another thread may design then, and end."""
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
        """The control that flat parameters describe, as `assembly.control`; a `CancelledError` after `close`."""
        try:
            return self._in_process(control, values)
        except AwayError:
            # With a model of its own: meanwhile the control path uses the other one.
            return control(build(self.model.arm), values)

    def prepare(self, feedforward, trajectory, start, waits=None):
        """What `Feedforward.prepare` of the `feedforward` makes of a `trajectory` and its `start`.

        After `close` a `CancelledError`.

        While ``waits()`` is true, where it is given: what is not there by then is left out, and the note names it; a
        `DesignError` where nothing is.
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
        """What `default.find` makes of the same `settings` and `uncertainty`; a `CancelledError` after `close`."""
        try:
            return self._in_process(find, settings, uncertainty)
        except AwayError:
            return find(self.model, settings, uncertainty)

    def judge(self, trajectory, start, limit):
        """As `refuse_torque`: in the process where one is idle, else in this thread, which is soon done."""
        if self._process is not None and self._process.idle:
            try:
                return self._in_process(judge, trajectory, start, limit)
            except AwayError:
                pass
        if self._own is None:
            self._own = build(self.model.arm)  # the control path uses the other one
        refuse_torque(self._own, trajectory, start, limit)

    def _in_process(self, function, *arguments, waits=None):
        """``function(model, *arguments)`` in the process; an `AwayError`, with a warning, where that can't be."""
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
