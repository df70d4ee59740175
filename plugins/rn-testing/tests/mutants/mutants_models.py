"""Backends, runtimes and accelerations whose answers have the right type but are unusable."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from mutation import Mutant, mutate, then

from rn_testing.fakes import CountingRuntime, HalvingAcceleration, InstantBackend
from roboneuron.plugins.specs import ActionSpace


def backend(rule, words="", *, spec=None, case=None, **changes):
    target = mutate(InstantBackend, **changes)
    return Mutant(
        rule=f"backend/{rule}", target=target, spec=spec or {}, case=case or {}, words=words
    )


def metrics(**values):
    return lambda self, call, observation: replace(call(observation), metrics=values)


def first_word(self, call, observation):
    observation.instruction.split()[0]
    return call(observation)


def only_ascii(self, call, observation):
    observation.instruction.encode("ascii")
    return call(observation)


def only_short(self, call, observation):
    np.zeros(500)[len(observation.instruction.split())]
    return call(observation)


def rows(count):
    action = np.array([[0.001, 0, 0, 0, 0, 0, 1.0]])
    return lambda self, call, o: replace(call(o), actions=np.repeat(action, count, axis=0))


FIXED = {"config": None, "action_space": ActionSpace(horizon=8)}
BACKENDS = {
    "metric_of_nan": backend("metrics-numeric", "finite", predict=metrics(tokens=float("nan"))),
    "metric_infinite": backend("metrics-numeric", "finite", predict=metrics(tokens=float("inf"))),
    "metric_of_single_precision": backend("metrics-numeric", predict=metrics(tokens=np.float32(1))),
    "metrics_of_every_layer": backend(
        "metrics-numeric", "at most", predict=metrics(**{f"layer_{i}": 1.0 for i in range(2000)})
    ),
    "note_of_20_000_characters": backend(
        "metrics-numeric",
        "20000 characters",
        predict=lambda s, call, o: replace(call(o), note="x" * 20_000),
    ),
    "chunk_shorter_than_declared": backend(
        "rows-declared", "expected 8", spec=FIXED, predict=rows(4)
    ),
    "chunk_shorter_than_its_option": backend(
        "rows-declared", "expected 6", case={"options": {"horizon": 6}}, predict=rows(3)
    ),
    "chunk_shorter_than_its_case": backend("rows-declared", case={"rows": 5}, predict=rows(2)),
    "needs_a_word": backend("any-instruction", "IndexError", predict=first_word),
    "needs_ascii": backend("any-instruction", "UnicodeEncodeError", predict=only_ascii),
    "needs_a_short_instruction": backend(
        "any-instruction",
        "IndexError",
        predict=lambda s, call, o: then(np.zeros(300)[len(o.instruction)], call(o)),
    ),
}


def runtime(rule, words="", *, case=None, **changes):
    target = mutate(CountingRuntime, **changes)
    return Mutant(rule=f"runtime/{rule}", target=target, case=case or {}, words=words)


RUNTIMES = {
    "answers_text": runtime("run-expected", "expects", run=lambda s, call, r: f"{call(r)}"),
    "answers_text_of_a_float": runtime(
        "run-expected", case={"expected": lambda: 4.0}, run=lambda s, call, r: repr(float(call(r)))
    ),
    "answers_an_array_of_text": runtime(
        "run-expected",
        case={"expected": lambda: np.array([4.0])},
        run=lambda s, call, r: np.array([str(call(r))]),
    ),
    "answers_a_flag": runtime(
        "run-expected", case={"expected": lambda: 1}, run=lambda s, call, r: then(call(r), True)
    ),
    "answers_nan": runtime("run-answers", "NaN", run=lambda s, call, r: call(r) * float("nan")),
    "answers_an_array_with_nan": runtime(
        "run-answers", "NaN", run=lambda s, call, r: {"logits": np.array([call(r), np.nan])}
    ),
}


def preset(rule, words="", **changes):
    return Mutant(
        rule=f"acceleration/{rule}", target=mutate(HalvingAcceleration, **changes), words=words
    )


KEPT: list[object] = []


ACCELERATIONS = {
    "keeps_every_decoder": preset(
        "memory-bounded",
        "2 of 2",
        apply=lambda s, call, d: then(call(d), s.__dict__.setdefault("kept", []).append(d)),
    ),
    "keeps_every_decoder_in_its_module": preset(
        "memory-bounded", apply=lambda s, call, d: then(call(d), KEPT.append(d))
    ),
}

MUTANTS: dict[str, Mutant] = {
    **{f"backend_{name}": mutant for name, mutant in BACKENDS.items()},
    **{f"runtime_{name}": mutant for name, mutant in RUNTIMES.items()},
    **{f"acceleration_{name}": mutant for name, mutant in ACCELERATIONS.items()},
}


def __getattr__(name: str) -> Any:
    if name not in MUTANTS:
        raise AttributeError(name)
    return MUTANTS[name].target
