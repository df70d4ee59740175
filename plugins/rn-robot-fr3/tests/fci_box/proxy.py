"""The control box as a process: `python -m fci_box.proxy --host 127.0.0.3 --upstream 127.0.0.2`.

It sits between the driver and franka-sim. Only the first command for the newest state counts;
others are dropped, as in a real box with its own clock, although franka-sim would accept them.
Counted commands are checked, and states contain q_d, dq_d and ddq_d computed from them. On UDP port
1340 it answers with its counts, and accepts faults such as {"loss": 0.05} or {"silence": 10}.
{"lenient": 1} makes it forward everything without checks.
"""

from __future__ import annotations

import argparse
import contextlib
import ctypes
import gc
import json
import select
import signal
import socket
import time
from dataclasses import fields, replace

from fci_box import services, wire
from fci_box.judge import CommandJudge
from fci_box.network import Cable, Faults
from fci_box.wire import Service

ASKING_PORT = 1340
_WAIT_S = 0.05
_CONNECT_S = 5.0
_PR_SET_PDEATHSIG = 1
"""Source: linux/prctl.h."""


class FciStream:
    """One TCP connection, split into messages."""

    def __init__(self, connection: socket.socket) -> None:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.connection = connection
        self._rest = b""

    def messages(self) -> list[tuple[int, int, bytes]]:
        """Received messages: service, number, payload. Raises ConnectionError at the end."""
        received = self.connection.recv(65536)
        if not received:
            raise ConnectionError
        self._rest += received
        found = []
        while len(self._rest) >= wire.HEADER.size:
            service, number, size = wire.HEADER.unpack_from(self._rest)
            if len(self._rest) < size:
                break
            found.append((service, number, self._rest[wire.HEADER.size : size]))
            self._rest = self._rest[size:]
        return found

    def send(self, service: int, number: int, payload: bytes) -> None:
        """Send one message."""
        self.connection.sendall(
            wire.HEADER.pack(service, number, wire.HEADER.size + len(payload)) + payload
        )


class BoxProxy:
    """Serves one client at a time, like the FCI."""

    def __init__(self, host: str, upstream: str, seed: int) -> None:
        self._host, self._upstream = host, upstream
        self._listener = socket.create_server((host, wire.PORT))
        self._asking = _datagrams(host, ASKING_PORT)
        self._to_arm, self._to_client = Cable(seed), Cable(seed + 1)
        self._judge = CommandJudge()
        self._counts = dict.fromkeys(("states", "repeated", "late", "refused"), 0)
        self._is_latched = self._is_lenient = False
        self._client: FciStream | None = None
        self._robot: FciStream | None = None
        self._states: socket.socket | None = None
        self._commands: socket.socket | None = None
        self._robot_address: tuple[str, int] | None = None
        self._client_port = 0
        self._newest_id = self._answered_id = self._last_sent_id = 0
        self._mode = wire.IDLE
        self._is_armed = False

    def run(self) -> None:
        """Run until the process ends."""
        while True:
            try:
                self._turn()
            except (ConnectionError, BrokenPipeError):
                self._hang_up()

    def _turn(self) -> None:
        sockets: list[socket.socket] = [self._listener, self._asking]
        sockets += [stream.connection for stream in (self._client, self._robot) if stream]
        sockets += [udp for udp in (self._states, self._commands) if udp]
        due = [
            at_s
            for cable in (self._to_arm, self._to_client)
            if (at_s := cable.next_s()) is not None
        ]
        wait_s = max(0.0, min([*due, time.monotonic() + _WAIT_S]) - time.monotonic())
        ready, _, _ = select.select(sockets, [], [], wait_s)
        now_s = time.monotonic()
        if self._commands in ready:
            self._commanded(now_s)
        if self._states in ready:
            self._told(now_s)
        self._deliver(time.monotonic())
        if self._asking in ready:
            self._answer()
        if self._client and self._client.connection in ready:
            self._requested()
        if self._robot and self._robot.connection in ready:
            for service, number, payload in self._robot.messages():
                assert self._client is not None
                self._client.send(service, number, payload)
        if self._listener in ready and self._client is None:
            self._client = FciStream(self._listener.accept()[0])

    def _hang_up(self) -> None:
        for stream in (self._client, self._robot):
            if stream is not None:
                stream.connection.close()
        for udp in (self._states, self._commands):
            if udp is not None:
                udp.close()
        self._client = self._robot = self._states = self._commands = None
        self._judge.arm = None
        self._is_armed = False

    def _requested(self) -> None:
        """Forward the client's TCP requests, or refuse them."""
        assert self._client is not None
        for service, number, payload in self._client.messages():
            if service == Service.CONNECT:
                payload = self._connected(payload)
            elif service == Service.AUTOMATIC_ERROR_RECOVERY:
                self._is_latched = False
            refused = services.refusal(service, payload, self._mode, self._is_latched)
            if refused is None:
                assert self._robot is not None
                self._robot.send(service, number, payload)
            else:
                self._counts["refused"] += 1
                self._client.send(service, number, refused)

    def _connected(self, payload: bytes) -> bytes:
        """Connect to franka-sim, with its states redirected to this proxy."""
        upstream = socket.create_connection(
            (self._upstream, wire.PORT), _CONNECT_S, (self._host, 0)
        )
        self._robot = FciStream(upstream)
        self._states, self._commands = _datagrams(self._host, 0), _datagrams(self._host, 0)
        self._client_port = int.from_bytes(payload[2:4], "little")
        self._newest_id = self._answered_id = self._last_sent_id = 0
        port: int = self._states.getsockname()[1]
        return payload[:2] + port.to_bytes(2, "little") + payload[4:]

    def _told(self, now_s: float) -> None:
        """Process a state of franka-sim: one cycle ends, and the next begins."""
        assert self._states is not None
        state, self._robot_address = self._states.recvfrom(2048)
        if len(state) != wire.STATE_BYTES:
            return
        number = wire.message_id(state)
        self._counts["states"] += 1
        self._mode = wire.robot_mode(state)
        if not wire.is_following(state):
            self._judge.arm, self._is_armed = None, False
        elif self._judge.arm is None:
            self._judge.begin(wire.desired(state))
        elif self._is_armed and self._answered_id < self._newest_id:
            self._judge.miss()
        self._newest_id = number
        if (arm := self._judge.arm) is not None and not self._is_lenient:
            state = wire.with_desired(state, arm.position, arm.velocity, arm.acceleration)
        self._to_client.put(state, now_s)

    def _commanded(self, now_s: float) -> None:
        """Process a datagram of the client before it enters the cable."""
        assert self._commands is not None
        command = self._commands.recv(2048)
        if len(command) != wire.COMMAND_BYTES:
            self._counts["repeated"] += 1
            return
        number = wire.message_id(command)
        if number <= self._last_sent_id:
            self._counts["repeated"] += 1
        self._last_sent_id = max(number, self._last_sent_id)
        self._to_arm.put(command, now_s)

    def _deliver(self, now_s: float) -> None:
        for state in self._to_client.arrived(now_s):
            if self._commands is not None and self._client is not None:
                address = (self._client.connection.getpeername()[0], self._client_port)
                with contextlib.suppress(ConnectionRefusedError):
                    self._commands.sendto(state, address)
        for command in self._to_arm.arrived(now_s):
            self._count(command)

    def _count(self, command: bytes) -> None:
        """Count the first command that answers the newest state."""
        assert self._states is not None
        assert self._robot_address is not None
        if self._is_lenient:
            self._states.sendto(command, self._robot_address)
            return
        number = wire.message_id(command)
        if number != self._newest_id or number == self._answered_id:
            self._counts["late"] += 1
            return
        self._answered_id = number
        if self._judge.arm is not None:
            self._is_armed = True
            self._judge.take(wire.position(command))
            if wire.is_finish(command):
                self._judge.arm, self._is_armed = None, False
        self._states.sendto(command, self._robot_address)

    def _answer(self) -> None:
        """Report the counts; accept new faults."""
        data, sender = self._asking.recvfrom(4096)
        asked = json.loads(data)
        names = {field.name for field in fields(Faults)} & asked.keys()
        if names:
            faults = replace(self._to_arm.faults, **{name: float(asked[name]) for name in names})
            self._to_arm.faults = faults if asked.get("commands", True) else Faults()
            self._to_client.faults = faults if asked.get("states", True) else Faults()
        self._to_client.silence = int(asked.get("silence", self._to_client.silence))
        self._is_latched = bool(asked.get("latched", self._is_latched))
        self._is_lenient = bool(asked.get("lenient", self._is_lenient))
        if asked.get("fresh"):
            self._judge, arm = CommandJudge(), self._judge.arm
            self._judge.arm = arm
            self._counts = dict.fromkeys(self._counts, 0)
        report = {**self._counts, **self._judge.report(), "mode": self._mode}
        self._asking.sendto(json.dumps(report).encode(), sender)


def _datagrams(host: str, port: int) -> socket.socket:
    made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    made.bind((host, port))
    return made


def main() -> None:
    """Run until ended, or until the parent process ends."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--host", required=True)
    parser.add_argument("--upstream", required=True)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    box = BoxProxy(arguments.host, arguments.upstream, arguments.seed)
    gc.freeze()
    gc.disable()
    box.run()


if __name__ == "__main__":
    main()
