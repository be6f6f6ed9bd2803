"""A worker thread that runs only the newest of the waiting jobs."""

import contextlib
import threading
from collections.abc import Callable

Job = Callable[[], None]


class NewestJobThread:
    """A thread that runs jobs one after the other.

    A new job replaces a job that still waits, so at most one job waits. A job reports its own errors.
    """

    def __init__(self, name: str):
        """Start a thread with this `name`."""
        self._job: Job | None = None
        self._ended = False
        self._changed = threading.Condition()
        threading.Thread(target=self._work, name=name, daemon=True).start()

    def ask(self, job: Job) -> None:
        """Run the `job` next, in place of a job that waits."""
        with self._changed:
            self._job = job
            self._changed.notify()

    def end(self) -> None:
        """End the thread after the current job."""
        with self._changed:
            self._ended = True
            self._changed.notify()

    def _work(self) -> None:
        while (job := self._next()) is not None:
            with contextlib.suppress(Exception):  # an error must not end the thread
                job()

    def _next(self) -> Job | None:
        with self._changed:
            self._changed.wait_for(lambda: self._ended or self._job is not None)
            job, self._job = self._job, None
            return None if self._ended else job
