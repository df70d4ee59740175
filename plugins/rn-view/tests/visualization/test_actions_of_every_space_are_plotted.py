"""The plots of actions show the channels that the label of the newest action names."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
import viser

from rn_view.sources.measured_topics import MeasuredTopics, ShownAction
from rn_view.visualization.plots import History, Plots, action_panels
from roboneuron import ACTION_LABEL, EE_DELTA, GRIPPER, Channel, ControlSpace, RobotProfile

JOINTS = ControlSpace(
    kind="joint_velocity",
    channels=(
        *(Channel(name=f"joint{i}", unit="rad/s") for i in range(1, 8)),
        Channel(name=GRIPPER, unit="opening"),
    ),
    rate_hz=15.0,
)
TWO_ARMS = ControlSpace(
    kind="joint_position",
    channels=tuple(
        Channel(name=name, unit="rad", arm=arm)
        for arm in ("left", "right")
        for name in ("joint1", "joint2", GRIPPER)
    ),
)


class Shown(Plots):
    """Plots whose data can be read."""

    def lines(self) -> dict[str, dict[str, list[float]]]:
        """Values by title of the plot and name of the channel."""
        return {
            panel.title: {
                name: values.tolist()
                for name, values in zip(panel.names, plot.data[1:], strict=True)
            }
            for panel, plot in self._actions
        }


@pytest.fixture
def plots() -> Iterator[Shown]:
    """Plots in a tab of a server without a client."""
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    yield Shown(server.gui, server.gui.add_tab_group().add_tab("Plots"))
    server.stop()


def test_displacements_are_shown_in_millimetres_and_degrees(plots: Shown) -> None:
    row = (0.001, 0.002, 0.003, 0.1, 0.2, 0.3, 1.0)
    plots.update([ShownAction(1.0, ACTION_LABEL, row)], History(), 2.0)
    lines = plots.lines()
    assert list(lines) == ["action: translation [mm]", "action: rotation [deg]"]
    assert lines["action: translation [mm]"]["dz"] == pytest.approx([3.0])
    assert lines["action: rotation [deg]"]["ry"] == pytest.approx(np.degrees([0.2]).tolist())


def test_another_space_brings_its_own_plots(plots: Shown) -> None:
    before = ShownAction(0.5, ACTION_LABEL, (0.0,) * 7)
    now = ShownAction(1.0, JOINTS.label, (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.9))
    malformed = ShownAction(1.1, JOINTS.label, (0.1,))
    plots.update([before, malformed, now], History(), 2.0)
    assert plots.lines() == {
        "action: joint velocity [rad/s or m/s]": {f"joint{i}": [i / 10] for i in range(1, 8)},
        "action: gripper [0..1]": {GRIPPER: [0.9]},
    }
    plots.update([before], History(), 2.0)
    assert "action: translation [mm]" in plots.lines()


def test_channels_of_two_arms_keep_their_names() -> None:
    left, right, gripper = action_panels(TWO_ARMS.label)
    assert left.title == "left: joint position [rad or m]"
    assert (left.names, left.columns) == (("left/joint1", "left/joint2"), (0, 1))
    assert (right.names, right.columns) == (("right/joint1", "right/joint2"), (3, 4))
    assert (gripper.names, gripper.columns) == (("left/gripper_open", "right/gripper_open"), (2, 5))


def test_every_channel_is_in_one_plot() -> None:
    for space in (JOINTS, TWO_ARMS):
        columns = [column for panel in action_panels(space.label) for column in panel.columns]
        assert sorted(columns) == list(range(space.size))
    delta = [column for panel in action_panels(EE_DELTA.label) for column in panel.columns]
    assert delta == [0, 1, 2, 3, 4, 5]


def test_messages_are_kept_with_their_label() -> None:
    from roboneuron.ros.messages import to_action_message

    class Now:
        playback = None

        def now_s(self) -> float:
            return 3.0

    measured = MeasuredTopics(Now(), RobotProfile(name="arm"))  # type: ignore[arg-type]
    measured._on_action(to_action_message(np.arange(8.0), JOINTS))
    assert list(measured.actions) == [ShownAction(3.0, JOINTS.label, tuple(np.arange(8.0)))]
