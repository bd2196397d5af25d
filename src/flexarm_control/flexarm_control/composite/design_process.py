# SPDX-License-Identifier: Apache-2.0
"""A second process for designs, so that no design holds the interpreter's lock while a sample waits for its torque.

A design in a thread shares the lock of the controller's process. Measured steps of the control path then took two to
three times as long. The second process has a lower priority and a model of the same arm; it sends back the finished
law. Models hold compiled code and are not sent; each process puts its own model in their place.
"""

import io
import multiprocessing
import os
import pickle
import signal
from concurrent.futures import ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from threading import Lock

import numpy as np

from flexarm_dynamics.errors import DesignError
from flexarm_dynamics.models import model as models
from flexarm_dynamics.models.model import ArmModel
from flexarm_dynamics.processes import end_with, step_back

_MODEL = "model"
#: Interval at which a caller is asked whether it still waits [s].
ASKED = 0.01
#: What pickle raises for things that can't be sent.
NOT_SENT = (pickle.PicklingError, TypeError, AttributeError)


class AwayError(DesignError):
    """The process can't do the work: it has died, or an argument or result can't be sent. The caller can do it."""


class _Pickler(pickle.Pickler):
    """Writes every model of the arm as a name, with any payload, and fuller models of the arm, too."""

    def __init__(self, file, arm):
        super().__init__(file, protocol=-1)
        self._arm = arm

    def persistent_id(self, obj):
        if not isinstance(obj, ArmModel):
            return None
        arm, scale = obj.origin
        if arm == self._arm:
            return _MODEL, scale, None
        more = arm.most_modes, arm.foreshortening, arm.finite_slope
        return (_MODEL, scale, more) if arm == self._arm.fuller(*more) else None

    def reducer_override(self, obj):
        if isinstance(obj, ArmModel):
            raise pickle.PicklingError(f"a model of another arm, {obj.arm.name}, can't be sent")
        return NotImplemented


class _Unpickler(pickle.Unpickler):
    def __init__(self, file, model):
        super().__init__(file)
        self._models = {(1.0, None): model}

    def persistent_load(self, name):
        _, scale, more = name
        if (scale, more) not in self._models:
            model = self._models[1.0, None]
            model = model if more is None else model.fuller(*more)
            model = self._models[scale, more] = model if scale == 1.0 else model.with_payload(scale)
            rest = np.zeros(model.n_joints)
            # Prepare the data for the terms here, not on the control path.
            model.terms(rest, rest)
        return self._models[scale, more]


def dumps(thing, arm):
    """A `thing`, such as a law or a plan, as bytes without the models of `arm`.

    A thing that can't be sent, such as a law with a model of another arm, raises one of `NOT_SENT`.
    """
    file = io.BytesIO()
    _Pickler(file, arm).dump(thing)
    return file.getvalue()


def loads(data, model):
    """Read what `dumps` wrote; `model`, or a variant of it, takes the place of the models that it left out."""
    return _Unpickler(io.BytesIO(data), model).load()


# In the process ------------------------------------------------------------------------------

_own = {}


def _begin(arm, parent, niceness, cpus):
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends this process
    end_with(parent)
    step_back(niceness, cpus)
    _own["model"] = models.build(arm)


def _work(function, data):
    model = _own["model"]
    return dumps(function(model, *loads(data, model)), model.arm)


class DesignProcess:
    """Calls functions, one after the other, in a second process that has a model of the same arm; its callers may wait.

    The process is started by the first call, and again after it has died. It ends with `close`, with the thread
    that made the first call, and with this process.

    Parameters
    ----------
    model : ArmModel
        The control path's model; laws that come back hold it.
    niceness : int
        Niceness of the process relative to this one.
    cpus : collection of int
        CPUs that the process runs on; empty: as this one.
    """

    def __init__(self, model, niceness=10, cpus=()):
        self.model, self.niceness, self.cpus, self._pool = model, niceness, cpus, None
        self._last = None
        self._starting = Lock()

    def call(self, function, *arguments, waits=None):
        """``function(model, *arguments)`` in the process.

        The `function` must be defined in a module. The `arguments` and the result must be picklable, except for models
        of this arm. If `waits` is given, it is called every `ASKED` to ask whether the result is still wanted. The
        process finishes a call even if its result is not wanted any more.

        Raises
        ------
        AwayError
            If the process has died, or an argument or the result can't be sent.
        TimeoutError
            If the result is not wanted any more.
        Exception
            Any error that the function raises.
        """
        try:
            data = dumps(arguments, self.model.arm)
            self._last = last = self._running().submit(_work, function, data)
            while waits is not None and not wait([last], ASKED).done:
                if not waits():
                    raise TimeoutError("the result is not wanted any more")
            return loads(last.result(), self.model)
        except BrokenProcessPool:
            self.close()
            raise AwayError(
                "the process that designs has died (killed, or out of memory); a new one is started for the next design"
            ) from None
        except NOT_SENT as error:
            raise AwayError(f"this design can't be sent to another process: {error}") from error

    @property
    def idle(self):
        """Whether the process has been started and has nothing to do."""
        last = self._last
        return self._pool is not None and last is not None and last.done()

    def start(self, function):
        """Call ``function(model)`` in the process without waiting; the process ends with the calling thread."""
        self._last = self._running().submit(_work, function, dumps((), self.model.arm))

    def _running(self):
        with self._starting:
            if self._pool is None:
                self._pool = ProcessPoolExecutor(
                    1,
                    mp_context=multiprocessing.get_context("spawn"),
                    initializer=_begin,
                    initargs=(self.model.arm, os.getpid(), self.niceness, self.cpus),
                )
            return self._pool

    def close(self):
        """End the process, even in the middle of a call."""
        pool, self._pool = self._pool, None
        if pool is None:
            return
        for process in list((pool._processes or {}).values()):
            process.kill()
        pool.shutdown(wait=False, cancel_futures=True)
