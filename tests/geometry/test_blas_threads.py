"""One BLAS thread while the library computes, and what was set before it afterwards."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import warnings
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from threadpoolctl import OpenBLASController, ThreadpoolController

import gtsam_rwhec as rw
from gtsam_rwhec.errors import NotUniqueWarning, WeightsWarning
from gtsam_rwhec.geometry.blas_threads import one_blas_thread
from gtsam_rwhec.methods import opencv
from gtsam_rwhec.simulate import Noise, general

#: Threads that each test begins with, more than one on any machine.
THREADS = 3
BLAS = ThreadpoolController().select(user_api="blas")


def threads() -> set[int]:
    """The numbers of threads of all BLAS libraries that are loaded now: NumPy's, SciPy's."""
    return {library["num_threads"] for library in BLAS.info()}


def set_threads(count: int) -> None:
    """Set them so that any Python thread may change them afterwards."""
    for library in BLAS.lib_controllers:
        library.set_num_threads(count)
    OpenBLASController.clear_controlling_thread()
    assert threads() == {count}


@pytest.fixture(autouse=True)
def several_threads() -> Iterator[None]:
    before = {library["num_threads"] for library in BLAS.info()}
    set_threads(THREADS)
    yield
    left = threads()
    set_threads(max(before))
    assert left == {THREADS}, "another number of threads than it was before the call"


def simulated(count: int = 10) -> rw.Problem:
    return general(2, 2, seed=0, number_of_measurements=count, noise=Noise(0.003, 1000.0)).problem


class Seen:
    """A progress display that writes down the numbers of threads whenever it is called."""

    def __init__(self) -> None:
        self.threads: list[set[int]] = []

    def __call__(self, stage: str) -> None:
        self.threads.append(threads())


def certify(problem: rw.Problem, seen: Seen) -> None:
    solution = rw.solve(problem)
    rw.certify(problem, solution.X, solution.Y, progress=seen)


CALLS: dict[str, Callable[[rw.Problem, Seen], object]] = {
    "solve": lambda problem, seen: rw.solve(problem, progress=seen),
    "certify": certify,
    "refine": lambda problem, seen: rw.refine(problem, rw.solve(problem), progress=seen),
    "calibrate": lambda problem, seen: rw.calibrate(problem, progress=seen),
    "cross_validate": lambda problem, seen: rw.cross_validate(problem, 2, progress=seen),
    "compare": lambda problem, seen: rw.methods.compare(problem, methods=["shah2013"], progress=seen),
}


@pytest.mark.parametrize("call", CALLS)
def test_one_thread_inside(call: str) -> None:
    seen = Seen()
    CALLS[call](simulated(), seen)
    assert seen.threads
    assert all(count == {1} for count in seen.threads)


def test_one_thread_in_methods_without_progress(monkeypatch: pytest.MonkeyPatch) -> None:
    """Methods tell no stages; every eigenvalue problem and singular value decomposition is looked at in its place."""
    found: list[set[int]] = []

    def watched(function: Callable[..., object]) -> Callable[..., object]:
        def call(*arguments: object, **options: object) -> object:
            found.append(threads())
            return function(*arguments, **options)

        return call

    for name in ("eigh", "svd", "lstsq", "solve"):
        monkeypatch.setattr(np.linalg, name, watched(getattr(np.linalg, name)))
    problem = general(1, 1, seed=0, number_of_measurements=10, noise=Noise(0.003, 1000.0)).problem
    raw = problem.measurements(*problem.pairs[0])
    A, B = raw.A, raw.B
    calls: list[Callable[[], object]] = [
        lambda: rw.methods.run("shah2013", problem),
        lambda: rw.methods.solve_hand_eye(np.linalg.inv(A[:-1]) @ A[1:], B[:-1] @ np.linalg.inv(B[1:])),
        lambda: opencv.calibrateHandEye(A[:, :3, :3], A[:, :3, 3], B[:, :3, :3], B[:, :3, 3]),
        lambda: opencv.calibrateRobotWorldHandEye(A[:, :3, :3], A[:, :3, 3], B[:, :3, :3], B[:, :3, 3]),
    ]
    for call in calls:
        found.clear()
        call()
        assert found
        assert all(count == {1} for count in found)


def test_restored_after_an_exception_in_a_block() -> None:
    @one_blas_thread()
    def fails() -> None:
        raise ZeroDivisionError(threads())

    with pytest.raises(ZeroDivisionError, match=r"\{1\}"):
        fails()


def test_an_exception_of_the_progress_display() -> None:
    def stop(stage: str) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        rw.solve(simulated(), progress=stop)


def test_nested_calls_restore_at_the_end_of_the_outer_one() -> None:
    with one_blas_thread():
        with one_blas_thread():
            assert threads() == {1}
        assert threads() == {1}


def test_calls_that_overlap_in_several_threads() -> None:
    """The first to come is the first to go: what was set returns only when the last one has gone."""
    entered, first_left = threading.Event(), threading.Event()
    found: list[set[int]] = []

    def second() -> None:
        with one_blas_thread():
            entered.set()
            assert first_left.wait(60.0)
            found.append(threads())

    other = threading.Thread(target=second)
    with one_blas_thread():
        other.start()
        assert entered.wait(60.0)
    found.append(threads())
    first_left.set()
    other.join()
    assert found == [{1}, {1}]


def test_many_threads_solve_at_once() -> None:
    problem, answers = simulated(), []
    expected = rw.solve(problem).cost
    workers = [threading.Thread(target=lambda: answers.append(rw.solve(problem).cost)) for _ in range(6)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    assert answers == [expected] * 6


def test_a_number_that_the_user_sets_meanwhile_stays() -> None:
    with one_blas_thread():
        set_threads(THREADS + 1)
    assert threads() == {THREADS + 1}
    set_threads(THREADS)


def test_a_limit_that_the_user_sets_around_a_call_is_restored_too() -> None:
    with BLAS.limit(limits=2):
        seen = Seen()
        rw.solve(simulated(), progress=seen)
        assert threads() == {2}
    assert all(count == {1} for count in seen.threads)


#: The beginning of programs of their own: all BLAS libraries that the library has loaded by then have three threads.
BEGINNING = f"""
import os, threading
import gtsam_rwhec as rw
from gtsam_rwhec.simulate import general
from threadpoolctl import OpenBLASController, ThreadpoolController, threadpool_info

problem = general(1, 1, seed=0).problem
rw.solve

def counts():
    return {{i["filepath"]: i["num_threads"] for i in threadpool_info() if i["user_api"] == "blas"}}

for library in ThreadpoolController().select(user_api="blas").lib_controllers:
    library.set_num_threads({THREADS})
OpenBLASController.clear_controlling_thread()
before = counts()
"""


def run_apart(code: str) -> None:
    """Run a program after ``BEGINNING``; it must end without an error."""
    subprocess.run([sys.executable, "-W", "ignore", "-c", BEGINNING + code], check=True, timeout=120)


def test_no_library_comes_after_the_search_for_libraries() -> None:
    """In a process of its own, where nothing but the library has loaded them."""
    run_apart(
        f"""
seen = []
rw.solve(problem, progress=lambda stage: seen.append(counts()))
assert set(before.values()) == {{{THREADS}}}
assert seen and all(inside == dict.fromkeys(before, 1) for inside in seen), seen
assert counts() == before
"""
    )


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system does not fork")
def test_a_child_of_a_process_that_holds_the_limit() -> None:
    """It does not wait for a lock that another thread of its parent held."""
    run_apart(
        """
from gtsam_rwhec.geometry.blas_threads import one_blas_thread
stop = threading.Event()

def work():
    while not stop.is_set():
        with one_blas_thread():
            pass

other = threading.Thread(target=work)
other.start()
for _ in range(10):
    child = os.fork()
    if child == 0:
        with one_blas_thread():
            os._exit(0 if set(counts().values()) == {1} else 1)
    assert os.waitpid(child, 0)[1] == 0
stop.set()
other.join()
assert counts() == before, counts()
"""
    )


def test_warnings_point_to_the_caller() -> None:
    """The decorator is a frame of its own between a function and its caller."""
    problem = general(1, 1, seed=0, motion="planar", noise=Noise(0.01, 500.0)).problem
    with warnings.catch_warnings(record=True, action="always") as caught:
        rw.refine(problem, rw.solve(problem))
    assert {warning.category for warning in caught} == {NotUniqueWarning}
    noisy = general(1, 1, seed=0, number_of_measurements=30, noise=Noise(0.01, 500.0)).problem
    raw = noisy.measurements(*noisy.pairs[0])
    told = rw.Problem()
    told.add(*noisy.pairs[0], raw.A, raw.B, 1e-4, 1e6)
    with warnings.catch_warnings(record=True, action="always") as also:
        rw.refine(told, rw.solve(told), rw.RefineOptions(max_iterations=1))
    assert WeightsWarning in {warning.category for warning in also}
    for warning in [*caught, *also]:
        assert warning.filename == __file__, warning
