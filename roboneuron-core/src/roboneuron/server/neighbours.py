"""What modules that run side by side need from each other; refused before anything is started or stopped."""

from __future__ import annotations

from roboneuron.config import Config
from roboneuron.errors import InvalidInputError
from roboneuron.planning import check_plan
from roboneuron.plugins.registry import Registry
from roboneuron.server.selection import Selection
from roboneuron.supervisor.view import ModuleView


def check_cameras(registry: Registry, inference: Config, perception: Config) -> None:
    """Compare what a backend needs with what a source serves.

    Raises:
        InvalidInputError: the source does not serve all cameras of the backend.
    """
    section, serving = inference.inference, perception.perception
    assert section is not None
    assert serving is not None
    plan = check_plan(
        registry,
        robot=inference.robot.name,
        driver=inference.robot.driver,
        backend=section.backend,
        runtime=section.runtime,
        acceleration=section.acceleration,
        cameras=section.cameras,
    )
    assert plan.backend is not None
    absent = [name for role in plan.backend.cameras if (name := plan.cameras[role]) not in serving.cameras]
    if serving.cameras and absent:
        raise InvalidInputError(
            f"Backend {section.backend!r} needs the camera {', '.join(absent)}, "
            f"but perception serves only {', '.join(serving.cameras)}.",
            hint="Call switch_perception with all cameras, or name others in `cameras`.",
        )


def check_same_commands(old: ModuleView, selection: Selection) -> None:
    """Two controllers that publish on different topics cannot hand the arm over.

    Raises:
        InvalidInputError: the type of the command topic would change.
    """
    assert old.choice is not None
    before, after = old.choice.settings.config.control, selection.config.control
    if before is not None and after is not None and before.command != after.command:
        raise InvalidInputError(
            f"The running controller sends {before.command}, the new one would send {after.command}.",
            hint="Call stop_control and start_control instead.",
        )
