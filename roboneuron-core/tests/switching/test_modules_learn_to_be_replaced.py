"""What every module process gets when it joins: moments of a handover, told by parameters."""

from __future__ import annotations

from contextlib import ExitStack
from types import SimpleNamespace
from typing import Any

import pytest

from roboneuron.modules.status import StatusWriter
from roboneuron.switching.handover import TimedHandover
from roboneuron.switching.joining import join
from roboneuron.switching.standby import ACT_FROM, ACT_UNTIL, NEVER_NS, PLAY_FROM, PLAY_UNTIL


def joined(*, shadow: bool) -> tuple[Any, dict[str, tuple[Any, ...]]]:
    """A host that keeps what it is given, and its parameters."""
    parameters: dict[str, tuple[Any, ...]] = {}
    host = SimpleNamespace(
        settings=SimpleNamespace(is_successor=shadow),
        status=StatusWriter("fake/inference"),
        resources=ExitStack(),
        filters=[],
        on_configured=[],
        add_parameter=lambda name, *more: parameters.update({name: more}),
    )
    join(host)  # type: ignore[arg-type]
    return host, parameters


@pytest.mark.parametrize(("shadow", "first_ns"), [(True, NEVER_NS), (False, 0)])
def test_a_standby_is_in_shadow_until_its_moment_is_told(shadow: bool, first_ns: int) -> None:
    host, parameters = joined(shadow=shadow)
    (handover,) = host.filters
    assert isinstance(handover, TimedHandover)
    assert {name: given[0] for name, given in parameters.items()} == {
        ACT_FROM: first_ns,
        ACT_UNTIL: 0,
        PLAY_UNTIL: 0,
        PLAY_FROM: 0,
    }
    assert handover.sends(1) is not shadow
    _, take, _ = parameters[ACT_FROM]
    take(1)
    assert handover.sends(1)


def test_a_moment_before_all_time_is_refused() -> None:
    _, parameters = joined(shadow=False)
    for _, _, refuse in parameters.values():
        assert refuse(-1)
        assert not refuse(0)
