"""The managed node of a module process: its transitions create, activate and release a `Module`."""

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
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import Bool

from roboneuron.config import ModuleSettings
from roboneuron.errors import ConfigurationError, RoboNeuronError, StateError, UnsafeError
from roboneuron.estop.latch import EmergencyStopLatch
from roboneuron.hang_watch import HangWatch
from roboneuron.modules.module_host import Module, ModuleHost
from roboneuron.modules.parent_watch import Signals, watch_stdin
from roboneuron.modules.requests import RequestGuard
from roboneuron.modules.settings import (
    EMERGENCY_STOP,
    EMERGENCY_STOP_TOPIC,
    SERVER_SILENT,
    START_PARAMETER,
    STOP_PARAMETER,
)
from roboneuron.modules.status import StatusReporter
from roboneuron.modules.step_filters import StepFilter
from roboneuron.plugins.discovery import discover
from roboneuron.plugins.loading import load_attribute
from roboneuron.plugins.specs import FeatureSpec
from roboneuron.ros.claim import LEAVE_S, claim
from roboneuron.ros.executor import TolerantExecutor
from roboneuron.ros.qos import STOP_REQUESTS

_LOOP_PERIOD_S = 0.02
"""Period of the executor's heartbeat and of its check of the latch file (1 us): upper bound on the
delay of a stop by the file.
"""
_ROBOT = "roboneuron.modules.robot:RobotModule"
"""The robot module, which moves the arm; features are resolved from the same kind of reference."""
log = logging.getLogger(__name__)


class ModuleNode(ModuleHost):
    """`/<namespace>/<node name>`: standard lifecycle services in front of a Module.

    `watch` is that of the process, if it is watched for hangs.

    Callbacks run on the executor's thread, one at a time. `note_beat` comes on the thread that
    reads stdin, and on the executor's when a request has to be judged.
    """

    def __init__(self, settings: ModuleSettings, kind: type[Module] | None = None) -> None:
        """Args:
        settings: settings of the process.
        kind: class of the module, instead of that of the settings.
        """
        super().__init__(settings)
        self._kind = kind
        self.watch = HangWatch()
        self.status.set(emergency_stop=False)
        for qos in STOP_REQUESTS:
            self.create_subscription(Bool, EMERGENCY_STOP_TOPIC, self._on_emergency_stop, qos)
        self._latch = EmergencyStopLatch.in_directory(Path(settings.state_directory))
        self._stop_requested = self._was_server_silent = False
        self._beat_s: float | None = None
        # the same for every kind of module: all need a new start after the same silence
        self._silence_s = settings.config.silence_s
        self._silences = self._silences_seen = self._resumes = self._resumes_seen = 0
        self.create_timer(_LOOP_PERIOD_S, self._on_loop)
        self.add_parameter(START_PARAMETER, 0, self._permit, self._why_not_permit)
        self.add_parameter(STOP_PARAMETER, "", self.stop_motion)
        if settings.needs_start:
            self.require_start(settings.needs_start)
        self._requests = RequestGuard(self, self.status)
        for reference in settings.on_join:
            self._join(reference)
        self._reporter = StatusReporter(self, self.status)
        self._reporter.start()

    def _join(self, reference: str) -> None:
        """Call a function that a feature registered for every module process; a failure is logged.

        Args:
            reference: "module:attribute" of a function that takes this node.
        """
        try:
            function = load_attribute(reference, "`on_join` of a feature")
            cast("Callable[[ModuleHost], None]", function)(self)
        except Exception:  # a feature's own code; under another interpreter it may not be installed
            log.exception("%s cannot be used in this module.", reference)

    def _why_not_permit(self, stops: int) -> str:
        """Reason why motion cannot be permitted; empty if it can. For the number see `_permit`."""
        if self.stopped:
            return "the emergency stop is latched"
        if stops == self.stops:
            return ""
        # not always a stop that somebody pressed: a silent server or a frozen process counts too
        return f"motion has to be asked for again: {self.needs_start or 'it was forbidden since'}"

    def _permit(self, stops: int) -> None:
        """Permit motion again after a request for motion that is newer than the latest stop.

        Args:
            stops: number of stops that the server knew of; with a lower one than now it is refused.
        """
        with self.stops_lock:
            if stops == self.stops:
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
        """Start watching stdin; `on_end` is called when the server closes its end."""
        self._requests.announcements.catch_up = watch_stdin(on_end, self.note_beat).read

    def note_beat(self, data: bytes = b"\n") -> None:
        """Record a sign of life or an announced request from the server; called from the thread
        that reads stdin.
        """
        now_s = time.monotonic()
        if self._beat_s is not None and now_s - self._beat_s > self._silence_s:
            self._silences += 1  # first, so that no silence is over but not counted
        self._beat_s = now_s
        # The only caller of `feed`: signs of life and announcements keep the order of the pipe.
        self._requests.announcements.feed(data)

    def note_resumed(self) -> None:
        """Record that this process was stopped and goes on (SIGCONT): a stop could not have reached
        it. Called by a signal handler, so it takes no lock.
        """
        self._resumes += 1

    def is_server_silent(self) -> bool:
        """See `ModuleHost.is_server_silent`."""
        if self._silences != self._silences_seen or self._resumes != self._resumes_seen:
            return True
        beat_s = self._beat_s
        return beat_s is not None and time.monotonic() - beat_s > self._silence_s

    def release(self) -> None:
        """Stop reporting and release the module; called once the executor has stopped.

        Reporting ends last, so that reports made during the release are still published.
        """
        try:
            self._shut_down()
        except RoboNeuronError as error:
            log.error("while leaving: %s", error)
        finally:
            self._reporter.stop()

    def _configure(self) -> None:
        """Create the module; if it or an extension fails, release what it has acquired.

        Raises:
            ConfigurationError: it is to replace another module, and no feature says when.
            RoboNeuronError: raised by the module.
        """
        phases = [one.phase for one in self.filters]
        if self.settings.is_successor and StepFilter.StepPhase.HANDOVER not in phases:
            raise ConfigurationError(
                "This process is to replace a running module, but nothing here says when.",
                hint="Install the package of the feature that replaces modules here too.",
            )
        try:
            with self.watch.loading():
                self.module = (self._kind or _class_of(self.settings))(self)
            # Loaded objects are kept: a full collection over all of them would pause the loop for
            # up to half a second.
            gc.collect()
            gc.freeze()
            for extend in self.on_configured:
                extend(self.module)
            # loading may block every thread, and nothing moved meanwhile
            self._silences_seen, self._resumes_seen = self._silences, self._resumes
        except Exception:
            try:
                self._release()
            except Exception:  # the original failure matters more
                log.exception("while releasing what was acquired")
            raise

    def _release(self) -> None:
        # first: no request may reach a module whose resources are being released
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
        """Make a transition and report its result.

        Args:
            step: the work of the transition; raises if it fails.
            then: state afterwards.
            otherwise: state after a failure.

        Returns:
            For rclpy: FAILURE leaves the node in its previous state.
        """
        try:
            step()
        # the module border: no exception of a plugin may end the process silently
        except Exception as error:
            log.error("not %s: %s", then, error)
            self.status.set_error(error)
        else:
            self.status.clear_error()
            self.status.set_state(then)
            return TransitionCallbackReturn.SUCCESS
        self.status.set_state(otherwise)
        # At once and on this thread: the server looks for the reason when it has the answer to its
        # request.
        self._reporter.publish()
        return TransitionCallbackReturn.FAILURE

    def _on_loop(self) -> None:
        self.status.tick_loop()
        self._check_stop()
        self._check_server()

    def _check_server(self) -> None:
        """Stop the module after a silence of the server, or after this process was stopped: no stop
        could have reached it then; earlier requests are discarded.
        """
        silences, resumes = self._silences, self._resumes
        was_silent = self._was_server_silent
        # before the module is stopped, whose robot may refuse to hold: a silence is one stop
        self._was_server_silent = self.is_server_silent()
        if resumes != self._resumes_seen:
            self.require_start(f"the {self.settings.kind} process was frozen", "server_silent")
        elif self._was_server_silent and not was_silent:
            self.require_start(SERVER_SILENT, "server_silent")
        # both were read before the silence was measured: one that ends in between is not missed
        self._silences_seen, self._resumes_seen = silences, resumes

    def _on_emergency_stop(self, message: Bool) -> None:
        """Handle the emergency-stop topic. Any node may stop; only a reset of the latch releases.

        A False on the topic only takes back a stop that could not be written to the file.
        """
        if message.data:
            self.trigger_stop(f"a node on the topic {EMERGENCY_STOP_TOPIC}")
        else:
            self._stop_requested = False
            self._check_stop()

    def trigger_stop(self, who: str) -> None:
        """Stop this module at once, then latch the stop for every process and restart; from then on
        the latch file counts.
        """
        # The module first: the disk may be slow or full, and the robot must not wait for it.
        self._stop_requested = True
        try:
            self._check_stop()
        finally:  # a robot may refuse to hold
            try:
                self._latch.press(who=who, reason=f"received by the module {self.settings.kind}")
            except UnsafeError as error:
                log.error("%s", error)
            else:
                self._stop_requested = False

    def _check_stop(self) -> None:
        """Apply a change of the emergency stop.

        It arrives by two independent channels: the topic, and the latch file, which needs no other
        process to be alive. A stop whose file could not be written lasts until the topic releases
        it.
        """
        stopped = self._stop_requested or self._latch.is_latched()
        if stopped == self.stopped:
            return
        self.stopped = stopped
        try:
            if stopped:
                self.require_start(EMERGENCY_STOP, "emergency_stop")
        finally:  # a robot may refuse to hold; then the stop is not confirmed
            if self.module is not None:
                self.module.emergency_stop(self.stopped)
        self.status.announce(emergency_stop=self.stopped)


def run(line: str, watch: HangWatch | None = None) -> None:
    """Run the module that a line of settings describes, on the main thread, until a signal or the
    end of the parent.

    Exits with a message when the settings are not valid or another process runs that node.

    Args:
        line: `ModuleSettings` as JSON.
        watch: watch of this process, or None.
    """
    try:
        settings = ModuleSettings.model_validate_json(line)
        held = claim(f"/{settings.status_name}", LEAVE_S)
    except ValidationError as error:
        sys.exit(f"The settings are not valid: {error}")
    except StateError as error:
        sys.exit(f"{error.message} {error.hint}")
    with held:
        # rclpy's own handlers would end the context first: a last hold could not be published.
        signals, watch = Signals(), watch or HangWatch()
        signals.listen()
        watch.bound(settings.config.supervisor.hang_timeout_s)
        with watch.loading():  # joining the graph keeps the interpreter's lock
            rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
            node = ModuleNode(settings)
        node.watch = watch
        signals.on_resumed = node.note_resumed
        node.watch_parent(signals.leave)
        try:
            _spin(node, signals)
        finally:
            node.release()
            node.destroy_node()
            rclpy.try_shutdown()


def _class_of(settings: ModuleSettings) -> type[Module]:
    """Class of the module that the settings describe, of the feature that provides its kind."""
    target = _ROBOT
    if settings.kind != "robot":
        registry = discover(settings.config.disabled_plugins)
        target = registry.get(FeatureSpec, settings.kind).module or ""
    return cast("type[Module]", load_attribute(target, "class of the module"))


def _spin(node: ModuleNode, signals: Signals) -> None:
    """Process the node's callbacks until the process has to exit; raises InternalError when the
    executor serves nothing any more, not even the watchdogs.
    """

    def report(error: BaseException, name: str) -> None:
        if not isinstance(error, Exception):  # a plugin ends the process: sys.exit
            raise error
        node.status.set_error(error)

    executor = TolerantExecutor(report)
    executor.add_node(node)
    is_leaving = False
    while not is_leaving:  # wakes with every tick of the node's loop timer
        is_leaving = signals.is_leaving  # first: a stop before it counts
        try:
            if signals.take_stop():
                node.trigger_stop("the signal SIGUSR1")
        except Exception as error:  # the module border: a robot's driver may raise anything
            node.status.set_error(error)
        executor.spin_once()
