"""A row of the fault matrix: modules are started and stopped in every order, without waiting for
one another.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor

import psutil
import pytest
from fault_loop import JointWitness, standing_loop

from rn_testing.waiting import wait_until
from roboneuron.selection.requests import StartChosenInference
from roboneuron.server.loop import ClosedLoop

pytestmark = [pytest.mark.ros, pytest.mark.timeout(120)]
KINDS = ("robot", "perception", "control", "inference")
Order = tuple[str, ...]


def covering_orders(size: int) -> list[Order]:
    """A small set of orders that contains every permutation of any `size` elements; chosen
    greedily.
    """
    missing = set(itertools.permutations(KINDS, size))
    chosen: list[Order] = []
    while missing:
        best = max(
            itertools.permutations(KINDS), key=lambda order: len(missing & parts(order, size))
        )
        chosen.append(best)
        missing -= parts(best, size)
    return chosen


def parts(order: Order, size: int) -> set[Order]:
    """Every subsequence of `size` elements."""
    return set(itertools.combinations(order, size))


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[ClosedLoop, JointWitness]]:
    with standing_loop(tmp_path_factory.mktemp("orders"), 10.0) as made:
        yield made


def check(
    loop: ClosedLoop, witness: JointWitness, starts: Sequence[str], stops: Sequence[str]
) -> None:
    """Start in one order without waiting; stop in another one."""
    work: dict[str, Callable[[], object]] = {
        "robot": lambda: loop.start("robot"),
        "perception": lambda: loop.start("perception"),
        "control": lambda: loop.start("control"),
        "inference": lambda: loop.start("inference", StartChosenInference(instruction="move on")),
    }
    with ThreadPoolExecutor(4) as pool:
        begun = []
        for kind in starts:
            begun.append(pool.submit(work[kind]))
            wait_until(
                lambda kind=kind: loop.modules.view(kind).process is not None,
                10.0,
                f"{kind} is spawned",
            )
        for start in begun:
            start.result(60.0)
    wait_until(witness.moves, 10.0, "the arm moves")
    pids = [view.process.pid for view in loop.modules.views() if view.process is not None]
    assert len(pids) == 4
    for kind in stops:
        assert loop.stop(kind) is not None  # type: ignore[arg-type]
        others = {view.kind: view.phase for view in loop.modules.views()}
        assert "exited" not in others.values(), f"something ended by itself: {others}"
    assert {view.phase for view in loop.modules.views()} == {"stopped"}
    assert not any(psutil.pid_exists(pid) for pid in pids)


@pytest.mark.parametrize("number", [0, pytest.param(1, marks=pytest.mark.exhaustive)])
def test_orders_in_which_any_two_modules_stand_in_every_order(
    cell: tuple[ClosedLoop, JointWitness], number: int
) -> None:
    orders = covering_orders(2)
    assert len(orders) == 2
    check(*cell, orders[number], orders[number - 1])


@pytest.mark.slow
@pytest.mark.parametrize("number", range(6))
def test_orders_in_which_any_three_modules_stand_in_every_order(
    cell: tuple[ClosedLoop, JointWitness], number: int
) -> None:
    orders = covering_orders(3)
    assert len(orders) == 6
    check(*cell, orders[number], orders[number - 1])


@pytest.mark.slow
@pytest.mark.timeout(400)
def test_every_order(cell: tuple[ClosedLoop, JointWitness]) -> None:
    orders = list(itertools.permutations(KINDS))
    for number, order in enumerate(orders):
        check(*cell, order, orders[number * 7 % len(orders)])
