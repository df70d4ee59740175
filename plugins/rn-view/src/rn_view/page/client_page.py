"""The page of one client: its layout, its buttons, and the token form."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from contextlib import ExitStack

import numpy as np
import viser
from numpy.typing import NDArray

from rn_view.diagnostics.active_limits import limit_place
from rn_view.page.picture_stream import PictureStream
from rn_view.page.robot_area import SHOWN, key_html
from rn_view.recordings.playback_controls import PlaybackControls
from rn_view.sources.measured_topics import MeasuredTopics
from rn_view.sources.operator_calls import Operator
from rn_view.sources.source import PageState, Source
from rn_view.teleoperation import stick_panel
from rn_view.teleoperation.sample_socket import LeadSockets, PageTeleoperator
from rn_view.teleoperation.stick_panel import FULL_SHARE
from rn_view.visualization import markup
from rn_view.visualization.plots import History, Plots
from rn_view.visualization.scene import PageScene
from rn_view.web.page_requests import OpenPage, OpenPages
from roboneuron import RobotProfile
from roboneuron.feature import Holder, Role

_PHONE_PX, _WIDE_PX = 576, 1100
"""Up to the first width viser's panel is folded at first; below the second the scene is narrow."""
_LINES = 40
_MODULES = ("robot", "perception", "control", "inference")
_NOTICE_S = 8.0
_TRIES = 5
"""Number of wrong tokens a page may give before it must be reloaded."""


class Page:
    """The page of one client.

    The stop button is above it, see `stop_bar`. Everything else is shown once the holder is known.
    """

    def __init__(
        self,
        client: viser.ClientHandle,
        sources: Mapping[str, Source],
        operators: Mapping[str, Operator],
        admit: Callable[[str], Holder | None],
        on_choice: Callable[[Page], object],
        lead_sockets: LeadSockets,
        open_pages: OpenPages,
    ) -> None:
        """Args:
        sources: data sources by robot name. The page shows the first, and has a choice if there are
            several.
        operators: call tools for the buttons, by robot name; a robot without one has no buttons.
        admit: returns the holder of a token; None for an unknown token.
        on_choice: called when another robot is chosen.
        lead_sockets: registry of the pages that may lead by hand.
            open_pages: registry of the open pages, for their requests.
        """
        self.client = client
        self.holder: Holder | None = None
        self.width_px = 0
        self._sources = sources
        self._source = next(iter(sources.values()))
        self._operators = operators
        self._operator = operators.get(next(iter(sources)))
        self._admit = admit
        self._lead_sockets, self._open_pages = lead_sockets, open_pages
        self._lock = threading.Lock()
        self._content: _Content | None = None
        self._tries = _TRIES
        self._is_gone = False
        self._pictures: PictureStream | None = None
        self._presence = ExitStack()
        self._stop_text: viser.GuiHtmlHandle | None = None
        self._full_text: viser.GuiHtmlHandle | None = None
        client.gui.add_html(markup.STYLE)
        self._choice: viser.GuiDropdownHandle[str] | None = None
        if len(sources) > 1:
            self._choice = client.gui.add_dropdown(
                "Robot", tuple(sources), initial_value=next(iter(sources))
            )

            def choose(_: object) -> None:
                on_choice(self)

            self._choice.on_update(choose)
        if self._source.playback is None:
            self._stop_text = client.gui.add_html(markup.stop_text(None, self._source.label))

    @property
    def robot(self) -> str:
        """Name of the robot that is chosen on the page."""
        first = next(iter(self._sources))
        chosen = first if self._choice is None else str(self._choice.value)
        return chosen if chosen in self._sources else first

    @property
    def is_admitted(self) -> bool:
        """Whether the page knows its holder."""
        return self._content is not None

    def ask_token(self, on_admitted: Callable[[], None]) -> None:
        """Show a form for the token."""
        with self.client.gui.add_form(None) as form:
            self.client.gui.add_html(f"<div {SHOWN}></div>")
            token = self.client.gui.add_text("Token", "", hint="as in [[http.tokens]]")
            send = self.client.gui.add_button("Show the robot")
        send.on_click(lambda _: form.submit())

        def check(_: object) -> None:
            given = token.value.strip()
            form.remove()
            holder = self._admit(given)
            if holder is not None:
                self.holder = holder
                on_admitted()
                return
            self.tell("No access", "Unknown token.", is_bad=True)
            self._tries -= 1
            if self._tries:
                self.ask_token(on_admitted)

        form.on_submit(check)

    def show(
        self,
        profile: RobotProfile,
        history: History,
        state: Callable[[], PageState],
    ) -> None:
        """Build the rest of the page for its holder."""
        assert self.holder is not None
        self._pictures = pictures = PictureStream(profile.cameras)
        if self._operator is not None:
            self._presence.enter_context(self._operator.present(self.holder))
        buttons = (
            None
            if self._operator is None or not Role.OPERATOR.is_held_by(self.holder.role)
            else self._call
        )

        with self._lock:
            self._content = _Content(
                self.client, self._source, profile, history, buttons, self.width_px
            )
        key = self._open_pages.add(OpenPage(self.holder, self._source, state, pictures))
        self._presence.callback(self._open_pages.remove, key)
        self._presence.callback(self._forget, self.client.gui.add_html(key_html(key)))
        self._fold(False)
        if buttons is not None:
            self._let_lead(profile)

    def say_full(self, most: int) -> None:
        """Show that too many pages are open, so that this one has only the emergency stop."""
        if self._full_text is None:
            self._full_text = self.client.gui.add_html(
                f"<div {SHOWN}>{markup.full_text(most)}</div>"
            )

    def change(self) -> None:
        """Remove the contents of the previous robot; call `show` for the chosen one."""
        self._leave_robot()
        with self._lock:
            content, self._content = self._content, None
            self._source = self._sources[self.robot]
            self._operator = self._operators.get(self.robot)
            if self._stop_text is not None:
                self._stop_text.content = markup.stop_text(None, self._source.label)
            if content is not None:
                content.remove()

    def update_state(self, source: Source, snapshot: PageState, measured: MeasuredTopics) -> None:
        """Show the state of `source`, unless the page shows another source by now. Called a few
        times a second.
        """
        with self._lock:
            if self._is_gone or source is not self._source:
                return
            if self._stop_text is not None:
                self._stop_text.content = markup.stop_text(snapshot, self._source.label)
            if self._content is not None:
                self._content.update_state(snapshot, measured)

    def update_motion(self, source: Source, measured: MeasuredTopics) -> None:
        """Like `update_state`, for the moving parts of the scene. Called many times a second."""
        with self._lock:
            if self._content is not None and not self._is_gone and source is self._source:
                with self.client.atomic():
                    self._content.scene.update(measured)

    def show_picture(
        self, source: Source, camera: str, jpeg: bytes, in_scene: NDArray[np.uint8] | None
    ) -> None:
        """Like `update_state`, for a camera image; `in_scene` are pixels for the 3-D scene."""
        with self._lock:
            if self._content is None or self._is_gone or source is not self._source:
                return
            assert self._pictures is not None
            self._pictures.put(camera, jpeg)
            if in_scene is not None:
                self._content.scene.show_picture(camera, in_scene)

    def tell(self, title: str, text: str, *, is_bad: bool) -> None:
        """Show a notification for a few seconds."""
        self.client.add_notification(
            title, text, auto_close_seconds=_NOTICE_S, color="red" if is_bad else "green"
        )

    def leave(self) -> None:
        """Called when the client has disconnected."""
        self._is_gone = True
        self._leave_robot()

    def _let_lead(self, profile: RobotProfile) -> None:
        """Enable the stick panel: lead the arm and label recordings, if the server supports it."""
        operator, limits = self._operator, profile.limits
        if operator is None:
            return
        name, source = f"page-{self.client.client_id}", PageTeleoperator()
        speeds: dict[str, float] = {}
        if limits is not None and profile.arm_joints and operator.lend(name, source):
            self._presence.callback(operator.lend, name, None)
            shares = (FULL_SHARE * np.asarray(limits.velocity)).tolist()
            speeds = dict(zip(profile.arm_joints, shares, strict=True))
        labels = operator.has("label_recording")
        if not speeds and not labels:
            return
        key = self._lead_sockets.add(name, source, self._start_call, self._fetch, self._fold)
        self._presence.callback(self._lead_sockets.remove, key)
        html = stick_panel.key_html(key, speeds, labels=labels)
        place = self.client.gui.add_html(html)
        self._presence.callback(self._forget, place)

    def _fold(self, is_folded: bool) -> None:
        """Fold the panel beside the scene; on a phone it is folded unless a person unfolds it. A
        narrow page looks from nearer while it is folded, because the scene is low then.
        """
        content = self._content
        if content is not None and self.width_px < _WIDE_PX:
            content.scene.look(is_narrow=not is_folded)
        panel = self.client.gui.main_panel
        if is_folded or self.width_px <= _PHONE_PX:
            panel.minimize()
        else:
            panel.expand()

    def _forget(self, place: viser.GuiHtmlHandle) -> None:
        if not self._is_gone:
            place.remove()

    def _leave_robot(self) -> None:
        self._presence.close()
        if self._operator is not None and self.holder is not None:
            self._operator.leave(self.holder)

    def _start_call(self, tool: str, arguments: dict[str, object]) -> Future[str]:
        """Call a tool as the holder."""
        assert self._operator is not None
        assert self.holder is not None
        return self._operator.call(self.holder, tool, arguments)

    def _fetch(self, tool: str) -> Future[Mapping[str, object]]:
        """Call a tool that only reads, as the holder."""
        assert self._operator is not None
        assert self.holder is not None
        return self._operator.fetch(self.holder, tool)

    def _call(self, tool: str, arguments: dict[str, object]) -> None:

        def told(future: Future[str]) -> None:
            failure = str(future.exception() or "") or future.result()
            self.tell(tool, failure or "done", is_bad=bool(failure))

        self._start_call(tool, arguments).add_done_callback(told)


class _Content:
    """The contents of a page whose holder is known."""

    def __init__(
        self,
        client: viser.ClientHandle,
        source: Source,
        profile: RobotProfile,
        history: History,
        call: Callable[[str, dict[str, object]], None] | None,
        width_px: int,
    ) -> None:
        gui = client.gui
        self._source = source
        self._profile = profile
        self._history = history
        self._gui = gui
        self._player = (
            PlaybackControls(gui, source.playback) if source.playback is not None else None
        )
        self._client = client
        self._instruction = gui.add_html("")
        buttons = () if call is None else (self._add_buttons(call),)
        tabs = gui.add_tab_group()
        self._parts = (self._instruction, *buttons, tabs)
        with tabs.add_tab("Events"):
            self._list = gui.add_html("")
        with tabs.add_tab("Health"):
            self._modules = gui.add_html("")
        self._plots = Plots(gui, tabs.add_tab("Plots"))
        with tabs.add_tab("Joints"):
            self._joints = gui.add_html("")
        self.scene = PageScene(client, profile, source.config(), is_narrow=width_px < _WIDE_PX)
        self._count = -1

    def remove(self) -> None:
        """Remove everything from the page. Only for one of several robots, never for a
        recording.
        """
        for part in self._parts:
            part.remove()
        self._client.scene.reset()

    def update_state(self, snapshot: PageState, measured: MeasuredTopics) -> None:
        if self._player is not None:
            self._player.update(snapshot)
        self._instruction.content = markup.instruction_text(snapshot)
        self._modules.content = markup.modules_table(snapshot.modules)
        place = limit_place(snapshot.limits, snapshot.limit, self._profile.arm_joints, ())
        self._joints.content = markup.joints_table(
            self._profile, measured.joints, place.joints, snapshot.unchecked
        )
        self.scene.update_limit(snapshot)
        self.scene.update_chunk(measured, self._source.now_s())
        count = self._source.shown_events.count
        if count != self._count:
            self._list.content = markup.event_rows(self._source.shown_events.newest(_LINES))
            self._count = count
        self._plots.update(list(measured.actions), self._history, self._source.now_s())

    def _add_buttons(self, call: Callable[[str, dict[str, object]], None]) -> object:
        gui = self._gui
        with gui.add_form("Operate") as form:
            text = gui.add_text("Instruction", "")
            send = gui.add_button("Give the instruction")
            start = gui.add_button_group("Start", _MODULES)
            stop = gui.add_button_group("Stop", (*_MODULES, "all"))
            take = gui.add_button(
                "Take over", hint="Become the operator, the only client that may move the robot."
            )
        send.on_click(lambda _: form.submit())
        form.on_submit(lambda _: call("set_instruction", {"instruction": text.value}))
        start.on_click(lambda _: call(f"start_{start.value}", {}))
        stop.on_click(lambda _: call(f"stop_{stop.value}", {}))
        take.on_click(lambda _: call("take_over", {}))
        return form
