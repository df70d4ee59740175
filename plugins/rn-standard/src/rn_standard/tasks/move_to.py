"""Tool move_to: to postures, places, positions and objects, measured on the way."""

from __future__ import annotations

from rn_standard.tasks.moving import MovedTo, Mover, MoveToArguments, PoseNow
from rn_standard.tasks.named_targets import Places
from roboneuron import (
    CallContext,
    Host,
    RoboNeuronError,
    Tool,
)
from roboneuron.tools.arm.motion_meter import MotionMeter


def move_to_subject(places: Places, arguments: MoveToArguments) -> tuple[str, str] | None:
    """What a person is asked to approve, see `Approval`; None for an unknown name."""
    if arguments.name is not None:
        return ("move to", arguments.name) if arguments.name in places.choices() else None
    target = arguments.object or arguments.position_m or f"mark {arguments.mark}"
    return "move to", str(target)


class MoveTo:
    """The handler of move_to: moves, and measures the motion and where it ended."""

    def __init__(self, host: Host, mover: Mover, places: Places, pose_now: PoseNow) -> None:
        self._host, self._mover, self._places = host, mover, places
        self._pose_now = pose_now

    async def __call__(self, arguments: MoveToArguments, context: CallContext) -> MovedTo:
        """Raises as `Mover.go`."""
        place = self._places.places().get(arguments.name or "")
        arm = arguments.arm if place is None else place.arm
        meter = MotionMeter(self._host, arm)
        await context.run(lambda _: meter.open())
        try:
            moved = await self._mover.go(arguments, context)
            end = await context.run(lambda _: self._end(arm, meter))
        finally:
            meter.close()
        return moved.model_copy(update={**end, "max_tcp_speed_m_s": meter.highest_m_s})

    def _end(self, arm: str, meter: MotionMeter) -> dict[str, object]:
        """Where the arm is measured now; nothing where control does not run."""
        try:
            position, rotation = self._pose_now(arm)
        except RoboNeuronError:
            return {}
        return meter.end(position, rotation)


def move_to_tool(mover: MoveTo, places: Places) -> Tool[MoveToArguments]:
    """move_to."""
    return Tool(
        name="move_to",
        title="Move to a posture, place, position or object",
        description="Move the arm to a named posture, through a gesture, or in straight lines to a "
        "place, a position or over an object (needs start_control). Refused while a policy has an "
        "instruction.",
        arguments=MoveToArguments,
        result=MovedTo,
        handler=mover,
        simulated_by=frozenset({"twin"}),
        open_world=True,
        choices={"name": places.choices},
    )
