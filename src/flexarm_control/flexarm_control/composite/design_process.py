# SPDX-License-Identifier: Apache-2.0
"""Designs in a process of their own, so that none holds the interpreter's lock while a sample waits for its torque.

A thread of the controller's process shares its lock: on a design's every other bytecode the control path may have to
wait for it, which was measured to double or treble the time of a step. Here the design is made by a second
interpreter, of lower priority, which knows the arm; what comes back is the finished law. Models hold compiled code and
do not travel: in either process "the arm's model" stands for its own.
"""

import ctypes
import io
import multiprocessing
import os
import pickle
import signal
import sys
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from threading import Lock

from flexarm_dynamics.errors import DesignError
from flexarm_dynamics.models import model as models
from flexarm_dynamics.models.model import ArmModel

from .design import design
from .priority import step_back

_PR_SET_PDEATHSIG = 1  # <linux/prctl.h>
_MODEL = "model"


class AwayError(DesignError):
    """The other process did not make it: it died, or what was to be made can't travel. It can be made here."""


class _Pickler(pickle.Pickler):
    """Writes the arm's model, and every other of the same arm, as a name."""

    def __init__(self, file, arm):
        super().__init__(file, pickle.HIGHEST_PROTOCOL)
        self._arm = arm

    def persistent_id(self, obj):
        return _MODEL if isinstance(obj, ArmModel) and obj.arm == self._arm else None

    def reducer_override(self, obj):
        if isinstance(obj, ArmModel):
            raise pickle.PicklingError(f"a model of another arm, {obj.arm.name}, stays at home")
        return NotImplemented


class _Unpickler(pickle.Unpickler):
    def __init__(self, file, model):
        super().__init__(file)
        self._model = model

    def persistent_load(self, name):
        return self._model


def dumps(thing, arm):
    """A law, plan or the like as bytes; models of `arm` are left out.

    The `thing` may hold the model many times over.

    Raises
    ------
    pickle.PicklingError, TypeError, AttributeError
        For what can't travel: a law with a model of another arm, say.
    """
    file = io.BytesIO()
    _Pickler(file, arm).dump(thing)
    return file.getvalue()


def loads(data, model):
    """What `dumps` wrote, with `model` in the place of the models left out."""
    return _Unpickler(io.BytesIO(data), model).load()


# In the process ------------------------------------------------------------------------------

_own = {}


def _begin(arm, parent, niceness, cpus):
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends this process
    if sys.platform.startswith("linux"):
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
        if os.getppid() != parent:
            os._exit(0)
    step_back(niceness, cpus)
    _own["model"] = models.build(arm)


def _work(function, data):
    model = _own["model"]
    return dumps(function(model, *loads(data, model)), model.arm)


def _nothing(model):
    return None


def _design(model, slow, fast, manifold, settings):
    return design(model, slow, fast, manifold, settings)


def _prepare(model, feedforward, trajectory, start):
    return feedforward.prepare(trajectory, start)


class DesignProcess:
    """Designs for one arm, one after the other; called from a thread that may wait.

    The process is started by the first call, and again if it has died. It ends with this object, with the thread
    that made the first call, and with this process.

    Parameters
    ----------
    model : ArmModel
        Of the control path: the laws that come back hold it.
    niceness : int
        Of the process, beside this one's.
    cpus : collection of int
        That it runs on; empty: as this one.
    """

    def __init__(self, model, niceness=10, cpus=()):
        self.model, self.niceness, self.cpus, self._pool = model, niceness, cpus, None
        self._starting = Lock()

    def begin(self):
        """Start the process, and let it import what it will need: the first design comes sooner."""
        self.call(_nothing)

    def design(self, slow, fast, manifold=None, settings=None):
        """As `composite.design`, of this arm; warnings of the laws are still theirs to ask for.

        `slow`, `fast`, `manifold` and `settings` as there.

        Raises
        ------
        FlexarmError
            What the design raises.
        """
        return self.call(_design, slow, fast, manifold, settings)

    def prepare(self, feedforward, trajectory, start):
        """As `Feedforward.prepare`: what is to be known of a trajectory before it is offered."""
        return self.call(_prepare, feedforward, trajectory, start)

    def call(self, function, *arguments):
        """``function(model, *arguments)`` over there; a function of a module, whose result can travel.

        Raises
        ------
        AwayError
            When the process died, or what it made can't travel: design here instead.
        """
        try:
            data = dumps(arguments, self.model.arm)
            result = self._running().submit(_work, function, data).result()
            return loads(result, self.model)
        except BrokenProcessPool:
            self.close()
            raise AwayError(
                "the process that designs has died (killed, or out of memory); it is started anew for the next one"
            ) from None
        except (pickle.PicklingError, TypeError, AttributeError) as error:
            raise AwayError(f"this design can't be made in another process: {error}") from error

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
        """End the process, whatever it is at."""
        pool, self._pool = self._pool, None
        if pool is None:
            return
        for process in list((pool._processes or {}).values()):
            process.kill()
        pool.shutdown(wait=False, cancel_futures=True)
