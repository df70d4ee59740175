"""Check for a display before opening a window, because PyBullet ends the process without one."""

from __future__ import annotations

import ctypes
import ctypes.util
import os

from roboneuron import ConfigurationError

_HINT = "Set gui = false, or DISPLAY to a running X server."


def check_display() -> None:
    """Return if the X server named in DISPLAY accepts a connection.

    Raises:
        ConfigurationError: DISPLAY is unset, its server does not answer, or libX11 is not
            installed.
    """
    name = os.environ.get("DISPLAY", "")
    if not name:
        raise ConfigurationError(
            "The simulation was asked for a window, but there is no display.", hint=_HINT
        )
    library = ctypes.util.find_library("X11")
    if library is None:
        raise ConfigurationError(
            "The simulation was asked for a window, but libX11 is missing.",
            hint="Install libx11-6, or set gui = false.",
        )
    x11 = ctypes.CDLL(library)
    x11.XOpenDisplay.restype = ctypes.c_void_p
    x11.XCloseDisplay.argtypes = [ctypes.c_void_p]
    connection = x11.XOpenDisplay(None)
    if not connection:
        raise ConfigurationError(f"The display {name!r} does not answer.", hint=_HINT)
    x11.XCloseDisplay(connection)
