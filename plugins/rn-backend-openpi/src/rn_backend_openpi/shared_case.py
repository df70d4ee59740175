"""The backend's contract case: a server with a small model that computes the answers for several
robots with one matrix product.
"""

from __future__ import annotations

import atexit
import functools
import os
import tempfile
from pathlib import Path

from rn_backend_openpi.plugin import SHARED
from rn_testing import BackendCase
from rn_testing.fakes.site import PluginSite

SOURCE = '''
from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
from PIL import Image

from roboneuron import ActionChunk, BackendSpec, CheckpointError, InvalidInputError, UnsafeError, hookimpl
from pydantic import BaseModel, ConfigDict


class Options(BaseModel):
    model_config = ConfigDict(extra="forbid")
    took_s: float = 0.0
    fails: bool = False
    rows: int = 1
    shrinks_to: list[int] | None = None
    gain: float = 0.01
    step_s: float = 0.1
    continues: bool = True


class Reflex:
    """One layer over the mean colours of the picture; answers any number of observations at once."""

    def __init__(self, config, *, runtime=None, acceleration=None):
        self._options = config

    def load(self):
        if self._options.fails:
            raise CheckpointError("There are no weights.", hint="Copy some.")
        self._weights = np.random.default_rng(0).standard_normal((12, 7))
        self._asked = 0

    @property
    def continues_rows(self):
        return self._options.continues

    @property
    def image_sizes(self):
        return {} if self._options.shrinks_to is None else {"primary": tuple(self._options.shrinks_to)}

    def predict(self, observation):
        chunk = self.predict_batch([observation])[0]
        ahead = observation.ahead
        if ahead is None or not len(ahead.rows):
            return chunk
        rows, count = chunk.actions.copy(), min(ahead.committed_rows, len(chunk.actions))
        rows[:count] = ahead.rows[:count]
        metrics = {"continues": -1.0 if ahead.context is None else ahead.context["row"] + ahead.context_row}
        return replace(chunk, actions=rows, conditioned_rows=count, metrics=metrics)

    def predict_batch(self, observations):
        rows = []
        for observation in observations:
            if observation.instruction == "crash":
                raise InvalidInputError("not that")
            joints = sorted(zip(observation.joints.names, observation.joints.position, strict=True))
            state = [joints[0][1], *observation.ee_pose.position_m, observation.gripper_open]
            if not np.isfinite([*observation.joints.position, *state]).all():
                raise UnsafeError("the state is not finite")
            image = observation.frames["primary"].image
            if self._options.shrinks_to is not None:
                image = np.asarray(Image.fromarray(image).resize(self._options.shrinks_to, Image.Resampling.BILINEAR))
            image = image.astype(float)
            half = image.shape[1] // 2
            colours = [*image[:, :half].mean((0, 1)), *image[:, half:].mean((0, 1)), len(observation.instruction)]
            rows.append([*np.array(colours) / 255.0, *state])
        time.sleep(self._options.took_s)
        moves = self._options.gain * np.tanh(np.array(rows) @ self._weights)
        count = self._options.rows
        self._asked += len(moves)
        return [
            ActionChunk(actions=np.outer(np.arange(count) + 1.0, row) * [1, 1, 1, 1, 1, 1, 0] + [0, 0, 0, 0, 0, 0, 0.5],
                        step_s=self._options.step_s, context={"row": 100.0 * self._asked})
            for row in moves
        ]

    def reset(self):
        pass

    def close(self):
        pass


class Rememberer(Reflex):
    predict_batch = None

    def predict(self, observation):
        return Reflex.predict_batch(self, [observation])[0]


@hookimpl
def roboneuron_backends():
    common = {"config": __name__ + ":Options", "needs_state": True}
    return [
        BackendSpec(name="reflex", summary="Small.", target=__name__ + ":Reflex", conditions_on_rows=True,
                    optional_cameras=("wrist",), **common),
        BackendSpec(name="rememberer", summary="Not sharable.", target=__name__ + ":Rememberer", **common),
    ]
'''  # noqa: E501


def shared_case() -> BackendCase:
    """`shared` with the backend `reflex`, which exists only in the server's process."""
    return BackendCase(
        spec=SHARED,
        options=options_in(_folder(), idle_s=5.0, options={"rows": 6}),
        row_tolerance=1e-12,
        rows=6,
    )


def options_in(folder: Path, **options: object) -> dict[str, object]:
    """Options for a server in its own folder that finds the small model."""
    path = os.pathsep.join(filter(None, (str(folder / "site"), os.environ.get("PYTHONPATH"))))
    return {
        "backend": "reflex",
        "directory": str(folder / "run"),
        "environment": {"PYTHONPATH": path},
        "start_timeout_s": 120.0,
        "timeout_s": 10.0,
        **options,
    }


def install(folder: Path) -> None:
    """Install the small model for servers with options from `options_in`."""
    PluginSite(path=folder / "site").install("rn-reflex", SOURCE, header="")
    (folder / "run").mkdir(mode=0o700)


@functools.cache
def _folder() -> Path:
    held = tempfile.TemporaryDirectory(prefix="rn-backend-openpi-")
    atexit.register(held.cleanup)
    install(Path(held.name))
    return Path(held.name)
