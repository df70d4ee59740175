"""What tests of all plugins share: a small model computes on one thread, and its memory is measured
once; observations with plain pictures.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from roboneuron.contract import Frame, JointSample, Observation, Pose

HERE = Path(__file__).parent
MODELS = ("rn-accel-", "rn-backend-", "rn-eval", "rn-policy-", "rn-runtime-", "rn-vla")
"""How packages begin whose tests load models."""


@pytest.fixture(autouse=True, scope="session")
def _small_models(request: pytest.FixtureRequest) -> Iterator[None]:
    """Compute on one thread, since each worker of pytest-xdist and each test beside it would use
    all cores; and measure the memory of a model once.

    The trial run that finds the memory took two thirds of loading a tiny model, which several
    hundred tests do. Models are the same here when their modules, parameters, cache and longest
    request are.
    """
    paths = (item.path for item in request.session.items)
    packages = {path.relative_to(HERE).parts[0] for path in paths if path.is_relative_to(HERE)}
    if not any(package.startswith(MODELS) for package in packages):
        yield
        return
    import torch

    torch.set_num_threads(1)
    from rn_runtime_torch.engine import Engine

    measure = Engine._needs
    known: dict[object, Any] = {}

    def needs(engine: Any, config: Any, parts: list[Any], quantized: bool) -> Any:
        model = engine._model
        request = model.example(model.max_prompt_tokens - engine._added_tokens())
        kept = engine._cache.tensors() if engine._cache is not None else ()
        key = (
            repr(parts),
            tuple((tuple(p.shape), p.dtype) for part in parts for p in part.parameters()),
            tuple((tuple(tensor.shape), tensor.dtype) for tensor in kept),
            tuple((name, array.shape) for name, array in request.prompt.arrays.items()),
            request.prompt.ids.size,
            repr(model.decoder),
            model.visual_tokens,
            model.extra_tokens,
            model.max_new_tokens,
            repr(config),
            quantized,
        )
        if key not in known:
            known[key] = measure(engine, config, parts, quantized)
        return known[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Engine, "_needs", needs)
        yield


def make_observation(
    *,
    primary: int = 90,
    wrist: int | None = None,
    instruction: str = "pick up the red cube",
    position_m: tuple[float, float, float] = (0.4, 0.0, 0.5),
    gripper_open: float | None = 1.0,
    size: tuple[int, int] = (48, 64),
) -> Observation:
    """An observation with plain grey pictures, the gripper pointing down."""
    frames = {}
    for role, level in (("primary", primary), ("wrist", wrist)):
        if level is not None:
            image = np.full((*size, 3), level, dtype=np.uint8)
            frames[role] = Frame(camera=role, image=image, stamp_ns=1, frame_id=f"{role}_optical")
    return Observation(
        frames=frames,
        instruction=instruction,
        joints=JointSample(names=("a", "b"), position=np.array([0.1, 0.2])),
        ee_pose=Pose(
            position_m=np.array(position_m), quaternion_xyzw=np.array([1.0, 0.0, 0.0, 0.0])
        ),
        gripper_open=gripper_open,
        stamp_ns=1,
    )


@pytest.fixture(scope="session")
def observe() -> Callable[..., Observation]:
    """Makes observations."""
    return make_observation
