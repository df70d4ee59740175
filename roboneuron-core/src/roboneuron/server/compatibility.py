"""What is to be started, compared with the modules that run."""

from __future__ import annotations

from collections.abc import Mapping

from roboneuron.errors import InvalidInputError, StateError
from roboneuron.modules.settings import ModuleKind
from roboneuron.server.selection import Selection
from roboneuron.supervisor.health import ModuleView


def check_compatible(selection: Selection, views: Mapping[ModuleKind, ModuleView]) -> None:
    """Compare what is to be started with the modules that run.

    Raises:
        StateError: another module works for another robot.
        InvalidInputError: the source of images does not serve all cameras of the backend.
    """
    if selection.kind == "robot":
        _check_robot(selection, views)
    elif selection.kind == "inference":
        served = _running(views["perception"])
        if served is not None:
            _check_cameras(selection, served)
    elif selection.kind == "perception":
        served_backend = _running(views["inference"])
        if served_backend is not None:
            _check_cameras(served_backend, selection)


def _check_robot(selection: Selection, views: Mapping[ModuleKind, ModuleView]) -> None:
    for view in views.values():
        if view.choice is not None and view.choice.settings.config.namespace != selection.config.namespace:
            raise StateError(
                f"{view.kind} works for the robot in /{view.choice.settings.config.namespace}, "
                f"not for {selection.config.robot.name!r}.",
                hint="Call stop_all first.",
            )


def _check_cameras(inference: Selection, perception: Selection) -> None:
    backend, section = inference.plan.backend, perception.config.perception
    assert backend is not None
    assert section is not None
    needed = [inference.plan.cameras[role] for role in backend.cameras]
    absent = [name for name in needed if name not in section.cameras]
    if section.cameras and absent:
        raise InvalidInputError(
            f"Backend {backend.name!r} needs the camera {', '.join(absent)}, "
            f"but perception serves only {', '.join(section.cameras)}.",
            hint="Let perception serve all cameras, or name others in `cameras`.",
        )


def _running(view: ModuleView) -> Selection | None:
    """What the running module was started with."""
    if view.phase != "running" or view.choice is None or view.choice.plan is None:
        return None
    return running_selection(view)


def running_selection(view: ModuleView) -> Selection:
    """What a module was started with, to start the same again.

    Raises:
        StateError: it was not started from a plan.
    """
    choice = view.choice
    if choice is None or choice.plan is None:
        raise StateError(f"It is not known what {view.kind} was started with.")
    config = choice.settings.config
    section = getattr(config, view.kind)
    return Selection(
        kind=view.kind,
        config=config,
        names=choice.names,
        plan=choice.plan,
        python=section.python if section is not None else None,
    )
