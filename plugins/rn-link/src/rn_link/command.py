"""The command `roboneuron link`."""

from __future__ import annotations

import asyncio
import re
import socket
import sys
import threading
from argparse import ArgumentParser, Namespace
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from rn_link.machine import PORT, Machine, check_address, link_folder, read_machine
from rn_link.state import PeerConnection, read_connections
from roboneuron import ConfigurationError, foreign

_say = partial(print, flush=True)
_RESTART = "Restart the server and its modules if they were running before the first pairing."
_FOLLOWS = "Running processes follow within two seconds."
_UNKNOWN = PeerConnection(error="it is being connected", hint="Look again in a moment.")
_NO_RELAY = PeerConnection(
    error="no relay is running", hint="Start RoboNeuron, or `roboneuron link run`."
)


class LinkCommand:
    """Pair machines, and show or remove paired ones.

    The robot's machine is the hub: `init`, then `add` for each other machine, which joins with
    `init --join`.
    """

    def configure(self, parser: ArgumentParser) -> None:
        """Add the arguments of `roboneuron link`."""
        actions = parser.add_subparsers(
            dest="action", required=True, metavar="ACTION", help="action to run (each has --help)"
        )
        init = actions.add_parser("init", help="make this machine the hub, or join a hub")
        init.add_argument("--name", help="name of the hub; default: its host name")
        init.add_argument("--join", metavar="ADDRESS", help="hub to join as a member")
        add = actions.add_parser("add", help="admit a member: shows a code for its `init --join`")
        add.add_argument("name", metavar="NAME", help="name of the member")
        actions.add_parser("show", help="machines, addresses and connections")
        actions.add_parser("run", help="keep this machine linked without a server")
        remove = actions.add_parser(
            "remove", help="revoke a member; or leave the link, on a member or with --all"
        )
        chosen = remove.add_mutually_exclusive_group(required=True)
        chosen.add_argument("name", metavar="NAME", nargs="?", help="name shown by `show`")
        chosen.add_argument("--all", action="store_true", help="remove all keys")

    def findings(self) -> Sequence[tuple[bool, str, str]]:
        """Findings for `roboneuron doctor`: for each paired machine whether it is connected, a
        description, and a remedy.

        Raises:
            ConfigurationError: the link's file is damaged.
            ForeignDataError: that of its connections is.
        """
        folder = link_folder()
        machine = read_machine(folder)
        if machine is None:
            return ()
        connections = read_connections(folder)
        found = []
        for name, peer in machine.peers.items():
            one = _NO_RELAY if connections is None else connections.get(name, _UNKNOWN)
            described = f"The machine {name} ({peer.address}) is {spoken(one)}."
            found.append((one.is_open, described, foreign.printable(one.hint)))
        return found

    def run(self, arguments: Namespace) -> int:
        """Run `roboneuron link`."""
        folder = link_folder()
        if arguments.action == "init" and arguments.join is not None:
            _join(folder, arguments.join)
        elif arguments.action == "init":
            _init(folder, arguments.name or host_name())
        elif arguments.action == "add":
            _add(folder, arguments.name)
        elif arguments.action == "remove":
            _remove(folder, arguments.name)
        elif (machine := read_machine(folder)) is None:
            raise ConfigurationError(
                "This machine has no link.", hint="`roboneuron link init` creates one."
            )
        elif arguments.action == "run":
            _run()
        else:
            _say(f"This machine is the {machine.role} {machine.name}.")
            for _, told, hint in self.findings():
                _say(f"{told} {hint}".rstrip())
        return 0


def _init(folder: Path, name: str) -> None:
    from rn_link.keys import make_machine, new_identity  # heavy

    make_machine(folder, Machine(name=name, role="hub"), new_identity())
    _say(f"This machine is the hub {name}.")
    _say("Next: `roboneuron link add NAME` for each other machine.")


def _join(folder: Path, address: str) -> None:
    from rn_link.keys import check_no_link  # heavy
    from rn_link.pairing import join

    check_address(address)
    check_no_link(folder)
    sys.stderr.write(f"Code that {address} shows: ")
    sys.stderr.flush()
    machine = asyncio.run(join(folder, address, check_code(sys.stdin.readline())))
    (hub,) = machine.peers
    _say(f"This machine is {machine.name}, a member of {hub}, and listens on TCP {PORT}.")
    _say(_RESTART)


def _add(folder: Path, name: str) -> None:
    from rn_link.pairing import PAIRING_S, PairingHub, new_code, open_listener  # heavy

    code = new_code()
    hub = PairingHub(folder, name, code, partial(print, file=sys.stderr))
    with open_listener() as listener:
        _say(f"Code: {code[:3]} {code[3:]}")
        _say(
            f"Type on {name}, within {PAIRING_S / 60:g} minutes: `roboneuron link init --join "
            "ADDRESS`, ADDRESS being the IPv4 address of this machine."
        )
        address = asyncio.run(hub.serve(listener))
    _say(f"{name} is added: {address}. {_RESTART}")


def spoken(connection: PeerConnection) -> str:
    """State of a connection in words."""
    if connection.is_open:
        return f"connected since {foreign.printable(connection.since)}"
    return f"NOT connected: {foreign.printable(connection.error)}"


def _run() -> None:
    from rn_link.keeper import RelayKeeper  # heavy

    keeper = RelayKeeper()
    keeper.start()
    try:
        threading.Event().wait()
    except KeyboardInterrupt:
        _say("")
    finally:
        keeper.close()


def _remove(folder: Path, name: str | None) -> None:
    from rn_link.keys import remove_all, remove_peer  # heavy

    if name is None:
        remove_all(folder)
        _say(f"Keys and certificates of this machine are removed. {_FOLLOWS}")
    else:
        remove_peer(folder, name)
        _say(f"{name} is removed. {_FOLLOWS}")


def host_name() -> str:
    """This machine's name, in the form that the link accepts."""
    return re.sub(r"[^a-z0-9-]+", "-", socket.gethostname().lower()).strip("-")[:31] or "robot"


def check_code(text: str) -> str:
    """Raise ConfigurationError unless it is six digits, ignoring spaces."""
    code = "".join(text.split())
    if not (len(code) == 6 and code.isascii() and code.isdecimal()):
        raise ConfigurationError(
            "The code is not six digits.", hint="`roboneuron link add NAME` on the hub shows it."
        )
    return code
