"""`python -m roboneuron.modules`: read the settings from stdin, run that module, leave with the
parent.
"""

from __future__ import annotations

import io
import logging
import os
import sys

from roboneuron.log_files import begin_logging
from roboneuron.modules.parent_watch import end_group, follow_parent
from roboneuron.ros.environment import prepare_environment


def main() -> None:
    """Entry point of a module process.

    In this order: a parent that dies from here on takes the process with it, and the environment is
    set before rclpy is imported, which reads it.
    """
    parent = os.getppid()
    begin_logging(logging.INFO)
    follow_parent(parent)
    prepare_environment()
    from roboneuron.modules.module import run  # heavy

    # without a buffer, because signs of life and announcements follow the line: a buffer would keep
    # them from whoever reads them next
    line = io.FileIO(0, closefd=False).readline()
    if not line.endswith(b"\n"):
        sys.exit("stdin ended before the settings came.")
    run(line.decode())
    end_group()


if __name__ == "__main__":
    main()
