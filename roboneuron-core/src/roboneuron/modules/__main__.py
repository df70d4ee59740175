"""`python -m roboneuron.modules`: read the settings from stdin, run that module, exit with the
parent.
"""

from __future__ import annotations

import io
import logging
import os
import sys

from roboneuron.hang_watch import HangWatch
from roboneuron.log_files import begin_logging
from roboneuron.modules.parent_watch import end_group, follow_parent
from roboneuron.ros.environment import prepare_environment


def main() -> None:
    """Entry point of a module process.

    The order matters: from the first step on a parent that dies ends the process, and the
    environment is set before rclpy, which reads it, is imported.
    """
    parent = os.getppid()
    begin_logging(logging.INFO)
    follow_parent(parent)
    prepare_environment()
    watch = HangWatch()
    watch.start()
    with watch.loading():
        from roboneuron.modules.module import run  # heavy

    # Unbuffered, because signs of life and announcements follow the line: a buffer would keep them
    # from the next reader.
    line = io.FileIO(0, closefd=False).readline()
    if not line.endswith(b"\n"):
        sys.exit("stdin ended before the settings came.")
    run(line.decode(), watch)
    end_group()


if __name__ == "__main__":
    main()
