"""Options of the driver `ros2-control`."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

TopicName = Annotated[str, Field(pattern=r"^/[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*$")]


class Ros2ControlOptions(BaseModel):
    """Names of the controller's interfaces, and tolerances for faults."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    controller: TopicName = Field(
        default="/joint_trajectory_controller",
        description="Absolute name of the joint_trajectory_controller.",
    )
    controller_type: Literal["joint-trajectory", "forward-position"] = Field(
        default="joint-trajectory",
        description="joint-trajectory: joint_trajectory_controller; forward-position: "
        "JointGroupPositionController, or ForwardCommandController with the interface position, to "
        "which the driver sends positions on the way.",
    )
    rate_hz: float = Field(
        default=100.0,
        ge=10.0,
        le=1000.0,
        description="forward-position: positions each second.",
    )
    controller_manager: TopicName = Field(
        default="/controller_manager",
        description="Name of the controller manager, which says why a controller is not active; "
        "asked where its types (controller_manager_msgs) are installed.",
    )
    mode: Literal["topic", "action", "chunks"] = Field(
        default="topic",
        description="topic: publish every target, for policies; action: a FollowJointTrajectory "
        "goal for each target; chunks: publish every target with those that control has planned "
        "after it ([control] horizon_s).",
    )
    horizon_s: float = Field(
        default=0.25,
        gt=0.0,
        le=1.0,
        description="chunks: how long the arm goes on by itself after a target [s]; later ones are "
        "left out.",
    )
    joint_states: TopicName = Field(
        default="/joint_states", description="Where the measured joints come from."
    )
    gripper_joint_states: TopicName | None = Field(
        default=None,
        description="Where the gripper's joint comes from, when that is another topic.",
    )
    gripper: Literal["none", "gripper-command", "parallel-gripper-command"] = Field(
        default="none", description="Action type that moves the gripper; none: it is not driven."
    )
    gripper_action: TopicName = Field(
        default="/gripper_controller/gripper_cmd", description="Absolute name of that action."
    )
    gripper_effort_n: float = Field(
        default=20.0, gt=0.0, description="Greatest effort of the gripper [N]."
    )
    interpolation: Literal["linear", "cubic"] = Field(
        default="linear",
        description="linear: positions only, for targets that follow each other; cubic: come to "
        "rest at each target.",
    )
    path_tolerance: float = Field(
        default=0.0,
        ge=0.0,
        description="Following error of a joint that is a fault [rad or m]; 0: the controller's.",
    )
    goal_tolerance: float = Field(
        default=0.0,
        ge=0.0,
        description="Error of a joint at the end that is a fault [rad or m]; 0: the controller's.",
    )
    goal_time_tolerance_s: float = Field(
        default=0.0, ge=0.0, description="How late the end may be reached [s]; 0: the controller's."
    )
    resume_after_fault: bool = Field(
        default=False,
        description="Follow commands again after a fault without stopping and starting the robot.",
    )
    watch_controller: bool = Field(
        default=True,
        description="Read `controller_state`; without it an inactive controller is not noticed.",
    )
    connect_timeout_s: float = Field(
        default=10.0, gt=0.0, le=120.0, description="Time for finding all of it [s]."
    )
    goal_timeout_s: float = Field(
        default=1.0, gt=0.0, le=30.0, description="Time for accepting a goal [s]."
    )
    state_timeout_s: float = Field(
        default=0.5,
        gt=0.0,
        le=10.0,
        description="Age of joint or controller states that counts as silence [s].",
    )

    @model_validator(mode="after")
    def _check_interpolation(self) -> Self:
        """Check that chunks are interpolated through their targets, and that the controller has
        what the mode needs.
        """
        if self.controller_type == "forward-position" and self.mode == "action":
            raise ValueError("mode = 'action' needs a joint-trajectory controller")
        if self.mode == "chunks" and self.interpolation == "cubic":
            raise ValueError(
                "mode = 'chunks' needs interpolation = 'linear'; cubic comes to rest at each target"
            )
        return self
