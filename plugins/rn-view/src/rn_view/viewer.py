"""The web server with all its pages; topics are subscribed to only while somebody looks."""

from __future__ import annotations

import contextlib
import io
import logging
import threading
import time
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from rn_view.access import Admission, check_address
from rn_view.measured import Measured
from rn_view.options import ViewOptions
from rn_view.page import Operator, Page
from rn_view.plots import History
from rn_view.source import Source
from roboneuron import RoboNeuronError, RobotProfile
from roboneuron.supervisor.changes import Periodic

log = logging.getLogger(__name__)
TITLE = "RoboNeuron"
_MOTION_S, _STATE_S, _SCENE_PICTURE_S, _IDLE_S = 1 / 25, 0.25, 0.5, 0.5
_LEAST_WIDTH_PX, _MOST_WIDTH_PX = 320, 640
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
        source: what is shown.
        admission: who may look.
        operator: calls tools for the buttons; None for a view without.
    """

    def __init__(self, options: ViewOptions, source: Source, admission: Admission, operator: Operator | None) -> None:
        self._options = options
        self._source = source
        self._admission = admission
        self._operator = operator
        self._lock = threading.RLock()
        self._pages: dict[int, Page] = {}
        self._server: _Server | None = None
        self._profile: RobotProfile | None = None
        self._place: tuple[str, str] = ("", "")
        self.measured: Measured | None = None
        """None while nobody looks: nothing is subscribed to then."""
        self._history = History()
        self._shown: dict[str, tuple[int, float, float]] = {}
        self._is_closing = threading.Event()
        self._motion = Periodic("view-motion", _MOTION_S, self._show_motion)
        self._state = Periodic("view-state", _STATE_S, self._show_state)
        self._pictures = threading.Thread(target=self._show_pictures, name="view-pictures", daemon=True)
        self._looks = threading.Event()

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
        for thread in (self._motion, self._state, self._pictures):
            thread.start()
        log.info("The live view is at %s.", self.url)

    def close(self) -> None:
        """End everything; idempotent."""
        self._is_closing.set()
        self._looks.set()
        self._motion.close()
        self._state.close()
        server, self._server = self._server, None
        if server is not None:
            with contextlib.redirect_stdout(io.StringIO()):
                server.stop()
        with self._lock:
            self._pages.clear()
            self._stop_looking()

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
        page = Page(client, self._source, self._operator, self._admission.tokens.find)
        page.holder = self._admission.visitor(client.client_id)
        with self._lock:
            self._pages[client.client_id] = page
        if page.holder is not None:
            self._admit(page)
        else:
            page.ask_token(lambda: self._admit(page))

    def _admit(self, page: Page) -> None:
        """Show everything to a page whose holder is known; the first one makes us look."""
        try:
            with self._lock:
                if self.measured is None:
                    self._start_looking()
                assert self._profile is not None
                page.show(self._profile, self._history)
                self._shown = {}  # it gets the pictures that are there, also if no others come
        except RoboNeuronError as error:
            log.error("The view cannot show the robot: %s", error)
            page.tell("The robot cannot be shown", str(error), is_bad=True)

    def _on_disconnect(self, client: viser.ClientHandle) -> None:
        with self._lock:
            page = self._pages.pop(client.client_id, None)
            if not any(other.is_admitted for other in self._pages.values()):
                self._stop_looking()
        if page is not None:
            page.leave()

    def _start_looking(self) -> None:
        self._profile = self._source.profile()
        config = self._source.config()
        self._place = (config.robot.name, config.namespace)
        measured = Measured(self._source, self._profile)
        try:
            measured.open()
        except RoboNeuronError:
            measured.close()
            raise
        self._shown = {}
        self.measured = measured
        self._looks.set()

    def _stop_looking(self) -> None:
        self._looks.clear()
        measured, self.measured = self.measured, None
        if measured is not None:
            measured.close()

    def _show_motion(self) -> None:
        measured = self.measured
        if measured is None:
            self._looks.wait(_IDLE_S)
            return
        for page in self._all_pages():
            page.update_motion(measured)

    def _show_state(self) -> None:
        measured = self.measured
        if measured is None:
            self._looks.wait(_IDLE_S)
            return
        config = self._source.config()
        if (config.robot.name, config.namespace) != self._place:  # another robot: every page begins anew
            with self._lock:
                self._stop_looking()
                server = self._server
            if server is not None:
                server._websock_server.disconnect_all_clients()
            return
        self._source.look()
        snapshot = self._source.snapshot()
        self._history.add(snapshot, self._source.now_s())
        for page in self._all_pages():
            page.update_state(snapshot, measured)

    def _show_pictures(self) -> None:
        while not self._is_closing.is_set():
            measured = self.measured
            if measured is None:
                self._looks.wait(_IDLE_S)
                continue
            with measured.news:
                if not self._due(measured):
                    measured.news.wait(_STATE_S)
            for camera in self._due(measured):
                try:
                    self._show_picture(measured, camera)
                except Exception:  # the border to a page that is just going away
                    log.exception("A picture of %s could not be shown.", camera)

    def _due(self, measured: Measured) -> list[str]:
        """Cameras with a picture that is new and not too soon after the one before."""
        now_s = time.monotonic()
        return [
            camera
            for camera, (number, _, _) in list(measured.images.items())
            if camera not in self._shown
            or (self._shown[camera][0] != number and now_s - self._shown[camera][1] >= 0.9 / self._options.image_hz)
        ]

    def _show_picture(self, measured: Measured, camera: str) -> None:
        number, pixels, _ = measured.images[camera]
        now_s = time.monotonic()
        before_s = self._shown[camera][2] if camera in self._shown else 0.0
        in_scene = now_s - before_s >= _SCENE_PICTURE_S
        self._shown[camera] = (number, now_s, now_s if in_scene else before_s)
        fitting = fitted(pixels)
        for page in self._all_pages():
            page.show_picture(camera, fitting, in_scene=in_scene)

    def _all_pages(self) -> list[Page]:
        with self._lock:
            return list(self._pages.values())


def fitted(pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """A picture of a width that fits the panel: whole numbers of pixels are repeated or left out."""
    width = pixels.shape[1]
    if width > _MOST_WIDTH_PX:
        step = -(-width // _MOST_WIDTH_PX)
        return np.ascontiguousarray(pixels[::step, ::step])
    times = -(-_LEAST_WIDTH_PX // width)
    return pixels if times == 1 else pixels.repeat(times, axis=0).repeat(times, axis=1)
