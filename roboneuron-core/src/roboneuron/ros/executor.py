"""Executor that survives every exception of a callback, and creation of a node's entities with
errors that name them.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, TypeVar

from rclpy.exceptions import InvalidHandle, NameValidationException
from rclpy.executors import (
    ExternalShutdownException,
    ShutdownException,
    SingleThreadedExecutor,
    TimeoutException,
)
from rclpy.node import Node

from roboneuron.errors import ConfigurationError, InternalError, RoboNeuronError, StateError

T = TypeVar("T")
_LOST_S = 2.0
"""Time for which every wait for callbacks fails, after which the executor is lost: no entity of its
node is served. A wait that fails once, because an entity was destroyed meanwhile, is repeated.
"""
_RETRY_S = 0.02
"""Pause after a failed wait; without it a core would be busy."""


class TolerantExecutor(SingleThreadedExecutor):  # type: ignore[misc]
    """SingleThreadedExecutor whose `spin` an exception of a callback, task or take does not end.

    rclpy raises an exception of any of them out of `spin`, so that the others are served no more.
    Source: `SingleThreadedExecutor._spin_once_impl` in rclpy 7.1.
    """

    def __init__(self, on_error: Callable[[BaseException, str], object], **options: Any) -> None:
        """Args:
        on_error: called with the exception and the name of its topic or service, empty for others;
            on the executor's thread.
        options: options of SingleThreadedExecutor.
        """
        super().__init__(**options)
        self._on_error = on_error
        self._failing_since_s: float | None = None

    def spin_once(self, timeout_sec: float | None = None) -> None:
        """Wait for one callback and execute it.

        Raises:
            ExternalShutdownException: the context was shut down.
            InternalError: nothing can be waited for any more.
        """
        try:
            handler, entity, _ = self.wait_for_ready_callbacks(timeout_sec)
        except (ShutdownException, TimeoutException):
            return
        except ExternalShutdownException:
            raise
        except Exception as error:  # rclpy raises its own, and those of its C++ parts
            self._note_failed_wait(error)
            return
        self._failing_since_s = None
        name = _name_of(entity)
        try:
            handler()
        except BaseException as error:  # a callback may call sys.exit, which rclpy raises at once
            self._on_error(error, name)
        else:
            if (failure := handler.exception()) is not None:
                self._on_error(failure, name)

    def _note_failed_wait(self, error: Exception) -> None:
        now_s = time.monotonic()
        if self._failing_since_s is None:
            self._failing_since_s = now_s
        if now_s - self._failing_since_s > _LOST_S:
            raise InternalError(
                f"The ROS executor has failed for {_LOST_S:g} s: {one_line(error)}."
            ) from error
        time.sleep(_RETRY_S)


def _name_of(entity: object) -> str:
    """Name of a topic or service; empty for timers and others."""
    for attribute in ("topic_name", "srv_name"):
        try:
            return str(getattr(entity, attribute))
        except (AttributeError, RuntimeError):  # RuntimeError: it was destroyed by its callback
            continue
    return ""


def created(node: Node, noun: str, name: str, ros_type: type | None, make: Callable[[], T]) -> T:
    """Return what `make` creates on `node`; its errors name what was to be created.

    Args:
        node: the node.
        noun: "subscription", "publisher", "client", "service", "action client" or "timer".
        name: name of the topic, service or action, absolute or relative to the node.
        ros_type: its rosidl class; None for a timer.
        make: creates it; called on the executor's thread.

    Raises:
        ConfigurationError: the name, type or quality of service cannot be used, or this process
            uses the name with another type.
        StateError: the node was destroyed.
    """
    what = f"The {noun} {name}" + (f" ({type_name(ros_type)})" if ros_type is not None else "")
    if noun == "action client" and not hasattr(ros_type, "Goal"):
        # rclpy would end the process with a segmentation fault
        raise ConfigurationError(f"{what} cannot be created: that is not the type of an action.")
    try:
        return make()
    except RoboNeuronError:
        raise
    except NameValidationException as error:
        raise ConfigurationError(f"{what} cannot be created: {one_line(error)}.") from error
    # rclpy raises many kinds: RCLError, RuntimeError, ValueError, TypeError, AttributeError ...
    except Exception as error:
        if isinstance(error, InvalidHandle) or not node.context.ok():
            raise StateError(f"{what} cannot be created: the node was closed.") from error
        other = _other_type(node, noun, name, type_name(ros_type))
        if other:
            raise ConfigurationError(
                f"{what} cannot be created: this process uses that name as {other}.",
                hint=f"Give the type {other}, or another name.",
            ) from error
        raise ConfigurationError(f"{what} cannot be created: {one_line(error)}.") from error


def _other_type(node: Node, noun: str, name: str, own: str) -> str:
    """The type with which the ROS graph, which contains this process, has that name; empty if it
    has no other.
    """
    space = node.get_namespace().rstrip("/")
    place, end = name if name.startswith("/") else f"{space}/{name}", ""
    if noun == "action client":
        place, end = f"{place}/_action/send_goal", "_SendGoal"
    is_topic = noun in ("subscription", "publisher")
    known = node.get_topic_names_and_types() if is_topic else node.get_service_names_and_types()
    types = [kind.removesuffix(end) for found, kinds in known if found == place for kind in kinds]
    return next((kind for kind in types if kind != own), "")


def type_name(ros_type: object) -> str:
    """Name of a rosidl class as in "std_msgs/msg/Bool"; the Python name of anything else."""
    module, name = getattr(ros_type, "__module__", ""), getattr(ros_type, "__name__", "")
    package, _, kind = module.partition(".")
    if not name or not kind:
        return str(ros_type)
    return f"{package}/{kind.partition('.')[0]}/{name}"


def one_line(error: BaseException) -> str:
    """Text of an exception without line breaks."""
    return " ".join(str(error).split()).rstrip(".") or type(error).__name__
