"""The command `roboneuron link`."""

from __future__ import annotations

import json
import re
import socket
import sys
import threading
from argparse import ArgumentParser, Namespace
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path

from rn_link.machine import (
    PORT,
    check_address,
    check_port,
    link_folder,
    read_machine,
)
from rn_link.state import PeerConnection, read_connections
from roboneuron import ConfigurationError, foreign

_DAYS = 365
_PAIRING_PORT = 7410
_RESTART = "Restart the server and its modules if they were running before the first pairing."
_NO_RELAY = "No relay is running: start RoboNeuron, or `roboneuron link run`."
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
        init = actions.add_parser(
            "init", help="make this machine the hub, renew its certificate, or join a hub"
        )
        init.add_argument("--name", help="name of this machine; default: its host name")
        init.add_argument("--join", metavar="ADDRESS[:PORT]", help="hub to join as a member")
        init.add_argument(
            "--port", type=int, default=PORT, help="port that a member listens on (%(default)s)"
        )
        add = actions.add_parser("add", help="admit a member: shows a code for its `init --join`")
        add.add_argument("name", metavar="NAME", help="name of the member")
        add.add_argument("--address", help="address of the member; default: that of its request")
        add.add_argument(
            "--port", type=int, default=_PAIRING_PORT, help="pairing port (%(default)s)"
        )
        for one in (init, add):
            one.add_argument(
                "--days", type=int, default=_DAYS, help="validity of the certificate (%(default)s)"
            )
        show = actions.add_parser("show", help="machines, addresses and dates")
        show.add_argument("--json", action="store_true", help="for programs")
        actions.add_parser("run", help="keep this machine linked without a server")
        remove = actions.add_parser(
            "remove", help="revoke a member; or leave the link, on a member or with --all"
        )
        chosen = remove.add_mutually_exclusive_group(required=True)
        chosen.add_argument("name", metavar="NAME", nargs="?", help="name shown by `show`")
        chosen.add_argument("--all", action="store_true", help="remove keys and authority too")

    def findings(self) -> Sequence[tuple[bool, str, str]]:
        """Findings for `roboneuron doctor`: for each paired machine whether it is connected, a
        description, and a remedy.

        Raises:
            ConfigurationError: the link's file is damaged.
        """
        folder = link_folder()
        machine = read_machine(folder)
        if machine is None or not machine.peers:
            return ()
        connections = read_connections(folder)
        if connections is None:
            others = ", ".join(machine.peers)
            return [(False, f"The link to {others} is down: no relay is running.", _NO_RELAY)]
        now, found = datetime.now(UTC), []
        for name in machine.peers:
            one = _connection(connections, name)
            hint = "" if one.is_open else one.hint or "Check again in a moment."
            found.append((one.is_open, f"The machine {name} is {spoken(one, now)}.", hint))
        return found

    def run(self, arguments: Namespace) -> int:
        """Run `roboneuron link`."""
        folder = link_folder()
        if arguments.action == "init":
            _init(folder, arguments)
        elif arguments.action == "add":
            _add(folder, arguments)
        elif arguments.action == "show":
            _show(folder, arguments.json)
        elif arguments.action == "run":
            _run(folder)
        else:
            _remove(folder, arguments)
        return 0


def _init(folder: Path, arguments: Namespace) -> None:
    if arguments.join is not None:
        _join(folder, arguments)
        return
    from rn_link_pairing.keeping import become_hub  # heavy

    name = arguments.name or host_name()
    machine = become_hub(folder, name, datetime.now(UTC), arguments.days)
    members = ", ".join(machine.peers)
    _say(f"This machine is the hub {machine.name}; its certificate is valid {arguments.days} days.")
    _say(
        f"Its members ({members}) accept it. {_FOLLOWS}"
        if members
        else "Next: `roboneuron link add NAME` for each other machine."
    )


def _join(folder: Path, arguments: Namespace) -> None:
    from rn_link_pairing.pairing import join  # heavy

    host, _, port = arguments.join.partition(":")
    address = check_address(host)
    found = read_machine(folder)
    if found is not None and found.role == "hub":
        raise ConfigurationError(
            f"This machine is itself a hub, {found.name}.",
            hint="Type `roboneuron link remove --all` first, if its members no longer need it.",
        )
    port_here = check_port(arguments.port)
    sys.stderr.write(f"Code that {foreign.printable(address)} shows: ")
    sys.stderr.flush()
    code = check_code(sys.stdin.readline())
    machine = join(folder, address, _port(port), code, port_here)
    (hub,) = machine.peers
    _say(f"This machine is {machine.name}, a member of {hub}, and listens on TCP {port_here}.")
    _say(_RESTART)


def _add(folder: Path, arguments: Namespace) -> None:
    from rn_link_pairing.pairing import PAIRING_S, PairingHub, new_code, open_listener  # heavy

    address = None if arguments.address is None else check_address(arguments.address)
    admission = PairingHub(
        folder, arguments.name, address=address, days=arguments.days, notify=_complain
    )
    code = new_code()
    with open_listener(arguments.port) as listener:
        port = "" if arguments.port == _PAIRING_PORT else f":{arguments.port}"
        _say(f"Code: {code[:3]} {code[3:]}")
        _say(
            f"Type on {arguments.name}, within {PAIRING_S / 60:g} minutes: `roboneuron link init "
            f"--join ADDRESS{port}`, ADDRESS being the IPv4 address of this machine."
        )
        peer = admission.serve(listener, code)
    _say(f"{arguments.name} is added: {peer.address}, TCP {peer.port}. {_RESTART}")


def _show(folder: Path, as_json: bool) -> None:
    machine = read_machine(folder)
    if machine is None:
        if as_json:
            _say("{}")
        else:
            _say("This machine has no link. `roboneuron link init` creates one.")
        return
    from rn_link.certificates import expiries, exposed_keys  # heavy

    for key in exposed_keys(folder):
        _complain(
            f"Others may read or replace the key {key} (mode {key.stat().st_mode & 0o777:o}). Pair "
            f"the machine again; if nobody has read it, type `chmod 600 {key}`."
        )
    dates = expiries(machine, folder)
    connections = read_connections(folder)
    if as_json:
        facts = json.loads(machine.to_json())
        facts["expires"] = {name: date.isoformat() for name, date in dates.items()}
        facts["connections"] = (
            None
            if connections is None
            else {name: asdict(_connection(connections, name)) for name in machine.peers}
        )
        _say(json.dumps(facts, indent=2))
        return
    now = datetime.now(UTC)
    width = max(len(name) for name in (machine.name, *machine.peers))
    own = f"{machine.role}, this machine{_validity(dates.get(machine.name), now)}"
    _say(f"{machine.name:<{width}}  {own}")
    for name, peer in machine.peers.items():
        place = f"{peer.address}, TCP {peer.port}" if machine.role == "hub" else peer.address
        told = f"{place}{_validity(dates.get(name), now)}"
        if connections is None:
            _say(f"{name:<{width}}  {told}")
            continue
        connection = _connection(connections, name)
        _say(f"{name:<{width}}  {told}; {spoken(connection, now)}")
        if connection.hint:
            _say(f"{'':<{width}}  {foreign.printable(connection.hint)}")
    if connections is None and machine.peers:
        _say(_NO_RELAY)


def _connection(connections: Mapping[str, PeerConnection], name: str) -> PeerConnection:
    return connections.get(name, PeerConnection(error="it is being connected"))


def spoken(connection: PeerConnection, now: datetime) -> str:
    """State of a connection in words."""
    if not connection.is_open:
        return f"NOT connected: {foreign.printable(connection.error)}"
    seconds = max(0, int((now - datetime.fromisoformat(connection.since)).total_seconds()))
    hours, minutes = divmod(seconds // 60, 60)
    lasted = f"{hours} h {minutes} min" if hours else f"{minutes} min {seconds % 60} s"
    return f"connected for {lasted}, since {connection.since[:19].replace('T', ' ')} UTC"


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


def _validity(date: datetime | None, now: datetime) -> str:
    if date is None:
        return ""
    return f", {'EXPIRED on' if date <= now else 'valid until'} {date:%Y-%m-%d}"


def _remove(folder: Path, arguments: Namespace) -> None:
    from rn_link_pairing.keeping import remove_all, remove_peer  # heavy

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
