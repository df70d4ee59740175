"""Recovery of a robot from a fault: a ROS parameter, so that only the server of this module may ask for it."""

from __future__ import annotations

import logging
import threading

from rclpy.parameter import Parameter

from roboneuron.contract import RecoverableDriver
from roboneuron.errors import PluginError, RoboNeuronError
from roboneuron.modules.module import ModuleNode
from roboneuron.modules.settings import RECOVER_PARAMETER

log = logging.getLogger(__name__)


class Recovery:
    """Asks the driver in a thread of its own, for it may take seconds, and reports "<number> <word> <text>"."""

    def __init__(self, node: ModuleNode, driver: RecoverableDriver) -> None:
        self._status = node.status
        self._driver = driver
        self._busy = threading.Lock()
        node.add_post_set_parameters_callback(self._take)
        node.resources.callback(node.remove_post_set_parameters_callback, self._take)
        node.declare_parameter(RECOVER_PARAMETER, 0)
        node.resources.callback(node.undeclare_parameter, RECOVER_PARAMETER)

    def _take(self, parameters: list[Parameter]) -> None:
        for parameter in parameters:
            if parameter.name == RECOVER_PARAMETER and parameter.value:
                threading.Thread(target=self._run, args=(parameter.value,), name="recovery", daemon=True).start()

    def _run(self, number: int) -> None:
        with self._busy:
            try:
                told = f"recovered {self._driver.recover()}"
            except RoboNeuronError as error:
                told = f"{error.code} {error}"
            except Exception as error:  # the thread's border: who asked gets an answer
                log.exception("The driver could not be recovered.")
                told = f"{PluginError.code} {type(error).__name__}: {error}"
        self._status.set_value("recovery", f"{number} {told}")
        self._status.changed.set()
