"""What a user notices of a change is a file of one kind, which a release collects."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]
SETTINGS = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["towncrier"]
KINDS = "|".join(kind["directory"] for kind in SETTINGS["type"])
MOST = 400
"""Characters; more belongs into the documentation."""


def test_each_file_has_a_kind_and_few_words() -> None:
    for path in (ROOT / SETTINGS["directory"]).iterdir():
        assert re.fullmatch(rf"\+[a-z0-9-]+\.({KINDS})\.md|\.gitkeep", path.name), path.name
        text = path.read_text(encoding="utf-8")
        assert len(text) <= MOST, path.name
        assert path.name == ".gitkeep" or text.rstrip().endswith("."), path.name


def test_the_changelog_has_the_place_where_a_release_is_put() -> None:
    text = (ROOT / SETTINGS["filename"]).read_text(encoding="utf-8")
    assert text.count(SETTINGS["start_string"]) == 1
