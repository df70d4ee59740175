"""Detection rate of the contract kit for broken plugins, and its false alarms for good ones.

    python benchmarks/bench_contract_kit.py [--only WORD] [--good]

Every mutant of plugins/rn-testing/tests/mutants runs in its own process (many of them change the
process), first under the rule named for it, then under the others of its kind until one fails.
`--good` counts false alarms instead: every rule on all installed plugins, as in `roboneuron plugins
check`.
"""

from __future__ import annotations

import argparse
import importlib
import os
import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

from rn_testing import FeatureCase, RuleVerdict, effects, verify
from rn_testing.automatic import installed_needs, make_case
from rn_testing.rules import RULES, rules_of
from roboneuron.plugins.discovery import discover
from roboneuron.plugins.registry import Status
from roboneuron.plugins.specs import FeatureSpec

TESTS = Path(__file__).parents[1] / "plugins" / "rn-testing" / "tests"
FOUND, MISSED = 0, 7
"""Exit statuses of a process that runs one mutant."""


def finds(case: Any, named: str, kind: str) -> bool:
    """True if any rule of the kind fails, the named one first."""
    rules = sorted(RULES[kind], key=lambda rule: rule.id != named)
    return any(verify(rule, case).verdict is RuleVerdict.FAILED for rule in rules)


def try_apart(work: Any) -> bool:
    """Run `work` in a forked process; True if it returned true, or if the process died."""
    child = os.fork()
    if child == 0:
        status = MISSED
        try:
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
            os.dup2(1, 2)
            status = FOUND if work() else MISSED
        finally:
            os._exit(status)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) != MISSED


def count_mutants(word: str) -> None:
    """Print the number of detected mutants by module, among those with `word` in their name."""
    sys.path[:0] = [str(TESTS / "mutants"), str(TESTS)]
    mutants_unclaimed = importlib.import_module("mutants_unclaimed")
    tests = importlib.import_module("test_every_rule_can_fail")

    effects.RELEASE_S = 0.5
    mutants = {
        **tests.MUTANTS,
        **{f"unclaimed:{n}": m for n, m in mutants_unclaimed.MUTANTS.items()},
    }
    tests.MUTANTS.update(mutants)
    found: Counter[str] = Counter()
    count: Counter[str] = Counter()
    for name, mutant in mutants.items():
        if word not in name:
            continue
        module, kind = name.partition(":")[0], tests.kind_of(mutant.rule)
        count[module] += 1
        if try_apart(
            lambda name=name, mutant=mutant, kind=kind: finds(
                tests.make_case(name), mutant.rule, kind
            )
        ):
            found[module] += 1
        else:
            print(f"missed: {name}", flush=True)
    for module in count:
        print(f"{module:>12}: {found[module]} of {count[module]}")
    total, all_found = sum(count.values()), sum(found.values())
    print(f"{'all':>12}: {all_found} of {total} ({all_found / max(1, total):.1%})")


def count_false_alarms() -> int:
    """Print violations reported for installed plugins; returns their number."""
    outcomes: Counter[RuleVerdict] = Counter()
    for offer in discover().all_offers:
        if offer.status is not Status.READY:
            continue
        case = make_case(offer.spec, {})
        if isinstance(case, FeatureCase):
            case = replace(case, needs=installed_needs(case.spec, discover().specs(FeatureSpec)))
        for rule in rules_of(offer.spec.kind):
            outcome = verify(rule, case)
            outcomes[outcome.verdict] += 1
            if outcome.verdict is RuleVerdict.FAILED:
                print(
                    f"false alarm: {offer.spec.kind} {offer.spec.name}: {rule.id}: "
                    f"{outcome.detail[:200]}",
                    flush=True,
                )
    print(
        f"{outcomes[RuleVerdict.FAILED]} of {sum(outcomes.values())} rules fail, "
        f"{outcomes[RuleVerdict.SKIPPED]} skipped"
    )
    return outcomes[RuleVerdict.FAILED]


def main() -> None:
    """Run one of the two counts."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--good", action="store_true", help="count false alarms on installed plugins"
    )
    parser.add_argument(
        "--only", default="", metavar="WORD", help="only mutants with this in their name"
    )
    arguments = parser.parse_args()
    if arguments.good:
        sys.exit(count_false_alarms() > 0)
    count_mutants(arguments.only)


if __name__ == "__main__":
    main()
