"""Descriptors of this package: the perception sources "ros-camera" and "video-camera", and the
command `cameras`.
"""

from __future__ import annotations

from collections.abc import Sequence

from roboneuron import CommandSpec, PerceptionSpec, Requirement, hookimpl

_VIDEO = "pip install opencv-python-headless"


@hookimpl
def roboneuron_perceptions() -> Sequence[PerceptionSpec]:
    """Cameras of any robot."""
    return [
        PerceptionSpec(
            name="ros-camera",
            summary="Images that camera drivers publish on ROS topics, raw or compressed, with "
            "their camera_info",
            target="rn_perception_camera.ros_source:RosCameras",
            config="rn_perception_camera.options:RosCamerasOptions",
            case="rn_perception_camera.contract_cases:ros_case",
        ),
        PerceptionSpec(
            name="video-camera",
            summary="USB (V4L2) cameras and video files, through OpenCV",
            target="rn_perception_camera.video_source:VideoCameras",
            config="rn_perception_camera.options:VideoCamerasOptions",
            case="rn_perception_camera.contract_cases:video_case",
            requires=(Requirement(module="cv2", install=_VIDEO),),
        ),
    ]


@hookimpl
def roboneuron_commands() -> Sequence[CommandSpec]:
    """The command for all cameras of a machine."""
    return [
        CommandSpec(
            name="robot-cameras",
            group="robot",
            summary="list cameras with a picture of each, print a calibration board, calibrate",
            target="rn_cameras.command:Cameras",
            old_names=("cameras",),
            old_options=(("--output", "--out"),),
        )
    ]
