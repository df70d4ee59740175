"""Recovery of a robot from a fault: a ROS parameter, so that only this module's server can request
it.
"""

from __future__ import annotations

import logging
import threading
from functools import partial
from typing import TYPE_CHECKING, Protocol, runtime_checkable

from roboneuron import PluginError, RoboNeuronError

if TYPE_CHECKING:
    from roboneuron.feature import Module, ModuleHost

RECOVER_PARAMETER = "recover"
"""ROS parameter of the robot node: a new number requests a recovery from a supporting driver; the
status `recovery` contains the result.
"""
log = logging.getLogger(__name__)


@runtime_checkable
class RecoverableDriver(Protocol):
    """Optional interface of a driver, which need not import this: clearing a fault that has stopped
    the robot.
    """

    def recover(self) -> str:
        """Clear the fault on a person's request; nothing moves. Return the cleared fault.

        Raises:
            StateError: there is no fault.
            RefusedError: its cause persists; the message contains a remedy.
        """
        ...


def join(host: ModuleHost) -> None:
    """Called in every module process; see `FeatureSpec.on_join`."""
    if host.settings.kind == "robot":
        host.on_configured.append(partial(_extend, host))


def _extend(host: ModuleHost, module: Module) -> None:
    driver = getattr(module, "driver", None)
    if isinstance(driver, RecoverableDriver):
        recovery = Recovery(host, driver)
        host.resources.callback(host.add_parameter(RECOVER_PARAMETER, 0, recovery.ask))


class Recovery:
    """Runs the driver's recovery on a separate thread, since it may take seconds, and reports
    "<number> <word> <text>".
    """

    def __init__(self, host: ModuleHost, driver: RecoverableDriver) -> None:
        self._host = host
        self._status = host.status
        self._driver = driver
        # a driver recovers one fault at a time
        self._busy = threading.Lock()

    def ask(self, number: int) -> None:
        """Start a recovery; `number` identifies the request."""
        if number:
            threading.Thread(target=self._run, args=(number,), name="recovery", daemon=True).start()

    def _run(self, number: int) -> None:
        with self._busy:
            # earlier requests are void
            self._host.require_start("a recovery from a fault")
            try:
                told = f"recovered {self._driver.recover()}"
            except RoboNeuronError as error:
                told = f"{error.code} {error}"
            except Exception as error:  # the thread's border: the request gets an answer
                log.exception("The driver could not be recovered.")
                told = f"{PluginError.code} {type(error).__name__}: {error}"
        self._status.set_value("recovery", f"{number} {told}")
        self._status.changed.set()
