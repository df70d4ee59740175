"""Listening socket that protects the server behind it from silent connections, and keeps handles
free.

An asyncio server accepts each connection at once, with a protocol and a handle for it, and logs a
traceback for each one without a handle. This socket passes a connection on when its first bytes
have arrived. Silent connections cost little, the oldest is dropped for the newest, and some handles
of the process are never used for them.

The connections that wait are passed on a few at a time, one of each holder after the other: whoever
opens many waits behind its own.

It works with every server that accepts a socket: asyncio, uvicorn, websockets. Their own bounds
(`limit_concurrency`, `open_timeout`) apply after a connection was accepted, and would refuse an
emergency stop like everything else.
"""

from __future__ import annotations

import asyncio
import ctypes
import errno
import itertools
import logging
import os
import resource
import select
import socket
import time
from collections import Counter, deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

from rn_standard.http.addresses import network_of
from rn_standard.http.fairness import FairQueue

log = logging.getLogger(__name__)
SocketAddress = tuple[str, int] | tuple[str, int, int, int]
"""Of IPv4, and of IPv6 with flow and scope."""
SILENT_S = 5.0
"""Time after which a silent connection is closed."""
_PEEK_BYTES = 4096
_AT_ONCE, _TAKE_S = 32, 0.004
"""New connections per iteration of the event loop: at least so many, and as many as come within
this time [s]. Calls are served between two iterations; a queue that is emptied more slowly than it
fills lets the kernel drop a client's first packet, which is repeated after a second.
"""
_PASSED = 2
"""Connections of known, and as many of unknown clients, that are passed on per iteration: the
server behind takes about a millisecond of each iteration for each of them.
"""
_LIBC = ctypes.PyDLL(None, use_errno=True)
"""For calls that do not wait, without releasing the interpreter's lock: to get it back from a busy
thread after each of three calls takes up to a millisecond, and most connections of a flood have
ended before they are accepted.
"""
BACKLOG = 2048
"""Length of the kernel's queue; if it is full, a new client retries only after a second."""
_WINDOW_S = 1.0
_LOG_S = 60.0
_NO_HANDLES = (errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM)
_MOST_HANDLES = 65536
"""Assumed limit of handles if it is higher or absent."""
Peer = tuple[str, int]
_Waiting = tuple[socket.socket, SocketAddress]


@dataclass(frozen=True, kw_only=True, slots=True)
class ConnectionBounds:
    """Limits on the connections of a port.

    Attributes:
        silent: connections that have sent nothing yet.
        unproven: connections that have sent data, but are not proven.
        unproven_of_one: the same, from one address.
        new: unknown connections per second from one address; twice as many from all.
        handle: number of a new handle from which the oldest silent connection is dropped, or else
            the new one.
        handle_known: number of a new handle from which known connections are refused too.
    """

    silent: int
    unproven: int
    unproven_of_one: int
    new: int
    handle: int
    handle_known: int


def stop_bounds(limit: int | None = None) -> ConnectionBounds:
    """Bounds of the port for emergency stops: an eighth of the handles stays free, half of it for
    known connections.

    Args:
        limit: number of handles of the process; RLIMIT_NOFILE by default.
    """
    limit = handle_limit() if limit is None else limit
    quarter = min(1024, limit // 4)
    return ConnectionBounds(
        silent=quarter,
        unproven=min(256, quarter),
        unproven_of_one=min(192, quarter),
        new=500,
        handle=limit - limit // 8,
        handle_known=limit - limit // 16,
    )


def other_bounds(most: int, limit: int | None = None) -> ConnectionBounds:
    """Bounds of any other port: it never uses the upper half of the handles.

    Args:
        most: maximum of silent, and of unproven connections.
        limit: as in `stop_bounds`.
    """
    limit = handle_limit() if limit is None else limit
    most = min(most, limit // 8)
    return ConnectionBounds(
        silent=most,
        unproven=most,
        unproven_of_one=most,
        new=250,
        handle=limit // 2,
        handle_known=limit // 2,
    )


def handle_limit() -> int:
    """Number of handles that this process may have open at once."""
    return min(resource.getrlimit(resource.RLIMIT_NOFILE)[0] % (1 << 63), _MOST_HANDLES)


class BoundedListener(socket.socket):
    """Replacement for an asyncio server's socket; used on its event loop only.

    A new handle gets the lowest free number, so the number indicates how many are open in the whole
    process. Source: POSIX, "File Descriptor Allocation".

    Args:
        bound: a bound TCP socket, whose ownership is transferred.
        bounds: limits on connections.
        holder_of: returns who is shown by the first bytes of a connection, such as the holder of a
            token; empty if unknown. Known connections are not counted.
    """

    def __init__(
        self,
        bound: socket.socket,
        bounds: ConnectionBounds,
        holder_of: Callable[[bytes], str] = lambda first: "",
    ) -> None:
        super().__init__(fileno=bound.detach())
        self.setblocking(False)
        self._bounds = bounds
        self._holder_of = holder_of
        self._own = super().fileno()
        self._poll = select.epoll()
        self._poll.register(self._own, select.EPOLLIN)
        self._spare = _open_spare()
        self._silent: dict[int, tuple[socket.socket, SocketAddress, float]] = {}
        self._unproven: dict[Peer, tuple[socket.socket, str]] = {}
        self._known: FairQueue[_Waiting] = FairQueue()
        self._unknown: FairQueue[_Waiting] = FairQueue()
        self._passed: deque[_Waiting] = deque()
        self._again = os.eventfd(1, os.EFD_CLOEXEC | os.EFD_NONBLOCK)
        self._is_again = False
        self._first = ctypes.create_string_buffer(1)
        self._has_looked = False
        self._new: Counter[str] = Counter()
        self._window_s = 0.0
        self._timer: asyncio.TimerHandle | None = None
        self._told_s = -_LOG_S

    def fileno(self) -> int:
        """Descriptor that is readable when `accept` has work: from the listening socket, a silent
        connection, or connections that wait to be passed on.
        """
        return -1 if self._poll.closed else self._poll.fileno()

    def accept(self) -> tuple[socket.socket, SocketAddress]:
        """Return a connection whose first bytes have arrived, known ones first. Raises
        BlockingIOError if this iteration has passed on its share.
        """
        if not self._has_looked:
            self._has_looked = True
            self._look()
            self._pass_on()
        if self._passed:
            return self._passed.popleft()
        self._has_looked = False
        raise BlockingIOError

    def close(self) -> None:
        """Close it with all connections that were not passed on; idempotent."""
        if self._poll.closed:
            return
        if self._timer is not None:
            self._timer.cancel()
        for connection, _, _ in self._silent.values():
            connection.close()
        for connection, _ in (*self._known, *self._unknown, *self._passed):
            connection.close()
        for held in (self._silent, self._known, self._unknown, self._passed):
            held.clear()
        self._poll.close()
        os.close(self._again)
        self._close_spare()
        super().close()

    def prove(self, peer: Peer) -> None:
        """Mark the connection of that peer as authorised: it is no longer dropped for others."""
        self._unproven.pop(peer, None)

    def _pass_on(self) -> None:
        for queue in (self._known, self._unknown):
            for _ in range(_PASSED):
                if (found := queue.take()) is not None:
                    source, (connection, address) = found
                    self._drop_unproven(source)
                    self._unproven[address[:2]] = connection, source
                    self._passed.append((connection, address))
        if self._is_again != (is_again := bool(self._known or self._unknown)):
            self._is_again = is_again
            if is_again:
                self._poll.register(self._again, select.EPOLLIN)
            else:
                self._poll.unregister(self._again)

    def _look(self) -> None:
        for handle, _ in self._poll.poll(0, 2 * _AT_ONCE):
            if handle == self._own:
                self._take_new()
            elif handle in self._silent:
                connection, address, _ = self._silent.pop(handle)
                self._poll.unregister(handle)
                self._hear(connection, address)

    def _take_new(self) -> None:
        end_s, flags = time.monotonic() + _TAKE_S, socket.SOCK_NONBLOCK | socket.SOCK_CLOEXEC
        for count in itertools.count():
            if count >= _AT_ONCE and time.monotonic() > end_s:
                return
            handle = _LIBC.accept4(self._own, None, None, flags)
            if handle < 0:
                error = OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
                if isinstance(error, BlockingIOError | InterruptedError | ConnectionAbortedError):
                    return
                if error.errno not in _NO_HANDLES:
                    raise error
                self._do_without(error)
                return
            if _LIBC.recv(handle, self._first, 1, socket.MSG_PEEK) == 0:
                _LIBC.close(handle)  # its peer has left
                continue
            connection = socket.socket(self.family, self.type, self.proto, fileno=handle)
            connection.setblocking(False)
            try:
                address = connection.getpeername()
            except OSError:
                connection.close()
                continue
            self._hear(connection, address)

    def _hear(self, connection: socket.socket, address: SocketAddress) -> None:
        """Pass on a connection with data, keep a silent one, close a dead one."""
        try:
            first = connection.recv(_PEEK_BYTES, socket.MSG_PEEK)
        except BlockingIOError:
            self._keep(connection, address)
            return
        except OSError:
            first = b""
        holder = self._holder_of(first) if first else ""
        if first and holder and self._has_room(connection, holder):
            self._known.put(holder, (connection, address))
        elif first and not holder and self._admits(connection, network_of(address[0])):
            self._unknown.put(network_of(address[0]), (connection, address))
        else:
            connection.close()

    def _keep(self, connection: socket.socket, address: SocketAddress) -> None:
        handle = connection.fileno()
        is_full = len(self._silent) >= self._bounds.silent or handle >= self._bounds.handle
        if is_full and not self._drop_silent():
            connection.close()
            return
        self._silent[handle] = connection, address, time.monotonic()
        self._poll.register(handle, select.EPOLLIN)
        if self._timer is None:
            self._timer = asyncio.get_running_loop().call_later(SILENT_S, self._expire)

    def _has_room(self, connection: socket.socket, holder: str) -> bool:
        """True if there are handles for a known connection, for which the newest one of whoever has
        the most is dropped.
        """
        handle = connection.fileno()
        if handle < self._bounds.handle or self._drop_silent():
            return True
        if (dropped := self._known.take_longest(besides=holder)) is not None:
            dropped[0].close()
            return True
        return handle < self._bounds.handle_known

    def _admits(self, connection: socket.socket, source: str) -> bool:
        bounds = self._bounds
        now_s = time.monotonic()
        if now_s - self._window_s >= _WINDOW_S:
            self._window_s = now_s
            self._new.clear()
        self._new[source] += 1
        if self._new[source] > bounds.new or self._new.total() > 2 * bounds.new:
            return False
        return connection.fileno() < bounds.handle or self._drop_silent()

    def _drop_silent(self) -> bool:
        """Close the oldest silent connection; return True if there was one."""
        for handle, (connection, _, _) in self._silent.items():
            del self._silent[handle]
            connection.close()  # this also removes it from epoll
            return True
        return False

    def _drop_unproven(self, source: str) -> None:
        """Shut down the oldest unproven connection if there is one too many: of `source`, or of the
        busiest one.

        Its server notices the end of the stream, and closes it.
        """
        counts = Counter(other for _, other in self._unproven.values())
        is_full = counts.total() >= self._bounds.unproven
        if not is_full and counts[source] < self._bounds.unproven_of_one:
            return
        self._unproven = {
            peer: held for peer, held in self._unproven.items() if held[0].fileno() >= 0
        }
        counts = Counter(other for _, other in self._unproven.values())
        if counts[source] < self._bounds.unproven_of_one:
            if counts.total() < self._bounds.unproven:
                return
            source = counts.most_common(1)[0][0]
        peer = next(peer for peer, (_, other) in self._unproven.items() if other == source)
        connection, _ = self._unproven.pop(peer)
        with suppress(OSError):  # already closed
            connection.shutdown(socket.SHUT_RDWR)

    def _do_without(self, error: OSError) -> None:
        """Handle the lack of handles: make room for the next connection, and remove this one from
        the queue, which would stay full.
        """
        now_s = time.monotonic()
        if now_s - self._told_s >= _LOG_S:
            self._told_s = now_s
            log.error(
                "A connection is refused, and others for up to %g s without a word: %s. Who has "
                "so many files open?",
                _LOG_S,
                error.strerror,
            )
        if self._drop_silent():
            return
        self._close_spare()
        with suppress(OSError):  # another thread has taken the handle, or the connection is closed
            super().accept()[0].close()
        with suppress(OSError):
            self._spare = _open_spare()

    def _close_spare(self) -> None:
        if self._spare >= 0:
            os.close(self._spare)
        self._spare = -1

    def _expire(self) -> None:
        self._timer = None
        now_s = time.monotonic()
        while self._silent:
            begun_s = next(iter(self._silent.values()))[2]
            if now_s - begun_s < SILENT_S:
                wait_s = begun_s + SILENT_S - now_s
                self._timer = asyncio.get_running_loop().call_later(wait_s, self._expire)
                return
            self._drop_silent()


def _open_spare() -> int:
    """Open a spare handle, which is released when there is no other: then a connection can be
    accepted and refused with it.
    """
    return os.open(os.devnull, os.O_RDONLY | os.O_CLOEXEC)
