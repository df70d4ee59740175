"""The command `roboneuron runs`."""

from __future__ import annotations

import sys
from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import TYPE_CHECKING

from rn_recorder_bags.command import add_bag_options, import_named
from rn_standard.console.plugin_options import add_option, read_options
from roboneuron import (
    ConfigurationError,
    InvalidInputError,
    foreign,
)

if TYPE_CHECKING:
    from rn_recorder_runs.lerobot import Written
    from rn_recorder_runs.store import Run, RunStore

_NEWEST = 'id of a run (its beginning will do), "latest", or a path of MCAP files'
_OUTCOMES = ("success", "failure", "unknown")
_SEVERAL = f'{_NEWEST}; "all" for all recordings'


class Runs:
    """List, show, export, replay and delete recorded runs; import bags of other recorders."""

    def configure(self, parser: ArgumentParser) -> None:
        """Add the arguments of `roboneuron runs`."""
        parser.add_argument(
            "--config", type=Path, metavar="FILE", help="a roboneuron.toml that names the directory"
        )
        parser.add_argument("--directory", type=Path, help="the directory of runs itself")
        actions = parser.add_subparsers(
            dest="action", required=True, metavar="ACTION", help="what to do (each: --help)"
        )
        listing = actions.add_parser(
            "list", help="recordings and incidents, oldest first; repairs what was cut short"
        )
        listing.add_argument("--json", action="store_true", help="for programs")
        show = actions.add_parser(
            "show", help="topics, counts, lost messages, tool calls and incidents of a run"
        )
        show.add_argument("run", help=_NEWEST)
        show.add_argument("--json", action="store_true", help="for programs")
        led = actions.add_parser("interventions", help="spans in which a person moved the arm")
        led.add_argument("runs", nargs="+", metavar="RUN", help=_SEVERAL)
        led.add_argument("--json", action="store_true", help="for programs")
        label = actions.add_parser("label", help="say how a recording, or an episode, has ended")
        label.add_argument("run", help=_NEWEST)
        label.add_argument("--outcome", choices=_OUTCOMES)
        label.add_argument("--comment", help="any text")
        label.add_argument(
            "--episode", type=int, metavar="N", help="counted from 0; default: all of the run"
        )
        delete = actions.add_parser("delete", help="delete runs")
        delete.add_argument("runs", nargs="+", metavar="RUN", help="ids")
        delete.add_argument("--yes", action="store_true", help="do not ask")
        self._configure_replay(
            actions.add_parser(
                "replay",
                help="feed a run to a backend and compare, or play its actions into a simulation",
            )
        )
        self._configure_export(
            actions.add_parser("export", help="write runs as a data set, or as one MCAP file")
        )
        bags = actions.add_parser("import", help="write bags of other recorders as a data set")
        add_bag_options(bags)
        add_writer_options(bags)

    def _configure_export(self, parser: ArgumentParser) -> None:
        add = parser.add_argument
        add("runs", nargs="+", metavar="RUN", help=_SEVERAL)
        target = parser.add_mutually_exclusive_group(required=True)
        target.add_argument(
            "--lerobot",
            type=Path,
            metavar="DIRECTORY",
            help="a LeRobotDataset v3 of their episodes",
        )
        target.add_argument("--mcap", type=Path, metavar="FILE", help="one MCAP file of all parts")
        add(
            "--outcome",
            choices=_OUTCOMES,
            help="only episodes that ended so",
        )
        add(
            "--interventions",
            action="store_true",
            help="only spans in which a person moved the arm, each as an episode",
        )
        add(
            "--fps",
            type=int,
            help="rows per second of the data set; default: the rate of the actions",
        )
        add_writer_options(parser)

    def _configure_replay(self, parser: ArgumentParser) -> None:
        add = parser.add_argument
        add("run", help=_NEWEST)
        add(
            "--against",
            choices=("backend", "robot"),
            default="backend",
            help="robot: recorded actions, in simulation",
        )
        add(
            "--backend",
            help="which backend gets the observations (default: the one that was recorded)",
        )
        add("--checkpoint", help="folder of the model's files")
        add("--runtime", help="runtime; default: the backend's own")
        add("--acceleration", help="acceleration preset")
        add_option(parser, "the backend")
        add(
            "--tolerance",
            type=float,
            default=1e-9,
            help="differences up to this count as equal (default: 1e-9)",
        )
        add("--out", type=Path, help="folder for comparison.json and comparison.png")

    def run(self, arguments: Namespace) -> int:
        """Run `roboneuron runs`."""
        from rn_recorder_runs.listing import list_runs, show_run

        if arguments.action == "import":
            return _tell(import_named(arguments), arguments.lerobot)
        store = open_store(arguments)
        if arguments.action == "list":
            return list_runs(store, arguments.json)
        if arguments.action == "show":
            return show_run(find_run(store, arguments.run), arguments.json)
        if arguments.action == "interventions":
            return _interventions(store, arguments.runs, arguments.json)
        if arguments.action == "label":
            return _label(store, arguments)
        if arguments.action == "delete":
            return _delete(store, arguments.runs, arguments.yes)
        if arguments.action == "replay":
            return _replay(find_run(store, arguments.run), arguments)
        return _export(store, arguments)


def add_writer_options(parser: ArgumentParser) -> None:
    """Add the options of what writes a data set."""
    parser.add_argument(
        "--codec",
        choices=("av1", "h264"),
        default="av1",
        help="of the data set's videos (default: av1)",
    )
    parser.add_argument(
        "--with-lerobot",
        type=Path,
        metavar="PYTHON",
        help="interpreter whose lerobot 0.6 writes the data set",
    )


def open_store(arguments: Namespace) -> RunStore:
    """Open the directory named in the arguments. Raises ConfigurationError for an invalid
    configuration.
    """
    from rn_recorder.feature import runs_directory
    from rn_recorder.options import RecorderOptions
    from rn_recorder.plugin import FEATURE
    from rn_recorder_runs.store import RunStore
    from roboneuron.command import environment, feature_options, load_config

    if arguments.directory:
        return RunStore(arguments.directory)
    config = load_config(arguments.config)
    options = feature_options(FEATURE, config)
    assert isinstance(options, RecorderOptions)
    return RunStore(
        runs_directory(options, environment.state_directory(config.supervisor.state_directory))
    )


def find_run(store: RunStore, name: str) -> Run:
    """Find the run of that id, or the MCAP files at that path. Raises InvalidInputError if there is
    none.
    """
    from rn_recorder_runs.files import read_about
    from rn_recorder_runs.store import Run

    path = Path(name)
    if path.suffix == ".mcap" and path.is_file():
        return Run(id=path.stem, kind="recording", files=(path,), facts=dict(read_about(path)))
    if path.is_dir() and (files := tuple(sorted(path.glob("*.mcap")))):
        return Run(id=path.name, kind="recording", files=files, facts={})
    return store.get(name)


def find_runs(store: RunStore, name: str) -> list[Run]:
    """Like `find_run`; "all" stands for all recordings."""
    if name == "all":
        return [run for run in store.runs() if run.kind == "recording"]
    return [find_run(store, name)]


def _interventions(store: RunStore, names: list[str], as_json: bool) -> int:
    from rn_recorder_runs.interventions import interventions, to_text

    runs = [run for name in names for run in find_runs(store, name)]
    print(to_text([one for run in runs for one in interventions(run)], as_json))
    return 0


def _label(store: RunStore, arguments: Namespace) -> int:
    if arguments.outcome is None and arguments.comment is None:
        raise InvalidInputError("There is nothing to note.", hint="Give --outcome or --comment.")
    run = store.get(arguments.run)
    if arguments.episode is not None:
        from rn_recorder_runs.episodes import read_episodes

        count = len(read_episodes(run.id, run.files, run.facts)[0])
        if not 0 <= arguments.episode < count:
            raise InvalidInputError(
                f"{run.id} has no episode {arguments.episode}.",
                hint=f"It has {count}, counted from 0.",
            )
    label = store.label(
        run,
        outcome=arguments.outcome,
        comment=arguments.comment,
        episode=arguments.episode,
    )
    print(foreign.printable(f"{run.id}: {' '.join(text for text in label.values() if text)}"))
    return 0


def _delete(store: RunStore, names: list[str], agreed: bool) -> int:
    from roboneuron.command import terminal

    runs = [store.get(name) for name in names]
    if not agreed:
        if not sys.stdin.isatty():
            raise InvalidInputError("Nobody can be asked whether to delete.", hint="Say --yes.")
        print("\n".join(run.id for run in runs))
        if not terminal.is_agreed("Delete?"):
            return 1
    for run in runs:
        store.delete(run)
        print(f"Deleted: {run.id}")
    return 0


def _replay(run: Run, arguments: Namespace) -> int:
    """Replay a run; status 1 if the backend diverges, or control refused an action."""
    if arguments.against == "robot":
        from rn_recorder_runs.against_robot import play

        played = play(run.files, arguments.config)
        refused = ", ".join(f"{count} {reason}" for reason, count in played.dropped.items())
        print(f"{played.sent} actions sent; not acted on: {refused or 'none'}.")
        if played.end_m is not None:
            print(
                f"The TCP ended {played.end_m * 1e3:.1f} mm from where it was recorded; path "
                f"{played.path_m:.3f} m."
            )
        return int(bool(set(played.dropped) - {"holds"}))  # it holds after the end of the actions
    from rn_recorder_runs.comparison import compare, describe, write_report
    from rn_recorder_runs.files import read_about
    from rn_recorder_runs.replay import replay
    from rn_recorder_runs.replayed_run import load_replayed

    about = read_about(run.files[0])
    told = foreign.decode_json(about.get("config", "{}"), "the configuration", has_constants=True)
    part = foreign.table(told or {}, "the configuration").get("inference") or {}
    recorded = foreign.table(part, "[inference]").get("backend")
    backend = arguments.backend or recorded
    if backend is None:
        raise InvalidInputError(
            "The run does not say which backend it is of.", hint="Give --backend NAME."
        )
    if about.get("images") == "jpeg":
        print(
            "Images were recorded as JPEG: answers differ from what the pixels before gave.",
            file=sys.stderr,
        )
    observations, deployed = load_replayed(
        run.files,
        backend=backend,
        config=arguments.config,
        checkpoint=arguments.checkpoint,
        runtime=arguments.runtime,
        acceleration=arguments.acceleration,
        options=read_options(arguments.option, backend),
    )
    try:
        found = list(replay(observations, deployed.backend, deployed.agreement))
    finally:
        deployed.backend.close()
    comparison = compare(found, arguments.tolerance, observations.gaps)
    print(describe(comparison, found))
    if arguments.out is not None:
        write_report(arguments.out, found, comparison)
        print(f"{arguments.out}: comparison.json, comparison.png")
    return int(comparison.diverging > 0)


def _tell(written: Written, directory: Path) -> int:
    """Print what was written and what was left out; 1 if something was."""
    frames = f"{written.frames} frames at {written.fps} Hz"
    print(f"{directory}: {written.episodes} episodes, {frames}")
    for left in written.skipped:
        print(foreign.printable(f"Left out: {left}."), file=sys.stderr)
    if written.skipped:
        print(
            f"{len(written.skipped)} left out; what is in the data set is whole.",
            file=sys.stderr,
        )
    return int(bool(written.skipped))


def _export(store: RunStore, arguments: Namespace) -> int:
    """Export runs; status 1 if something was left out."""
    from rn_recorder_runs.files import copy_records, read_about
    from rn_recorder_runs.repairing import read_origin

    if arguments.interventions and arguments.lerobot is None:
        raise InvalidInputError(
            "--interventions cuts a data set.", hint="Give --lerobot DIRECTORY instead of --mcap."
        )
    if arguments.with_lerobot is not None and arguments.lerobot is None:
        raise InvalidInputError(
            "--with-lerobot writes a data set.", hint="Give --lerobot DIRECTORY instead of --mcap."
        )
    runs = [found for name in arguments.runs for found in find_runs(store, name)]
    if arguments.lerobot is not None:
        from rn_recorder_runs.lerobot import export

        written = export(
            runs,
            arguments.lerobot,
            outcome=arguments.outcome,
            fps=arguments.fps,
            codec=arguments.codec,
            with_lerobot=arguments.with_lerobot,
            only_interventions=arguments.interventions,
        )
        return _tell(written, arguments.lerobot)
    files = [path for run in runs for path in run.files]
    if not files:
        raise InvalidInputError("These runs hold no files.")
    if arguments.mcap.exists():
        raise ConfigurationError(f"{arguments.mcap} exists.", hint="Name another file.")
    arguments.mcap.parent.mkdir(parents=True, exist_ok=True)
    left_out = {f"{path}, which is no MCAP file" for path in files if not read_origin(path)}
    about = {**read_about(files[0]), "run": " ".join(run.id for run in runs)}
    count = copy_records(files, arguments.mcap, about, skipped=left_out)
    print(f"{arguments.mcap}: {count} messages")
    for reason in sorted(left_out):
        print(f"Left out: {reason}.", file=sys.stderr)
    return int(bool(left_out))
