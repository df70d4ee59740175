"""The runtime's contract case: it loads a toy policy and runs it."""

from __future__ import annotations

import atexit
import functools
import tempfile
from pathlib import Path

from rn_runtime_torch.plugin import roboneuron_runtimes
from rn_testing import RuntimeCase


def torch_case() -> RuntimeCase:
    """The runtime `torch` on the CPU."""
    from rn_runtime_torch.toy import EveryOtherToken, ToyPolicy  # heavy: torch
    from rn_vla.testing import check_token_answer, late

    def policy() -> ToyPolicy:
        return ToyPolicy(path=_directory())

    return RuntimeCase(
        spec=roboneuron_runtimes()[0],
        options={"device": "cpu"},
        model=lambda: policy().model(),
        request=lambda: policy().token_request(),
        bad_request=lambda: policy().token_request(count=65),
        acceleration=EveryOtherToken,
        late_request=lambda: late(policy().token_request()),
        check_answer=check_token_answer,
    )


@functools.cache
def _directory() -> Path:
    from rn_runtime_torch.toy import ToyPolicy  # heavy: torch

    held = tempfile.TemporaryDirectory(prefix="rn-runtime-torch-")
    atexit.register(held.cleanup)
    path = Path(held.name)
    ToyPolicy(path=path).write()
    return path
