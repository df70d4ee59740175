"""The documentation: the site covers the code, and the check of the built site detects external
resources.
"""

from __future__ import annotations

import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

import roboneuron
from rn_standard.doctor.checks import CHECKS
from roboneuron.errors import RoboNeuronError

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
CHECK = runpy.run_path(str(ROOT / "tools" / "check_site.py"))
IN_SITE_BY_INCLUSION = {"CONTRIBUTING.md": "contributing.md", "CHANGELOG.md": "changelog.md"}


def all_errors(kind: type[RoboNeuronError]) -> set[type[RoboNeuronError]]:
    return {kind}.union(*(all_errors(sub) for sub in kind.__subclasses__()))


def test_every_public_name_is_in_the_api_reference() -> None:
    page = (DOCS / "reference" / "api.md").read_text(encoding="utf-8")
    shown = set(re.findall(r"^::: roboneuron\.(\w+)$", page, re.MULTILINE))
    assert shown == set(roboneuron.__all__) - {"__version__"}


def test_troubleshooting_names_every_error_code() -> None:
    page = (DOCS / "troubleshooting.md").read_text(encoding="utf-8")
    codes = {e.code for e in all_errors(RoboNeuronError) if e.__module__ == "roboneuron.errors"} - {
        "error"
    }
    assert codes
    assert {code for code in codes if f"| `{code}` |" not in page} == set()


def test_troubleshooting_names_every_check_of_doctor() -> None:
    page = (DOCS / "troubleshooting.md").read_text(encoding="utf-8")
    headings = set(re.findall(r"^### `([a-z-]+)`", page, re.MULTILINE))
    assert headings == {check.id for check in CHECKS}


def test_every_page_is_in_the_navigation() -> None:
    nav = (ROOT / "mkdocs.yml").read_text(encoding="utf-8").partition("\nnav:\n")[2]
    listed = set(re.findall(r": (\S+\.md)$", nav, re.MULTILINE))
    assert listed == {path.relative_to(DOCS).as_posix() for path in DOCS.rglob("*.md")}


def test_the_list_of_packages_is_complete() -> None:
    page = (DOCS / "packages.md").read_text(encoding="utf-8")
    named = set(re.findall(r"^\|(.*?)\|", page, re.MULTILINE))
    folders = {path.parent.name for path in ROOT.glob("plugins/*/pyproject.toml")}
    assert set(re.findall(r"`([^`]+)`", " ".join(named))) == folders


def files_named(text: str, page: str) -> list[str]:
    """Paths in backticks, relative to the repository's root; braces as in a shell."""
    names = re.findall(r"`([^`\s<>]+/(?:[^`\s<>]*\.(?:py|toml|md|json|yml))?)`", text)
    for name in names[:]:
        head, brace, tail = name.partition("{")
        if brace:
            middle, _, end = tail.partition("}")
            names += [head + word + end for word in middle.split(",")]
            names.remove(name)
    return [
        AT[page].get(name.partition("/")[0], f"{name.partition('/')[0]}/") + name.partition("/")[2]
        for name in names
    ]


CORE, STANDARD = "roboneuron-core/src/roboneuron/", "plugins/rn-standard/src/rn_standard/"
AT = {
    "ten-changes.md": {"core": CORE, "standard": STANDARD},
    "architecture.md": {"rn_standard": STANDARD, "roboneuron": CORE}
    | {
        name: f"{CORE}{name}/"
        for name in (
            *("cli", "config", "contract", "data", "direct_path", "estop", "gate", "modules"),
            *("plugins", "ros", "selection", "server", "stdio", "supervisor"),
        )
    },
}
"""Meaning of the first part of a path, by page."""


@pytest.mark.parametrize("page", AT)
def test_files_that_contributors_are_sent_to_exist(page: str) -> None:
    text = (DOCS / page).read_text(encoding="utf-8")
    names = files_named(text.partition("## A reading path")[2] or text, page)
    assert len(names) > 15
    assert [name for name in names if not (ROOT / name).exists()] == []


@pytest.mark.parametrize(("source", "page"), IN_SITE_BY_INCLUSION.items())
def test_pages_that_stand_at_the_root_are_included(source: str, page: str) -> None:
    assert (ROOT / source).exists()
    assert f'--8<-- "{source}"' in (DOCS / page).read_text(encoding="utf-8")


@pytest.mark.parametrize("tool", ["process_figure.py", "diagrams.py"])
def test_drawn_figures_are_current(tool: str) -> None:
    done = subprocess.run([sys.executable, str(ROOT / "tools" / tool), "--check"], check=False)
    assert done.returncode == 0, f"run: python tools/{tool}"


def test_every_picture_is_small_described_and_on_a_page() -> None:
    pages = "".join(path.read_text(encoding="utf-8") for path in DOCS.rglob("*.md"))
    described = set(re.findall(r"!\[[^\]]+\]\((?:\.\./)?assets/([^)]+)\)", pages))
    pictures = {path.name: path for path in (DOCS / "assets").iterdir()}
    assert described == pictures.keys()
    assert len(pictures) >= 20
    assert {name for name, path in pictures.items() if path.stat().st_size > 250_000} == set()


def test_drawn_pictures_load_nothing() -> None:
    for path in (DOCS / "assets").glob("*.svg"):
        text = path.read_text(encoding="utf-8").replace("http://www.w3.org/", "")
        assert re.findall(r"url\(\s*[\"']?http|href=|@import", text) == [], path.name


def test_pictures_of_the_readme_are_there_and_small() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    pictures = re.findall(r"!\[[^\]]+\]\(([^)]+)\)", text)
    assert pictures == ["docs/assets/demo.webp", "docs/assets/processes.svg"]
    assert all((ROOT / picture).stat().st_size < 1_500_000 for picture in pictures)


@pytest.mark.parametrize(
    "text",
    [
        '<script src="https://cdn.example/x.js"></script>',
        '<link rel="stylesheet" href="//fonts.example/x.css">',
        '<link rel="preconnect" href="https://fonts.example">',
        '<img src="https://img.example/x.png">',
        "<style>@import 'https://x.example/a.css';</style>",
        '<p style="background: url(https://x.example/a.png)">',
        '<pre class="mermaid">graph LR</pre>',
    ],
)
def test_the_check_of_the_site_finds_what_comes_from_another_host(
    tmp_path: Path, text: str
) -> None:
    (tmp_path / "index.html").write_text(f"<html><body>{text}</body></html>", encoding="utf-8")
    assert len(CHECK["external_resources"](tmp_path)) == 1


def test_the_check_of_the_site_allows_links_and_own_files(tmp_path: Path) -> None:
    page = (
        '<a href="https://x.example">x</a><script src="a.js"></script><link rel="canonical" '
        'href="https://x.example">'
    )
    (tmp_path / "index.html").write_text(page, encoding="utf-8")
    (tmp_path / "a.css").write_text("a { background: url(b.png) }", encoding="utf-8")
    assert CHECK["external_resources"](tmp_path) == []


def test_a_site_without_pages_is_no_success(tmp_path: Path) -> None:
    assert CHECK["main"]([str(tmp_path)]) == 1
