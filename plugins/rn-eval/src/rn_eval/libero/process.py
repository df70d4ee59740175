"""Runs and controls the simulator's process."""

from __future__ import annotations

import os
import select
import subprocess
import tempfile
import time
from pathlib import Path
from typing import IO, TypeVar

from rn_eval.libero.options import LiberoOptions
from rn_eval.libero.simulator import pipe
from roboneuron import ConfigurationError, NotReadyError

MAIN = Path(__file__).parent / "simulator" / "__main__.py"
_END_S = 10.0
_TAIL_BYTES = 1500

Reply = TypeVar("Reply", pipe.Ready, pipe.State, pipe.Image)


class SimulatorProcess:
    """Starts on construction, ends with `close`. Used from one thread.

    Attributes:
        versions: versions of the simulator's packages.
    """

    def __init__(self, options: LiberoOptions) -> None:
        """Start the process.

        Raises:
            ConfigurationError: there is no such interpreter.
            NotReadyError: it ended, or did not answer in time; the message contains its last
                output.
        """
        if not options.python.is_file():
            raise ConfigurationError(
                f"There is no interpreter {str(options.python)!r} with the LIBERO simulator.",
                hint="Run: make .venv-libero (in RoboNeuron's source folder), or give "
                "--suite-option python=PATH.",
            )
        self._answer_s = options.answer_s
        self._words: IO[bytes] = tempfile.TemporaryFile(prefix="roboneuron-libero-")  # noqa: SIM115  it outlives this
        platform: dict[str, str] = {
            "MUJOCO_GL": options.renderer,
            "PYOPENGL_PLATFORM": options.renderer,
        }
        inherited = {
            name: value
            for name, value in os.environ.items()
            if name not in ("PYTHONPATH", "PYTHONHOME")
        }
        self._process = subprocess.Popen(
            [str(options.python), str(MAIN)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._words,
            env=inherited | platform,
            bufsize=0,
        )
        self.versions = self.ask(pipe.Hello(), pipe.Ready).versions

    def ask(self, request: pipe.Message, kind: type[Reply]) -> Reply:
        """Send a request and wait for its answer.

        Raises:
            NotReadyError: the simulator failed, ended or timed out; it is then closed.
        """
        assert self._process.stdin is not None
        try:
            pipe.send(self._process.stdin, request)  # type: ignore[arg-type]
            end_s = time.monotonic() + self._answer_s
            reply = pipe.receive(lambda count: self._read(count, end_s))
        except pipe.PipeError as error:
            self._end()
            said = self._tail()
            self.close()
            raise NotReadyError(
                f"The LIBERO simulator does not answer: {error} It said: {said}"
            ) from error
        if isinstance(reply, pipe.Failed):
            self.close()
            raise NotReadyError(f"The LIBERO simulator failed: {reply.reason.strip()}")
        if not isinstance(reply, kind):
            self.close()
            raise NotReadyError(
                f"The LIBERO simulator answered {type(reply).__name__}, expected {kind.__name__}."
            )
        return reply

    def close(self) -> None:
        """End the process; may be called twice."""
        self._end()
        self._words.close()

    def _end(self) -> None:
        if self._process.stdin is not None:
            self._process.stdin.close()
        try:
            self._process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        if self._process.stdout is not None:
            self._process.stdout.close()

    def _read(self, count: int, end_s: float) -> bytes:
        stdout = self._process.stdout
        assert stdout is not None
        data = bytearray()
        while len(data) < count:
            left_s = end_s - time.monotonic()
            if left_s <= 0 or not select.select([stdout], [], [], left_s)[0]:
                self._process.kill()
                raise pipe.PipeError(f"no answer within {self._answer_s:g} s.")
            piece = os.read(stdout.fileno(), count - len(data))
            if not piece:
                raise pipe.PipeError("it ended.")
            data += piece
        return bytes(data)

    def _tail(self) -> str:
        end = self._words.seek(0, os.SEEK_END)
        self._words.seek(max(0, end - _TAIL_BYTES))
        return self._words.read().decode(errors="replace").strip() or "nothing"
