"""`python -m roboneuron.modules`: read ModuleSettings from stdin, run that module, leave with the
parent.
"""

from __future__ import annotations

import logging
import os
import sys
from typing import cast

from pydantic import ValidationError

from roboneuron.errors import StateError
from roboneuron.log_files import begin_logging
from roboneuron.modules.parent_watch import Signals, end_group, follow_parent
from roboneuron.modules.settings import MODULE_CLASSES, ModuleSettings
from roboneuron.plugins.loading import load_attribute
from roboneuron.ros.claim import LEAVE_S, claim
from roboneuron.ros.environment import prepare_environment


def _read_line() -> str:
    """The first line of stdin, unbuffered: what follows are signs of life and announcements."""
    data = bytearray()
    while not data.endswith(b"\n"):
        byte = os.read(0, 1)
        if not byte:
            sys.exit("stdin ended before the settings came.")
        data += byte
    return data.decode()


def _run(settings: ModuleSettings) -> None:
    import rclpy  # heavy
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.signals import SignalHandlerOptions

    from roboneuron.modules.module import ModuleNode
    from roboneuron.modules.module_host import Module

    # rclpy's own handlers end the context first: then nobody could publish a last hold.
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    signals = Signals()
    signals.listen()
    kind = cast(
        "type[Module]", load_attribute(MODULE_CLASSES[settings.kind], "class of the module")
    )
    node = ModuleNode(settings, kind)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    node.watch_parent(signals.leave)
    try:
        is_leaving = False
        while not is_leaving:  # wakes with every turn of the node's loop timer
            is_leaving = signals.is_leaving  # first: a stop before it counts
            if signals.take_stop():
                node.trigger_stop("the signal SIGUSR1")
            try:
                executor.spin_once()
            except Exception as error:  # the module border: a plugin's callback may raise anything
                node.report_unexpected(error)
    finally:
        node.release()
        node.destroy_node()
        rclpy.try_shutdown()


def main() -> None:
    """Entry point of a module process."""
    parent = os.getppid()
    begin_logging(logging.INFO)
    follow_parent(parent)
    prepare_environment()
    try:
        settings = ModuleSettings.model_validate_json(_read_line())
    except ValidationError as error:
        sys.exit(f"The settings are not valid: {error}")
    try:
        held = claim(f"/{settings.status_name}", LEAVE_S)
    except StateError as error:
        sys.exit(f"{error.message} {error.hint}")
    with held:
        _run(settings)
    end_group()


if __name__ == "__main__":
    main()
