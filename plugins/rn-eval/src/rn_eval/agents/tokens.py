"""Text that an agent reads and writes, in tokens of a language model."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterable
from functools import cache
from importlib import import_module
from typing import Protocol, cast

ENCODING = "o200k_base"
"""Encoding of tiktoken; counts for other models differ by some per cent."""
_MOST_CHARACTERS = 20_000_000
_log = logging.getLogger(__name__)


class Encoding(Protocol):
    """Interface of `tiktoken.Encoding`."""

    def encode_ordinary(self, text: str) -> list[int]:
        """Encode a text, ignoring special tokens."""
        ...


@cache
def encoding() -> Encoding | None:
    """Load tiktoken's encoding; None if tiktoken, or its table (downloaded once), is missing."""
    try:
        return cast("Encoding", import_module("tiktoken").get_encoding(ENCODING))
    except ModuleNotFoundError:
        return None
    except (OSError, ValueError) as error:  # the table cannot be downloaded, or is damaged
        _log.warning("Tokens are not counted: tiktoken has no table %s: %s", ENCODING, error)
        return None


def count(texts: Iterable[str]) -> int | None:
    """Count the tokens of all texts; None without `encoding`."""
    found = encoding()
    return None if found is None else sum(len(found.encode_ordinary(text)) for text in texts)


class ReadTexts:
    """Recorded traffic as a language model reads it: only the text parts of answers, without images
    and structured copies.

    Attributes:
        lists: lists of tools, as JSON.
        answers, requests: texts of answers, and requests.
    """

    def __init__(self) -> None:
        self.lists: list[str] = []
        self.answers: list[str] = []
        self.requests: list[str] = []
        self._characters = 0

    def note(self, texts: list[str], value: object) -> None:
        """Store a text, or a value as JSON; beyond the limit nothing is stored."""
        text = value if isinstance(value, str) else json.dumps(value, separators=(",", ":"))
        self._characters += len(text)
        if self._characters <= _MOST_CHARACTERS:
            texts.append(text)

    def note_answer(self, result: object) -> None:
        """Store the text parts of a call's result."""
        content = result.get("content") if isinstance(result, dict) else None
        for part in content if isinstance(content, list) else ():
            if isinstance(part, dict) and isinstance(part.get("text"), str):
                self.note(self.answers, part["text"])

    def counted(self) -> dict[str, int | None]:
        """Token counts, named as in `AgentCosts`; None if they cannot be counted."""
        is_cut = self._characters > _MOST_CHARACTERS
        return {
            f"{name}_tokens": None if is_cut else count(texts)
            for name, texts in (
                ("list", self.lists),
                ("answer", self.answers),
                ("request", self.requests),
            )
        }
