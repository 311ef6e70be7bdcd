# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false, reportUnknownVariableType=false
# pyright: reportUnknownArgumentType=false
"""Workers that a batch system starts: the ``[cluster]`` table of a TOML file, for dask-jobqueue."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from optsim.core.config import Part, build, read_toml
from optsim.core.errors import ConfigError

_CLASSES = {
    "slurm": "SLURMCluster",
    "pbs": "PBSCluster",
    "sge": "SGECluster",
    "lsf": "LSFCluster",
    "htcondor": "HTCondorCluster",
    "oar": "OARCluster",
    "moab": "MoabCluster",
    # Jobs of this machine's shell, to try a table out.
    "local": "local.LocalCluster",
}


class Cluster(Part):
    """A batch system whose jobs are workers.

    Parameters
    ----------
    kind : str
        Batch system.
    jobs : int
        Jobs to ask for; each is one worker with one task at a time.
    cores : int
        Cores of a job, used by the threads of its task.
    memory : str
        Memory of a job, such as ``"4 GB"``.
    walltime : str
        Longest time of a job, as the batch system writes it. The rest of the list waits for the next job.
    options : dict
        Further arguments of dask-jobqueue's class, such as ``queue`` or ``account``.
    """

    kind: Literal["slurm", "pbs", "sge", "lsf", "htcondor", "oar", "moab", "local"]
    jobs: int = Field(ge=1, le=100_000)
    cores: int = Field(default=1, ge=1, le=1024)
    memory: str = "4 GB"
    walltime: str = "04:00:00"
    options: dict[str, Any] = Field(default={})


def read_cluster(path: Path) -> Cluster:
    """Read the ``[cluster]`` table of a TOML file."""
    table = read_toml(path)
    if not isinstance(table.get("cluster"), dict):
        raise ConfigError(
            f"--scheduler: got {path} without a [cluster] table; cure: add one, with kind and jobs"
        )
    return build(Cluster, table["cluster"], where=f"{path}: [cluster]")


@contextmanager
def running(cluster: Cluster, workers: int) -> Generator[Any]:
    """Start a scheduler here and its jobs, at most one a task; all end with the block."""
    module, _, name = f"dask_jobqueue.{_CLASSES[cluster.kind]}".rpartition(".")
    try:
        made = getattr(import_module(module), name)
    except ImportError:
        raise ConfigError(
            "--scheduler: [cluster] needs dask-jobqueue; cure: pip install 'optsim[cluster]'"
        ) from None
    options: dict[str, Any] = {"cores": cluster.cores, "processes": 1, "memory": cluster.memory}
    # dask's threads are tasks: one at a time, with all cores of the job.
    options["worker_extra_args"] = ["--nthreads", "1"]
    if cluster.kind != "local":
        options["job_script_prologue"] = [f"export OPTSIM_THREADS={cluster.cores}"]
    if cluster.kind not in ("local", "htcondor"):
        options["walltime"] = cluster.walltime
    try:
        jobs = made(**{**options, **cluster.options})
    except (TypeError, ValueError) as error:
        raise ConfigError(f"[cluster]: got options that dask-jobqueue refuses ({error})") from None
    with jobs:
        jobs.scale(jobs=min(cluster.jobs, workers))
        yield jobs
