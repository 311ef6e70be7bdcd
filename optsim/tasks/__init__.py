"""Long lists of tasks, each making one folder, in workers of this machine or of a cluster; they resume."""

from optsim.tasks.folder import RECORDS, Task, task_record
from optsim.tasks.run import Outcome, default_workers, run_tasks, tell

__all__ = ["RECORDS", "Outcome", "Task", "default_workers", "run_tasks", "task_record", "tell"]
