"""Pieces of work that do not depend on each other, in one process or in several."""

from __future__ import annotations

import multiprocessing
import multiprocessing.connection
import os
import signal
import threading
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from typing import TypeVar

import torch

Key = TypeVar("Key")
Result = TypeVar("Result")


def results(
    jobs: Mapping[Key, Callable[[], Result]], processes: int, safe_point: Callable[[], None] = lambda: None
) -> Iterator[tuple[Key, Result]]:
    """(key, result) of every job, in the order in which they end.

    ``jobs`` are functions of modules with their arguments (``functools.partial``), which other processes can load by
    name. ``safe_point`` is called between jobs, and now and then while processes work; it may raise to end the work.
    Raises what a job raises. However the work ends, no process of it is left.
    """
    if processes == 1 or len(jobs) < 2:
        for key, job in jobs.items():
            safe_point()
            yield key, job()
        return
    # spawn: a fork would copy the threads of torch and Numba in whatever state they are.
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(min(processes, len(jobs)), mp_context=context, initializer=_start_worker)
    try:
        futures = {pool.submit(job): key for key, job in jobs.items()}
        while futures:
            ready, _ = wait(futures, timeout=0.5, return_when=FIRST_COMPLETED)
            for future in ready:
                yield futures.pop(future), future.result()
            safe_point()
    except BaseException:
        for process in multiprocessing.active_children():
            process.terminate()
        raise
    finally:
        pool.shutdown(cancel_futures=True)


def _start_worker() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends the work
    torch.set_num_threads(1)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def follow() -> None:
        multiprocessing.connection.wait([parent.sentinel])
        os._exit(1)

    # A killed parent cannot end its workers, which would wait for more work for ever.
    threading.Thread(target=follow, daemon=True).start()
