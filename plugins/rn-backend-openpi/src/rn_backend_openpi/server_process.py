"""The process that holds a model: `python -m rn_backend_openpi.server_process`."""

from __future__ import annotations

import logging
import os
import signal
import sys
import threading
from pathlib import Path
from typing import IO

from rn_backend_openpi.model_server import SharedModelServer
from rn_backend_openpi.options import ModelOptions
from roboneuron.command import HangWatch

log = logging.getLogger(__name__)
STAY = "--stay"


def serve(
    options: ModelOptions, path: Path, idle_s: float | None, parent: IO[str] | None = None
) -> int:
    """Run a server in this process until SIGTERM or SIGINT, or the end of a parent's pipe."""
    server = SharedModelServer(options, path, idle_s)
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: server.stop())
    if parent is not None:

        def watch() -> None:
            parent.read()  # the other end closes with the parent process
            server.stop()

        threading.Thread(target=watch, name="parent", daemon=True).start()
    hangs = HangWatch()
    hangs.start()
    return server.run(hangs)


def main(source: IO[str] = sys.stdin, arguments: list[str] = sys.argv[1:]) -> int:
    """Run a server: options as JSON in the first line of stdin; `idle_s` and the path of the socket
    as arguments. The started process returns at once; the server continues in the background. With
    `--stay` instead of `idle_s` the process itself serves, until stdin ends.
    """
    options = ModelOptions.model_validate_json(source.readline())
    mode, path = arguments
    if mode != STAY and os.fork():
        return 0
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(message)s")
    idle_s, parent, code = (None, source, 1) if mode == STAY else (float(mode), None, 1)
    try:
        code = serve(options, Path(path), idle_s, parent)
    except Exception:  # the process would end silently
        log.exception("The server cannot continue.")
    finally:
        logging.shutdown()
        # threads of robots may still be running, but hold nothing to be saved
        os._exit(code)


if __name__ == "__main__":
    sys.exit(main())
