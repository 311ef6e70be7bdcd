"""Lists of tasks: whole folders or none, resumed, dead workers replaced, what fails put aside."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from optsim.core.errors import ConfigError, StorageError
from optsim.tasks import Task, run_tasks, task_record
from optsim.tasks.folder import make_folder

PROGRAM = """
import os, sys, time
from pathlib import Path
from optsim.core.errors import ConfigError
from optsim.tasks import Task, run_tasks
import tasks_of_a_test as work
if __name__ == "__main__":
    root = Path(sys.argv[1])
    tasks = [Task(f"train/s{i}", str(i), work.write, (i,)) for i in range(6)]
    tasks += [Task(f"bad/{what}", what, work.fail, (what,)) for what in sys.argv[2:]]
    outcome = run_tasks(tasks, root, workers=2)
    print(len(outcome.made), len(outcome.found), sorted(outcome.failed.items()))
"""
WORK = """
import os, time
from optsim.core.errors import ConfigError

def write(folder, number):
    (folder / "a").write_text(str(number))
    time.sleep(0.3)
    (folder / "b").write_text(os.environ["OPTSIM_THREADS"])

def fail(folder, what):
    (folder / "attempt").open("a").write("x")
    if what == "dies":
        os._exit(9)
    if what == "user":
        raise ConfigError("lens: got 3, expected 1")
    raise KeyError("boom")
"""


def write(folder: Path, text: str) -> None:
    (folder / "a").write_text(text)


def stop(folder: Path, text: str) -> None:
    (folder / "a").write_text(text)
    raise KeyboardInterrupt


@pytest.fixture
def program(tmp_path):
    (tmp_path / "tasks_of_a_test.py").write_text(WORK)
    (tmp_path / "program.py").write_text(PROGRAM)
    path = os.pathsep.join([str(tmp_path), str(Path(__file__).parents[1])])
    command = [sys.executable, str(tmp_path / "program.py"), str(tmp_path / "out")]
    return command, {**os.environ, "PYTHONPATH": path}


def whole(root: Path) -> list[str]:
    """Names of the folders that are there, each of which must be whole."""
    for folder in (found := [p for p in sorted(root.glob("train/*")) if p.name[0] != "."]):
        assert {p.name for p in folder.iterdir()} == {"a", "b"}
    return [folder.name for folder in found]


def test_the_good_are_made_and_the_bad_put_aside(program, tmp_path):
    command, environment = program
    told = subprocess.run(
        [*command, "user", "raises"], env=environment, capture_output=True, text=True, check=False
    )
    assert told.returncode == 0, told.stderr
    made, found, rest = told.stdout.strip().split(" ", 2)
    assert (made, found) == ("6", "0")
    assert rest == "[('bad/raises', \"KeyError: 'boom'\"), ('bad/user', 'lens: got 3, expected 1')]"
    assert whole(tmp_path / "out") == [f"s{i}" for i in range(6)]
    tries = {p.parent.name: p.read_text() for p in (tmp_path / "out/bad").glob(".*.part/attempt")}
    # What the user can mend is not tried again.
    assert tries == {".raises.part": "xxx", ".user.part": "x"}
    assert (tmp_path / "out/train/s0/b").read_text() == str(max(1, len(os.sched_getaffinity(0)) // 2))


def test_a_killed_list_goes_on_and_dead_workers_are_replaced(program, tmp_path):
    command, environment = program
    running = subprocess.Popen(command, env=environment, start_new_session=True)
    deadline = time.monotonic() + 300
    while not whole(tmp_path / "out") and time.monotonic() < deadline:
        time.sleep(0.02)
    os.killpg(running.pid, signal.SIGKILL)
    running.wait()
    before = whole(tmp_path / "out")
    assert before
    command = [*command, "dies"]
    again = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    made, found, failed = again.stdout.strip().split(" ", 2)
    assert int(made) + int(found) == 6
    assert int(found) >= len(before)
    assert failed.startswith("[('bad/dies', '3 workers died at it")
    assert (tmp_path / "out/bad/.dies.part/attempt").read_text() == "xxx"
    assert len(whole(tmp_path / "out")) == 6


def test_a_task_is_not_there_before_it_is_whole_and_never_made_twice(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        make_folder(tmp_path, Task("a/b", "k", stop, ("half",)))
    task = Task("a/b", "k", write, ("whole",))
    assert task_record(tmp_path, task) is None
    assert make_folder(tmp_path, task) == "made"
    assert make_folder(tmp_path, Task("a/b", "k", stop, ("again",))) == "found"
    assert (tmp_path / "a/b/a").read_text() == "whole"
    with pytest.raises(StorageError, match=r"a/b: got a folder made from something else"):
        make_folder(tmp_path, Task("a/b", "other", write, ("x",)))


def test_shards_are_parts_that_together_are_the_list(tmp_path):
    tasks = [Task(str(n), "k", write, (str(n),)) for n in range(7)]
    for task in tasks:
        make_folder(tmp_path, task)
    shards = [run_tasks(tasks, tmp_path, shard=(part, 3)).found for part in (1, 2, 3)]
    assert sorted(name for shard in shards for name in shard) == [str(n) for n in range(7)]
    with pytest.raises(ConfigError, match="--shard: got 4/3"):
        run_tasks(tasks, tmp_path, shard=(4, 3))
    with pytest.raises(ConfigError, match="more than once"):
        run_tasks([*tasks, tasks[0]], tmp_path)


def test_a_scheduler_that_is_not_there_is_said(tmp_path, monkeypatch):
    from optsim.tasks import run

    monkeypatch.setattr(run, "_PATIENCE_S", 1)
    with pytest.raises(ConfigError, match=r"--scheduler: got 'tcp://127\.0\.0\.1:9'"):
        run_tasks([Task("a", "k", write, ("x",))], tmp_path, scheduler="tcp://127.0.0.1:9")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("jobs = 3", r"without a \[cluster\] table"),
        ("[cluster]\nkind = 'slurm'\njobs = 0", "jobs"),
        ("[cluster]\nkind = 'cloud'\njobs = 2", "kind"),
    ],
)
def test_a_bad_cluster_table_is_said(text, said, tmp_path):
    (tmp_path / "cluster.toml").write_text(text)
    with pytest.raises(ConfigError, match=said):
        run_tasks([Task("a", "k", write, ("x",))], tmp_path, scheduler=str(tmp_path / "cluster.toml"))


# The class for the shell leaves its processes' pipes to the garbage collector.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning", "ignore::ResourceWarning")
def test_jobs_of_a_batch_system_do_the_list(tmp_path, monkeypatch):
    """Jobs of the shell stand for those of a cluster: the same class of dask-jobqueue starts them."""
    pytest.importorskip("dask_jobqueue")
    (tmp_path / "tasks_of_a_test.py").write_text(WORK)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")]))
    monkeypatch.setenv("OPTSIM_THREADS", "1")
    monkeypatch.syspath_prepend(tmp_path)
    import tasks_of_a_test as work

    (tmp_path / "cluster.toml").write_text("[cluster]\nkind = 'local'\njobs = 2\nmemory = '1 GB'\n")
    tasks = [Task(f"train/s{i}", str(i), work.write, (i,)) for i in range(3)]
    outcome = run_tasks(tasks, tmp_path / "out", scheduler=str(tmp_path / "cluster.toml"))
    assert (sorted(outcome.made), outcome.failed) == (["train/s0", "train/s1", "train/s2"], {})
    assert whole(tmp_path / "out") == ["s0", "s1", "s2"]
