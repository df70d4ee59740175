"""`roboneuron plugins check`: options, a worker that hangs or crashes, offers that are not
ready.
"""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from rn_testing import plugin_check
from roboneuron.cli.main import main
from roboneuron.errors import ConfigurationError

GOOD = """
@hookimpl
def roboneuron_backends():
    return [BackendSpec(name="good", summary="Works.", target="good_module:Good",
                        requires=(Requirement(module="json", install="-"),), optional_cameras=("wrist",))]
"""  # noqa: E501


@pytest.fixture
def only(site, monkeypatch):
    """Make the command see only the plugins of the test's site."""
    monkeypatch.setattr(plugin_check, "discover", site.discover)
    return site


def test_an_option_of_something_else_is_refused(only):
    only.install("rn-good", GOOD)
    with pytest.raises(
        ConfigurationError, match=r"names 'bad', which is not checked\. Checked: good"
    ):
        plugin_check.check(
            only.discover(),
            "rn-good",
            kind=None,
            options=["bad.gain=1"],
            timeout_s=60.0,
            as_json=True,
        )


def _worker(monkeypatch, tmp_path, body):
    """Replace the worker by a script that writes one result and then executes `body`."""
    begun = {"subject": "rn-x", "rule": "x/one", "text": "One."}
    decided = {**begun, "verdict": "passed", "detail": "", "traceback": ""}
    lines = [json.dumps(begun), json.dumps(decided), json.dumps({**begun, "rule": "x/two"})]
    script = "import sys\n" + "".join(f"print({line!r}, flush=True)\n" for line in lines) + body
    (tmp_path / "lost_worker.py").write_text(script)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setattr(plugin_check, "WORKER", "lost_worker")


def _run_until(begun: Path):
    """Results of a worker ended after it has written `begun`, which is slow on a busy machine."""
    for limit_s in (1.0, 5.0, 25.0, 125.0):
        results = plugin_check.run_worker("{}", limit_s)
        if begun.exists() and begun.read_text():
            return results
    raise AssertionError("the worker never came to its body")


def test_a_check_that_hangs_is_ended_and_names_the_rule(monkeypatch, tmp_path):
    pid_file = tmp_path / "pid"
    body = (
        "import os, time, "
        f"pathlib\npathlib.Path({str(pid_file)!r}).write_text(str(os.getpid()))\ntime.sleep(60)\n"
    )
    _worker(monkeypatch, tmp_path, body)
    results = _run_until(pid_file)
    assert [(r.rule, r.verdict) for r in results] == [("x/one", "passed"), ("x/two", "timeout")]
    assert not Path(f"/proc/{pid_file.read_text()}").exists()


@pytest.mark.parametrize("end", ["", "time.sleep(60)", "os._exit(0)"])
def test_the_folders_that_a_case_makes_are_removed_however_the_check_ends(
    monkeypatch, tmp_path, end
):
    told = tmp_path / "folder"
    body = (
        "import os, pathlib, tempfile, time\nmade = tempfile.mkdtemp()\n"
        "pathlib.Path(made, "
        f"'weights').write_text('1')\npathlib.Path({str(told)!r}).write_text(made)\n{end}\n"
    )
    _worker(monkeypatch, tmp_path, body)
    _run_until(told)
    assert not Path(told.read_text()).exists()


def test_a_check_that_crashes_names_the_rule_and_the_reason(monkeypatch, tmp_path):
    _worker(monkeypatch, tmp_path, "raise SystemExit('the plugin took the process down')\n")
    results = plugin_check.run_worker("{}", 120.0)
    assert [(r.rule, r.verdict) for r in results] == [("x/one", "passed"), ("x/two", "crashed")]
    assert "took the process down" in results[1].detail


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ("import os\nos._exit(0)\n", "ended within this rule"),
        ('print(\'{"subject": "rn-x", "verdict"\')\n', "broken"),
        ("print('[1]')\n", "broken"),
        ("print('[RTPS_TRANSPORT_SHM Error] port')\n", "broken"),
    ],
)
def test_a_result_that_is_lost_or_broken_fails_the_rule(monkeypatch, tmp_path, body, words):
    _worker(monkeypatch, tmp_path, body)
    results = plugin_check.run_worker("{}", 120.0)
    assert [(r.rule, r.verdict) for r in results] == [("x/one", "passed"), ("x/two", "crashed")]
    assert words in results[1].detail


def test_check_of_what_is_not_ready_says_why_and_fails(only, capsys):
    only.install(
        "rn-bad", GOOD.replace('"good"', '"odd"').replace("summary", "contract=99, summary")
    )
    assert main(["plugins", "check", "odd"]) == 1
    assert "incompatible" in capsys.readouterr().out
