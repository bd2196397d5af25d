# SPDX-License-Identifier: Apache-2.0
"""Shapes a trajectory outside of the shaper node's own thread, since a new time law can take seconds."""

from concurrent.futures import ThreadPoolExecutor

from flexarm_dynamics.errors import TrajectoryError

#: Number of trajectories that are computed at once: a new one does not wait for the one that it replaces.
THREADS = 2
#: A motion under way is replaced this much later than requested, so that there is time to compute the next one [ns].
AHEAD = 100_000_000


class Job:
    """A trajectory or a stop that is being shaped.

    Parameters
    ----------
    prepare, quick : callable
        Return its plan: `prepare` may take long, in any thread; `quick` is called in the node's own, at its due time.
    due_ns : int or None
        When it replaces the motion under way [ns]; None: there is none, and it begins once it is ready.
    done, refused : callable
        Called in the node's own thread, with the plan or a `TrajectoryError`.
    """

    def __init__(self, prepare, quick, due_ns, done, refused):
        self.prepare, self.quick, self.due_ns = prepare, quick, due_ns
        self.done, self.refused = done, refused
        self.result, self.ready = None, False

    def put(self, result):
        """Set the `result`: the plan, None if there is nothing to do, or a `TrajectoryError`."""
        self.result, self.ready = result, True

    def finished(self, now_ns):
        """Whether its result can be used at a time [ns]; if there is none at its due time, `quick` makes one."""
        if isinstance(self.result, TrajectoryError) or self.due_ns is None:
            return self.ready
        if now_ns < self.due_ns:
            return False
        if not self.ready:
            self.put(attempt(self.quick))
        return True

    def answer(self):
        """Call back with the result."""
        refused = isinstance(self.result, TrajectoryError)
        (self.refused if refused else self.done)(self.result)


class ShapingJob:
    """Holds at most one `Job`; a newer one replaces it.

    Parameters
    ----------
    node : ArmNode
        Node with `now_ns`.
    """

    def __init__(self, node):
        self._node, self._job = node, None
        self._thread = ThreadPoolExecutor(max_workers=THREADS, thread_name_prefix="shaping")

    @property
    def busy(self):
        """Whether there is a job."""
        return self._job is not None

    def begin(self, job):
        """Work on a `Job` from now on."""
        self.drop("replaced by a newer trajectory")
        self._job = job
        self._thread.submit(self._work, job)

    def drop(self, reason):
        """Give the job up, and refuse it with the `reason`; returns whether there was one."""
        job, self._job = self._job, None
        if job is not None:
            job.refused(TrajectoryError(reason, field="trajectory"))
        return job is not None

    def forget(self):
        """Give the job up, and call nothing back."""
        self._job = None

    def look(self, now_ns):
        """Hand out the result, if it can be used at a time [ns]."""
        job = self._job
        if job is None or not job.finished(now_ns):
            return
        self._job = None
        job.answer()

    def close(self):
        """End with the node; work under way is not waited for."""
        self._job = None
        self._thread.shutdown(wait=False, cancel_futures=True)

    def _work(self, job):
        """Prepare a job, in a thread."""
        if job is self._job:
            self._node.hand_over(self._ready, job, attempt(job.prepare))

    def _ready(self, job, result):
        if job is self._job and not job.ready:
            job.put(result)
            self.look(self._node.now_ns())


def attempt(make):
    """The result of ``make()``, or the `TrajectoryError` that it raises; any other error is turned into one."""
    try:
        return make()
    except TrajectoryError as error:
        return error
    except Exception as error:  # a defect must not leave the trajectory without an answer
        return TrajectoryError(
            f"can't be shaped: {type(error).__name__}: {error}", field="trajectory"
        )
