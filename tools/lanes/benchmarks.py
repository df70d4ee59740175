"""Benchmarks; their numbers are in benchmarks/results.toml."""

from __future__ import annotations

import nox

from lanes.environments import prepare, python_of
from lanes.lane import JOBS, lane, python


@lane
def bench(session: nox.Session) -> None:
    """every benchmark of the closed loop (ARGS=--quick: only check that they work)"""
    python(session, "benchmarks/run_all.py")


@lane
def bench_guard(session: nox.Session) -> None:
    """the hot paths against their floors, one minute; fails if one of them has become slow"""
    python(session, "benchmarks/guard.py")


@lane
def soak(session: nox.Session) -> None:
    """the loop for 30 minutes with switches and faults: no growth, every fault recovered"""
    python(session, "benchmarks/soak.py")


@lane
def bench_fci_box(session: nox.Session) -> None:
    """a policy through a box that loses packets; resumes: --minutes 60"""
    prepare(session, "fr3sim")
    python(session, "benchmarks/bench_fci_box.py")


@lane
def bench_fleet(session: nox.Session) -> None:
    """16 light bases behind one server: lost commands, fleet stop, one killed (--parts stops)"""
    python(session, "benchmarks/bench_fleet.py")


@lane
def bench_shared(session: nox.Session) -> None:
    """eight robots on one shared model: batched against one at a time"""
    python(session, "benchmarks/bench_shared_inference.py")


@lane
def bench_serve(session: nox.Session) -> None:
    """cost of a model on another machine, against an echo of the same bytes over TLS"""
    python(session, "benchmarks/bench_serve_policy.py")


@lane
def bench_vla(session: nox.Session) -> None:
    """backends and acceleration presets against a plain transformers loop"""
    python(session, "benchmarks/bench_vla.py")


@lane
def bench_tasks(session: nox.Session) -> None:
    """outcomes of tasks against the simulator's truth (--runs 20)"""
    python(session, "benchmarks/bench_tasks.py", "--workers", JOBS)


@lane
def bench_lerobot(session: nox.Session) -> None:
    """cost of the boundary to a LeRobot policy against a call in its own process"""
    prepare(session, "lerobot-policies")
    theirs = str(python_of("lerobot-policies"))
    session.run(theirs, "benchmarks/bench_lerobot.py", *session.posargs)
