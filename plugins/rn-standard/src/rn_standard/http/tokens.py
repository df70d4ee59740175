"""Bearer tokens: from the environment or from files, compared in constant time, never shown."""

from __future__ import annotations

import hashlib
import hmac
import logging
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from rn_standard.http.options import TokenConfig
from roboneuron import ConfigurationError, ForeignDataError, foreign
from roboneuron.feature import Holder

log = logging.getLogger(__name__)
_LEAST_CHARACTERS, _MOST_BYTES = 16, 4096
_STOP = b"emergency_stop"
_BEARER = re.compile(rb"\r\nauthorization:[ \t]*bearer[ \t]+([!-~]+)[ \t]*\r\n", re.IGNORECASE)
"""Source: RFC 9110, section 5.5, and RFC 6750, section 2.1."""
_NEW = "Make one with: python -c 'import secrets; print(secrets.token_urlsafe(32))'"


class TokenTable:
    """Holders by token; stores digests, not tokens."""

    def __init__(self, entries: Sequence[tuple[str, Holder]]) -> None:
        self._entries = _digests(entries)

    def __bool__(self) -> bool:
        return bool(self._entries)

    def find(self, token: str) -> Holder | None:
        """Return the holder of a token; constant time for all tokens, valid or not."""
        given, found = _digest(token), None
        for digest, holder in self._entries:
            if hmac.compare_digest(given, digest):
                found = holder
        return found


class TokenFiles(TokenTable):
    """Tokens of a running server: a changed file is read again at the next request.

    If a file is missing, or contains no valid token any more, its holder loses access; the others
    are not affected.
    """

    def __init__(self, sections: Sequence[TokenConfig], environment: Mapping[str, str]) -> None:
        """Read the tokens. Raises ConfigurationError as `read_tokens`."""
        self._sections = sections
        self._environment = environment
        self._marks = self._look()
        super().__init__(_entries(sections, environment))

    def __bool__(self) -> bool:
        """True if a token is required, even if none is valid at the moment."""
        return bool(self._sections)

    def find(self, token: str) -> Holder | None:
        """As `TokenTable.find`, with the present content of the files."""
        marks = self._look()
        if marks != self._marks:
            self._marks = marks
            good: list[tuple[str, Holder]] = []
            for section in self._sections:
                try:
                    good = _entries([section], self._environment, good)
                except ConfigurationError as error:
                    log.error("A token is not accepted any more: %s", error)
            self._entries = _digests(good)
            log.info(
                "The files of tokens have changed; %d of %d are good.",
                len(good),
                len(self._sections),
            )
        return super().find(token)

    def _look(self) -> list[tuple[int, ...] | None]:
        """Attributes by which a change of each file is detected; None for a missing file."""
        return [_mark(section.file) for section in self._sections if section.file is not None]


def _mark(name: str) -> tuple[int, ...] | None:
    try:
        seen = Path(name).expanduser().stat()
    except OSError:
        return None
    return seen.st_mtime_ns, seen.st_ctime_ns, seen.st_ino, seen.st_size, seen.st_mode


def shown_holder(tokens: TokenTable, first: bytes) -> str:
    """Holder of the valid token in the first bytes of a connection; empty without one. Bytes that
    name the stop tool have a holder of their own, also where there are no tokens.
    """
    stop = " (stop)" if _STOP in first else ""
    if not tokens:
        return stop
    found = _BEARER.search(first)
    holder = None if found is None else tokens.find(found.group(1).decode("ascii"))
    return "" if holder is None else holder.who + stop


def read_tokens(sections: Sequence[TokenConfig], environment: Mapping[str, str]) -> TokenTable:
    """Read the configured tokens.

    Raises:
        ConfigurationError: one is missing, too short, readable by others, or a duplicate; the token
            is never shown.
    """
    return TokenTable(_entries(sections, environment))


def _entries(
    sections: Sequence[TokenConfig],
    environment: Mapping[str, str],
    before: Sequence[tuple[str, Holder]] = (),
) -> list[tuple[str, Holder]]:
    """Read tokens and holders, and append them to `before`."""
    entries = list(before)
    for section in sections:
        token = _read(section, environment)
        where = f"The token of {section.name!r}"
        if (
            len(token) < _LEAST_CHARACTERS
            or not token.isascii()
            or not token.isprintable()
            or " " in token
        ):
            raise ConfigurationError(
                f"{where} must have at least {_LEAST_CHARACTERS} printable ASCII characters, none "
                "of them a space.",
                hint=_NEW,
            )
        if any(token == other or section.name == holder.who for other, holder in entries):
            raise ConfigurationError(
                f"{where} or its name is that of another entry of [[http.tokens]].", hint=_NEW
            )
        entries.append((token, Holder(who=section.name, role=section.role)))
    return entries


def _read(section: TokenConfig, environment: Mapping[str, str]) -> str:
    where = f"The token of {section.name!r} in [[http.tokens]]"
    if (section.variable is None) == (section.file is None):
        raise ConfigurationError(f"{where} needs either `variable` or `file`.")
    if section.variable is not None:
        token = environment.get(section.variable, "")
        if not token:
            raise ConfigurationError(
                f"{where} is in {section.variable}, which is not set.", hint=_NEW
            )
        return token
    assert section.file is not None
    path = Path(section.file).expanduser()
    try:
        return foreign.read_text(path, most_bytes=_MOST_BYTES, is_secret=True).strip()
    except FileNotFoundError as error:
        raise ConfigurationError(f"{where}: there is no file {path}.", hint=_NEW) from error
    except ForeignDataError as error:
        raise ConfigurationError(f"{where}: {error.message}.", hint=error.hint) from error


def _digests(entries: Sequence[tuple[str, Holder]]) -> list[tuple[bytes, Holder]]:
    return [(_digest(token), holder) for token, holder in entries]


def _digest(token: str) -> bytes:
    return hashlib.sha256(token.encode("utf-8", errors="surrogateescape")).digest()
