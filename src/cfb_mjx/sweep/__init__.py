"""Parameter sweeps: one command with many combinations of arguments, on this machine or a cluster.

A file names a command of ``cfb`` and the arguments that vary (`config`, `tasks`). Every combination is a task with a
name and a command line. Workers run the tasks and move each result into place with one rename (`drive`, `folder`), so
that it is complete and there is only one. The driver records the outcomes (`drive`) and writes a table (`summary`). All
state is in the sweep's folder, so an interrupted sweep can always continue. Only `cluster` uses Ray. The caller passes
the classes of the commands in, because the layer of commands is above this one.
"""

from cfb_mjx.sweep.config import Sweep, load_sweep
from cfb_mjx.sweep.drive import drive
from cfb_mjx.sweep.folder import Folder, open_folder
from cfb_mjx.sweep.summary import Summary
from cfb_mjx.sweep.tasks import Task, tasks_of

__all__ = ["Folder", "Summary", "Sweep", "Task", "drive", "load_sweep", "open_folder", "tasks_of"]
