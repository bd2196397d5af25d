# SPDX-License-Identifier: Apache-2.0
"""The trajectory that the shaper node is working on, off its own thread: a new time law can take seconds."""

from concurrent.futures import ThreadPoolExecutor

from flexarm_dynamics.errors import TrajectoryError

#: Trajectories that are worked on at once: one that was replaced is not waited for.
THREADS = 2
#: A motion that is under way is left so much later than asked for: what takes its place has this time to be made [ns].
AHEAD = 100_000_000


class Job:
    """A trajectory or a stop that is being shaped.

    Parameters
    ----------
    prepare, quick : callable
        Give its plan: of any thread, when it may take long; in the node's own, at its `due` time at the latest.
    due_ns : int or None
        When it takes the place of the motion under way [ns]; None: there is none, it begins once it is ready.
    done, refused : callable
        What the node's own thread then calls, with the plan or a `TrajectoryError`.
    """

    def __init__(self, prepare, quick, due_ns, done, refused):
        self.prepare, self.quick, self.due_ns = prepare, quick, due_ns
        self.done, self.refused = done, refused
        self.result, self.ready = None, False

    def put(self, result):
        """The plan, None where there is nothing to do, or a `TrajectoryError`."""
        self.result, self.ready = result, True

    def finished(self, now_ns):
        """Whether its result can be used at a time [ns]; at its due time the quick one is made where there is none."""
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
    """At most one `Job`: a newer one takes its place.

    Parameters
    ----------
    node : ArmNode
        With `now_ns`.
    """

    def __init__(self, node):
        self._node, self._job = node, None
        self._thread = ThreadPoolExecutor(max_workers=THREADS, thread_name_prefix="shaping")

    @property
    def busy(self):
        """Whether there is one."""
        return self._job is not None

    def begin(self, job):
        """Work on a `Job` from now on."""
        self.drop("replaced by a newer trajectory")
        self._job = job
        self._thread.submit(self._work, job)

    def drop(self, reason):
        """Work on it no more; whether there was one, which is refused with the `reason`."""
        job, self._job = self._job, None
        if job is not None:
            job.refused(TrajectoryError(reason, field="trajectory"))
        return job is not None

    def forget(self):
        """Work on it no more, and call nothing back."""
        self._job = None

    def look(self, now_ns):
        """Hand out the result, if it is time [ns]."""
        job = self._job
        if job is None or not job.finished(now_ns):
            return
        self._job = None
        job.answer()

    def close(self):
        """The node ends; what is under way is not waited for."""
        self._job = None
        self._thread.shutdown(wait=False, cancel_futures=True)

    def _work(self, job):
        """In a thread."""
        if job is self._job:
            self._node.hand_over(self._ready, job, attempt(job.prepare))

    def _ready(self, job, result):
        if job is self._job and not job.ready:
            job.put(result)
            self.look(self._node.now_ns())


def attempt(make):
    """What ``make()`` gives, or the `TrajectoryError` that it raises; any other error of it as one."""
    try:
        return make()
    except TrajectoryError as error:
        return error
    except Exception as error:  # a defect must not leave the trajectory without an answer
        return TrajectoryError(
            f"can't be shaped: {type(error).__name__}: {error}", field="trajectory"
        )
