"""A proxy before a policy server, with the server's own keys, that spoils answers as set in the
file FOLDER/liar; each time a byte is appended to FOLDER/lied. Before it is a man in the middle
without keys, which replays TLS records.

    python link_liar.py FOLDER STATE-OF-THE-SERVER STATE-OF-THE-ROBOT ADDRESS-OF-THE-SERVER
"""

from __future__ import annotations

import contextlib
import os
import socket
import ssl
import sys
import threading
import time
from collections import deque
from collections.abc import Sequence
from functools import partial
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1] / "plugins" / "rn-backend-openpi" / "tests"))

from middle_man import MiddleMan, Recording, message_of, plain_frame, tls_record

from rn_link.machine import Machine, read_machine
from rn_link.tls import tls_context

KEPT = 8
"""Number of records of each side of a connection that the man in the middle stores."""
HELD_S, DRIP_S = 2.0, 0.02
RECORDS = ("answers' records twice", "requests' records twice", "an old record again")
"""Modes of the man in the middle."""
OLDER = 3
"""Age, in answers, of the replayed answer."""


class Liar:
    """Spoils answers of one connection at a time; usable from any thread.

    Args:
        folder: folder of the file with the mode.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._answers: deque[bytes] = deque(maxlen=OLDER)

    def mode(self) -> str:
        """The current mode."""
        with contextlib.suppress(OSError):
            return (self._folder / "liar").read_text()
        return ""

    def note(self) -> None:
        """Note a spoilt message."""
        with (self._folder / "lied").open("ab") as file:
            file.write(b".")

    def pass_on(self, frame: bytes, robot: ssl.SSLSocket) -> None:
        """Send an answer, or spoilt data."""
        mode, older = self.mode(), self._answers[0] if self._answers else None
        if mode in ("", *RECORDS):
            if "actions" in message_of(frame):
                self._answers.append(frame)  # stored from before the fault
            robot.sendall(frame)
            return
        if "actions" not in message_of(frame) or (older is None and mode.startswith("replayed")):
            robot.sendall(frame)
            return
        self.note()
        if mode == "replayed answer":
            robot.sendall(older or b"")
        elif mode == "replayed before the answer":
            robot.sendall((older or b"") + frame)
        elif mode == "answered twice":
            robot.sendall(frame + frame)
        elif mode == "garbage":
            robot.sendall(os.urandom(4096))
        elif mode == "half an answer":
            robot.sendall(frame[: len(frame) // 2])
        elif mode == "slow drip":
            for number in range(len(frame)):
                robot.sendall(frame[number : number + 1])
                time.sleep(DRIP_S)
        elif mode == "answers held back":
            time.sleep(HELD_S)
            robot.sendall(frame)
        elif mode == "huge length":
            robot.sendall(b"\x82\x7f" + b"\x7f" * 8 + frame[2:])
        elif mode not in ("swallowed", "handshake without a word", "garbage before the handshake"):
            raise ValueError(mode)


def replayed(liar: Liar, recording: Recording, record: bytes, *, asks: bool) -> Sequence[bytes]:
    """Data sent by the man in the middle for a record."""
    mode = liar.mode()
    before = recording.asked if asks else recording.answered
    if mode == ("requests' records twice" if asks else "answers' records twice"):
        liar.note()
        return (record, record)
    if mode == "an old record again" and not asks and before:
        liar.note()
        return (before[-1], record)
    return (record,)


def serve(raw: socket.socket, liar: Liar, contexts: tuple[ssl.SSLContext, ...], far: str) -> None:
    """Serve one robot."""
    mode = liar.mode()
    if mode in ("handshake without a word", "garbage before the handshake"):
        liar.note()
        if mode.startswith("garbage"):
            raw.sendall(os.urandom(512))
        time.sleep(5.0)
        raw.close()
        return
    with contextlib.suppress(OSError):
        robot = contexts[0].wrap_socket(raw, server_side=True)
        server = contexts[1].wrap_socket(socket.create_connection((far, 7421), 5.0))

        def ask() -> None:
            with contextlib.suppress(OSError):
                while data := robot.recv(65536):
                    server.sendall(data)
            with contextlib.suppress(OSError):
                # if it were closed while being read, it would remain one of the server's robots
                socket.socket.shutdown(server, socket.SHUT_RDWR)

        threading.Thread(target=ask, daemon=True).start()
        with contextlib.suppress(OSError):
            while True:
                liar.pass_on(plain_frame(server), robot)
        for end in (robot, server):
            end.close()
    raw.close()


def context_of(state: Path, peer: str) -> ssl.SSLContext:
    """TLS context of a machine for another one."""
    folder = state / "roboneuron" / "link"
    machine = read_machine(folder)
    assert isinstance(machine, Machine)
    return tls_context(machine, folder, peer)


def main(folder: str, there: str, here: str, address: str) -> None:
    """Serve until killed."""
    liar = Liar(Path(folder))
    contexts = (context_of(Path(there), "robot"), context_of(Path(here), "gpu"))
    with socket.create_server(("127.0.0.1", 0)) as listener:
        man = MiddleMan(listener.getsockname()[1], tls_record, ("0.0.0.0", 7420), KEPT)
        man.ask = partial(replayed, liar, asks=True)
        man.answer = partial(replayed, liar, asks=False)
        while True:
            raw, _ = listener.accept()
            words = (raw, liar, contexts, address)
            threading.Thread(target=serve, args=words, daemon=True).start()


if __name__ == "__main__":
    main(*sys.argv[1:])
