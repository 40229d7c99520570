"""Actions that a policy was not trained with, as a table describes them (paper algorithm 2)."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxnew.actions import ActionIdentity, ActionUniverse, SplitMismatch
from jaxnew.ppo import Learner
from jaxnew.representation.table import RepresentationTable
from jaxnew.task.places import UsageError
from jaxnew.task.settings import with_settings
from jaxnew.task.task import Task
from jaxnew.trainer import Trainer, policy_of, rollout_of

OTHER_ENCODER, UNKNOWN_ACTIONS = "other-encoder", "unknown-actions"
ALLOWANCES = (OTHER_ENCODER, UNKNOWN_ACTIONS)
_EXAMPLES = 3


@dataclass(frozen=True)
class Offered:
    """What plays with the actions of a table.

    Attributes:
      trainer: with the environments that have these actions; the run's own if they do.
      ids: int32[n] the actions, as these environments number them.
      vectors: f32[R, d] row i describes action i of theirs; the rest is for the policy alone.
      identity: what the actions are.
      num_seen: how many of them the policy was trained with.
    """

    trainer: Trainer
    ids: np.ndarray
    vectors: Any
    identity: ActionIdentity
    num_seen: int

    def describe(self) -> dict[str, Any]:
        """Plain JSON for a record."""
        return {
            "universe": self.identity.universe,
            "num_seen": self.num_seen,
            "examples": list(self.identity.names[:_EXAMPLES]),
        }


def offer(
    trainer: Trainer,
    table: RepresentationTable,
    universe: str = "",
    allow: Collection[str] = (),
) -> Offered:
    """The actions of a table, found in the environments by what they do, not by their numbers.

    Args:
      trainer: of the run.
      table: of one or more actions.
      universe: that they are looked for in, see `Task.with_universe`; default: the run's own, and
        then the one that the table names.
      allow: `other-encoder`: the vectors are another encoder's, or a user's own;
        `unknown-actions`: the table does not say what its actions are, and its ids are taken as
        those of the universe.

    Raises:
      UsageError: the vectors have another width, or there is no such universe or allowance.
      SplitMismatch: the vectors are not those of the run's encoder, or the environments do not
        have the actions.
    """
    unknown = sorted(set(allow) - set(ALLOWANCES))
    if unknown:
        raise UsageError(f"allow={unknown[0]!r} is none of {', '.join(ALLOWANCES)}.")
    own = trainer.training.table
    if table.vectors.shape[1] != own.shape[1]:
        raise UsageError(
            f"The new table has {table.vectors.shape[1]} numbers per action; the policy reads "
            f"{own.shape[1]}."
        )
    if table.made_by != trainer.table.made_by and OTHER_ENCODER not in allow:
        raise SplitMismatch(
            f"The table ({table.source}) is of encoder {table.made_by}, the policy learned with "
            f"{trainer.table.made_by} ({trainer.table.source}): its vectors mean something else. "
            "Encode the actions with the run's own encoder (embed --checkpoint), or, if you know "
            f"better, allow {OTHER_ENCODER}."
        )
    task, known, ids = _find(trainer.task, table, universe, UNKNOWN_ACTIONS in allow)
    identity = ActionIdentity.of(known, ids, task.universe_name)
    first = trainer.task.make_universe()
    trained = ActionIdentity.of(first, trainer.split.ids(trainer.config.trained_on))
    num_seen = len(set(identity.hashes) & set(trained.hashes))
    vectors = jnp.zeros((known.num_actions, own.shape[1]), own.dtype)
    if task is trainer.task:
        vectors = vectors.at[: len(own)].set(own)
    else:
        # Behind the new actions stand the old ones, which policies may compare them with.
        vectors = jnp.concatenate([vectors, own])
        trainer, always, rows = _moved(trainer, task, known, first)
        vectors = vectors.at[jnp.asarray(always)].set(own[rows])
    vectors = vectors.at[jnp.asarray(ids)].set(jnp.asarray(table.vectors))
    return Offered(trainer, ids, vectors, identity, num_seen)


def _find(
    task: Task, table: RepresentationTable, universe: str, is_unknown_allowed: bool
) -> tuple[Task, ActionUniverse, np.ndarray]:
    """The task that has the actions of a table, its universe, and int32[n] their ids in it."""
    if table.identity is None:
        task = task.with_universe(universe)
        known = task.make_universe()
        if not is_unknown_allowed:
            raise SplitMismatch(
                f"The table ({table.source}) does not say what its actions are, so ids such as "
                f"{table.ids[0]} may mean anything. Record them with collect --output, or, if they "
                f"are ids of {known.name}, allow {UNKNOWN_ACTIONS}."
            )
        if table.ids.max() >= known.num_actions:
            raise SplitMismatch(
                f"The table ({table.source}) has ids up to {table.ids.max()}; {known.name} has "
                f"0..{known.num_actions - 1}."
            )
        return task, known, table.ids
    tried: list[str] = []
    for name in (universe,) if universe else ("", table.identity.place):
        there = task.with_universe(name)
        known = there.make_universe()
        ids = table.identity.find(table.ids, known)
        if (ids >= 0).all():
            return there, known, ids
        missing = table.identity.names[int(np.argmin(ids))]
        tried.append(f"{known.name} lacks {np.sum(ids < 0)} of them, e.g. {missing!r}")
    raise SplitMismatch(
        f"The table ({table.source}) describes {len(table.ids)} actions of "
        f"{table.identity.universe}; {'; '.join(dict.fromkeys(tried))}. Name the universe that has "
        "them (--universe)."
    )


def _moved(
    trainer: Trainer, task: Task, known: ActionUniverse, first: ActionUniverse
) -> tuple[Trainer, np.ndarray, np.ndarray]:
    """The run's policy in the environments of another universe.

    Returns:
      The trainer, whose always available actions are those of the universe; int32[q] these; and
      int32[q] the same in the run's own universe.
    """
    split, config, n = trainer.split, trainer.config, known.num_actions
    rows = split.always_available
    always = ActionIdentity.of(first, rows).find(rows, known)
    if (always < 0).any():
        lacking = first.action_names[int(rows[np.argmin(always)])]
        raise SplitMismatch(
            f"{known.name} lacks {lacking!r}, which is always available in this task."
        )
    behind = {
        part: getattr(split, part) + n
        for part in ("train", "validation", "test", "always_available")
    }
    task = with_settings(task, config)
    method = policy_of(config, task, replace(split, **behind), split, trainer.table)
    rollout = rollout_of(task, method, config.ppo, config.seed, trainer.num_workers)
    moved = replace(
        trainer,
        task=task,
        split=replace(split, **{**behind, "always_available": always}),
        learner=Learner(rollout, config.ppo),
    )
    return moved, always, rows
