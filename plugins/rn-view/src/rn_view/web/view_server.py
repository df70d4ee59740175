"""The web server of the view, with all its pages."""

from __future__ import annotations

import asyncio
import contextlib
import io
import logging
import threading
from collections.abc import Mapping
from typing import Any

import viser

from rn_standard.http.addresses import bind
from rn_standard.http.listener import BoundedListener, other_bounds
from rn_view.options import ViewOptions
from rn_view.page import stop_bar
from rn_view.page.client_page import Page
from rn_view.page.robot_pages import RobotPages
from rn_view.page.stop_bar import TITLE
from rn_view.sources.measured_topics import MeasuredTopics
from rn_view.sources.operator_calls import Operator
from rn_view.sources.source import Source
from rn_view.teleoperation.sample_socket import LeadSockets
from rn_view.teleoperation.stick_panel import SOCKET_PATH
from rn_view.web.access import ViewAccess
from rn_view.web.page_requests import PICTURES_PATH, OpenPages
from rn_view.web.request_handler import RequestHandler, served_by
from rn_view.web.visitors import Visitors

log = logging.getLogger(__name__)
_RIGHT_PX = 380
_CONNECTIONS = 128
_SILENT_S = 60.0
"""Time limit for a new websocket to say where its camera is, and so to become a page. A browser
takes 1 to 5 s, on a busy machine many times as long.
"""
_MOST_SILENT, _MOST_WAITING = 32, 32
"""Maximum number of websockets that are not pages yet, and of pages that show only the stop. Beyond
it the oldest is disconnected.
"""


class _ViserServer(viser.ViserServer):
    """Refuses tunnels: in viser any page may request a public address of the server."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        log.warning("A page asked to share the view with the internet: refused.")
        return None


class ViewServer:
    """Serves pages from `open` to `close`.

    Args:
        options: of `[view]`.
        source: data source; for several robots by name, and each page has a choice.
        admission: checks who may connect.
        operator: calls tools for the buttons; None for a view without buttons.
    """

    def __init__(
        self,
        options: ViewOptions,
        source: Source | Mapping[str, Source],
        admission: ViewAccess,
        operator: Operator | None,
    ) -> None:
        self._options = options
        self._sources: dict[str, Source] = (
            dict(source) if isinstance(source, Mapping) else {"": source}
        )
        self._admission = admission
        self._operators = {} if operator is None else dict.fromkeys(self._sources, operator)
        self._lock = threading.RLock()
        self._pages: dict[int, Page] = {}
        self._server: _ViserServer | None = None
        self._listener: BoundedListener | None = None
        self._visitors = Visitors()
        self._robot_pages = {
            name: RobotPages(one, options.image_hz, self._begin_anew)
            for name, one in self._sources.items()
        }
        self._shown: dict[Page, str] = {}
        self._lead_sockets, self._open_pages = LeadSockets(), OpenPages()

    @property
    def measured(self) -> MeasuredTopics | None:
        """Measurements of the first robot; None while no page shows it."""
        return next(iter(self._robot_pages.values())).measured

    @property
    def url(self) -> str:
        """Address of the page."""
        assert self._server is not None
        host = "127.0.0.1" if self._options.host in ("0.0.0.0", "::", "") else self._options.host
        return (
            f"http://[{host}]:{self._server.get_port()}"
            if ":" in host
            else f"http://{host}:{self._server.get_port()}"
        )

    def open(self) -> None:
        """Start to listen.

        Raises:
            ConfigurationError: as `check_port`.
        """
        web = RequestHandler(
            self._admission,
            lambda: self._sources,
            self._visitors.who,
            self._visitors.cookie,
            self._open_pages,
        )
        bound = bind("view", self._options.host, self._options.port, self._admission.tokens)
        self._listener = BoundedListener(bound, other_bounds(_CONNECTIONS), stop_bar.stop_holder)
        with (
            served_by(
                self._listener,
                web,
                {
                    SOCKET_PATH: self._lead_sockets.serve,
                    PICTURES_PATH: self._open_pages.send_pictures,
                },
            ),
            contextlib.redirect_stdout(io.StringIO()),
        ):  # hide viser's banner: stdout may carry MCP
            self._server = _ViserServer(
                host=self._options.host, port=self._options.port, label=TITLE, verbose=False
            )
        _set_theme(self._server.gui, is_dark=False)
        self._server.gui.main_panel.dock_right()
        self._server.gui.main_panel.set_width(_RIGHT_PX)
        self._server._websock_server.on_client_connect(self._check_connection)
        self._server.on_client_connect(self._on_connect)
        self._server.on_client_disconnect(self._on_disconnect)
        for pages in self._robot_pages.values():
            pages.start()
        log.info("The live view is at %s.", self.url)

    def join(self, name: str, source: Source, operator: Operator) -> None:
        """Show one more robot. Every page reloads and has a choice of the robot then."""
        with self._lock:
            self._sources = {**self._sources, name: source}
            self._operators = {**self._operators, name: operator}
            pages = RobotPages(source, self._options.image_hz, self._begin_anew)
            self._robot_pages = {**self._robot_pages, name: pages}
        if self._server is not None:
            pages.start()
            self._begin_anew()

    def close(self) -> None:
        """Stop serving and close all pages; idempotent."""
        for pages in self._robot_pages.values():
            pages.close()
        server, self._server = self._server, None
        if server is not None:
            with contextlib.redirect_stdout(io.StringIO()):
                server.stop()
        if self._listener is not None:
            self._listener.close()
        with self._lock:
            self._pages.clear()
            self._shown.clear()
        for pages in self._robot_pages.values():  # again: a page may have connected meanwhile
            pages.close()

    def _begin_anew(self) -> None:
        """Disconnect all pages, so that they reload."""
        server = self._server
        if server is not None:
            server._websock_server.disconnect_all_clients()

    async def _check_connection(self, connection: Any) -> None:
        """Give a new websocket `_SILENT_S` to become a page. Close the oldest ones that are not
        pages beyond `_MOST_SILENT`.
        """
        assert self._server is not None
        live = self._server._websock_server._live_connections
        found = live.get(connection.client_id)
        if found is None or found.request is None:
            return
        assert self._listener is not None
        self._listener.prove(found.remote_address[:2])
        self._visitors.connect(connection.client_id, found.request)
        pages = self._server.get_clients()
        silent = [number for number in live if number not in pages]
        for number in silent[:-_MOST_SILENT]:
            live[number].transport.abort()
        loop = asyncio.get_running_loop()
        loop.call_later(_SILENT_S, self._drop_silent, connection.client_id, found)

    def _drop_silent(self, number: int, connection: Any) -> None:
        server = self._server
        if server is not None and number not in server.get_clients():
            connection.transport.abort()

    def _on_connect(self, client: viser.ClientHandle) -> None:
        """Build the page of a client. If that fails, disconnect it: a browser connects again."""
        try:
            self._build(client)
        except Exception:
            log.exception("The page of client %d could not be built.", client.client_id)
            self._abort(client.client_id)

    def _build(self, client: viser.ClientHandle) -> None:
        page = Page(
            client,
            self._sources,
            self._operators,
            self._admission.tokens.find,
            self._choose,
            self._lead_sockets,
            self._open_pages,
        )
        page.holder = self._admission.visitor(client.client_id)
        page.width_px = self._visitors.width_px(client.client_id) or client.camera.image_width
        if self._visitors.wants_dark(client.client_id):
            _set_theme(client.gui, is_dark=True)
        server = self._server
        with self._lock:
            # Viser forgets a client before it calls _on_disconnect, which removes the page.
            if server is None or client.client_id not in server.get_clients():
                return
            self._pages[client.client_id] = page
            self._shown[page] = page.robot
            self._robot_pages[page.robot].add(page)
            waiting = [number for number, other in self._pages.items() if not other.is_admitted]
        for number in waiting[:-_MOST_WAITING]:
            self._abort(number)
        self._begin(page)

    def _abort(self, number: int) -> None:
        """Disconnect a page. It reconnects by itself."""
        server = self._server
        found = None if server is None else server._websock_server._live_connections.get(number)
        loop = None if server is None else server._websock_server._background_event_loop
        if found is not None and loop is not None:
            loop.call_soon_threadsafe(found.transport.abort)

    def _begin(self, page: Page) -> None:
        """Show the robot on a page whose holder is known; ask for a token on others."""
        if page.holder is not None:
            self._admit(page)
        else:
            page.ask_token(lambda: self._admit(page))

    def _admit(self, page: Page) -> None:
        with self._lock:
            robot = self._shown.get(page)
            if robot is None:
                return
            if page.holder is not None:
                self._visitors.name(page.client.client_id, page.holder.who)
            if (
                sum(other.is_admitted for other in self._pages.values())
                >= self._options.max_viewers
            ):
                page.say_full(self._options.max_viewers)
                return
            self._robot_pages[robot].admit(page)

    def _choose(self, page: Page) -> None:
        """Switch a page to the robot chosen on it."""
        with self._lock:
            before, robot = self._shown.get(page), page.robot
            if before is None or robot == before:
                return
            self._shown[page] = robot
            was_admitted = page.is_admitted
            page.change()
            self._robot_pages[before].remove(page)
            self._robot_pages[robot].add(page)
            if was_admitted:
                self._robot_pages[robot].admit(page)

    def _on_disconnect(self, client: viser.ClientHandle) -> None:
        with self._lock:
            page = self._pages.pop(client.client_id, None)
            robot = self._shown.pop(page, None) if page is not None else None
        self._visitors.disconnect(client.client_id)
        if page is not None and robot is not None:
            self._robot_pages[robot].remove(page)
            page.leave()


def _set_theme(gui: viser.GuiApi, *, is_dark: bool) -> None:
    """Set the theme, of every page or of one."""
    gui.configure_theme(
        show_logo=False, show_share_button=False, control_width="medium", dark_mode=is_dark
    )
