"""Check that a checkpoint has no pickles, code, or names that would be looked up on the hub."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path

from rn_vla.checkpoint_files import clip, list_names, read_json
from roboneuron import CheckpointError

_PICKLES = ("*.bin", "*.pt", "*.pth", "*.pkl", "*.pickle", "*.ckpt")
_HUB_NAME = re.compile(r"[A-Za-z0-9][\w.-]*/[\w.-]+")
_REFERENCES = frozenset(
    {
        "action_tokenizer_name",
        "action_tokenizer_path",
        "base_model_path",
        "checkpoint_path",
        "discrete_action_tokenizer",
        "jepa_encoder_name",
        "pretrained_name_or_path",
        "qwen_model_name",
        "text_encoder_name",
        "text_tokenizer_name",
        "tokenizer_name",
        "vision_encoder_name",
        "vlm_base",
        "vlm_model_name",
        "wan_pretrained_path",
    }
)
"""Keys whose value is the name of a backbone or tokenizer that LeRobot loads."""
_NOT_LOADED = frozenset({"license", "pretrained_path", "pretrained_revision", "repo_id", "tags"})
"""Keys with the origin or destination of a checkpoint; LeRobot loads nothing by them."""
_OWN_CODE = ("lerobot.",)
_NO_CODE = "RoboNeuron never runs code that a checkpoint contains or names."


def check_folder(directory: Path) -> None:
    """Raise CheckpointError unless `directory` is a folder without pickled weights and code."""
    if not directory.is_dir():
        raise CheckpointError(
            f"{clip(directory, 300)} is no folder on this machine.",
            hint="Nothing is looked up on the hub: download the checkpoint, for instance by "
            "`hf download NAME --local-dir FOLDER`, and name that folder.",
        )
    _check_pickles(directory)
    _check_code(directory)


def _check_pickles(directory: Path) -> None:
    if any(directory.glob("*.safetensors")):
        return
    pickles = sorted(path.name for pattern in _PICKLES for path in directory.glob(pattern))
    if pickles:
        raise CheckpointError(
            f"{directory} holds its weights as pickles ({list_names(pickles)}), which can run code "
            "when they are read.",
            hint="Save it as safetensors with LeRobot's save_pretrained.",
        )


def _check_code(directory: Path) -> None:
    code = sorted(path.name for path in directory.glob("*.py"))
    if code:
        raise CheckpointError(f"{directory} contains code ({list_names(code)}). {_NO_CODE}")
    for path in sorted(directory.glob("*.json")):
        # tokenizers are large and contain no code
        if path.name in ("tokenizer.json", "vocab.json"):
            continue
        if any(key == "auto_map" for key, _ in _walk(read_json(path))):
            raise CheckpointError(f"{path} names code of its own (auto_map). {_NO_CODE}")


def find_references(
    documents: Mapping[str, object], directory: Path, folders: Mapping[str, Path]
) -> dict[str, Path]:
    """The local folder of each backbone and tokenizer that the checkpoint names.

    Args:
        documents: parsed JSON by file name.
        directory: folder of the checkpoint; a name that is a folder in it means that one.
        folders: local folder by name, given by the user.

    Raises:
        CheckpointError: a name is no local folder, the folder holds code, or a document requests
            code.
    """
    found: dict[str, Path] = {}
    for source, document in documents.items():
        for key, value in _walk(document):
            if key == "trust_remote_code" and value is True:
                raise CheckpointError(
                    f"{directory / source} asks for code from the hub (trust_remote_code). "
                    f"{_NO_CODE}"
                )
            if key == "class" and isinstance(value, str) and not value.startswith(_OWN_CODE):
                raise CheckpointError(
                    f"{directory / source} names the code of a step ({clip(value)}) instead of a "
                    f"step that LeRobot knows. {_NO_CODE}"
                )
            if isinstance(value, str) and _is_reference(key, value):
                found[value] = _folder(value, key, directory / source, directory, folders)
    return found


def _is_reference(key: str, value: str) -> bool:
    if key in _REFERENCES:
        return bool(value)
    return key not in _NOT_LOADED and _HUB_NAME.fullmatch(value) is not None


def _folder(
    name: str, key: str, source: Path, directory: Path, folders: Mapping[str, Path]
) -> Path:
    """Folder of `name`: the one given by the user, one in the checkpoint, or an absolute path."""
    chosen = folders.get(name)
    if chosen is None:
        # an absolute name stays as it is
        chosen = directory / name
    if not chosen.is_dir():
        raise CheckpointError(
            f"{source} names {clip(name)} ({key}), which is no folder on this machine; nothing is "
            "looked up on the hub.",
            hint=f'Download it and say where it is: [plugins.lerobot.folders] "{clip(name)}" = '
            '"FOLDER".',
        )
    check_folder(chosen)
    return chosen.resolve()


def _walk(value: object, key: str = "") -> Iterator[tuple[str, object]]:
    """Every value of a document with its key; elements of a list have the list's key."""
    if isinstance(value, dict):
        for name, inner in value.items():
            yield from _walk(inner, str(name))
    elif isinstance(value, list):
        for inner in value:
            yield from _walk(inner, key)
    yield key, value
