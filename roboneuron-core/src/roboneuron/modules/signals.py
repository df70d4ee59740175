"""What a module was told by signals, without a lock anywhere.

A handler runs in the middle of whatever the main thread does, another handler included: when a server is killed, the
kernel sends the death signal again with the end of each of its threads. `threading.Event.set` holds a lock for a
moment; interrupted there by a second signal, the main thread waits for itself, for ever, and so does everybody else who
sets the event. Assigning an attribute cannot wait.
"""

from __future__ import annotations

import signal


class Signals:
    """Main thread only, except `leave`, which any thread may call."""

    def __init__(self) -> None:
        self._leaving = False
        self._pressed = False

    def listen(self) -> None:
        """From now on SIGTERM, SIGINT and SIGHUP end the module, and SIGUSR1 presses the emergency stop."""
        for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
            signal.signal(number, lambda *_: self.leave())
        signal.signal(signal.SIGUSR1, lambda *_: self._press())

    def leave(self) -> None:
        """As if SIGTERM had come."""
        self._leaving = True

    @property
    def is_leaving(self) -> bool:
        """Whether the module was told to end."""
        return self._leaving

    def take_press(self) -> bool:
        """Whether the emergency stop was pressed since the last call."""
        pressed = self._pressed
        if pressed:
            self._pressed = False
        return pressed

    def _press(self) -> None:
        self._pressed = True
