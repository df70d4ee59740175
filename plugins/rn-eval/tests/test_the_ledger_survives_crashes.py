"""One line per episode, on disk before it counts; a truncated line is run again; no episode occurs
twice.
"""

from __future__ import annotations

import io
import json
import resource
import signal
from argparse import Namespace

import pytest
from rich.console import Console

from rn_eval import command_plans
from rn_eval.evaluate import evaluate
from rn_eval.ledger import FILE_NAME, Ledger, read_records
from rn_eval.plan import Key, fingerprint
from rn_eval.pools import InProcess
from rn_eval.record import EpisodeOutcome, EpisodeRecord
from roboneuron import ConfigurationError, StateError


def record(seed, status="success"):
    key = Key(suite="toy", preset="none", execution="sequential", latency="0", task="t", seed=seed)
    return EpisodeRecord(key=key, instruction="reach", outcome=EpisodeOutcome(status=status))


@pytest.mark.exhaustive
def test_every_prefix_of_a_ledger_can_be_continued(plan, tmp_path):
    """A crash may truncate the file anywhere: complete lines stay, others are run again, and the
    final result is the same.
    """
    made = plan(episodes=3)
    quiet = Console(file=io.StringIO())
    whole = evaluate(made, tmp_path / "whole", lambda: InProcess(made), quiet)
    data = (tmp_path / "whole" / FILE_NAME).read_bytes()
    for cut in range(0, len(data) + 1, 211):
        folder = tmp_path / f"cut-{cut}"
        with Ledger(folder) as ledger:
            ledger.open(made)
        (folder / FILE_NAME).write_bytes(data[:cut])
        kept = data[:cut].count(b"\n")
        records = evaluate(made, folder, lambda: InProcess(made), quiet)
        assert [r.outcome for r in records] == [r.outcome for r in whole]
        lines = (folder / FILE_NAME).read_bytes().splitlines()
        assert len(lines) == 3
        assert lines[:kept] == data.splitlines()[:kept]


def test_a_finished_episode_is_not_run_twice(plan, tmp_path):
    made = plan(episodes=2)
    quiet = Console(file=io.StringIO())
    evaluate(made, tmp_path, lambda: InProcess(made), quiet)

    def forbidden():
        raise AssertionError("nothing is missing")

    assert len(evaluate(made, tmp_path, forbidden, quiet)) == 2
    more = plan(episodes=3, executions=("sequential", "overlap"))
    assert len(evaluate(more, tmp_path, lambda: InProcess(more), quiet)) == 6


@pytest.fixture
def sigterm():
    """Restore the handlers of SIGTERM and SIGINT; enable Ctrl-C, which is disabled in processes
    that a shell started in the background.
    """
    before, interrupt = (
        signal.getsignal(signal.SIGTERM),
        signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    yield before
    signal.signal(signal.SIGTERM, before)
    signal.signal(signal.SIGINT, interrupt)


@pytest.mark.parametrize(
    ("number", "ended"), [(signal.SIGINT, KeyboardInterrupt), (signal.SIGTERM, SystemExit)]
)
def test_who_ends_a_run_learns_what_is_kept(plan, tmp_path, sigterm, number, ended):
    class Ended(InProcess):
        def run(self, jobs):
            yield next(super().run(jobs))
            assert callable(signal.getsignal(number))  # the default would end the tests
            signal.raise_signal(number)

    made, console = plan(episodes=3), Console(file=io.StringIO(), width=200)
    with pytest.raises(ended):
        evaluate(made, tmp_path, lambda: Ended(made), console)
    assert "1 of 3 episodes are in the ledger" in console.file.getvalue()
    assert len(evaluate(made, tmp_path, lambda: InProcess(made), console)) == 3


def test_a_second_sigterm_does_not_cut_the_end_short(plan, tmp_path, sigterm):
    """make and timeout each send one SIGTERM."""

    class Ended(InProcess):
        def run(self, jobs):
            assert callable(signal.getsignal(signal.SIGTERM))
            signal.raise_signal(signal.SIGTERM)
            yield

        def __exit__(self, *error):
            assert signal.getsignal(signal.SIGTERM) is signal.SIG_IGN
            super().__exit__(*error)

    made = plan(episodes=1)
    with pytest.raises(SystemExit):
        evaluate(made, tmp_path, lambda: Ended(made), Console(file=io.StringIO()))


def test_sigterm_is_as_it_was_after_a_run(plan, tmp_path, sigterm):
    made = plan(episodes=1)
    evaluate(made, tmp_path, lambda: InProcess(made), Console(file=io.StringIO()))
    assert signal.getsignal(signal.SIGTERM) == sigterm


def test_an_episode_is_refused_a_second_time_unless_it_crashed(plan, tmp_path):
    with Ledger(tmp_path) as ledger:
        ledger.open(plan())
        ledger.add(record(0))
        ledger.add(record(1, "error"))
        ledger.add(record(1))
        with pytest.raises(StateError, match="in the ledger already"):
            ledger.add(record(0))
    assert {r.key.seed: r.outcome.status for r in read_records(tmp_path)} == {
        0: "success",
        1: "success",
    }


def test_a_repeated_or_damaged_line_is_refused(plan, tmp_path):
    with Ledger(tmp_path) as ledger:
        ledger.open(plan())
        ledger.add(record(0))
    path = tmp_path / FILE_NAME
    line = path.read_text()
    path.write_text(line + line)
    with pytest.raises(ConfigurationError, match=":2 repeats"):
        read_records(tmp_path)
    path.write_text("{}\n" + line)
    with pytest.raises(ConfigurationError, match=":1 is damaged"):
        read_records(tmp_path)


def test_two_processes_cannot_write_one_ledger(plan, tmp_path):
    with Ledger(tmp_path) as ledger:
        ledger.open(plan())
        with pytest.raises(StateError, match="Another process"):
            Ledger(tmp_path).open(plan())


def test_a_ledger_of_other_settings_is_refused(plan, tmp_path):
    with Ledger(tmp_path) as ledger:
        ledger.open(plan())
    with pytest.raises(ConfigurationError, match="another first_seed"), Ledger(tmp_path) as ledger:
        ledger.open(plan(first_seed=5))


def test_a_run_is_not_resumed_with_another_checkpoint_of_the_same_name(plan, tmp_path, monkeypatch):
    monkeypatch.setattr(command_plans, "limit_threads", lambda count: None)
    checkpoint = tmp_path / "model"
    checkpoint.write_text("A")
    made = plan(checkpoint=str(checkpoint), checkpoint_sha256=fingerprint(str(checkpoint)))
    with Ledger(tmp_path / "run") as ledger:
        ledger.open(made)
    checkpoint.write_text("B")
    now = command_plans.resumed(Namespace(directory=tmp_path / "run"))
    with (
        pytest.raises(ConfigurationError, match="another checkpoint_sha256"),
        Ledger(tmp_path / "run") as ledger,
    ):
        ledger.open(now)


def test_a_run_is_not_continued_with_other_latencies_in_a_file(plan, tmp_path):
    latencies = tmp_path / "latencies.txt"
    latencies.write_text("0.1\n")
    name, quiet = f"file:{latencies}", Console(file=io.StringIO())

    def run(episodes, *names):
        made = plan(episodes=episodes, latencies=names)
        return evaluate(made, tmp_path / "run", lambda: InProcess(made), quiet)

    run(1, name)
    run(1, "0")
    assert len(run(2, name, "0")) == 4
    latencies.write_text("0.2\n")
    with pytest.raises(ConfigurationError, match="episodes of another latency 'file:"):
        run(3, name)


def test_a_line_holds_what_a_reader_needs(plan, tmp_path):
    made = plan(episodes=1)
    evaluate(made, tmp_path, lambda: InProcess(made), Console(file=io.StringIO()))
    line = json.loads((tmp_path / FILE_NAME).read_text())
    assert line["key"]["seed"] == 0
    assert line["outcome"]["status"] == "success"
    assert len(line["outcome"]["digest"]) == 64
    assert line["outcome"]["metrics"] == {"tokens_kept": 64.0}
    assert line["measured"]["wall_s"] > 0
    assert len(line["measured"]["inference_ms"]) == line["outcome"]["predictions"]


@pytest.mark.parametrize("with_strip", [False, True], ids=["line", "strip"])
def test_a_full_disk_is_told_with_the_file_and_leaves_the_ledger_whole(plan, tmp_path, with_strip):
    with Ledger(tmp_path) as ledger:
        ledger.open(plan())
        ledger.add(record(0))
        whole = (tmp_path / FILE_NAME).read_bytes()
        soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
        # as on a full disk
        resource.setrlimit(resource.RLIMIT_FSIZE, (len(whole) + 30, hard))
        try:
            with pytest.raises(StateError, match="cannot be written") as refusal:
                ledger.add(record(1), b"x" * 100_000 if with_strip else None)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        assert ("strips" if with_strip else FILE_NAME) in refusal.value.message
        assert "Free space" in refusal.value.hint
        assert (tmp_path / FILE_NAME).read_bytes() == whole
        ledger.add(record(1), b"x" if with_strip else None)
    assert [r.key.seed for r in read_records(tmp_path)] == [0, 1]
    assert [path.name for path in tmp_path.rglob(".*")] == []
