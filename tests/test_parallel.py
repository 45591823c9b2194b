"""Work in several processes: the same results, and no process left behind."""

import multiprocessing
import signal
from functools import partial
from typing import Any

import pytest

from erl_torch import parallel

SQUARES = {n: partial(pow, n, 2) for n in range(4)}
FOR_EVER = partial(signal.pause)


@pytest.mark.parametrize("processes", [1, 2])
def test_every_job_is_done_once(processes):
    assert sorted(parallel.results(SQUARES, processes)) == [(n, n * n) for n in range(4)]


def test_a_failure_ends_jobs_that_never_end():
    with pytest.raises(ValueError, match="invalid literal"):
        list(parallel.results({"fails": partial(int, "x"), "waits": FOR_EVER}, 2))
    assert multiprocessing.active_children() == []


def test_who_stops_asking_ends_jobs_that_never_end():
    work: Any = parallel.results({"ends": partial(pow, 3, 2), "waits": FOR_EVER}, 2)
    assert next(work) == ("ends", 9)
    work.close()
    assert multiprocessing.active_children() == []


@pytest.mark.parametrize("processes", [1, 2])
def test_a_safe_point_may_end_the_work(processes):
    def stop():
        raise SystemExit(130)

    with pytest.raises(SystemExit):
        list(parallel.results(SQUARES, processes, stop))
    assert multiprocessing.active_children() == []
