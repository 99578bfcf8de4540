"""Simulations in other processes: the same numbers; what fails or is interrupted does not take the rest with it."""

import concurrent.futures
import copy
import multiprocessing
import os
import pickle
import signal

import numpy as np
import pytest
from distributed import Client, LocalCluster
from loops import steered

from covocp.base.errors import CovocpWarning, ProblemError, SolveError
from covocp.simulation.runs import simulate

RUNS, BATCH = 300, 64
ARRAYS = (
    "deviations",
    "estimates",
    "costs",
    "left",
    "asked",
    "violated",
    "at_end",
    "violating",
    "asking",
    "paths",
    "numbers",
)
MOMENTS = ("count", "mean", "product", "cube", "fourth")


@pytest.fixture(scope="module")
def lag():
    return steered(0.1)


@pytest.fixture(scope="module")
def here(lag):
    return sample_of(lag)


def sample_of(lag, runs=RUNS, batch=BATCH, **options):
    return simulate(lag, runs, 7, step=0.1, batch=batch, store=21, progress=False, **options)


def assert_same(one, two, names=ARRAYS):
    for name in names:
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name), err_msg=name)
    for name in MOMENTS if names is ARRAYS else ():
        np.testing.assert_array_equal(getattr(one.moments, name), getattr(two.moments, name), err_msg=name)


class Inline(concurrent.futures.Executor):
    """Runs a task when it is submitted; `before` may raise."""

    def __init__(self, before=lambda first: None):
        self.before, self.submitted = before, []

    def submit(self, function, plan, first, last):
        future = concurrent.futures.Future()
        self.submitted.append((first, last))
        try:
            self.before(first)
            future.set_result(function(plan, first, last))
        except BaseException as error:
            future.set_exception(error)
        return future


@pytest.mark.parametrize("batch", [1, 64, 100, 256, 1024])
def test_batches_do_not_matter(lag, here, batch):
    assert_same(here, sample_of(lag, batch=batch))


def test_the_number_of_runs_does_not_matter(lag, here):
    for runs in (65, 130):
        few = sample_of(lag, runs=runs)
        for name in ("deviations", "estimates", "costs"):
            np.testing.assert_array_equal(getattr(few, name), getattr(here, name)[:runs], err_msg=name)


def test_another_seed_is_another_sample(lag, here):
    other = simulate(lag, RUNS, 8, step=0.1, progress=False)
    assert (np.abs(other.deviations - here.deviations) > 0).all()


def test_processes_give_the_same_numbers(lag, here):
    context = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(2, mp_context=context) as executor:
        sample = sample_of(lag, executor=executor)
    assert_same(here, sample)
    assert str(sample) == str(here)


def test_threads_give_the_same_numbers(lag, here):
    with concurrent.futures.ThreadPoolExecutor(2) as executor:
        assert_same(here, sample_of(lag, executor=executor))


def test_a_cluster_gives_the_same_numbers(lag, here, tmp_path):
    with (
        LocalCluster(
            n_workers=2,
            threads_per_worker=1,
            processes=True,
            dashboard_address=None,
            local_directory=str(tmp_path),
            host="127.0.0.1",
        ) as cluster,
        Client(cluster) as client,
    ):
        processes = set(client.run(os.getpid).values())
        sample = sample_of(lag, executor=client.get_executor())
    assert len(processes) == 2
    assert os.getpid() not in processes
    assert_same(here, sample)


def test_a_task_that_fails_loses_its_runs_only(lag, here):
    def before(first):
        if first == 128:
            raise OSError("the node is gone\nand more")

    with pytest.warns(CovocpWarning, match="runs 128 to 191: OSError: the node is gone"):
        sample = sample_of(lag, executor=Inline(before))
    kept = np.r_[0:128, 192:RUNS]
    assert (sample.numbers == kept).all()
    np.testing.assert_array_equal(sample.deviations, here.deviations[kept])
    assert sample.requested == RUNS
    assert sample.runs == RUNS - 64
    assert [(f.first, f.last) for f in sample.failed] == [(128, 192)]
    assert "FAILED: runs 128 to 191" in str(sample)
    assert not sample.interrupted


def test_an_executor_that_breaks_down_keeps_what_is_finished(lag):
    class Breaking(Inline):
        def submit(self, function, plan, first, last):
            if first >= 128:
                raise concurrent.futures.BrokenExecutor("a process was killed")
            return super().submit(function, plan, first, last)

    with pytest.warns(CovocpWarning, match="BrokenExecutor"):
        sample = sample_of(lag, executor=Breaking())
    assert sample.runs == 128
    assert len(sample.failed) == 3


def test_where_every_task_fails_nothing_is_left(lag):
    def before(first):
        raise MemoryError

    with pytest.raises(SolveError, match="every task failed"):
        sample_of(lag, executor=Inline(before))


@pytest.mark.parametrize("executor", [3, "processes", type("Odd", (), {"submit": lambda self, *given: 1})()])
def test_what_is_no_executor_is_refused(lag, executor):
    with pytest.raises(ProblemError, match=r"concurrent\.futures"):
        sample_of(lag, executor=executor)


def test_an_interrupt_keeps_the_finished_runs(lag, here, monkeypatch):
    from covocp.simulation import workers

    simulated = workers.run_batch

    def interrupted(plan, first, last, stop):
        if first == 128:
            signal.raise_signal(signal.SIGINT)
        return simulated(plan, first, last, stop)

    monkeypatch.setattr(workers, "run_batch", interrupted)
    with pytest.warns(CovocpWarning, match="Interrupted: 128 of 300 runs"):
        sample = sample_of(lag)
    assert sample.interrupted
    np.testing.assert_array_equal(sample.deviations, here.deviations[:128])
    assert "INTERRUPTED: 128 of 300" in str(sample)


def test_an_interrupt_of_an_executor_keeps_the_finished_runs(lag, here):
    class Slow(Inline):
        def submit(self, function, plan, first, last):
            if first < 128:
                return super().submit(function, plan, first, last)
            return concurrent.futures.Future()  # never finished

    def before(first):
        if first == 64:
            signal.raise_signal(signal.SIGINT)

    executor = Slow(before)
    with pytest.warns(CovocpWarning, match="Interrupted: 128 of 300 runs"):
        sample = sample_of(lag, executor=executor)
    np.testing.assert_array_equal(sample.deviations, here.deviations[:128])
    assert not sample.failed


def test_an_interrupt_before_the_first_run_is_one(lag, monkeypatch):
    from covocp.simulation import workers

    def interrupted(*given):
        raise KeyboardInterrupt

    monkeypatch.setattr(workers, "run_batch", interrupted)
    with pytest.raises(KeyboardInterrupt):
        sample_of(lag)


def test_an_interrupt_while_the_step_is_chosen_is_one(lag, monkeypatch):
    from covocp.simulation import step_choice

    simulated = step_choice.run_batch

    def interrupted(plan, first, last, stop):
        signal.raise_signal(signal.SIGINT)
        return simulated(plan, first, last, stop)

    monkeypatch.setattr(step_choice, "run_batch", interrupted)
    with pytest.raises(KeyboardInterrupt):
        simulate(lag, 64, 1, progress=False)


def test_a_result_that_was_sent_to_another_process_knows_names(lag, here):
    again = pickle.loads(pickle.dumps(here))
    assert_same(again, here)
    assert str(again) == str(here)
    assert (again.violations, again.chances, again.verdict) == (here.violations, here.chances, here.verdict)
    (state, *_) = [block.name for block in here.blocks if block.kind == "state"]
    assert np.array_equal(again.covariance(state), here.covariance(here.symbols[state]))
    assert again.to_dict().keys() == here.to_dict().keys()
    assert len(again.plot().axes) == len(here.plot().axes)
    with pytest.raises(ProblemError, match="sent to another process") as caught:
        again.deviation(here.symbols[state])
    assert caught.value.remedy == f"give the name as a string: '{state}'"
    assert copy.deepcopy(here).symbols == here.symbols  # within a process nothing is lost
    sample = lag.at([0.0, 1.0])
    assert np.array_equal(pickle.loads(pickle.dumps(sample))[state], sample[sample.symbols[state]])
