"""Sweeps: one command with many arguments, on this machine or a cluster, each result landing once.

A file names a command of ``cfb`` and what varies (`config`, `tasks`); every combination is a task with a name and a
command line. Workers run tasks apart and land each with one rename (`attempt`, `folder`); the driver notes what ended
(`drive`) and writes a table (`summary`). What lies in the folder is all there is to know, so that a sweep goes on after
anything. Ray is behind `cluster` alone; the commands themselves come from whoever calls, since they stand above this.
"""

from cfb_mjx.sweep.config import Sweep, load_sweep
from cfb_mjx.sweep.drive import drive
from cfb_mjx.sweep.folder import Folder, open_folder
from cfb_mjx.sweep.summary import Summary
from cfb_mjx.sweep.tasks import Task, tasks_of

__all__ = ["Folder", "Summary", "Sweep", "Task", "drive", "load_sweep", "open_folder", "tasks_of"]
