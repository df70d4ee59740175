"""Validation errors of a configuration model as sentences that name the file, the key and the nearest valid key."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches
from typing import Any

from pydantic import BaseModel, ValidationError

from roboneuron.errors import ConfigurationError

MOVED = {
    f"server.{key}": f"http.{key}"
    for key in ("host", "port", "allowed_hosts", "allowed_origins", "lease_s", "max_request_bytes", "tokens")
}
"""Where keys of earlier versions are now."""


def explain(error: ValidationError, root: type[BaseModel], source: str, section: str = "") -> ConfigurationError:
    """The error for people.

    Args:
        error: raised by the model `root`.
        root: the model that was validated.
        source: file name.
        section: where that model stands in the file; empty for the whole.
    """
    lines = []
    for item in error.errors(include_url=False):
        key = ".".join([*([section] if section else []), *(str(part) for part in item["loc"])])
        if item["type"] == "extra_forbidden" and key in MOVED:
            lines.append(f"{source}: {key!r} is now {MOVED[key]!r}: write it under [{MOVED[key].partition('.')[0]}].")
        elif item["type"] == "extra_forbidden":
            lines.append(unknown_key(source, key, _valid_keys(root, item["loc"])))
        elif item["type"] == "missing":
            lines.append(f"{source}: {key!r} is missing.")
        else:
            lines.append(f"{source}: {key} = {item['input']!r}: {item['msg'][0].lower()}{item['msg'][1:]}.")
    return ConfigurationError("\n".join(lines))


def unknown_key(source: str, key: str, valid: Iterable[str]) -> str:
    """The sentence for a key that nothing knows."""
    known = sorted(valid)
    near = get_close_matches(key.rpartition(".")[2], known, n=1, cutoff=0.5)
    nearest = f" Did you mean {near[0]!r}?" if near else f" Valid keys: {', '.join(known)}."
    return f"{source}: unknown key {key!r}.{nearest}"


def _valid_keys(root: type[BaseModel], location: tuple[int | str, ...]) -> list[str]:
    """Keys allowed in the section that `location` (of an error) points into."""
    model: Any = root
    for part in location[:-1]:
        if isinstance(part, int):  # an entry of an array of tables
            continue
        field = model.model_fields.get(part) if hasattr(model, "model_fields") else None
        if field is None:
            return []
        candidates = [field.annotation, *getattr(field.annotation, "__args__", ())]
        candidates += [a for c in candidates for a in getattr(c, "__args__", ())]
        model = next((c for c in candidates if hasattr(c, "model_fields")), None)
        if model is None:
            return []
    return sorted(name for name, field in model.model_fields.items() if not field.exclude)
