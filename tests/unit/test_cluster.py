"""Tasks on a real Dask cluster: the same outcomes as here, a killed worker costs its task only, and what is in the way is one line."""

import importlib
import os
import time
from collections.abc import Iterator
from contextlib import closing

import pytest

pytest.importorskip("distributed", reason="the extra cluster is not installed")

from dask_cluster import DaskCluster, dask_cluster, die, die_once, wants_more, where

import tcpipe
from tcpipe import execution
from tcpipe.errors import TcpipeError, UsageError
from tcpipe.execution import run_all
from tcpipe.progress import STEP, Step, step_of


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[DaskCluster]:
    with dask_cluster(tmp_path_factory.mktemp("dask")) as running:
        yield running


def test_workers_do_all_tasks_and_what_they_say_is_said_here(cluster, caplog):
    with caplog.at_level(STEP, "tcpipe"):
        outcomes = sorted(run_all(where, range(9), jobs=1, cluster=cluster.address), key=lambda outcome: outcome.index)
    assert [outcome.result[0] for outcome in outcomes] == [value * value for value in range(9)]
    assert list(run_all(where, [], jobs=1, cluster=cluster.address)) == []
    assert os.getpid() not in {outcome.result[1] for outcome in outcomes}
    said = [record for record in caplog.records if record.name == "tcpipe"]
    assert sorted(filter(None, map(step_of, said)), key=str) == [Step(f"log {n}", "squaring", 0, 0) for n in range(9)]
    assert sorted(record.getMessage() for record in said if step_of(record) is None) == [f"task {n}" for n in range(9)]


def test_the_task_of_a_killed_worker_runs_again_and_costs_no_other(cluster, tmp_path):
    outcomes = list(
        run_all(die_once, [tmp_path / "a", tmp_path / "b", tmp_path / "b"], jobs=1, cluster=cluster.address)
    )
    assert sorted(outcome.index for outcome in outcomes) == [0, 1, 2]
    assert not any(outcome.died for outcome in outcomes)


def test_a_task_that_kills_its_workers_is_named(cluster, caplog):
    assert [outcome.died for outcome in run_all(die, [1], jobs=1, cluster=cluster.address)] == [True]
    assert "a task ended without a result (KilledWorker: " in caplog.text


def test_a_worker_of_another_version_is_refused(cluster, monkeypatch):
    monkeypatch.setattr(execution, "__version__", "99.0")
    with pytest.raises(UsageError, match=f"a worker has tcpipe {tcpipe.__version__}, expected 99.0 as here"):
        list(run_all(where, [1], jobs=1, cluster=cluster.address))


def test_what_a_worker_or_the_scheduler_lacks_is_one_line(cluster, tmp_path, monkeypatch):
    with pytest.raises(
        UsageError, match=r"tcp://.*: a worker lacks nowhere_to_be_had; install the same packages there"
    ):
        list(run_all(wants_more, [1], jobs=1, cluster=cluster.address))
    (tmp_path / "only_here.py").write_text("def task(value):\n    return value\n")
    monkeypatch.syspath_prepend(tmp_path)
    task = importlib.import_module("only_here").task
    with pytest.raises(
        UsageError, match=r"tcp://.*: the scheduler lacks tcpipe; install the same packages there as here"
    ):
        list(run_all(task, [1], jobs=1, cluster=cluster.address))


def test_a_scheduler_that_is_not_there_is_one_line(monkeypatch):
    monkeypatch.setattr(execution, "_ANSWER_S", 1)
    with pytest.raises(UsageError, match=r"tcp://127\.0\.0\.1:9: no Dask scheduler answers"):
        list(run_all(where, [1], jobs=1, cluster="tcp://127.0.0.1:9"))
    for address in ("nowhere", "ftp://x:1", "tcp://x"):
        with pytest.raises(UsageError, match="no address of a scheduler; expected tcp://host:port"):
            list(run_all(where, [1], jobs=1, cluster=address))


def test_a_scheduler_without_workers_and_a_worker_of_many_threads_are_one_line(tmp_path, monkeypatch):
    assert execution._ANSWER_S <= 10, "with what Python takes to start, a report after 15 s"
    with dask_cluster(tmp_path, workers=0) as lonely:
        with monkeypatch.context() as patch:
            patch.setattr(execution, "_ANSWER_S", 1)
            with pytest.raises(
                UsageError, match=r"no workers after 1 s; start one: dask worker tcp://\S+ --nthreads 1"
            ):
                list(run_all(where, [1], jobs=1, cluster=lonely.address))
        lonely.start_worker(threads=2)
        with pytest.raises(UsageError, match="has 2 threads; expected one thread per worker"):
            list(run_all(where, [1], jobs=1, cluster=lonely.address))


def test_workers_that_stay_away_and_a_scheduler_that_goes_are_one_line(tmp_path, monkeypatch, caplog):
    with dask_cluster(tmp_path, workers=1) as brief:
        with closing(run_all(time.sleep, [0, 600], jobs=1, cluster=brief.address)) as outcomes:
            next(outcomes)
            with monkeypatch.context() as patch:
                patch.setattr(execution, "_ANSWER_S", 1)
                patch.setattr(execution, "_ALONE_S", 1)
                brief.workers[0].kill()
                with pytest.raises(TcpipeError, match="had no workers for 1 s; start workers"):
                    next(outcomes)
        assert "lost all its workers; waiting for one" in caplog.text
        brief.start_worker()
        with closing(run_all(time.sleep, [0, 600], jobs=1, cluster=brief.address)) as outcomes:
            next(outcomes)
            brief.scheduler.kill()
            with pytest.raises(TcpipeError, match="the scheduler stopped; start it and run the same command again"):
                next(outcomes)
