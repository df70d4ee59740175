"""Managed mode: a server in its own virtual environment, process group and log, which ends with
this process.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import suppress
from pathlib import Path

from rn_runtime_sglang.config import SglangRuntimeConfig
from rn_runtime_sglang.served.versions import SUPPORTED, TESTED, is_supported
from roboneuron import (
    ConfigurationError,
    MissingDependencyError,
    NotReadyError,
    install_command,
)

KEY_VARIABLE = "ROBONEURON_SGLANG_KEY"
LAST_LINES = 15
_STOP_S = 1.5
"""Time between SIGTERM to the server and SIGKILL to its whole group."""
_PROBE_S = 60.0
OURS = ("rn-runtime-sglang", "rn-vla", "roboneuron-core")
NEEDED = ("lazy-loader", "simplejpeg")
"""Modules that the served half of OURS imports and SGLang does not install. OURS are installed
without their requirements, which would install ROS and MCP packages.
"""
_PROBE = """
import importlib.metadata as m, json, sys
def v(name):
    try: return m.version(name)
    except m.PackageNotFoundError: return None
print(json.dumps({n: v(n) for n in sys.argv[1:]}))
"""


class ManagedServer:
    """Process of a managed server. The constructor has no side effects; `start` is called once,
    `failure` and `stop` from any thread.
    """

    def __init__(self, config: SglangRuntimeConfig, checkpoint: Path, key: str) -> None:
        assert config.python is not None
        self._python = config.python
        self._config = config
        self._checkpoint = checkpoint
        self._key = key
        self._child: subprocess.Popen[bytes] | None = None
        self._error: OSError | None = None
        self._thread: threading.Thread | None = None
        self._spawned = threading.Event()
        self._ended = threading.Event()
        self._reaping = threading.Lock()
        self._stopping = False
        self._log = Path()

    def start(self) -> str:
        """Check the environment, launch the server and return its URL; it is not ready yet.

        Raises:
            MissingDependencyError: SGLang or this package is missing in that environment, or of
                another release.
            ConfigurationError: the interpreter cannot be run, or the port is taken.
        """
        check_environment(self._python, self._environment())
        port = free_port(self._config.port)
        self._log = self._open_log()
        self._thread = threading.Thread(
            target=self._watch, args=(port,), name="sglang server", daemon=True
        )
        self._thread.start()
        self._spawned.wait()
        if self._error is not None:
            raise ConfigurationError(
                f"{self._python} cannot be started: {self._error}"
            ) from self._error
        return f"http://127.0.0.1:{port}"

    def failure(self) -> str:
        """Exit status and last lines of an ended server; empty while it runs."""
        if self._stopping or not self._ended.is_set() or self._child is None:
            return ""
        status = self._child.returncode
        how = (
            f"was ended by {signal.Signals(-status).name}"
            if status < 0
            else f"ended with status {status}"
        )
        return f"The SGLang server (process {self._child.pid}) {how}. {self.last_lines()}"

    def check(self) -> None:
        """Raise NotReadyError with the last lines if the server has ended by itself."""
        failure = self.failure()
        if failure:
            raise NotReadyError(failure, hint="Stop and start inference to launch it again.")

    def stop(self) -> None:
        """End the server and all its processes; idempotent."""
        failed = bool(self.failure())
        self._stopping = True
        self._signal(signal.SIGTERM)
        if self._thread is not None:
            if not self._ended.wait(_STOP_S):
                self._signal(signal.SIGKILL)
            self._thread.join()
            self._thread = None
            if self._config.log is None and not failed:
                with suppress(OSError):
                    self._log.unlink()

    def _environment(self) -> dict[str, str]:
        # This process's Python and library paths belong to another environment.
        inherited = {
            name: value
            for name, value in os.environ.items()
            if name not in ("PYTHONPATH", "PYTHONHOME")
        }
        libraries = inherited.pop("LD_LIBRARY_PATH", "").split(os.pathsep)
        kept = [path for path in libraries if path and not Path(path).is_relative_to(sys.prefix)]
        if kept:
            inherited["LD_LIBRARY_PATH"] = os.pathsep.join(kept)
        return {
            **inherited,
            "PYTHONUNBUFFERED": "1",
            **self._config.environment,
            KEY_VARIABLE: self._key,
        }

    def _command(self, port: int) -> list[str]:
        config = self._config
        return [
            *(str(self._python), "-m", "rn_runtime_sglang.served", "--parent", str(os.getpid())),
            *("--model-path", str(self._checkpoint), "--host", "127.0.0.1", "--port", str(port)),
            *("--device", config.device, "--dtype", config.dtype, *config.server_arguments),
        ]

    def _open_log(self) -> Path:
        path = self._config.log
        if path is None:
            descriptor, name = tempfile.mkstemp(prefix="roboneuron-sglang-", suffix=".log")
            os.close(descriptor)
            return Path(name)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.touch(mode=0o600)  # SGLang prints its arguments, including the key
        except OSError as error:
            raise ConfigurationError(f"The log {path} cannot be written: {error}") from error
        return path

    def _watch(self, port: int) -> None:
        """Start and reap the process on one thread: the kernel's death signal follows the thread
        that started it.
        """
        try:
            with self._log.open("wb") as output:
                self._child = subprocess.Popen(
                    self._command(port),
                    stdin=subprocess.DEVNULL,
                    stdout=output,
                    stderr=subprocess.STDOUT,
                    env=self._environment(),
                    start_new_session=True,
                )
        except OSError as error:
            self._error = error
            self._ended.set()
            return
        finally:
            self._spawned.set()
        pid = self._child.pid
        os.waitid(os.P_PID, pid, os.WEXITED | os.WNOWAIT)
        with self._reaping:
            # Its number is not reused before it is reaped, so its group can be killed safely.
            _kill_group(pid, signal.SIGKILL)
            self._child.wait()
        self._ended.set()

    def _signal(self, number: signal.Signals) -> None:
        with self._reaping:
            if self._child is not None and self._child.returncode is None:
                _kill_group(self._child.pid, number)

    def last_lines(self) -> str:
        """The end of its output, with the key removed."""
        try:
            with self._log.open("rb") as file:
                file.seek(max(0, self._log.stat().st_size - 16384))
                text = file.read().decode("utf-8", "replace")
        except OSError as error:
            return f"Its output cannot be read: {error}"
        lines = [line[:300] for line in text.replace(self._key, "***").splitlines() if line.strip()]
        return "\n".join((f"Its last lines ({self._log}):", *lines[-LAST_LINES:]))


def _kill_group(group: int, number: signal.Signals) -> None:
    with suppress(ProcessLookupError, PermissionError):
        os.killpg(group, number)


def free_port(wanted: int | None) -> int:
    """`wanted` if it is free, or any free port of this machine. Raises ConfigurationError."""
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("127.0.0.1", wanted or 0))
        except OSError as error:
            raise ConfigurationError(
                f"Port {wanted} of this machine is taken: {error}.",
                hint="Set another `port`, or leave it out for a free one.",
            ) from error
        return int(probe.getsockname()[1])


def check_environment(python: Path, environment: dict[str, str]) -> None:
    """Raise unless `python` runs, and has a supported SGLang, this package and its requirements."""
    first, end = (".".join(map(str, numbers)) for numbers in SUPPORTED)
    pip = f"{python} -m pip install"
    started_s = time.monotonic()
    try:
        done = subprocess.run(
            [str(python), "-c", _PROBE, "sglang", *OURS, *NEEDED],
            capture_output=True,
            env=environment,
            timeout=_PROBE_S,
            check=True,
        )
        found: dict[str, str | None] = json.loads(done.stdout)
    except OSError as error:
        raise ConfigurationError(
            f"`python` is {python}, which cannot be run: {error}",
            hint="Name the interpreter of the environment that SGLang is installed in.",
        ) from error
    except (subprocess.SubprocessError, ValueError) as error:
        spent_s = time.monotonic() - started_s
        raise ConfigurationError(
            f"`python` is {python}, which is no Python ({error}; {spent_s:.0f} s)."
        ) from error
    sglang = found["sglang"]
    if sglang is None:
        raise MissingDependencyError(
            f"SGLang is not installed for {python}.",
            hint=f'Run: {pip} "sglang>={first},<{end}" (tried with {", ".join(TESTED)}).',
        )
    if not is_supported(sglang):
        raise MissingDependencyError(
            f"SGLang {sglang} is installed for {python}, supported is >={first},<{end}.",
            hint=f'Run: {pip} "sglang>={first},<{end}" (tried with {", ".join(TESTED)}).',
        )
    absent = [name for name, version in found.items() if version is None]
    if absent:
        raise MissingDependencyError(
            f"{', '.join(absent)} must be installed for {python} too.",
            hint=f"Run: {pip} {' '.join(NEEDED)}; "
            f"{install_command(*OURS).replace('pip install', f'{pip} --no-deps', 1)}",
        )
