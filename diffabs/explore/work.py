"""A thread that does the newest of what it is asked for."""

import threading
from collections.abc import Callable

Job = Callable[[], None]


class NewestJobThread:
    """Does jobs one after the other, in a thread of its own; one that is still waiting when another comes is dropped,
    so that whoever asks faster than it works is never behind by more than one job."""

    def __init__(self, name: str, failed: Callable[[Exception], None]):
        """`name` is the thread's; `failed` is told what a job raises."""
        self._job: Job | None = None
        self._ended = False
        self._there = threading.Condition()
        self._failed = failed
        threading.Thread(target=self._work, name=name, daemon=True).start()

    def ask(self, job: Job) -> None:
        """Do this next, in place of what waits."""
        with self._there:
            self._job = job
            self._there.notify()

    def waiting(self) -> bool:
        """Whether a job waits: one that is under way may ask this to make room."""
        return self._job is not None

    def end(self) -> None:
        """Do nothing more; what is under way is finished."""
        with self._there:
            self._ended = True
            self._there.notify()

    def _work(self) -> None:
        while (job := self._next()) is not None:
            try:
                job()
            except Exception as error:
                self._failed(error)

    def _next(self) -> Job | None:
        with self._there:
            self._there.wait_for(lambda: self._ended or self._job is not None)
            job, self._job = self._job, None
            return None if self._ended else job
