"""The process that stops the wheels of a killed or frozen driver.

Standard input is a pipe with the driver's heartbeats, standard output the serial port; the
arguments are hexadecimal packets, written in this order. It is started by its path with only the
standard library, so that it starts quickly.
"""

from __future__ import annotations

import os
import select
import signal
import sys
import time
from collections.abc import Sequence
from contextlib import suppress

ROLLING, STANDING, END = b"r", b"s", b"e"
"""Heartbeats: state of the wheels, or the driver's regular end after stopping them."""
SILENT_S = 0.5
"""Without a heartbeat for this time, the driver of rolling wheels counts as frozen."""
_REPEATS, _PAUSE_S = 5, 0.01
"""Repeated because the driver may have died within a packet, which its motors still answer."""


def main(packets: Sequence[bytes]) -> None:
    """Return after `END`, or exit with status 1 after stopping the wheels."""
    for number in (signal.SIGHUP, signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)  # because the pipe ends it in any case
    beat, reason = STANDING, f"silent for {SILENT_S:g} s"
    while select.select([0], [], [], SILENT_S if beat == ROLLING else None)[0]:
        beats = os.read(0, 4096)
        if END in beats:
            return
        if not beats:
            reason = "gone"
            break
        beat = beats[-1:]
    for packet in packets:
        for _ in range(_REPEATS):
            with suppress(OSError):
                os.write(1, packet)
            time.sleep(_PAUSE_S)
    sys.exit(f"The driver is {reason}: its wheels were told to stop.")


if __name__ == "__main__":
    main([bytes.fromhex(text) for text in sys.argv[1:]])
