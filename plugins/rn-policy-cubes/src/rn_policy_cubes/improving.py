"""One improvement round: rollouts of the champion, labels of the teacher and human corrections,
training, a paired evaluation, and promotion. A process that is killed at any time can be resumed.
"""

from __future__ import annotations

import importlib.util
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field

from rn_policy_cubes.checkpoint import unpack
from rn_policy_cubes.corrections import corrections_in, take_corrections
from rn_policy_cubes.demonstrations import FIRST_SEED, VIEWS, shard_files
from rn_policy_cubes.evaluation import evaluate
from rn_policy_cubes.improvement_ledger import (
    BEGUN,
    EVALUATED,
    FIRST,
    KEPT,
    PROMOTED,
    ROLLED_BACK,
    ROLLED_OUT,
    TRAINED,
    ImprovementLedger,
)
from rn_policy_cubes.packing import Packed
from rn_policy_cubes.paired import PairedTest, paired
from rn_policy_cubes.progress import Say
from rn_policy_cubes.recipe import Recipe
from rn_policy_cubes.record import record
from rn_policy_cubes.replacing import replacing
from rn_policy_cubes.rollouts import SHARDS_PER_ROUND, Student, write_rollouts
from rn_policy_cubes.training import pack, train
from rn_policy_cubes.words import write_tokenizer
from roboneuron import ConfigurationError, MissingDependencyError, StateError, install_command

EVALUATION_SEED, SEEDS_PER_ROUND = 100_000, 1000
"""The evaluation scenes of round n start at the first value plus n times the second, so that rounds
share no scenes with each other or with demonstrations.
"""
_CHAMPION, _CHALLENGER = "champion", "challenger"
ORDINARY, ELSEWHERE = "test", "test_elsewhere"
"""Comparisons of a round, by their name in the ledger: on ordinary scenes, and on the same ones
with the options of the suite in the plan.
"""


class RoundPlan(BaseModel):
    """Settings of one round; stored in the ledger, so that a resumed round keeps them.

    Attributes:
        recipe: recipe of the training; its shards are the demonstrations.
        rollouts: number of shards of the champion's states.
        views: images of each shard.
        seeds: number of unseen scenes for the evaluation of champion and challenger.
        time_limit_s: time limit of each scene [simulated s].
        corrections: names of the data sets with human corrections added in this round.
        suite_options: options of the suite, NAME=VALUE, of a second evaluation; empty for none.
        margin: share of the scenes that a promoted challenger may solve fewer, see `PairedTest`.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    recipe: Recipe
    rollouts: int = Field(ge=0, lt=SHARDS_PER_ROUND)
    views: int = Field(default=VIEWS, ge=1)
    seeds: int = Field(ge=1, le=SEEDS_PER_ROUND)
    time_limit_s: float = Field(default=30.0, gt=0)
    corrections: tuple[str, ...] = ()
    suite_options: tuple[str, ...] = ()
    margin: float = Field(default=0.0, ge=0, lt=1)


def recipe_of_round(shards: int, steps: int, settings: Mapping[str, object]) -> Recipe:
    """The recipe of a training that continues from a champion.

    Raises:
        pydantic.ValidationError: a setting is wrong.
    """
    usual: dict[str, object] = {
        "shards": shards,
        "steps": steps,
        "rate": 1e-3,
        "cool_down": 0.4,
        "warm_up": max(1, min(100, steps // 4)),
        "full_from": 0.95,
        "light": 0.6,
        "continues": True,
    }
    return Recipe.model_validate({**usual, **settings})


class Wheel:
    """The improvement rounds of one directory; used by one process, see `alone_in`.

    Args:
        directory: folder of all files.
        say: called with lines for people.
        fuse: compile the layers before training, see `train`.
    """

    def __init__(self, directory: Path, say: Say, *, fuse: bool = False) -> None:
        self.directory, self._say, self._fuse = directory, say, fuse
        self.ledger = ImprovementLedger(directory)
        self._data = directory / "demonstrations"

    def begin(self, weights: Path, plan: RoundPlan, corrections: Sequence[Path]) -> int:
        """Return the current round, or start a new one.

        Args:
            weights: packed file of the first champion; read only once.
            plan: plan of a new round, without its corrections.
            corrections: data sets in the layout of LeRobot v3.

        Raises:
            StateError: a round with another plan is unfinished.
            RoboNeuronError: a data set cannot be used.
        """
        if importlib.util.find_spec("rn_eval") is None:
            raise MissingDependencyError(
                "Champion and challenger are evaluated by rn-eval, which is not installed.",
                hint=f"Run: {install_command('rn-eval')}.",
            )
        first = self._weights(FIRST)
        if not first.exists():
            first.parent.mkdir(parents=True, exist_ok=True)
            with replacing(first) as unfinished:
                shutil.copyfile(weights, unfinished)
        # an incomplete copy is written again: it counts only once its round has started
        names = tuple(take_corrections(self.directory, path) for path in corrections)
        shape = Packed.read(self._weights(self.champion)).card.recipe.shape
        number = self.ledger.unfinished
        wanted = len(self.ledger.rounds) + 1 if number is None else number
        recipe = plan.recipe.model_copy(update={"shape": shape, "seed": wanted})
        plan = plan.model_copy(update={"recipe": recipe, "corrections": names})
        if number is None:
            facts = {"champion": self.champion, "plan": plan.model_dump(mode="json")}
            self.ledger.add(wanted, BEGUN, facts)
        elif plan != self._plan(number):
            raise StateError(
                f"Round {number} in {self.directory} is unfinished and has another plan: "
                f"{self._plan(number).model_dump_json()}.",
                hint="Use the same arguments to continue it, or another --out.",
            )
        return wanted

    def run(self, number: int) -> dict[str, PairedTest]:
        """Complete a round; returns the comparisons of champion and challenger: `ORDINARY`, and
        `ELSEWHERE` if the plan has options of the suite.

        Raises:
            PluginError: the evaluation has failed.
            StateError: the disk is full, or not writable.
        """
        plan = self._plan(number)
        begun = self.ledger.of(number, BEGUN)
        assert begun is not None, "a round is worked at once it has begun"
        champion = int(begun["champion"])
        self._say(f"round {number}: the champion is {self._title(champion)}")
        if plan.suite_options and self.ledger.of(number, TRAINED) is None:
            # a wrong option fails before the training
            self._solved(number, plan, _CHAMPION, champion, ELSEWHERE)
        record(self._data, plan.recipe.shards, workers=1, say=self._say, views=plan.views)
        self._roll_out(number, plan, champion)
        self._train(number, plan, champion)
        tests = self._evaluate(number, plan, champion)
        if self.ledger.of(number, PROMOTED) is None and self.ledger.of(number, KEPT) is None:
            is_worse = any(test.is_worse(plan.margin) for test in tests.values())
            difference = tests[ORDINARY].difference
            self.ledger.add(number, KEPT if is_worse else PROMOTED, {"difference": difference})
        return tests

    def roll_back(self) -> tuple[int, int]:
        """Restore the previous champion; returns the rounds of the removed champion and of the
        restored one.

        Raises:
            StateError: a round is unfinished, or there was no promotion.
        """
        if self.ledger.unfinished is not None:
            raise StateError(
                f"Round {self.ledger.unfinished} is unfinished.",
                hint="Let `policy cubes improve` complete it first.",
            )
        *before, champion = self.ledger.champions
        if not before:
            raise StateError(f"The champion in {self.directory} is the first one.")
        self.ledger.add(champion, ROLLED_BACK, {"back": before[-1]})
        return champion, before[-1]

    @property
    def champion(self) -> int:
        """Round of the champion's weights."""
        return self.ledger.champions[-1]

    def checkpoint(self, number: int) -> Path:
        """Checkpoint of a round in the layout that the backend loads; created if missing."""
        directory = self._folder(number) / "checkpoint"
        if not directory.exists():
            unfinished = directory.with_name("checkpoint.part")
            shutil.rmtree(unfinished, ignore_errors=True)
            unpack(Packed.read(self._weights(number)), unfinished, directory)
            unfinished.rename(directory)
        return directory

    def _roll_out(self, number: int, plan: RoundPlan, champion: int) -> None:
        if self.ledger.of(number, ROLLED_OUT) is not None:
            return
        tokenizer = self.directory / "tokenizer.json"
        write_tokenizer(tokenizer)
        student = Student(Packed.read(self._weights(champion)), tokenizer)
        for shard in _numbers(number, plan.rollouts):
            rows, _ = shard_files(self._data, shard)
            if rows.exists():
                continue
            lifted, episodes = write_rollouts(self._data, shard, plan.views, student)
            self._say(
                f"rollouts: {shard % SHARDS_PER_ROUND + 1} of {plan.rollouts} shards; "
                f"{lifted} of {episodes} episodes ended with the cube lifted"
            )
        self.ledger.add(number, ROLLED_OUT, {"views": plan.rollouts * plan.views})

    def _train(self, number: int, plan: RoundPlan, champion: int) -> None:
        if self.ledger.of(number, TRAINED) is not None:
            return
        folder = self._folder(number)
        more = [
            shard
            for earlier in range(1, number + 1)
            for shard in _numbers(earlier, self._plan(earlier).rollouts)
        ]
        training = train(
            plan.recipe,
            folder / "training",
            self._data,
            weights=Packed.read(self._weights(champion)),
            more=more,
            corrections=corrections_in(self.directory, self._corrections(number)),
            say=self._say,
            fuse=self._fuse,
        )
        packed = pack(folder / "training")
        with replacing(self._weights(number)) as unfinished:
            packed.write(unfinished)
        self.ledger.add(number, TRAINED, {"step": training.step, "figures": packed.card.figures})

    def _evaluate(self, number: int, plan: RoundPlan, champion: int) -> dict[str, PairedTest]:
        names = (ORDINARY, ELSEWHERE) if plan.suite_options else (ORDINARY,)
        found = self.ledger.of(number, EVALUATED)
        if found is not None:
            return {name: PairedTest(**found[name]) for name in names}
        tests = {}
        for name in names:
            verdicts = [
                self._solved(number, plan, who, policy, name)
                for who, policy in ((_CHAMPION, champion), (_CHALLENGER, number))
            ]
            tests[name] = paired(*verdicts)
        self.ledger.add(number, EVALUATED, {name: asdict(test) for name, test in tests.items()})
        return tests

    def _solved(
        self, number: int, plan: RoundPlan, who: str, policy: int, name: str
    ) -> dict[int, bool]:
        """Success by seed of a policy; an evaluation that is complete is read."""
        options = plan.suite_options if name == ELSEWHERE else ()
        self._say(" ".join([f"evaluation of the {who} on {plan.seeds} unseen scenes", *options]))
        folder = "elsewhere" if name == ELSEWHERE else "evaluation"
        return evaluate(
            self.checkpoint(policy),
            self._folder(number) / folder / who,
            first_seed=evaluation_seed(number),
            count=plan.seeds,
            time_limit_s=plan.time_limit_s,
            suite_options=options,
        )

    def _plan(self, number: int) -> RoundPlan:
        begun = self.ledger.of(number, BEGUN)
        assert begun is not None, "a round has a plan once it has begun"
        return RoundPlan.model_validate(begun["plan"])

    def _corrections(self, number: int) -> list[str]:
        """Names of all data sets added up to this round."""
        names = [
            name for earlier in range(1, number + 1) for name in self._plan(earlier).corrections
        ]
        return list(dict.fromkeys(names))

    def _folder(self, number: int) -> Path:
        return self.directory / "rounds" / f"{number:04d}"

    def _weights(self, number: int) -> Path:
        return self._folder(number) / "weights.safetensors"

    def _title(self, number: int) -> str:
        return "the initial one" if number == FIRST else f"that of round {number}"


def evaluation_seed(number: int) -> int:
    """First seed of a round's evaluation. Raises ConfigurationError if no unseen one is left."""
    seed = EVALUATION_SEED + SEEDS_PER_ROUND * number
    if seed + SEEDS_PER_ROUND > FIRST_SEED:
        raise ConfigurationError(
            f"Round {number} has no unseen scenes.", hint="Name another --out."
        )
    return seed


def _numbers(number: int, rollouts: int) -> range:
    """Numbers of a round's shards."""
    return range(number * SHARDS_PER_ROUND, number * SHARDS_PER_ROUND + rollouts)
