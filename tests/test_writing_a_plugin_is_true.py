"""docs/writing-a-plugin.md: its commands work, and the pages generated from docstrings are
current.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from pathlib import Path

from contract_run import contract_run

from roboneuron.cli.main import main
from roboneuron.plugins import hookspecs
from roboneuron.plugins.registry import Status

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "writing-a-plugin.md").read_text(encoding="utf-8")

STRICT = ("-W", "error")


def test_the_plugin_of_the_page_keeps_its_contract(tmp_path):
    command = next(line for line in PAGE.splitlines() if line.startswith("roboneuron plugins new"))
    project = tmp_path / "rn-backend-nod"
    assert main([*command.split()[1:], "--out", str(project)]) == 0
    files = re.findall(r"<!-- file: (\S+) -->\n```python\n(.*?)```", PAGE, flags=re.DOTALL)
    assert len(files) == 3
    for name, text in files:
        assert (project / name).exists(), name
        (project / name).write_text(text)
    assert re.search(r"\d\d passed", contract_run(project, "TestNod", options=STRICT))


def test_the_extra_with_what_tests_need_has_one_name():
    own = "plugins/rn-testing/pyproject.toml"
    for path in ROOT.glob("plugins/rn-*/pyproject.toml"):
        extras = tomllib.loads(path.read_text(encoding="utf-8"))["project"].get(
            "optional-dependencies", {}
        )
        named = [
            name
            for name, lines in extras.items()
            if any(line.startswith(("pytest", "rn-testing")) for line in lines)
        ]
        assert named == (["pytest"] if path == ROOT / own else ["testing"]), path
        assert path == ROOT / own or "rn-testing[pytest]>=0.1,<0.2" in extras["testing"], path
    template = ROOT / "plugins/rn-testing/src/rn_testing/templates/common/pyproject.toml.tmpl"
    assert 'testing = ["rn-testing[pytest]>=0.1,<0.2"]' in template.read_text(encoding="utf-8")
    assert "pip install -e '.[testing]'" in PAGE


def test_the_page_explains_every_status():
    assert set(re.findall(r"^\| (\w+) \|", PAGE, flags=re.MULTILINE)) - {"status"} == {
        s.value for s in Status
    }


def test_the_hook_page_is_what_the_docstrings_say():
    done = subprocess.run(
        [sys.executable, str(ROOT / "tools" / "hook_reference.py"), "--check"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout


def test_every_hook_has_a_docstring_and_is_on_the_page():
    page = (ROOT / "docs" / "reference" / "hooks.md").read_text(encoding="utf-8")
    for hook in hookspecs.HOOKS:
        assert getattr(hookspecs, hook).__doc__
        assert f"## `{hook}()" in page
