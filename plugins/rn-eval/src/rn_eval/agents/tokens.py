"""What an agent reads and writes, in tokens of a language model."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterable
from functools import cache
from importlib import import_module
from typing import Protocol, cast

ENCODING = "o200k_base"
"""Of tiktoken; tokens of other models differ by some percent."""
_MOST_CHARACTERS = 20_000_000
_log = logging.getLogger(__name__)


class Encoding(Protocol):
    """As `tiktoken.Encoding`."""

    def encode_ordinary(self, text: str) -> list[int]:
        """Tokens of a text, in which no special ones are looked for."""
        ...


@cache
def encoding() -> Encoding | None:
    """That of tiktoken; None where it, or its table (which it downloads once), is missing."""
    try:
        return cast("Encoding", import_module("tiktoken").get_encoding(ENCODING))
    except ModuleNotFoundError:
        return None
    except (OSError, ValueError) as error:  # it cannot be downloaded, or is not what it should be
        _log.warning("Tokens are not counted: tiktoken has no table %s: %s", ENCODING, error)
        return None


def count(texts: Iterable[str]) -> int | None:
    """Tokens of all texts together; None without `encoding`."""
    found = encoding()
    return None if found is None else sum(len(found.encode_ordinary(text)) for text in texts)


class ReadTexts:
    """What passed on the wire as a language model sees it: of answers the text parts, without
    pictures and without the structured copy.

    Attributes:
        lists: of tools, as JSON.
        answers, requests: of calls.
    """

    def __init__(self) -> None:
        self.lists: list[str] = []
        self.answers: list[str] = []
        self.requests: list[str] = []
        self._characters = 0

    def note(self, texts: list[str], value: object) -> None:
        """Keep a text, or JSON, in one of the lists; too many are not kept."""
        text = value if isinstance(value, str) else json.dumps(value, separators=(",", ":"))
        self._characters += len(text)
        if self._characters <= _MOST_CHARACTERS:
            texts.append(text)

    def note_answer(self, result: object) -> None:
        """Keep the text parts of the result of a call."""
        content = result.get("content") if isinstance(result, dict) else None
        for part in content if isinstance(content, list) else ():
            if isinstance(part, dict) and isinstance(part.get("text"), str):
                self.note(self.answers, part["text"])

    def counted(self) -> dict[str, int | None]:
        """Tokens by the names in `AgentCosts`; None where they cannot be counted."""
        is_cut = self._characters > _MOST_CHARACTERS
        return {
            f"{name}_tokens": None if is_cut else count(texts)
            for name, texts in (
                ("list", self.lists),
                ("answer", self.answers),
                ("request", self.requests),
            )
        }
