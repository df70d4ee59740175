"""Builds the plan of an evaluation from the command line and the configuration."""

from __future__ import annotations

import json
import os
import sys
from argparse import Namespace
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rn_eval.hooks import SuiteSpec
from rn_standard.console.plugin_options import read_options
from roboneuron import ConfigurationError

if TYPE_CHECKING:
    from rn_eval.plan import EvalPlan


def limit_threads(count: int) -> None:
    """Limit numerical libraries to some threads, before numpy or torch is imported: results of some
    models depend on the number.
    """
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[name] = str(count)
    torch = sys.modules.get("torch")
    if torch is not None:
        torch.set_num_threads(count)


def resumed(arguments: Namespace) -> EvalPlan:
    """Plan of an existing run, with the versions and the checkpoint's files of now.

    Raises:
        ConfigurationError: there is none, or its checkpoint is missing.
    """
    from rn_eval.ledger import read_plan
    from rn_eval.plan import fingerprint

    plan = read_plan(arguments.directory)
    if plan.checkpoint_sha256:  # the ledger refuses another one, because its path may be the same
        digest = fingerprint(plan.checkpoint)
        plan = plan.model_copy(update={"checkpoint_sha256": digest})
    limit_threads(plan.threads)
    return _with_versions(plan)


def _with_versions(plan: EvalPlan) -> EvalPlan:
    """Return the plan with the versions installed now."""
    from rn_eval.versions import installed_versions
    from roboneuron.command import discover

    return plan.model_copy(update={"versions": installed_versions(plan, discover())})


def configuration(arguments: Namespace) -> dict[str, object]:
    """The configuration, with the options of the suite and the command line."""
    from roboneuron.command import load_config

    config = load_config(arguments.config).model_dump(mode="json")
    options: dict[str, dict[str, object]] = config["plugins"]
    asked = read_options(_options_of_suite(arguments.suite), arguments.backend).get(
        arguments.backend, {}
    )
    if asked:
        options[arguments.backend] = {**asked, **options.get(arguments.backend, {})}
    for plugin, given in read_options(arguments.option, arguments.backend).items():
        options[plugin] = {**options.get(plugin, {}), **given}
    if config.get("control") is None:
        raise ConfigurationError(
            f"{arguments.config} has no section [control], which the deployed path needs."
        )
    return config


def planned(arguments: Namespace) -> EvalPlan:
    """Plan of a new run. Raises ConfigurationError for invalid arguments."""
    from pydantic import ValidationError

    from rn_eval.latency import check_unit
    from rn_eval.plan import EvalPlan, fingerprint

    config = configuration(arguments)
    for latency in arguments.latency or ():
        check_unit(latency)
    try:
        plan = EvalPlan(
            suite=arguments.suite,
            suite_options=_pairs(arguments.suite_option, "--suite-option NAME=VALUE"),
            backend=arguments.backend,
            checkpoint=arguments.checkpoint and str(Path(arguments.checkpoint).resolve()),
            checkpoint_sha256=fingerprint(arguments.checkpoint),
            runtime=arguments.runtime,
            config=config,
            presets=arguments.presets,
            executions=arguments.execution,
            latencies=tuple(dict.fromkeys(arguments.latency or ("0",))),
            episodes=arguments.episodes,
            first_seed=arguments.seed,
            shared_policy=arguments.policy_actors > 0,
            threads=arguments.threads,
            strips=arguments.strips,
        )
    except ValidationError as error:
        first = error.errors()[0]
        raise ConfigurationError(
            f"{'.'.join(map(str, first['loc']))}: {first['msg']}, got {first['input']!r}."
        ) from None
    return _with_versions(plan)


def _options_of_suite(suite: str) -> Sequence[str]:
    from roboneuron.command import discover

    return discover().get(SuiteSpec, suite).options


def _pairs(texts: Sequence[str], form: str) -> dict[str, object]:
    """Parse NAME=VALUE pairs; a value that is valid JSON is read as such, otherwise as text."""
    pairs: dict[str, object] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals:
            raise ConfigurationError(f"{text!r} is not of the form {form}.")
        try:
            pairs[name] = json.loads(value)
        except ValueError:
            pairs[name] = value
    return pairs
