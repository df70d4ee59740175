"""The process that stops the wheels of a driver that was killed or is frozen.

Standard input is a pipe on which the driver beats, standard output the serial port; the arguments
are packets in hexadecimal, to be written in this order. It is run by its path, with the standard
library alone, so that it starts at once.
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
"""Beats: what the wheels were sent, and that the driver has stopped them at its end."""
SILENT_S = 0.5
"""Without a beat for this long, a driver of rolling wheels is frozen."""
_REPEATS, _PAUSE_S = 5, 0.01
"""The driver may have died within a packet, and its motors answer it to the end."""


def main(packets: Sequence[bytes]) -> None:
    """Return after `END`, or exit with status 1 after the wheels were stopped."""
    for number in (signal.SIGHUP, signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)  # because the pipe ends it, in any case
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
