"""Free addresses on this machine: the FCI has fixed ports, so each simulator needs its own
address.
"""

from __future__ import annotations

import contextlib
import random
import socket

from roboneuron import NotReadyError

_TRIES = 200


def free_address(*ports: int) -> str:
    """An address of 127.0.0.0/8 on which these TCP and UDP ports are free. Raises NotReadyError."""
    dice = random.SystemRandom()
    for _ in range(_TRIES):
        address = f"127.{dice.randint(1, 254)}.{dice.randint(0, 254)}.{dice.randint(2, 254)}"
        if all(_is_free(address, port) for port in ports):
            return address
    raise NotReadyError(
        "No free address was found in 127.0.0.0/8.", hint="End other simulators on this machine."
    )


def _is_free(address: str, port: int) -> bool:
    for kind in (socket.SOCK_STREAM, socket.SOCK_DGRAM):
        with contextlib.closing(socket.socket(socket.AF_INET, kind)) as trial:
            try:
                trial.bind((address, port))
            except OSError:
                return False
    return True
