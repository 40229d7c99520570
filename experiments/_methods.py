"""What `--method` names: a policy of `jaxnew.policy` with the settings it is trained with.

Spec method 8 lists what each baseline and ablation changes; everything else is as for ours.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from experiments._flags import UsageError
from jaxnew.actions import ActionSplit
from jaxnew.environment import ActionSpec
from jaxnew.policy.method import METHODS, MethodContext, PolicyMethod, make_method
from jaxnew.task import StageTwoBudget, Task

_FIXED_SET_NUMBERS = 2**14  # Scored action and state pairs per microbatch that stay in the caches.


@dataclass(frozen=True)
class Variant:
    """One method of the paper.

    Attributes:
      policy: its name in `jaxnew.policy.METHODS`.
      has_fixed_set: trained with one set of actions that never changes.
      scores_fixed_set: it scores every action of that set, so that microbatches must be smaller.
      is_without_entropy: its entropy coefficient is 0.
      is_continuous: its output is a point, not a choice.
    """

    policy: str
    has_fixed_set: bool = False
    scores_fixed_set: bool = False
    is_without_entropy: bool = False
    is_continuous: bool = False


VARIANTS = {
    "ours": Variant("ours"),
    "no-subsampling": Variant("ours", has_fixed_set=True, scores_fixed_set=True),
    "no-entropy": Variant("ours", is_without_entropy=True),
    "continuous": Variant("continuous", is_continuous=True),
    "nearest-neighbour": Variant("discrete", has_fixed_set=True),
    "random": Variant("random"),
}


def variant_of(name: str) -> Variant:
    """The variant called `name`; a policy of `METHODS` is one without special settings.

    Raises:
      UsageError: there is none of that name.
    """
    if name in VARIANTS:
        return VARIANTS[name]
    if name in METHODS:
        return Variant(name)
    raise UsageError(f"Unknown method {name!r}; choose one of {', '.join(VARIANTS)}.")


def trained_ids(name: str, task: Task, split: ActionSplit, part: str = "train") -> np.ndarray:
    """int32[n] the actions of a part of the split that a method is trained with."""
    ids = split.ids(part)
    return task.baselines.fixed_set(ids) if variant_of(name).scores_fixed_set else ids


def adapted(budget: StageTwoBudget, name: str, task: Task, split: ActionSplit) -> StageTwoBudget:
    """The budget of a task as a method spends it."""
    variant = variant_of(name)
    ppo, hyperparameters = budget.ppo, budget.hyperparameters
    rollout = replace(ppo.rollout, has_fixed_set=variant.has_fixed_set)
    if variant.is_continuous:
        share = task.baselines.continuous_rollout_share
        rollout = replace(rollout, num_steps=round(rollout.num_steps * share))
        budget = replace(budget, num_updates=round(budget.num_updates / share))
    if variant.scores_fixed_set and ppo.microbatch_size:
        wanted = _FIXED_SET_NUMBERS // len(trained_ids(name, task, split))
        size = 2 ** max(2, int(np.log2(max(1, wanted))))
        ppo = replace(ppo, microbatch_size=min(size, ppo.microbatch_size))
    if variant.is_without_entropy:
        hyperparameters = replace(hyperparameters, entropy_coefficient=0.0)
    return replace(budget, ppo=replace(ppo, rollout=rollout), hyperparameters=hyperparameters)


def method_of(
    name: str,
    task: Task,
    split: ActionSplit,
    part: str = "train",
    *,
    action_spec: ActionSpec | None = None,
    conditions_position: bool = False,
) -> PolicyMethod:
    """The policy behind a variant that is trained with a part of the split.

    Args:
      action_spec: of the domain, for what comes with a choice there.
      conditions_position: see `MethodContext`.
    """
    context = MethodContext(
        train_ids=trained_ids(name, task, split, part),
        sums_gaussian_entropy=task.baselines.sums_gaussian_entropy,
        action_spec=action_spec,
        conditions_position=conditions_position,
    )
    return make_method(variant_of(name).policy, context)
