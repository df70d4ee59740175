"""Workers that run episodes: in this process, or on Ray."""

from __future__ import annotations

import os
import signal
import socket
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from types import ModuleType, TracebackType
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, TypeVar

from rn_eval.plan import EvalPlan, Job
from rn_eval.policy import EpisodePolicy
from rn_eval.record import EpisodeOutcome, EpisodeRecord
from rn_eval.runner import Runner
from roboneuron import ConfigurationError, MissingDependencyError, StateError, install_command

if TYPE_CHECKING:
    import ray

    from rn_eval.sharing import PolicyActor


J = TypeVar("J")
R = TypeVar("R")

_MOST_DEATHS = 3
"""An episode that has killed this many workers is recorded as an error."""
_POLL_S = 1.0
_STOPPED_POLLS = 5
"""A process that was stopped (SIGSTOP) each time in so many polls is ended."""
_REACH_S = 5.0
THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


class Finished(NamedTuple):
    """Result of a worker."""

    record: EpisodeRecord
    strip: bytes | None


class Pool(Protocol):
    """Runs jobs; a context manager."""

    def run(self, jobs: Iterable[Job]) -> Iterator[Finished]:
        """Run each job once; yield results in order of completion."""
        ...

    def __enter__(self) -> Pool: ...

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None: ...


class InProcess:
    """One worker: this process. Needs no Ray."""

    def __init__(self, plan: EvalPlan) -> None:
        self._runner = Runner(plan)

    def run(self, jobs: Iterable[Job]) -> Iterator[Finished]:
        """Run one job after the other."""
        for job in jobs:
            yield Finished(*self._runner.run(job))

    def __enter__(self) -> InProcess:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._runner.close()


def import_ray() -> ModuleType:
    """Import Ray. Raises MissingDependencyError if it is not installed."""
    try:
        return import_module("ray")  # heavy
    except ModuleNotFoundError as error:
        raise MissingDependencyError(
            "More than one worker needs Ray, which is not installed.",
            hint=f"Run: {install_command('rn-eval[ray]')}.",
        ) from error


def connect(
    ray: ModuleType, address: str | None, cpus: int, *, gpus: float = 0.0, variables: dict[str, str]
) -> None:
    """Start Ray on this machine, or join a cluster.

    Args:
        ray: the module.
        address: address of a running cluster; None starts one that ends with this process.
        cpus, gpus: required number.
        variables: environment variables of the workers.

    Raises:
        ConfigurationError: the cluster cannot be reached, or has too few CPUs or GPUs.
    """
    settings: dict[str, object] = {"runtime_env": {"env_vars": variables}, "log_to_driver": False}
    if address is None:
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        # The requested number of processes runs, however few CPUs the machine has.
        settings |= {"num_cpus": cpus, "include_dashboard": False}
    else:
        _check_reach(address)
    try:
        # Without an address Ray would join any cluster that runs on this machine.
        ray.init(address=address or "local", logging_level="ERROR", **settings)
    except ConnectionError as error:
        raise ConfigurationError(
            f"There is no Ray cluster at {address!r}, or it does not let this user in: {error}.",
            hint="Where the cluster asks for a token, set RAY_AUTH_MODE=token and put it into "
            "~/.ray/auth_token.",
        ) from error
    # Ray would let a worker without resources wait for ever, and its episode with it.
    there = ray.cluster_resources()
    for name, needed in (("CPU", cpus), ("GPU", gpus)):
        if needed > there.get(name, 0.0):
            ray.shutdown()
            raise ConfigurationError(
                f"{needed:g} {name}s are needed, Ray has {there.get(name, 0.0):g}.",
                hint="Give fewer --workers, or a smaller --policy-gpus.",
            )


class Located:
    """Base class of actors that say where they run."""

    def where(self) -> tuple[str, int]:
        """Name of the machine, and process id."""
        return socket.gethostname(), os.getpid()


class StoppedActors:
    """Ends the processes of actors that are stopped (SIGSTOP), because Ray replaces only dead ones,
    and would wait for them for ever. Those on other machines are not seen.

    Args:
        ray: the module.
    """

    def __init__(self, ray: ModuleType) -> None:
        self._ray = ray
        self._asked: dict[Any, Any] = {}
        self._pids: dict[Any, int] = {}
        self._stopped: Counter[int] = Counter()
        self._next_s = 0.0

    def look(self, actors: Iterable[Any]) -> None:
        """Look at actors of `Located`, if that is due."""
        if time.monotonic() < self._next_s:
            return
        self._next_s = time.monotonic() + _POLL_S
        stopped: Counter[int] = Counter()
        for actor in actors:
            pid = self._pid(actor)
            if pid and _is_stopped(pid):
                stopped[pid] = self._stopped[pid] + 1
                if stopped[pid] >= _STOPPED_POLLS:
                    with suppress(ProcessLookupError):
                        os.kill(pid, signal.SIGKILL)
        self._stopped = stopped

    def _pid(self, actor: Any) -> int:
        """Its process on this machine; 0 as long as it is unknown. It is asked again and again,
        because Ray may start it again; an episode ends before it answers.
        """
        if actor not in self._asked:
            self._asked[actor] = actor.where.remote()
        if self._ray.wait([self._asked[actor]], timeout=0)[0]:
            try:
                machine, pid = self._ray.get(self._asked.pop(actor))
            except self._ray.exceptions.RayError:
                machine, pid = "", 0
            self._pids[actor] = pid if machine == socket.gethostname() else 0
        return self._pids.get(actor, 0)


def _is_stopped(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state in "Tt"


def run_on_actors(
    ray: ModuleType,
    workers: list[Any],
    spawn: Callable[[int], object],
    jobs: Iterable[J],
    lost: Callable[[J, str], R],
    needed: Sequence[object] = (),
) -> Iterator[tuple[R, bytes | None]]:
    """Run each job once on actors with a method `run`; yield results in order of completion.

    Args:
        ray: the module.
        workers: the actors, of `Located`; dead and stopped ones are replaced in this list.
        spawn: creates the actor with a number.
        jobs: hashable jobs.
        lost: creates the record of a job that has killed `_MOST_DEATHS` workers, from the cause.
        needed: other actors of `Located` that the workers call.

    Raises:
        StateError: workers die before they run an episode.
    """
    waiting = deque(jobs)
    deaths: dict[J, int] = {}
    proven, stopped = False, StoppedActors(ray)
    idle = list(range(len(workers)))
    running: dict[object, tuple[int, J]] = {}
    while waiting or running:
        while waiting and idle:
            number, job = idle.pop(), waiting.popleft()
            running[workers[number].run.remote(job)] = (number, job)
        ready, _ = ray.wait(list(running), num_returns=1, timeout=_POLL_S)
        stopped.look([*(workers[number] for number, _ in running.values()), *needed])
        for reference in ready:
            number, job = running.pop(reference)
            try:
                finished = ray.get(reference)
            except ray.exceptions.RayActorError as error:
                deaths[job] = deaths.get(job, 0) + 1
                if deaths[job] >= _MOST_DEATHS and not proven:
                    raise StateError(
                        f"Workers end before they have run an episode: {_first_line(error)}"
                    ) from None
                workers[number] = spawn(number)
                if deaths[job] < _MOST_DEATHS:
                    waiting.appendleft(job)
                else:
                    yield lost(job, _first_line(error)), None
            except ray.exceptions.RayTaskError as error:
                raise error.as_instanceof_cause() from None
            else:
                proven = True
                yield finished
            idle.append(number)


class EpisodeWorker(Located):
    """A worker process, used as a Ray actor."""

    def __init__(self, plan: str, policies: Sequence[ray.actor.ActorHandle[PolicyActor]]) -> None:
        """Take the plan as JSON, and the actors of shared policies; without any, each worker loads
        its own.
        """
        from rn_eval.sharing import SharedPolicy

        parsed = EvalPlan.model_validate_json(plan)
        connect: Callable[[str], EpisodePolicy] | None = None
        if policies:
            actor = policies[os.getpid() % len(policies)]
            connect = lambda preset: SharedPolicy(actor, preset)  # noqa: E731
        self._runner = Runner(parsed, connect)

    def run(self, job: Job) -> tuple[EpisodeRecord, bytes | None]:
        """Like `Runner.run`."""
        return self._runner.run(job)


class OnRay:
    """Several workers, on this machine or on a cluster; a dead or stopped worker is replaced and
    its episode is run again; a shared policy is started again.

    Args:
        plan: the evaluation.
        workers: number of concurrent simulators, one CPU each.
        address: address of a running cluster; None starts Ray on this machine, which ends with this
            process.
        policy_actors: number of processes that hold the policy for all workers; 0 if each worker
            loads its own.
        policy_gpus: GPUs of each policy process, or of each worker if there are none.

    Raises:
        MissingDependencyError: Ray is not installed.
        ConfigurationError: the cluster cannot be reached, has too few CPUs or GPUs, or the policy
            cannot be shared.
    """

    def __init__(
        self,
        plan: EvalPlan,
        *,
        workers: int,
        address: str | None = None,
        policy_actors: int = 0,
        policy_gpus: float = 0.0,
    ) -> None:
        ray = import_ray()
        self._ray = ray
        self._plan, self._count = plan, workers
        # Results may depend on the number of threads, which Ray would set to an actor's CPUs.
        threads = {name: str(plan.threads) for name in THREAD_VARIABLES}
        gpus = policy_gpus * (policy_actors or workers)
        connect(ray, address, workers + policy_actors, gpus=gpus, variables=threads)
        self._policies: list[object] = []
        if policy_actors:
            from rn_eval.sharing import PolicyActor

            shared = ray.remote(
                num_cpus=1,
                num_gpus=policy_gpus,
                max_concurrency=max(8, 4 * workers),
                max_restarts=_MOST_DEATHS,
                max_task_retries=_MOST_DEATHS,
            )(PolicyActor)
            self._policies = [shared.remote(plan.model_dump_json()) for _ in range(policy_actors)]
        own_gpus = 0.0 if policy_actors else policy_gpus
        self._actor = ray.remote(num_cpus=1, num_gpus=own_gpus)(EpisodeWorker)
        self._workers: list[object] = [self._spawn() for _ in range(workers)]

    def _spawn(self) -> object:
        return self._actor.remote(self._plan.model_dump_json(), self._policies)

    def run(self, jobs: Iterable[Job]) -> Iterator[Finished]:
        """See `Pool`. Raises StateError if workers die before they run an episode."""
        for record, strip in run_on_actors(
            self._ray, self._workers, lambda _: self._spawn(), jobs, _lost, self._policies
        ):
            yield Finished(record, strip)

    def __enter__(self) -> OnRay:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._ray.shutdown()


def _lost(job: Job, cause: str) -> EpisodeRecord:
    reason = f"It ended {_MOST_DEATHS} workers: {cause}"
    return EpisodeRecord(
        key=job.key,
        instruction=job.episode.instruction,
        outcome=EpisodeOutcome(status="error", reason=reason),
    )


def _first_line(error: Exception) -> str:
    """The error without Ray's advice. Of a constructor's failure the last line is used."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return (lines[-1] if "creation task" in lines[0] or "Traceback" in str(error) else lines[0])[
        :500
    ]


def _check_reach(address: str) -> None:
    """Check at once that the address is reachable: Ray itself retries for more than three minutes.

    Raises:
        ConfigurationError: it is not.
    """
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if not port.isdigit():
        return  # such as "auto", which Ray resolves
    try:
        socket.create_connection((host, int(port)), timeout=_REACH_S).close()
    except (OSError, OverflowError) as error:
        raise ConfigurationError(
            f"There is no Ray cluster at {address!r}: {error}.",
            hint="`ray start --head` prints its address.",
        ) from error
