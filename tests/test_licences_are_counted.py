"""A bill of materials is read for licences that would bind users of this project."""

from __future__ import annotations

import licences
import pytest


@pytest.mark.parametrize(
    ("entries", "expected"),
    [
        ([], False),
        ([{"license": {"id": "MIT"}}], False),
        ([{"license": {"id": "GPL-3.0-only"}}], True),
        ([{"expression": "AGPL-3.0-or-later"}], True),
        ([{"license": {"id": "LGPL-2.1-only"}}], False),
        ([{"expression": "GPL-2.0-only OR MIT"}], False),
        (
            [{"license": {"name": "License :: OSI Approved :: GNU General Public License (GPL)"}}],
            True,
        ),
        (
            [
                {"license": {"name": "License :: OSI Approved :: BSD License"}},
                {
                    "license": {
                        "name": "License :: OSI Approved :: GNU General Public License (GPL)"
                    }
                },
            ],
            False,
        ),
    ],
)
def test_a_licence_binds_unless_there_is_a_choice(
    entries: list[dict[str, object]], expected: bool
) -> None:
    assert licences.is_binding(licences.named({"name": "other", "licenses": entries})) is expected
