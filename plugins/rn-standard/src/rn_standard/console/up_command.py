"""The commands `roboneuron up` and `roboneuron down`."""

from __future__ import annotations

import fcntl
import json
import os
import signal
import time
from argparse import ArgumentParser, Namespace
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rn_standard.console import connection
from roboneuron import ForeignDataError, foreign

_FILE = "up.json"
_DOWN_S = 60.0
_LOOK_S = 0.1


class Up:
    """Start all configured modules in parallel, and keep them running until Ctrl-C or `roboneuron
    down`.

    With --url the server there starts them and keeps them running, and the command ends.
    """

    def configure(self, parser: ArgumentParser) -> None:
        """Add the arguments of `roboneuron up`."""
        connection.add_arguments(parser)
        parser.add_argument(
            "--instruction",
            metavar="TEXT",
            help="what to do at once, such as 'pick up the red cube'",
        )
        parser.add_argument(
            "--model", metavar="NAME", help="a model of the configuration, [models.NAME]"
        )

    def run(self, arguments: Namespace) -> int:
        """Run `roboneuron up`."""
        import anyio  # heavy

        from rn_standard.console.screen import CommandScreen
        from rn_standard.console.table import make_console

        screen = CommandScreen(make_console(), is_quiet=bool(arguments.quiet))
        if arguments.url is not None:
            return anyio.run(_start, arguments, screen)
        with _kept(_folder(arguments)):
            return anyio.run(_start, arguments, screen)


class Down:
    """Stop all modules: those of the server at --url, or those of `roboneuron up` together with its
    server.

    Exit status 0 when all have ended, 1 if `roboneuron up` is not running.
    """

    def configure(self, parser: ArgumentParser) -> None:
        """Add the arguments of `roboneuron down`."""
        connection.add_arguments(parser)

    def run(self, arguments: Namespace) -> int:
        """Run `roboneuron down`."""
        if arguments.url is not None:
            import anyio  # heavy

            return anyio.run(_stop, arguments)
        path = _folder(arguments) / _FILE
        pid = keeper(path)
        if pid is None:
            print("`roboneuron up` keeps nothing here.")
            return 1
        os.kill(pid, signal.SIGTERM)
        deadline_s = time.monotonic() + _DOWN_S
        while keeper(path) is not None:
            if time.monotonic() > deadline_s:
                from roboneuron import NotReadyError

                raise NotReadyError(
                    f"`roboneuron up` (pid {pid}) has not ended within {_DOWN_S:g} s."
                )
            time.sleep(_LOOK_S)
        print(f"ended `roboneuron up` (pid {pid}), its server and its modules")
        return 0


def keeper(path: Path) -> int | None:
    """Process id of the `roboneuron up` that holds the lock of this file; None without one."""
    try:
        with path.open("r+", encoding="utf-8") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                told = foreign.decode_json(file.read(4096), path.name)
                return foreign.integer(foreign.field(told, "pid"), "pid", 1)
    except FileNotFoundError:
        pass
    except ForeignDataError:  # it is being written
        time.sleep(_LOOK_S)
        return keeper(path)
    return None


@contextmanager
def _kept(folder: Path) -> Iterator[None]:
    """Make this process visible to `roboneuron down`. The lock ends with the process, so an old
    file has no effect.
    """
    from roboneuron import StateError
    from roboneuron.feature import log_files

    with open(folder / _FILE, "a+", encoding="utf-8", opener=log_files.opener) as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise StateError(
                "`roboneuron up` runs already.", hint="End it with `roboneuron down`."
            ) from error
        file.truncate(0)
        json.dump({"pid": os.getpid()}, file)
        file.flush()
        yield
        (folder / _FILE).unlink(missing_ok=True)


def _folder(arguments: Namespace) -> Path:
    from roboneuron.command import environment, load_config

    return environment.state_directory(load_config(arguments.config).supervisor.state_directory)


async def _start(arguments: Namespace, screen: object) -> int:
    """Start, and without --url wait for the signal that ends it."""
    import anyio

    from rn_standard.console.screen import CommandScreen
    from rn_standard.console.session import ConsoleSession

    assert isinstance(screen, CommandScreen)
    asked = {"instruction": arguments.instruction, "model": arguments.model}
    async with connection.connect(arguments) as client:
        session = ConsoleSession(client, arguments.url or "a server of its own")
        robots = await session.robots("start_all")
        with anyio.open_signal_receiver(signal.SIGINT, signal.SIGTERM) as signals:
            ended = anyio.Event()

            async def wait() -> None:
                async for _ in signals:
                    ended.set()
                    group.cancel_scope.cancel()
                    return

            async with anyio.create_task_group() as group:
                group.start_soon(wait)
                given = {name: value for name, value in asked.items() if value is not None}
                for robot in robots:
                    whose = f"{robot['robot']}: " if robot else ""
                    with screen.step(f"{whose}start everything") as update:
                        answer = await session.call(
                            "start_all", {**given, **robot}, on_progress=update
                        )
                    for name, after_s in answer["ready_after_s"].items():
                        screen.say(f"{whose}{name} works after {after_s:.1f} s")
                if arguments.url is None:
                    screen.end(True, "up; Ctrl-C or `roboneuron down` ends it")
                    await anyio.sleep_forever()
                group.cancel_scope.cancel()
            if arguments.url is None and ended.is_set():
                with (
                    anyio.CancelScope(shield=True),
                    anyio.move_on_after(_DOWN_S),
                    screen.step("stop everything"),
                ):
                    for robot in robots:
                        await session.call("stop_all", robot)
    return 0


async def _stop(arguments: Namespace) -> int:
    from rn_standard.console.session import ConsoleSession

    async with connection.connect(arguments) as client:
        session = ConsoleSession(client, arguments.url)
        stopped = []
        for robot in await session.robots("stop_all"):
            answer = await session.call("stop_all", robot)
            stopped += [
                " of ".join([module["module"], *robot.values()]) for module in answer["stopped"]
            ]
        gone = ", ".join(stopped)
        print(f"stopped {gone}" if gone else "nothing ran")
    return 0
