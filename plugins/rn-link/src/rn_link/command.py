"""The command `roboneuron link`."""

from __future__ import annotations

import asyncio
import re
import socket
import sys
import threading
from argparse import ArgumentParser, Namespace
from collections.abc import Mapping, Sequence
from pathlib import Path

from rn_link.machine import (
    PORT,
    Machine,
    check_address,
    check_port,
    link_folder,
    read_machine,
)
from rn_link.state import PeerConnection, read_connections
from rn_link.tls import check_private
from roboneuron import ConfigurationError, foreign

_PAIRING_PORT = 7410
_RESTART = "Restart the server and its modules if they were running before the first pairing."
_NO_RELAY = "Start RoboNeuron, or `roboneuron link run`."
_SOON = "Look again in a moment."
_FOLLOWS = "Running processes follow within two seconds."


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
        init.add_argument("--join", metavar="ADDRESS[:PORT]", help="hub to join as a member")
        init.add_argument(
            "--port", type=int, default=PORT, help="port that a member listens on (%(default)s)"
        )
        add = actions.add_parser("add", help="admit a member: shows a code for its `init --join`")
        add.add_argument("name", metavar="NAME", help="name of the member")
        add.add_argument(
            "--port", type=int, default=_PAIRING_PORT, help="pairing port (%(default)s)"
        )
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
        """
        folder = link_folder()
        machine = read_machine(folder)
        if machine is None:
            return ()
        connections = read_connections(folder)
        return [_finding(machine, name, connections) for name in machine.peers]

    def run(self, arguments: Namespace) -> int:
        """Run `roboneuron link`."""
        folder = link_folder()
        if arguments.action == "init" and arguments.join is None:
            _init(folder, arguments)
        elif arguments.action == "init":
            _join(folder, arguments)
        elif arguments.action == "add":
            _add(folder, arguments)
        elif arguments.action == "show":
            _show(folder)
        elif arguments.action == "run":
            _run(folder)
        else:
            _remove(folder, arguments)
        return 0


def _init(folder: Path, arguments: Namespace) -> None:
    from rn_link.keys import make_machine, new_identity  # heavy

    machine = Machine(name=arguments.name or host_name(), role="hub")
    make_machine(folder, machine, new_identity())
    _say(f"This machine is the hub {machine.name}.")
    _say("Next: `roboneuron link add NAME` for each other machine.")


def _join(folder: Path, arguments: Namespace) -> None:
    from rn_link.keys import check_no_link  # heavy
    from rn_link.pairing import join

    host, _, port = arguments.join.partition(":")
    address = check_address(host)
    pairing_port = _port(port)
    own_port = check_port(arguments.port)
    check_no_link(folder)
    sys.stderr.write(f"Code that {foreign.printable(address)} shows: ")
    sys.stderr.flush()
    code = check_code(sys.stdin.readline())
    machine = asyncio.run(join(folder, address, pairing_port, code, own_port))
    (hub,) = machine.peers
    _say(f"This machine is {machine.name}, a member of {hub}, and listens on TCP {own_port}.")
    _say(_RESTART)


def _add(folder: Path, arguments: Namespace) -> None:
    from rn_link.pairing import PAIRING_S, PairingHub, new_code, open_listener  # heavy

    code = new_code()
    hub = PairingHub(folder, arguments.name, code, _complain)
    with open_listener(arguments.port) as listener:
        port = "" if arguments.port == _PAIRING_PORT else f":{arguments.port}"
        _say(f"Code: {code[:3]} {code[3:]}")
        _say(
            f"Type on {arguments.name}, within {PAIRING_S / 60:g} minutes: `roboneuron link init "
            f"--join ADDRESS{port}`, ADDRESS being the IPv4 address of this machine."
        )
        peer = asyncio.run(hub.serve(listener))
    _say(f"{arguments.name} is added: {peer.address}, TCP {peer.port}. {_RESTART}")


def _show(folder: Path) -> None:
    machine = read_machine(folder)
    if machine is None:
        _say("This machine has no link. `roboneuron link init` creates one.")
        return
    try:
        check_private(folder)
    except OSError as error:
        _complain(f"The key of this machine is not used: {error}.")
    _say(f"This machine is the {machine.role} {machine.name}.")
    connections = read_connections(folder)
    for name in machine.peers:
        _, told, hint = _finding(machine, name, connections)
        _say(f"{told} {hint}".rstrip())


def _finding(
    machine: Machine, name: str, connections: Mapping[str, PeerConnection] | None
) -> tuple[bool, str, str]:
    """Whether a machine is connected, a description, and a remedy."""
    peer = machine.peers[name]
    listens = f", TCP {peer.port}" if machine.role == "hub" else ""
    place = f"The machine {name} ({peer.address}{listens}) is"
    if connections is None:
        return False, f"{place} NOT connected: no relay is running.", _NO_RELAY
    found = connections.get(name, PeerConnection(error="it is being connected", hint=_SOON))
    return found.is_open, f"{place} {spoken(found)}.", foreign.printable(found.hint)


def spoken(connection: PeerConnection) -> str:
    """State of a connection in words."""
    if connection.is_open:
        return f"connected since {foreign.printable(connection.since)}"
    return f"NOT connected: {foreign.printable(connection.error)}"


def _run(folder: Path) -> None:
    machine = read_machine(folder)
    if machine is None or not machine.peers:
        raise ConfigurationError(
            "No other machine is paired with this one.",
            hint="Pair one with `roboneuron link init` and `roboneuron link add NAME`.",
        )
    from rn_link.keeper import RelayKeeper  # heavy

    keeper = RelayKeeper(folder)
    keeper.start()
    try:
        threading.Event().wait()
    except KeyboardInterrupt:
        _say("")
    finally:
        keeper.close()


def _remove(folder: Path, arguments: Namespace) -> None:
    from rn_link.keys import remove_all, remove_peer  # heavy

    if arguments.all:
        remove_all(folder)
        _say(f"Keys, certificates and profile of this machine are removed. {_FOLLOWS}")
    else:
        remove_peer(folder, arguments.name)
        _say(f"{arguments.name} is removed. {_FOLLOWS}")


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


def _port(text: str) -> int:
    if not text:
        return _PAIRING_PORT
    if not (text.isascii() and text.isdecimal() and 0 < int(text) < 65536):
        raise ConfigurationError(f"{text[:20]!r} is no port.", hint="Write ADDRESS:PORT.")
    return int(text)


def _complain(sentence: str) -> None:
    sys.stderr.write(f"{sentence}\n")


def _say(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()
