"""Relay of the server for an agent: a program on stdio that forwards bytes to the evaluation's
socket.

    python -m rn_eval.agents.relay SOCKET

Standard library only: it starts in a few hundredths of a second.
"""

from __future__ import annotations

import os
import socket
import sys
import threading

_CHUNK = 65536


def main() -> None:
    """Forward everything in both directions until either side ends."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as link:
        link.connect(sys.argv[1])
        threading.Thread(target=_pass_out, args=(link,), daemon=True).start()
        while data := os.read(0, _CHUNK):
            link.sendall(data)
        link.shutdown(socket.SHUT_WR)


def _pass_out(link: socket.socket) -> None:
    while data := link.recv(_CHUNK):
        view = memoryview(data)
        while view:
            view = view[os.write(1, view) :]
    # The main thread may block in a read: the process ends with the server.
    os._exit(0)


if __name__ == "__main__":
    main()
