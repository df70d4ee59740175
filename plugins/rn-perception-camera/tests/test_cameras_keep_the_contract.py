"""The contract kit, run against both sources; and what is said where OpenCV is missing."""

from __future__ import annotations

import sys
from importlib.metadata import entry_points

import pytest

from rn_perception_camera.contract_cases import ros_case, video_case
from rn_testing import PerceptionCase, PerceptionContract
from roboneuron.plugins.discovery import discover
from roboneuron.plugins.registry import Status


class TestRosCamera(PerceptionContract):
    """`ros-camera`, fed by the kit."""

    @pytest.fixture
    def plugin(self) -> PerceptionCase:
        return ros_case()


class TestVideoCamera(PerceptionContract):
    """`video-camera`, with a short film."""

    @pytest.fixture
    def plugin(self) -> PerceptionCase:
        return video_case()


def test_without_opencv_only_the_video_camera_is_unavailable(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "cv2", None)
    registry = discover(points=entry_points(group="roboneuron"))
    offers = {
        offer.spec.name: offer for offer in registry.all_offers if offer.spec.kind == "perception"
    }
    assert offers["ros-camera"].status is Status.READY
    assert offers["video-camera"].status is Status.UNAVAILABLE
    assert "pip install opencv-python-headless" in offers["video-camera"].reason
