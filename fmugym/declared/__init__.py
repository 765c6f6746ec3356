"""Tasks that are declared in a file or a dict instead of a class; see ``docs/task-file.md``."""

from fmugym.declared.loading import load
from fmugym.declared.task import Task
from fmugym.declared.task_env import TaskEnv

__all__ = ["Task", "TaskEnv", "load"]
