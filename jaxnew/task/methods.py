"""What a method is: a policy of `jaxnew.policy` with the settings it is trained with.

What each baseline and ablation changes stands in `docs/method.md`, "Baselines and ablations";
everything else is as for ours.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from jaxnew.actions import ActionSplit
from jaxnew.environment import ActionSpec
from jaxnew.policy.config import NetworkConfig
from jaxnew.policy.method import METHODS, MethodContext, PolicyMethod, make_method
from jaxnew.task.budgets import StageTwoBudget
from jaxnew.task.places import UsageError, load_place
from jaxnew.task.task import Task

_FIXED_SET_NUMBERS = 2**14  # Scored action and state pairs per microbatch that stay in the caches.


@dataclass(frozen=True)
class Variant:
    """One method: ours, those that the paper compares it with, and those that go beyond it.

    Attributes:
      policy: its name in `jaxnew.policy.METHODS`, or the `package.module:NAME` of a user's own.
      scores_fixed_set: it scores every action of one set that never changes, so that microbatches
        must be smaller.
      is_continuous: its output is a point, not a choice.
      training_share: of the actions of a set, those that are there in episodes that are learned
        from.
      minibatch_factor: times as many minibatches per pass as the budget has; its greatest divisor
        by which they can be divided.
      changes: fields of the budget that differ, as `StageTwoBudget.vary` takes them.
    """

    policy: str
    scores_fixed_set: bool = False
    is_continuous: bool = False
    training_share: float = 1.0
    minibatch_factor: int = 1
    changes: Mapping[str, Any] = field(default_factory=dict)


_ONE_SET = {"sets__is_fixed": True}  # Of all train actions, which never changes.

VARIANTS = {
    "ours": Variant("ours"),
    "modulated": Variant(
        "modulated",
        training_share=0.5,
        minibatch_factor=8,
        changes={
            "ppo__num_epochs": 2,
            "network__state_width": 256,
            "hyperparameters__representation_noise": 0.2,
            "hyperparameters__final_entropy": 0.1,
        },
    ),
    "no-subsampling": Variant("ours", scores_fixed_set=True, changes=_ONE_SET),
    "no-entropy": Variant("ours", changes={"hyperparameters__entropy_coefficient": 0.0}),
    "continuous": Variant("continuous", is_continuous=True),
    "nearest-neighbour": Variant("discrete", changes=_ONE_SET),
    "random": Variant("random"),
}


_ALLOWED = (
    f"Methods: {', '.join(VARIANTS)}; or give package.module:NAME for one of your own, a function "
    "or class that takes a jaxnew.policy.method.MethodContext and makes a PolicyMethod."
)
# What a policy must have, read off the protocol.
MEMBERS = [n for n in (*PolicyMethod.__annotations__, *vars(PolicyMethod)) if n[0] != "_"]


def variant_of(name: str) -> Variant:
    """The variant called `name`; a policy of `METHODS`, or one of the user's own that is given by
    its place `package.module:NAME`, is one without special settings.

    Raises:
      UsageError: there is none of that name or at that place.
    """
    if name in VARIANTS:
        return VARIANTS[name]
    if ":" in name:
        load_method(name)
    elif name not in METHODS:
        raise UsageError(f"Unknown method {name!r}. {_ALLOWED}")
    return Variant(name)


def load_method(place: str) -> Callable[[MethodContext], PolicyMethod]:
    """What makes a policy of the user's own.

    Raises:
      UsageError: there is nothing at `place`, or nothing that can be called with a `MethodContext`.
    """
    make = load_place(place, f"method {place!r}", _ALLOWED)
    if not callable(make):
        raise UsageError(f"{place} is {make!r}, which cannot be called. {_ALLOWED}")
    try:
        inspect.signature(make).bind(MethodContext())
    except TypeError as err:
        raise UsageError(f"{place} cannot be called with one argument: {err}. {_ALLOWED}") from err
    return make


def file_name(method: str) -> str:
    """A method's name as part of a file name: a place without its colon and dots."""
    return method.replace(":", "-").replace(".", "-")


def trained_ids(name: str, task: Task, split: ActionSplit, part: str = "train") -> np.ndarray:
    """int32[n] the actions of a part of the split that a method is trained with."""
    ids = split.ids(part)
    return task.baselines.fixed_set(ids) if variant_of(name).scores_fixed_set else ids


def learned_ids(name: str, task: Task, split: ActionSplit, part: str = "train") -> np.ndarray:
    """int32[n] the same, and before them those that are always available."""
    return np.concatenate([split.always_available, trained_ids(name, task, split, part)])


def adapted(budget: StageTwoBudget, name: str, task: Task, split: ActionSplit) -> StageTwoBudget:
    """The budget of a task as a method spends it."""
    variant = variant_of(name)
    budget = budget.vary(**variant.changes)
    ppo = budget.ppo
    if variant.is_continuous:
        share = task.baselines.continuous_rollout_share
        num_steps = round(ppo.rollout.num_steps * share)
        ppo = replace(ppo, rollout=replace(ppo.rollout, num_steps=num_steps))
        budget = replace(budget, num_updates=round(budget.num_updates / share))
    if variant.scores_fixed_set and ppo.microbatch_size:
        wanted = _FIXED_SET_NUMBERS // len(trained_ids(name, task, split))
        size = 2 ** max(2, int(np.log2(max(1, wanted))))
        ppo = replace(ppo, microbatch_size=min(size, ppo.microbatch_size))
    if variant.scores_fixed_set and task.baselines.fixed_set_minibatches:
        ppo = replace(ppo, num_minibatches=task.baselines.fixed_set_minibatches)
    parts = ppo.minibatch_size // (ppo.microbatch_size or 1)
    factor = math.gcd(parts, variant.minibatch_factor)
    ppo = replace(ppo, num_minibatches=ppo.num_minibatches * factor)
    sets = budget.sets
    if variant.training_share < 1.0:
        sets = replace(sets, training_size=math.ceil(sets.size * variant.training_share))
    return replace(budget, ppo=ppo, sets=sets)


def method_of(
    name: str,
    task: Task,
    split: ActionSplit,
    part: str = "train",
    *,
    action_spec: ActionSpec | None = None,
    conditions_position: bool = False,
    network: NetworkConfig | None = None,
    representations: np.ndarray | None = None,
) -> PolicyMethod:
    """The policy behind a variant that is trained with a part of the split.

    Args:
      action_spec: of the domain, for what comes with a choice there.
      conditions_position: see `MethodContext`.
      network: sizes; None: the paper's.
      representations: see `MethodContext`.
    """
    context = MethodContext(
        train_ids=learned_ids(name, task, split, part),
        sums_gaussian_entropy=task.baselines.sums_gaussian_entropy,
        action_spec=action_spec,
        conditions_position=conditions_position,
        network=network or NetworkConfig(),
        representations=representations,
    )
    policy = variant_of(name).policy
    if ":" not in policy:
        return make_method(policy, context)
    method = load_method(policy)(context)
    lacking = [member for member in MEMBERS if not hasattr(method, member)]
    if lacking:
        raise UsageError(
            f"{policy} made {method!r}, which lacks {', '.join(lacking)}. A policy needs "
            f"{', '.join(MEMBERS)}; see jaxnew.policy.PolicyMethod."
        )
    return method
