"""Work on several cores, in processes that end with their parent."""

import contextlib
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any, TypeVar

Item = TypeVar("Item")
Answer = TypeVar("Answer")


class WorkerEnded(RuntimeError):
    """A process ended before it answered, perhaps for want of memory."""


def map_in_processes(
    function: Callable[[Item], Answer], items: Sequence[Item], processes: int
) -> Iterator[tuple[int, Answer]]:
    """Yield the index of each item and its answer, in the order in which the answers come.

    The processes start by `spawn`, so a script that calls this needs `if __name__ == "__main__"`. They end when the
    iterator is closed or fails, and when this process ends in whatever way. They do not hear Ctrl-C.

    Args:
        function: Function of a module; it and its answers must be picklable.
        items: Arguments, one for each call.
        processes: Number of processes at most.

    Raises:
        WorkerEnded: A process ended before it answered.
        Exception: Whatever `function` raised.
    """
    left = iter(enumerate(items))
    running: dict[Connection, tuple[BaseProcess, int]] = {}

    def give(pipe: Connection, process: BaseProcess) -> None:
        for i, item in left:
            with contextlib.suppress(OSError):  # the end of the process is noticed below
                pipe.send(item)
            running[pipe] = process, i
            return
        pipe.close()

    started: list[BaseProcess] = []
    try:
        for _ in range(min(processes, len(items))):
            pipe, process = _start(function)
            started.append(process)
            give(pipe, process)
        while running:
            for pipe in wait(list(running)):
                assert isinstance(pipe, Connection)
                process, i = running.pop(pipe)
                try:
                    answer, error = pipe.recv()
                except (EOFError, OSError):
                    process.join(1.0)
                    raise WorkerEnded(f"a process ended before it answered, status {process.exitcode}") from None
                if error is not None:
                    raise error
                give(pipe, process)
                yield i, answer
    finally:
        for process in started:
            process.kill()
        for process in started:
            process.join()


def _start(function: Callable[[Any], Any]) -> tuple[Connection, BaseProcess]:
    """Start a process that answers items through a pipe."""
    context = multiprocessing.get_context("spawn")
    pipe, far = context.Pipe()
    process = context.Process(target=_answer_items, args=(far,), daemon=True)
    # The new process inherits the mask, so the terminal's Ctrl-C never reaches it, not even while it starts.
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT}) if hasattr(signal, "pthread_sigmask") else None
    try:
        process.start()
    finally:
        if before is not None:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
    far.close()
    with contextlib.suppress(OSError):
        pipe.send(function)
    return pipe, process


def _answer_items(pipe: Connection) -> None:
    """Answer the items of a pipe until it is closed: (answer, None) or (None, error)."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    with contextlib.suppress(EOFError, OSError):
        function = pipe.recv()
        while True:
            item = pipe.recv()
            try:
                answer = function(item), None
            except Exception as error:
                answer = None, error
            pipe.send(answer)


def _end_with_parent() -> None:
    """End this process as soon as its parent has ended."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
