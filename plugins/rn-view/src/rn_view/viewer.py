"""The web server with all its pages."""

from __future__ import annotations

import contextlib
import io
import logging
import threading
from collections.abc import Mapping
from typing import Any

import viser

from rn_view.access import Admission, check_address
from rn_view.measured import Measured
from rn_view.options import ViewOptions
from rn_view.page import Operator, Page
from rn_view.showing import Showing
from rn_view.source import Source

log = logging.getLogger(__name__)
TITLE = "RoboNeuron"
_POLICY_VIOLATION = 1008
"""Why a connection is closed. Source: RFC 6455, section 7.4.1."""


class _Server(viser.ViserServer):
    """Opens no tunnel: in viser any page may ask for a public address of the server."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        log.warning("A page asked to share the view with the internet: refused.")
        return None


class Viewer:
    """Serves pages from `open` to `close`.

    Args:
        options: where, how fast and to how many.
        source: what is shown; of several robots by their names, and each page has a choice.
        admission: who may look.
        operator: calls tools for the buttons; None for a view without, such as one of several robots.
    """

    def __init__(
        self,
        options: ViewOptions,
        source: Source | Mapping[str, Source],
        admission: Admission,
        operator: Operator | None,
    ) -> None:
        self._options = options
        self._sources = source if isinstance(source, Mapping) else {"": source}
        self._admission = admission
        self._operator = operator
        self._lock = threading.RLock()
        self._pages: dict[int, Page] = {}
        self._server: _Server | None = None
        self._showings = {name: Showing(one, options.image_hz, self._begin_anew) for name, one in self._sources.items()}
        self._shown: dict[Page, str] = {}

    @property
    def measured(self) -> Measured | None:
        """What is measured of the first robot; None while nobody looks at it: nothing is subscribed to then."""
        return next(iter(self._showings.values())).measured

    @property
    def url(self) -> str:
        """Where the page is."""
        assert self._server is not None
        host = "127.0.0.1" if self._options.host in ("0.0.0.0", "::", "") else self._options.host
        return (
            f"http://[{host}]:{self._server.get_port()}" if ":" in host else f"http://{host}:{self._server.get_port()}"
        )

    def open(self) -> None:
        """Begin to serve.

        Raises:
            ConfigurationError: as `check_address`.
        """
        check_address(self._options, self._admission.tokens)
        with contextlib.redirect_stdout(io.StringIO()):  # a banner; stdout may be a protocol
            self._server = _Server(host=self._options.host, port=self._options.port, label=TITLE, verbose=False)
        self._server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium")
        self._server.gui.main_panel.dock_right()
        self._server.gui.main_panel.set_width(400)
        self._server._websock_server.on_client_connect(self._check_connection)
        self._server.on_client_connect(self._on_connect)
        self._server.on_client_disconnect(self._on_disconnect)
        for showing in self._showings.values():
            showing.start()
        log.info("The live view is at %s.", self.url)

    def close(self) -> None:
        """End everything; idempotent."""
        for showing in self._showings.values():
            showing.close()
        server, self._server = self._server, None
        if server is not None:
            with contextlib.redirect_stdout(io.StringIO()):
                server.stop()
        with self._lock:
            self._pages.clear()
            self._shown.clear()
        for showing in self._showings.values():  # again: a page may have come meanwhile
            showing.close()

    def _begin_anew(self) -> None:
        """Another robot runs: every page begins anew."""
        server = self._server
        if server is not None:
            server._websock_server.disconnect_all_clients()

    async def _check_connection(self, connection: Any) -> None:
        """Close a connection that comes from another web page, or that is one too many, before anything is sent."""
        assert self._server is not None
        live = self._server._websock_server._live_connections
        found = live.get(connection.client_id)
        if found is None or found.request is None:
            return
        if not self._admission.allows(found.request.headers):
            log.warning("A page of %s may not connect to the view.", found.request.headers.get("Origin"))
            await found.close(_POLICY_VIOLATION, "This page may not connect.")
        elif len(live) > self._options.max_viewers:
            await found.close(_POLICY_VIOLATION, "Too many pages are open.")

    def _on_connect(self, client: viser.ClientHandle) -> None:
        page = Page(client, self._sources, self._operator, self._admission.tokens.find, self._choose)
        page.holder = self._admission.visitor(client.client_id)
        with self._lock:
            self._pages[client.client_id] = page
            self._shown[page] = page.robot
            self._showings[page.robot].add(page)
        self._begin(page)

    def _begin(self, page: Page) -> None:
        """Show everything to a page whose holder is known; ask the others."""
        if page.holder is not None:
            self._admit(page)
        else:
            page.ask_token(lambda: self._admit(page))

    def _admit(self, page: Page) -> None:
        with self._lock:
            robot = self._shown.get(page)
        if robot is not None:
            self._showings[robot].admit(page)

    def _choose(self, page: Page) -> None:
        """The page is to show another robot."""
        with self._lock:
            before, robot = self._shown.get(page), page.robot
            if before is None or robot == before:
                return
            self._shown[page] = robot
            page.change()
            self._showings[before].remove(page)
            self._showings[robot].add(page)
            if page.holder is not None:
                self._showings[robot].admit(page)

    def _on_disconnect(self, client: viser.ClientHandle) -> None:
        with self._lock:
            page = self._pages.pop(client.client_id, None)
            robot = self._shown.pop(page, None) if page is not None else None
        if page is not None and robot is not None:
            self._showings[robot].remove(page)
            page.leave()
