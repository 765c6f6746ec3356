"""Tasks that are declared in a file or a dict instead of a class; see ``docs/task-file.md``."""

from fmugym.task.task_env import TaskEnv, load
from fmugym.task.task_file import Task

__all__ = ["Task", "TaskEnv", "load"]
