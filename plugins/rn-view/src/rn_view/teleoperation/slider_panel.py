"""Panel of sliders by which a person leads the arm."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import viser

from rn_view.sources.measured_topics import MeasuredTopics
from rn_view.teleoperation.slider_goal import SliderGoal
from roboneuron import RoboNeuronError, RobotProfile, robot_space

_TITLE, _SWITCH = "Sliders for a program", "Lead with these sliders"
_HINT = (
    "For a program that follows this page, such as lerobot's teleoperator. Without one "
    "the sliders move nothing."
)


@dataclass(frozen=True, slots=True)
class _Slider:
    """A slider with its scale: position = zero + scale * value."""

    handle: viser.GuiSliderHandle[float]
    zero: float
    scale: float


class SliderPanel:
    """The panel on one page, collapsed at first.

    Args:
        gui: viser's elements of the page.
        profile: of the robot.
        lead: goal of that robot.
        measured: returns the present measurements.
        on_lead: called when this page starts to lead, with the object that leads.
        tell: shows a title and the reason why this page does not lead.
    """

    def __init__(
        self,
        gui: viser.GuiApi,
        profile: RobotProfile,
        lead: SliderGoal,
        measured: Callable[[], MeasuredTopics | None],
        on_lead: Callable[[object], object],
        tell: Callable[[str, str], object],
    ) -> None:
        self._lead, self._measured, self._on_lead, self._tell = lead, measured, on_lead, tell
        self._leads = False
        self._folder = gui.add_folder(_TITLE, expand_by_default=False)
        with self._folder:
            self._switch = gui.add_checkbox(_SWITCH, False, hint=_HINT)
            self._sliders = {
                joint: self._add_slider(gui, profile, joint, low, high)
                for joint, (low, high) in lead.bounds.items()
            }
        self._switch.on_update(lambda event: self._switched())

    def update(self) -> None:
        """Switch off if this page no longer leads."""
        if self._leads and not self._lead.is_led_by(self):
            self._switch.value = False  # type: ignore[misc]
            self._enable(False)

    def end(self) -> None:
        """Stop leading, because the page is closed."""
        self._lead.end(self)

    def remove(self) -> None:
        """Remove the panel from the page."""
        self.end()
        self._folder.remove()

    def _switched(self) -> None:
        if not self._switch.value:
            self._lead.end(self)
            self._enable(False)
            return
        measured = self._measured()
        try:
            start = self._lead.begin(self, {} if measured is None else measured.joints)
        except RoboNeuronError as error:
            self._tell(_TITLE, str(error))
            self._switch.value = False  # type: ignore[misc]
            return
        for joint, slider in self._sliders.items():
            value = (start[joint] - slider.zero) / slider.scale
            handle = slider.handle
            handle.value = min(max(value, handle.min), handle.max)  # type: ignore[misc]
        self._enable(True)
        self._on_lead(self)

    def _enable(self, is_enabled: bool) -> None:
        self._leads = is_enabled
        for slider in self._sliders.values():
            slider.handle.disabled = not is_enabled

    def _add_slider(
        self, gui: viser.GuiApi, profile: RobotProfile, joint: str, low: float, high: float
    ) -> _Slider:
        gripper = next((g for g in profile.grippers if g.joint == joint), None)
        if gripper is not None:
            zero, unit = gripper.closed_position, "% open"
            scale = (gripper.open_position - gripper.closed_position) / 100.0
        elif joint in _slides(profile):
            zero, scale, unit = 0.0, 1e-3, "mm"
        else:
            zero, scale, unit = 0.0, math.pi / 180.0, "deg"
        ends = sorted(((low - zero) / scale, (high - zero) / scale))
        first, last = math.ceil(ends[0] * 10.0) / 10.0, math.floor(ends[1] * 10.0) / 10.0
        handle = gui.add_slider(
            f"{joint} [{unit}]",
            first,
            last,
            0.1,
            min(max(0.0, first), last),
            disabled=True,
        )
        slider = _Slider(handle, zero, scale)

        def moved(event: viser.GuiEvent[viser.GuiSliderHandle[float]]) -> None:
            # moved by a person, not by this program
            if event.client is not None:
                self._lead.aim(self, joint, zero + scale * float(handle.value))

        handle.on_update(moved)
        return slider


def _slides(profile: RobotProfile) -> set[str]:
    """Names of the prismatic joints, whose positions are in metres."""
    space = robot_space("joint_position", profile)
    return {channel.name for channel in space.channels if channel.unit == "m"}
