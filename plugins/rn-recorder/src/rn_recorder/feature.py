"""The feature: forwards events of the server to the recorder's process, and provides its tools."""

from __future__ import annotations

import json
import logging
import os
import subprocess
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path

from rn_recorder.options import RecorderOptions
from rn_recorder.process import RecorderProcess
from rn_recorder.tools import RecordingEnds, recording_tools
from rn_recorder_runs.settings import (
    PLAY,
    SWITCH,
    CameraMount,
    RecorderSettings,
    RulesSettings,
    spawn_recorder,
)
from rn_recorder_runs.store import RunStore
from roboneuron import (
    ConfigurationError,
    Feature,
    Host,
    NotReadyError,
    RobotProfile,
    RobotSpec,
    Tool,
    __version__,
    quaternion_from_matrix,
)
from roboneuron.feature import (
    EXPLANATIONS,
    FAULTS,
    Config,
    EndedCall,
    Health,
    ModuleKind,
    ModuleView,
    load_profile,
)

log = logging.getLogger(__name__)
FOLDER = "runs"
_ORDINARY = frozenset({"ungrounded"})
"""Errors that are not faults: an instruction that a backend cannot follow is a regular answer."""
_SECTIONS = ("robot", "perception", "inference", "control", "modules", "limits")
_MOST_ARGUMENTS = 4096
CONTRACT = {
    "action": "dx dy dz [m], rx ry rz [rad, rotation vector], gripper [0 closed .. 1 open]",
    "action_frame": "base; p' = p + d, R' = exp(r) R",
    "action_spaces": "other control spaces: names in roboneuron.fields of the channel",
    "joint_states": "rad, rad/s (m, m/s for prismatic joints)",
    "ee_pose": "TCP in the base frame; m, quaternion x y z w; of the first of several arms",
    "<arm>/ee_pose": "the same of each of several arms",
    "images": "rgb8, stamped with capture time",
    "time": "ns since 1970 (ROS clock)",
}
"""Units and frames of the contract's streams, stored in every file."""


def runs_directory(options: RecorderOptions, state_directory: Path) -> Path:
    """Directory of the runs."""
    return Path(options.directory).expanduser() if options.directory else state_directory / FOLDER


class Recorder(Feature[RecorderOptions]):
    """Starts the recorder with the server, and ends it with it."""

    _process: RecorderProcess | None = None

    def __init__(self, options: RecorderOptions) -> None:
        super().__init__(options)
        self._ends = RecordingEnds()

    def check(self, config: Config) -> None:
        """Refuse a directory that is a file."""
        if self.options.directory and Path(self.options.directory).expanduser().is_file():
            raise ConfigurationError(
                f"directory in [recorder] is {self.options.directory!r}, a file.",
                hint="Name a folder.",
            )

    def tools(self, host: Host) -> Sequence[Tool]:
        """Return start_recording, stop_recording and list_recordings."""
        self._host = host
        self._store = RunStore(runs_directory(self.options, host.state_directory))
        self._restarting = threading.Lock()
        self._namespace = host.config.namespace
        self._process = self._make()
        self._ends.told = lambda run: self._tell_uncalled("stop_recording", run)
        if self.is_enabled:
            host.events.health.listen(self._on_health)
            host.events.fault.listen(self._on_fault)
            host.events.change.listen(self._on_change)
            host.events.call_ended.listen(self._on_call)
        tools = recording_tools(self._store, lambda: self._process, self.is_enabled, self._ends)
        if os.environ.get(SWITCH, "").lower() != PLAY:
            return tools
        from rn_recorder.playing import playing_tool  # heavy: reads recordings

        return [*tools, playing_tool(host)]

    def start(self, host: Host) -> None:
        """Start the recorder's process; it joins ROS by itself."""
        assert self._process is not None
        if not self.is_enabled:
            return
        self._process.start()
        if self.options.record:
            process = self._process
            threading.Thread(
                target=lambda: self._tell_uncalled("start_recording", self._record(process)),
                name="recording",
                daemon=True,
            ).start()

    def close(self) -> None:
        """Let the recorder finish its files."""
        self._ends.close()
        if self._process is not None:
            self._process.close()

    @property
    def is_enabled(self) -> bool:
        """True if recording is enabled."""
        return self.options.enabled and os.environ.get(SWITCH, "").lower() not in ("off", PLAY)

    def _tell_uncalled(self, tool: str, run: str) -> None:
        if run:
            self._host.events.uncalled.tell(tool, "the recorder", {"id": run})

    def _record(self, process: RecorderProcess) -> str:
        """Start a recording as soon as a recorder is ready, and return its id; if that one ends
        without an answer, the next one is used. Empty if the recorder is closed before.
        """
        while process.wait_for_status():
            run = str(process.status.get("recording", ""))
            try:
                run = run or str(
                    process.ask({"do": "start", "name": "server", "facts": {}}, 60.0).get("id", "")
                )
            except NotReadyError as error:
                log.warning("The recording with the server has not begun yet: %s", error)
            if run:
                process.resume_with(run, "server")
                return run
        return ""

    def _make(self) -> RecorderProcess:
        ended = self._host.modules.process_events.ended
        return RecorderProcess(self._spawn, lambda pid: ended.tell(pid, "recorder"))

    def _spawn(self, start: int, resume: str, name: str) -> subprocess.Popen[bytes]:
        modules, options = self._host.modules, self.options
        modules.process_events.spawning.tell()
        config = self._host.config
        self._namespace = config.namespace
        registry, robot = self._host.registry, config.robot
        profile = load_profile(registry, robot) if robot.name in registry.specs(RobotSpec) else None
        settings = RecorderSettings(
            namespace=config.namespace,
            state_directory=self._host.state_directory,
            directory=self._store.directory,
            topics=options.topics,
            exclude=options.exclude,
            images=options.images,
            jpeg_quality=options.jpeg_quality,
            rules=RulesSettings(
                ring_s=options.ring_s,
                after_s=options.incident_after_s,
                part_bytes=options.part_mb * 10**6,
                part_s=options.part_s,
                quota_bytes=options.quota_mb * 10**6,
                min_free_bytes=options.min_free_mb * 10**6,
                keep_s=options.keep_days * 86_400.0,
                incident_s=options.incident_most_s,
            ),
            about=self._about(config),
            urdf=profile.urdf if profile is not None else "",
            mounts=_mounts(profile) if profile is not None else (),
            resume=resume,
            resume_name=name,
        )
        return spawn_recorder(
            settings, modules.log_directory / "recorder.log", start, modules.secret_variables
        )

    def _about(self, config: Config) -> dict[str, str]:
        sections = {
            name: value
            for name, value in config.model_dump(mode="json").items()
            if name in _SECTIONS
        }
        return {
            "robot": config.robot.name,
            "driver": config.robot.driver,
            "namespace": config.namespace,
            "cameras": json.dumps(self._host.loop.camera_roles()),
            "config": json.dumps(sections),
            "contract": json.dumps(CONTRACT),
            "images": self.options.images,
            "roboneuron": __version__,
        }

    def _note(self, what: str, facts: Mapping[str, object], incident: str = "") -> None:
        if self._process is not None and self.is_enabled:
            self._process.note(what, facts, incident)

    def _on_health(self, view: ModuleView, before: Health, health: Health) -> None:
        error = view.report.error if view.report is not None else ""
        code = view.report.error_code if view.report is not None else ""
        is_fault = health in FAULTS and not (health == "failing" and code in _ORDINARY)
        facts: dict[str, object] = {
            "module": view.kind,
            "before": before,
            "health": health,
            "error": error,
        }
        facts["explanation"] = EXPLANATIONS[health]
        self._note("health", facts, f"{view.kind}-{health}" if is_fault else "")

    def _on_fault(self, module: str, what: str, facts: Mapping[str, object]) -> None:
        # these are recorded anyway
        plain = {key: value for key, value in facts.items() if key != "actions"}
        self._note("fault", {"module": module, "fault": what, **plain}, f"{module}-{what}")

    def _on_change(self, kind: ModuleKind) -> None:
        view = self._host.modules.view(kind)
        names = dict(view.plan.names) if view.plan is not None else {}
        self._note("change", {"module": kind, "phase": view.phase, "names": names})
        if (
            kind == "robot"
            and view.phase == "running"
            and self._host.config.namespace != self._namespace
        ):
            threading.Thread(target=self._restart, name="recorder-restart", daemon=True).start()

    def _on_call(self, ended: EndedCall) -> None:
        if ended.outcome != "answered":
            return
        arguments = ended.call.arguments
        text = json.dumps(arguments, default=str)
        kept: object = (
            arguments if len(text) <= _MOST_ARGUMENTS else {"begins": text[:_MOST_ARGUMENTS]}
        )
        facts = {
            "tool": ended.call.name,
            "arguments": kept,
            "who": ended.call.context.who,
            "error": ended.code,
            "took_ms": round(ended.took_s * 1e3, 2),
        }
        self._note("call", facts)

    def _restart(self) -> None:
        """Start a new recording, because another robot has other topics."""
        with self._restarting:
            assert self._process is not None
            if self._host.config.namespace == self._namespace:
                return
            self._process.close()
            self._process = self._make()
            self._process.start()


def _mounts(profile: RobotProfile) -> tuple[CameraMount, ...]:
    """Mounts of the cameras, if known."""
    links = {"base": profile.base_link, "tcp": profile.tcp_link}
    links |= {f"{arm.name}/tcp": arm.tcp_link for arm in profile.arms}
    found = []
    for camera in profile.cameras:
        calibration = camera.calibration
        parent = "" if calibration is None else links.get(calibration.mount, "")
        if calibration is None or not parent:
            continue
        pose = calibration.T_mount_camera
        x_m, y_m, z_m = pose[:3, 3].tolist()
        x, y, z, w = quaternion_from_matrix(pose[:3, :3]).tolist()
        found.append(
            CameraMount(
                parent=parent,
                frame_id=camera.frame_id,
                position_m=(x_m, y_m, z_m),
                quaternion_xyzw=(x, y, z, w),
            )
        )
    return tuple(found)
