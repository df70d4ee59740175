"""Rules about errors: RoboNeuron's own classes for missing files, short texts, no secrets."""

from __future__ import annotations

import os
import re
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, get_args

from rn_testing.case import Case
from rn_testing.rule import NotApplicable, Violation, require
from roboneuron import AgentMaySet, RoboNeuronError, Spec
from roboneuron.selection.restricted import OptionAccess

if TYPE_CHECKING:
    from pydantic.fields import FieldInfo

LONGEST = 2000
"""Maximum length of an error text in characters."""
SECRET = "s3cret-0f-the-c0ntract-k1t"
"""Value of options and variables with secrets, which no error may contain."""
SECRET_VARIABLES = (
    "HF_TOKEN",
    "API_KEY",
    "OPENAI_API_KEY",
    "ROBONEURON_TOKEN",
    "AWS_SECRET_ACCESS_KEY",
    "PASSWORD",
)
"""Environment variables that hold secrets on users' machines."""
_PLACE = re.compile(
    r"(^|_)(path|file|dir|directory|folder|checkpoint|weights|urdf|calibration|video|device)($|_)"
)
_SECRET = re.compile(
    r"(^|_)(secret|token|password|passphrase|credentials?|(api|access|private)_key)($|_)"
)


def _texts(field: FieldInfo) -> bool:
    """True if an option may be text or a secret."""
    kinds = (field.annotation, *get_args(field.annotation))
    return any(
        isinstance(k, type) and (issubclass(k, str) or k.__name__ == "SecretStr") for k in kinds
    )


def _fields(case: Case[Spec]) -> Mapping[str, FieldInfo]:
    model = case.option_model()
    return {} if model is None else model.model_fields


def file_options(case: Case[Spec]) -> list[str]:
    """Options that name a file or a folder to read, by type or name."""
    found = []
    for name, field in _fields(case).items():
        kinds = (field.annotation, *get_args(field.annotation))
        is_path = any(isinstance(kind, type) and issubclass(kind, PurePath) for kind in kinds)
        if is_path or (_texts(field) and _PLACE.search(name)):
            found.append(name)
    return found


def secret_options(case: Case[Spec]) -> list[str]:
    """Names of options that hold a secret; an option that names a file or variable with the secret
    does not count.
    """
    found = []
    for name, field in _fields(case).items():
        elsewhere = re.search(r"(^|_)(file|path|env|variable|header|name)($|_)", name)
        is_public = isinstance(OptionAccess.of(name, field).mark, AgentMaySet)
        if _texts(field) and _SECRET.search(name) and not elsewhere and not is_public:
            found.append(name)
    return found


def check_missing_files(case: Case[Spec], use: Callable[[Case[Spec]], object]) -> None:
    """Set each option that names a file to a missing one: `use` must succeed or raise a
    RoboNeuronError.
    """
    names = file_options(case)
    if not names:
        raise NotApplicable("no option names a file")
    with tempfile.TemporaryDirectory() as folder:  # because a plugin may create the missing file
        for name in names:
            absent = str(Path(folder) / f"absent-{name}" / "file")
            try:
                use(case.with_options({name: absent}))
            except (RoboNeuronError, NotApplicable):
                continue
            except Violation:
                raise
            except Exception as error:
                what = f"with a missing {name} it raised {type(error).__name__}: {error}"
                raise Violation(f"{what}; expected an error of roboneuron.errors") from error


@contextmanager
def secrets() -> Iterator[None]:
    """Set the variables that hold secrets to SECRET."""
    before = {name: os.environ.get(name) for name in SECRET_VARIABLES}
    os.environ.update(dict.fromkeys(SECRET_VARIABLES, SECRET))
    try:
        yield
    finally:
        for name, text in before.items():
            if text is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = text


def check_error(error: BaseException) -> None:
    """Check that an error and its causes are short and contain no secret."""
    text = str(error)
    kind = type(error).__name__
    require(bool(text.strip()), f"{kind} says nothing")
    require(
        len(text) <= LONGEST,
        f"the text of {kind} has {len(text)} characters, at most {LONGEST}: {text[:80]!r}",
    )
    require(
        "Traceback (most recent call last)" not in text, f"the text of {kind} holds a traceback"
    )
    one: BaseException | None = error
    while one is not None:
        require(
            SECRET not in f"{one} {one!r}",
            f"the text of {type(one).__name__} holds a secret of the user",
        )
        one = one.__cause__ or one.__context__
