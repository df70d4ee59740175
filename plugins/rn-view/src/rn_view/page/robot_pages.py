"""Updates of all pages of one robot. Its topics are subscribed to only while a page is open."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import replace

from rn_view.diagnostics.active_limits import ActiveLimits
from rn_view.diagnostics.module_health import SteadyHealth
from rn_view.page.client_page import Page
from rn_view.page.picture_stream import jpeg
from rn_view.sources.measured_topics import MeasuredTopics
from rn_view.sources.source import PageState, Source
from rn_view.visualization.plots import History
from roboneuron import RoboNeuronError, RobotProfile
from roboneuron.feature import Periodic

log = logging.getLogger(__name__)
_MOTION_S, _STATE_S, _SCENE_PICTURE_S, _IDLE_S = 1 / 25, 0.25, 0.5, 0.5
_MOST_WIDTH_PX, _JPEG_QUALITY = 640, 80


class RobotPages:
    """Updates the pages of one robot from `start` to `close`; usable from any thread.

    Args:
        source: data source of the robot.
        image_hz: maximum image rate of each camera.
        on_other_robot: called when another robot runs than the one that the pages were built for;
            they must be built again.

    Attributes:
        source: see above.
        measured: None while no page is open; nothing is subscribed to then.
        state: the newest state shown.
    """

    def __init__(
        self, source: Source, image_hz: float, on_other_robot: Callable[[], object]
    ) -> None:
        self.source = source
        self.measured: MeasuredTopics | None = None
        self.state = PageState()
        self._image_hz = image_hz
        self._on_other_robot = on_other_robot
        self._lock = threading.RLock()
        self._pages: list[Page] = []
        self._profile: RobotProfile | None = None
        self._place: tuple[str, str] = ("", "")
        self._history = History()
        self._steady, self._limits = SteadyHealth(), ActiveLimits()
        self._shown: dict[str, tuple[int, float, float]] = {}
        self._is_closing = threading.Event()
        self._motion = Periodic("view-motion", _MOTION_S, self._show_motion)
        self._state = Periodic("view-state", _STATE_S, self._show_state)
        self._pictures = threading.Thread(
            target=self._show_pictures, name="view-pictures", daemon=True
        )
        self._looks = threading.Event()

    def start(self) -> None:
        """Start the updates."""
        for thread in (self._motion, self._state, self._pictures):
            thread.start()

    def close(self) -> None:
        """Stop the updates; idempotent."""
        self._is_closing.set()
        self._looks.set()
        self._motion.close()
        self._state.close()
        with self._lock:
            self._pages.clear()
            self._stop_looking()

    def add(self, page: Page) -> None:
        """Add a page of this robot; `admit` shows its contents."""
        with self._lock:
            self._pages.append(page)

    def admit(self, page: Page) -> None:
        """Show the robot on a page whose holder is known. The first page starts the
        subscriptions.
        """
        try:
            with self._lock:
                if self.measured is None:
                    self._start_looking()
                assert self._profile is not None
                page.show(self._profile, self._history, lambda: self.state)
                self._shown = {}  # a new page gets the present images at once
        except RoboNeuronError as error:
            log.error("The view cannot show the robot: %s", error)
            page.tell("The robot cannot be shown", str(error), is_bad=True)

    def remove(self, page: Page) -> None:
        """Remove a page that was closed or shows another robot."""
        with self._lock:
            if page in self._pages:
                self._pages.remove(page)
            if not any(other.is_admitted for other in self._pages):
                self._stop_looking()

    def _start_looking(self) -> None:
        self._profile = self.source.profile()
        config = self.source.config()
        self._place = (config.robot.name, config.namespace)
        measured = MeasuredTopics(self.source, self._profile)
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
            page.update_motion(self.source, measured)

    def _show_state(self) -> None:
        measured = self.measured
        if measured is None:
            self.source.poll()
            self._looks.wait(_IDLE_S)
            return
        config = self.source.config()
        # another robot: build every page again
        if (config.robot.name, config.namespace) != self._place:
            with self._lock:
                self._stop_looking()
            self._on_other_robot()
            return
        self.source.poll()
        snapshot = self.source.snapshot()
        now_s = self.source.now_s()
        self._history.add(snapshot, now_s)
        snapshot = replace(snapshot, modules=self._steady.rows(snapshot.modules, now_s))
        snapshot = self._limits.update(snapshot, now_s)
        self.state = snapshot
        for page in self._all_pages():
            page.update_state(self.source, snapshot, measured)

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
                except Exception:  # the page may just be closing
                    log.exception("A picture of %s could not be shown.", camera)

    def _due(self, measured: MeasuredTopics) -> list[str]:
        """Cameras with a new image, whose minimum interval is over."""
        now_s = time.monotonic()
        return [
            camera
            for camera, (number, _, _) in list(measured.images.items())
            if camera not in self._shown
            or (
                self._shown[camera][0] != number
                and now_s - self._shown[camera][1] >= 0.9 / self._image_hz
            )
        ]

    def _show_picture(self, measured: MeasuredTopics, camera: str) -> None:
        number, pixels, _ = measured.images[camera]
        now_s = time.monotonic()
        before_s = self._shown[camera][2] if camera in self._shown else 0.0
        in_scene = now_s - before_s >= _SCENE_PICTURE_S
        self._shown[camera] = (number, now_s, now_s if in_scene else before_s)
        encoded = jpeg(pixels, _MOST_WIDTH_PX, _JPEG_QUALITY)
        for page in self._all_pages():
            page.show_picture(self.source, camera, encoded, pixels if in_scene else None)

    def _all_pages(self) -> list[Page]:
        with self._lock:
            return list(self._pages)
