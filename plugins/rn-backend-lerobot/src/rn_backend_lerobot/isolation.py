"""Isolation of LeRobot from the rest of the process, and checks that it omits."""

from __future__ import annotations

import contextlib
import functools
import importlib.metadata
import os
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from types import ModuleType
from typing import TYPE_CHECKING, Protocol, cast

from rn_vla.checkpoint_files import clip
from roboneuron import CheckpointError, MissingDependencyError

if TYPE_CHECKING:
    import torch

OLDEST, NEXT = (0, 6, 1), (0, 7)
"""Oldest supported release of LeRobot, and the first unsupported one."""
_OFFLINE = ("HF_HUB_OFFLINE", "TRANSFORMERS_OFFLINE")


def check_release(version: str) -> None:
    """Raise MissingDependencyError unless that release of LeRobot is supported."""
    parts = tuple(int(part) if part.isdigit() else 0 for part in version.split(".")[:3])
    if not parts >= OLDEST or parts[:2] >= NEXT:
        raise MissingDependencyError(
            f"LeRobot {version} is installed in {sys.prefix}; the backend 'lerobot' is written for "
            f">= {'.'.join(map(str, OLDEST))}, < {'.'.join(map(str, NEXT))}.",
            hint='Run there: pip install "lerobot>=0.6.1,<0.7"',
        )


def installed_release() -> str:
    """Version of LeRobot in this interpreter. Raises MissingDependencyError if it is absent."""
    try:
        return importlib.metadata.version("lerobot")
    except importlib.metadata.PackageNotFoundError as error:
        raise MissingDependencyError(
            f"LeRobot is not installed in {sys.prefix}.",
            hint='Run there: pip install "lerobot>=0.6.1,<0.7" (Python 3.12 or newer), and name '
            "that interpreter as `python` under [inference].",
        ) from error


class Noise:
    """Private random state of the policy: swapped into PyTorch's global generators during a call
    and out again afterwards, so that other code draws unchanged numbers.

    Args:
        seed: seed of each episode; "random" leaves the generators alone.
        device: device of the policy.
    """

    def __init__(self, torch_module: ModuleType, seed: int | str, device: str) -> None:
        self._torch, self._seed = torch_module, seed
        self._device = device
        self._states: list[torch.Tensor] = []

    def restart(self) -> None:
        """Start an episode."""
        if isinstance(self._seed, int):
            devices = ["cpu"] if self._device == "cpu" else ["cpu", self._device]
            make = self._torch.Generator
            self._states = [make(device=d).manual_seed(self._seed).get_state() for d in devices]

    @contextlib.contextmanager
    def drawn(self) -> Iterator[None]:
        """Draw from the private state within the context."""
        if not self._states:
            yield
            return
        before = self._read()
        self._write(self._states)
        try:
            yield
        finally:
            self._states = self._read()
            self._write(before)

    def _read(self) -> list[torch.Tensor]:
        states = [self._torch.get_rng_state()]
        if self._device != "cpu":
            states.append(self._torch.cuda.get_rng_state(self._device))
        return states

    def _write(self, states: Sequence[torch.Tensor]) -> None:
        self._torch.set_rng_state(states[0])
        if self._device != "cpu":
            self._torch.cuda.set_rng_state(states[1], self._device)


@contextlib.contextmanager
def offline() -> Iterator[None]:
    """Disable look-ups on the hub for all code within the context; modules imported within it stay
    offline.
    """
    before = {name: os.environ.get(name) for name in _OFFLINE}
    os.environ.update(dict.fromkeys(_OFFLINE, "1"))
    try:
        import huggingface_hub.constants

        # it may have been imported before, and reads the variable only once
        huggingface_hub.constants.HF_HUB_OFFLINE = True
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


@contextlib.contextmanager
def own_folder() -> Iterator[None]:
    """Put temporary files into a folder that is removed afterwards: LeRobot leaves a copy of each
    config.json.
    """
    with tempfile.TemporaryDirectory(prefix="roboneuron-lerobot-") as folder:
        before, tempfile.tempdir = tempfile.tempdir, folder
        try:
            yield
        finally:
            tempfile.tempdir = before


class LoadsWeights(Protocol):
    """A class of PyTorch modules."""

    load_state_dict: object


@contextlib.contextmanager
def whole_weights(kind: LoadsWeights, directory: str) -> Iterator[None]:
    """Raise CheckpointError if the weights were not loaded.

    Some policies of LeRobot only print what went wrong while loading, and continue with random
    weights.
    """
    problems: list[str] = []
    taken: list[bool] = []
    original = cast("Callable[..., object]", kind.load_state_dict)

    @functools.wraps(original)
    def load(self: torch.nn.Module, *arguments: object, **named: object) -> object:
        try:
            answer = original(self, *arguments, **named)
        except Exception as error:
            problems.append(str(error))
            raise
        taken.append(True)
        problems.extend(f"there is no {name}" for name in _missing(self, answer))
        return answer

    is_own = "load_state_dict" in vars(kind)
    kind.load_state_dict = load
    try:
        yield
    finally:
        if is_own:
            kind.load_state_dict = original
        else:
            del kind.load_state_dict
    if problems or not taken:
        why = clip(problems[0], 300) if problems else "LeRobot did not read them"
        raise CheckpointError(f"The weights of {directory} do not fit its policy: {why}")


def _missing(module: torch.nn.Module, answer: object) -> list[str]:
    """Names of weights missing from the file, without those that share memory with one it holds."""
    absent = set(getattr(answer, "missing_keys", ()))
    if not absent:
        return []
    weights = module.state_dict()
    held = {tensor.data_ptr() for name, tensor in weights.items() if name not in absent}
    return sorted(name for name in absent if weights[name].data_ptr() not in held)
