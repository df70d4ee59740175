"""`python -m rn_testing.check`: checks the rules of one installed plugin and writes JSON lines per
rule.

Run by `roboneuron plugins check` in its own process, which may crash. Standard input holds one JSON
object: `distribution`, `plugin` (the name of its entry point), `offers` (a list of kind and name)
and `options` (by name of the offer, "" for all of them). Standard output holds, per rule, first
{"subject", "rule", "text"} at its start and then the same with "verdict", "detail" and "traceback".
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterator, Mapping
from typing import TextIO, TypedDict

from rn_testing.automatic import make_case
from rn_testing.cases import PackageCase
from rn_testing.rule import AnyRule, RuleVerdict
from rn_testing.rules import RULES, rules_of
from rn_testing.verification import RuleResult, verify
from roboneuron import RoboNeuronError
from roboneuron.command import discover


class CheckRequest(TypedDict):
    """Request for a check."""

    distribution: str
    plugin: str
    offers: list[tuple[str, str]]
    options: dict[str, dict[str, object]]


def subjects(request: CheckRequest) -> Iterator[tuple[str, object, tuple[AnyRule, ...]]]:
    """Yield label, case and rules of each subject; if a case cannot be built, its RoboNeuronError
    instead.
    """
    package = PackageCase(distribution=request["distribution"], plugin=request["plugin"])
    yield request["plugin"], package, RULES["package"]
    offers = [tuple(pair) for pair in request["offers"]]
    specs = {
        (offer.spec.kind, offer.spec.name): offer.spec
        for offer in discover().all_offers
        if (offer.distribution, offer.plugin) == (package.distribution, package.plugin)
    }
    for kind, name in offers:
        label = f"{kind} {name}"
        try:
            options = {**request["options"].get("", {}), **request["options"].get(name, {})}
            yield label, make_case(specs[kind, name], options), rules_of(kind)
        except RoboNeuronError as error:
            yield label, error, rules_of(kind)


def decide(rule: AnyRule, case: object) -> RuleResult:
    """Verify one rule; without a case it fails with the error of building the case."""
    if isinstance(case, RoboNeuronError):
        return RuleResult(
            rule=rule.id, verdict=RuleVerdict.FAILED, detail=f"there is no case to try: {case}"
        )
    return verify(rule, case)


def run(request: CheckRequest, out: TextIO) -> None:
    """Check every rule; write one line before and one after each."""

    def write(line: Mapping[str, str]) -> None:
        out.write(json.dumps(line) + "\n")
        out.flush()

    for subject, case, rules in subjects(request):
        for rule in rules:
            begun = {"subject": subject, "rule": rule.id, "text": rule.text}
            write(begun)
            outcome = decide(rule, case)
            write(
                {
                    **begun,
                    "verdict": outcome.verdict,
                    "detail": outcome.detail,
                    "traceback": outcome.traceback,
                }
            )


def main() -> None:
    """Read the request and write results to the original standard output; output of plugins goes to
    standard error.
    """
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "w", encoding="utf-8")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    run(json.load(sys.stdin), answers)
    answers.close()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(0)  # so that threads left by a plugin do not keep this process alive


if __name__ == "__main__":
    main()
