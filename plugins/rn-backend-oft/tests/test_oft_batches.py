"""Several observations in one pass give the same results as each one separately."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from rn_backend_oft.backend import OftBackend, OftPrimaryBackend
from rn_backend_oft.config import OftConfig
from rn_backend_oft.tiny import make_tiny_oft
from rn_runtime_torch.config import TorchRuntimeConfig
from rn_runtime_torch.runtime import TorchRuntime
from roboneuron.contract import Frame, Observation, Pose
from roboneuron.errors import StateError, UngroundedError

TOLERANCE = 1e-5
"""float32: products of other sizes are summed in another order."""
INSTRUCTIONS = (
    "pick up the red cube",
    "stop",
    "put the small yellow cube that stands at the far end of the table into the bowl",
    "pick up the green cube",
    "open the drawer",
    "go",
    "push the button beside the lamp, then wait",
    "lift it",
)


def seen(number: int) -> Observation:
    """Observation and instruction of robot `number`."""
    drawn = np.random.default_rng(number)
    frames = {
        role: Frame(
            camera=role,
            image=drawn.integers(0, 256, (64, 64, 3), dtype=np.uint8),
            stamp_ns=1,
            frame_id=f"{role}_front",
        )
        for role in ("primary", "wrist")
    }
    pose = Pose(
        position_m=drawn.uniform(-0.3, 0.3, 3), quaternion_xyzw=np.array([1.0, 0.0, 0.0, 0.0])
    )
    return Observation(
        frames=frames,
        instruction=INSTRUCTIONS[number % 8],
        ee_pose=pose,
        gripper_open=float(drawn.uniform()),
    )


OBSERVATIONS = [seen(number) for number in range(8)]


class OneByOne:
    """A runtime that answers one request at a time, like served ones."""

    def __init__(self):
        self.inner = TorchRuntime(TorchRuntimeConfig(device="cpu", dtype="float32"))
        self.load, self.run, self.close = self.inner.load, self.inner.run, self.inner.close


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    path = tmp_path_factory.mktemp("tiny") / "oft"
    make_tiny_oft(path)
    return path


def loaded(path, kind=OftBackend, runtime=None) -> OftBackend:
    runtime = runtime or TorchRuntime(TorchRuntimeConfig(device="cpu", dtype="float32"))
    backend = kind(
        OftConfig(checkpoint=path, profile="libero", constants="libero", proprio=True),
        runtime=runtime,
    )
    backend.load()
    return backend


@pytest.fixture(scope="module", params=[OftBackend, OftPrimaryBackend])
def backend(request, tiny) -> OftBackend:
    return loaded(tiny, request.param)


def test_prompts_have_many_lengths(backend):
    """Otherwise the tests below would not test padding."""
    assert len({backend._request(observation).prompt.ids.size for observation in OBSERVATIONS}) >= 6


@pytest.mark.sampled(every=4)
@pytest.mark.parametrize("count", range(1, 9))
def test_each_row_of_a_batch_is_the_answer_alone(backend, count):
    chunks = backend.predict_batch(OBSERVATIONS[:count])
    assert len(chunks) == count
    for observation, chunk in zip(OBSERVATIONS, chunks, strict=False):
        alone = backend.predict(observation)
        np.testing.assert_allclose(chunk.actions, alone.actions, rtol=0, atol=TOLERANCE)
        assert chunk.step_s == alone.step_s
        assert chunk.metrics["tokens_kept"] == alone.metrics["tokens_kept"]
        assert chunk.metrics.get("batch", 1.0) == count


def test_observations_of_a_batch_do_not_disturb_each_other(backend):
    """The other observations change no answer by more than rounding; the order of the answers is
    that of the requests.
    """
    first, *others = OBSERVATIONS
    whole = backend.predict_batch([first, *others])
    mixed = backend.predict_batch([*reversed(others), first])
    np.testing.assert_allclose(mixed[-1].actions, whole[0].actions, rtol=0, atol=TOLERANCE)
    assert np.abs(mixed[0].actions - whole[0].actions).max() > 1e-3


def test_prompts_of_one_length_need_no_filling(backend):
    alike = [
        dataclasses.replace(observation, instruction="pick up the red cube")
        for observation in OBSERVATIONS[:3]
    ]
    for observation, chunk in zip(alike, backend.predict_batch(alike), strict=True):
        np.testing.assert_allclose(
            chunk.actions, backend.predict(observation).actions, rtol=0, atol=TOLERANCE
        )


def test_a_batch_of_one_is_bit_for_bit_the_answer_alone(backend):
    np.testing.assert_array_equal(
        backend.predict_batch(OBSERVATIONS[:1])[0].actions, backend.predict(OBSERVATIONS[0]).actions
    )


def test_no_observation_needs_no_answer(backend):
    assert backend.predict_batch([]) == []


def test_a_runtime_without_batches_is_asked_one_after_the_other(tiny):
    backend = loaded(tiny, runtime=OneByOne())
    for observation, chunk in zip(
        OBSERVATIONS[:3], backend.predict_batch(OBSERVATIONS[:3]), strict=True
    ):
        np.testing.assert_array_equal(chunk.actions, backend.predict(observation).actions)


def test_what_one_observation_lacks_is_raised(backend):
    blind = dataclasses.replace(OBSERVATIONS[1], frames={})
    with pytest.raises(UngroundedError, match="role 'primary'"):
        backend.predict_batch([OBSERVATIONS[0], blind])


def test_a_batch_needs_a_loaded_model(tiny):
    backend = loaded(tiny)
    backend.close()
    with pytest.raises(StateError):
        backend.predict_batch(OBSERVATIONS[:2])
