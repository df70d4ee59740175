"""The frame of every module process: a managed node whose transitions make, drive and release a
`Module`.
"""

from __future__ import annotations

import gc
import logging
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import cast

import rclpy
from pydantic import ValidationError
from rclpy.executors import SingleThreadedExecutor
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import Bool

from roboneuron.config import ModuleSettings
from roboneuron.errors import ConfigurationError, RoboNeuronError, StateError, UnsafeError
from roboneuron.estop.latch import EmergencyStopLatch
from roboneuron.modules.module_host import Handover, Module, ModuleHost
from roboneuron.modules.parent_watch import Signals, watch_stdin
from roboneuron.modules.requests import RequestGuard
from roboneuron.modules.settings import (
    EMERGENCY_STOP,
    EMERGENCY_STOP_TOPIC,
    SERVER_SILENT,
    START_PARAMETER,
)
from roboneuron.modules.status import StatusReporter
from roboneuron.plugins.discovery import discover
from roboneuron.plugins.loading import load_attribute
from roboneuron.plugins.specs import FeatureSpec
from roboneuron.ros.claim import LEAVE_S, claim
from roboneuron.ros.qos import STOP_REQUESTS

_LOOP_PERIOD_S = 0.02
"""How often the executor shows that it turns, and looks at the latch file (1 us): within this time
it sees a stop by the file.
"""
_ROBOT = "roboneuron.modules.robot:RobotModule"
"""The module that moves the arm; features that are called as the others bring these."""
log = logging.getLogger(__name__)


class ModuleNode(ModuleHost):
    """`/<namespace>/<node name>`: standard lifecycle services in front of a Module.

    Callbacks run on the executor's thread, one at a time. `note_beat` comes on the thread that
    reads stdin, and on the executor's when a request has to be judged.
    """

    def __init__(self, settings: ModuleSettings, kind: Callable[[ModuleNode], Module]) -> None:
        """Args:
        settings: of the process.
        kind: makes the module, at `configure`.
        """
        super().__init__(settings)
        self._kind = kind
        self.status.set(emergency_stop=False)
        for qos in STOP_REQUESTS:
            self.create_subscription(Bool, EMERGENCY_STOP_TOPIC, self._on_emergency_stop, qos)
        self._latch = EmergencyStopLatch.in_directory(Path(settings.state_directory))
        self._stop_requested = self._was_server_silent = False
        self._beat_s: float | None = None
        robot, control = settings.config.robot, settings.config.control
        # the shorter one for every kind of module: all need a new start after the same silence
        self._silence_s = min(
            section.server_timeout_s for section in (robot, control) if section is not None
        )
        self._silences = self._silences_seen = 0
        self.create_timer(_LOOP_PERIOD_S, self._on_loop)
        self.add_parameter(START_PARAMETER, 0, self._permit, self._why_not_permit)
        if settings.needs_start:
            self.require_start(settings.needs_start)
        self._requests = RequestGuard(self, self.status)
        for reference in settings.on_join:
            self._join(reference)
        self._reporter = StatusReporter(self, self.status)
        self._reporter.start()

    def _join(self, reference: str) -> None:
        """Call what a feature wants called in every module process; a failure is logged.

        Args:
            reference: "module:attribute" of a function that takes this node.
        """
        try:
            function = load_attribute(reference, "`on_join` of a feature")
            cast("Callable[[ModuleHost], None]", function)(self)
        except Exception:  # a feature's own code; under another interpreter it may not be installed
            log.exception("%s cannot be used in this module.", reference)

    def _why_not_permit(self, stops: int) -> str:
        """Why motion cannot be permitted; empty when it can. For the number see `_permit`."""
        if self.stopped:
            return "the emergency stop is latched"
        return "" if stops == self.stops else "a stop came since motion was asked for"

    def _permit(self, stops: int) -> None:
        """Somebody has asked for motion after the newest stop; obey again.

        Args:
            stops: as in the report that the server has seen; older counts are refused, so that a
                stop in between is not overruled by who did not know of it.
        """
        self.needs_start = ""
        self.status.announce(needs_start="")

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Lifecycle callback."""
        self.status.set_state("configuring")
        return self._attempt(self._configure, "inactive", otherwise="unconfigured")

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Lifecycle callback."""
        super().on_activate(state)
        result = self._attempt(
            lambda: self._configured().activate(), "active", otherwise="inactive"
        )
        if result is TransitionCallbackReturn.FAILURE:
            super().on_deactivate(state)
        return result

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Lifecycle callback."""
        result = self._attempt(
            lambda: self._configured().deactivate(), "inactive", otherwise="active"
        )
        super().on_deactivate(state)
        return result

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Lifecycle callback."""
        return self._attempt(self._release, "unconfigured", otherwise="inactive")

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Lifecycle callback."""
        return self._attempt(self._shut_down, "finalized", otherwise="finalized")

    def watch_parent(self, on_end: Callable[[], None]) -> None:
        """From now on listen to the server on stdin; `on_end` is called when it is gone."""
        self._requests.announcements.catch_up = watch_stdin(on_end, self.note_beat).read

    def note_beat(self, data: bytes = b"\n") -> None:
        """The server has shown that it lives, or announced a request; called from the thread that
        reads stdin.
        """
        now_s = time.monotonic()
        if self._beat_s is not None and now_s - self._beat_s > self._silence_s:
            self._silences += 1  # first: the executor never sees this silence over and not counted
        self._beat_s = now_s
        # Fed here and nowhere else: the order of signs of life and announcements is that of the
        # pipe.
        self._requests.announcements.feed(data)

    def is_server_silent(self) -> bool:
        """See `ModuleHost.is_server_silent`."""
        if self._silences != self._silences_seen:
            return True
        beat_s = self._beat_s
        return beat_s is not None and time.monotonic() - beat_s > self._silence_s

    def release(self) -> None:
        """Stop reporting and release the module; called once the executor has stopped.

        The report comes last to its end, so that what the module says while it leaves is heard.
        """
        try:
            self._shut_down()
        except RoboNeuronError as error:
            log.error("while leaving: %s", error)
        finally:
            self._reporter.stop()

    def _configure(self) -> None:
        """Make the module; what it has acquired is released when that or an extension fails.

        Raises:
            ConfigurationError: it is to work in shadow, and nothing would end that.
            RoboNeuronError: as the module.
        """
        if self.settings.shadow and type(self.handover) is Handover:
            raise ConfigurationError(
                "This process was started to replace a running module, but nothing here says when "
                "it takes over.",
                hint="Install the package of the feature that replaces modules in this "
                "interpreter's environment too.",
            )
        try:
            self.module = self._kind(self)
            # What is loaded stays: a full collection over it all would be a pause of up to half a
            # second in the loop.
            gc.collect()
            gc.freeze()
            for extend in self.on_configured:
                extend(self.module)
            # loading may keep every thread waiting, and nothing moved meanwhile
            self._silences_seen = self._silences
        except Exception:
            try:
                self._release()
            except Exception:  # why it could not be configured matters more
                log.exception("while releasing what was acquired")
            raise

    def _release(self) -> None:
        # first: nothing may be asked of a module whose resources are going
        self.module = None
        self.resources.close()

    def _configured(self) -> Module:
        if self.module is None:
            raise StateError(f"{self.settings.kind} is not configured.")
        return self.module

    def _shut_down(self) -> None:
        try:
            if self.module is not None:
                self.module.deactivate()
        finally:
            self._release()

    def _attempt(
        self, step: Callable[[], None], then: str, *, otherwise: str
    ) -> TransitionCallbackReturn:
        """Make a transition and report how it went.

        Args:
            step: what is to be done; raises why it cannot be.
            then: state after it.
            otherwise: state after a failure.

        Returns:
            For rclpy: FAILURE leaves the node in the state that it was in.
        """
        try:
            step()
        # the module border: whatever a plugin raises must not end the process silently
        except Exception as error:
            log.error("not %s: %s", then, error)
            self.status.set_error(error)
        else:
            self.status.clear_error()
            self.status.set_state(then)
            return TransitionCallbackReturn.SUCCESS
        self.status.set_state(otherwise)
        # At once and on this thread: the reason is out before the answer to the request, and the
        # server looks for it when it has the answer.
        self._reporter.publish()
        return TransitionCallbackReturn.FAILURE

    def _on_loop(self) -> None:
        self.status.tick_loop()
        self._check_stop()
        self._check_server()

    def _check_server(self) -> None:
        """Nobody could have stopped the robot meanwhile: what was asked for before counts no
        more.
        """
        silences = self._silences
        was_silent = self._was_server_silent
        # before the module is stopped, whose robot may refuse to hold: a silence is one stop
        self._was_server_silent = self.is_server_silent()
        if self._was_server_silent and not was_silent:
            self.require_start(SERVER_SILENT, "server_silent")
        # `silences` was read before the silence was measured: one that ends in between is not taken
        # for seen.
        self._silences_seen = silences

    def _on_emergency_stop(self, message: Bool) -> None:
        """Any node may stop; only the latch's own reset releases what it stopped.

        A False from the topic takes back only a stop that could not be written to the file.
        """
        if message.data:
            self.trigger_stop(f"a node on the topic {EMERGENCY_STOP_TOPIC}")
        else:
            self._stop_requested = False
            self._check_stop()

    def trigger_stop(self, who: str) -> None:
        """Stop this module at once, then latch it for every process and restart: from then on the
        latch file counts.
        """
        # The module first: the disk may be slow or full, and the robot must not wait for it.
        self._stop_requested = True
        self._check_stop()
        try:
            self._latch.press(who=who, reason=f"received by the module {self.settings.kind}")
        except UnsafeError as error:
            log.error("%s", error)
        else:
            self._stop_requested = False

    def _check_stop(self) -> None:
        """Stop, or end the stop, when that has changed.

        Two independent ways lead here: the topic, and the latch file, which needs no other process
        to be alive. A stop whose file could not be written lasts until the topic releases it.
        """
        stopped = self._stop_requested or self._latch.is_latched()
        if stopped == self.stopped:
            return
        self.stopped = stopped
        if stopped:
            self.require_start(EMERGENCY_STOP, "emergency_stop")
        if self.module is not None:
            self.module.emergency_stop(self.stopped)
        self.status.announce(emergency_stop=self.stopped)


def run(line: str) -> None:
    """Run the module that a line of settings describes, on the main thread, until a signal or the
    end of the parent asks it to leave.

    Exits with a sentence when the settings are not valid or another process runs that node.
    """
    try:
        settings = ModuleSettings.model_validate_json(line)
        held = claim(f"/{settings.status_name}", LEAVE_S)
    except ValidationError as error:
        sys.exit(f"The settings are not valid: {error}")
    except StateError as error:
        sys.exit(f"{error.message} {error.hint}")
    with held:
        # rclpy's own handlers end the context first: then nobody could publish a last hold.
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        signals = Signals()
        signals.listen()
        node = ModuleNode(settings, _make)
        node.watch_parent(signals.leave)
        try:
            _spin(node, signals)
        finally:
            node.release()
            node.destroy_node()
            rclpy.try_shutdown()


def _make(node: ModuleNode) -> Module:
    """The module that the settings describe, from the feature that brings its kind."""
    settings = node.settings
    target = _ROBOT
    if settings.kind != "robot":
        registry = discover(settings.config.disabled_plugins)
        target = registry.get(FeatureSpec, settings.kind).module or ""
    return cast("type[Module]", load_attribute(target, "class of the module"))(node)


def _spin(node: ModuleNode, signals: Signals) -> None:
    """Handle what comes for the node until the process is to leave."""
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    is_leaving = False
    while not is_leaving:  # wakes with every turn of the node's loop timer
        is_leaving = signals.is_leaving  # first: a stop before it counts
        if signals.take_stop():
            node.trigger_stop("the signal SIGUSR1")
        try:
            executor.spin_once()
        except Exception as error:  # the module border: a plugin's callback may raise anything
            node.status.set_error(error)
