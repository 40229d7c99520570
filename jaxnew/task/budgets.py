"""What a domain's budgets spend, and where the paper's baselines differ from domain to domain."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from jaxnew.policy.config import NetworkConfig
from jaxnew.ppo import Hyperparameters, PPOConfig
from jaxnew.representation.config import RepresentationConfig
from jaxnew.sampling import SetConfig
from jaxnew.storage import config as config_lib


@dataclass(frozen=True)
class StageOneBudget:
    """How much is spent on a representation.

    Attributes:
      num_recordings: recordings per action to collect.
      model: hyper-parameters, whose kind is asked for by name.
      checkpoint_every: gradient steps between checkpoints, which are five minutes apart at most.
      cost: what it takes; shown before it starts.
      vae_steps: gradient steps of the flat VAE; None: those of the HVAE.
      stores_drawn: recordings of a play with a drawing are drawn once and stored; else they are
        drawn for each batch. The numbers are the same.
      chunk_steps: gradient steps per compiled call; a kill loses as many at least, so that they
        should take less than five minutes.
      counts_epochs: the steps are those of the default split, and encoders that are trained on
        more or fewer actions take as many passes over them, not as many steps.
    """

    num_recordings: int
    model: RepresentationConfig
    checkpoint_every: int
    cost: str
    vae_steps: int | None = None
    stores_drawn: bool = False
    chunk_steps: int = 20
    counts_epochs: bool = False

    def vary(self, **changes: Any) -> StageOneBudget:
        """A budget that differs in some fields; `model__num_steps` is a field of a group.

        Raises:
          ConfigError: there is no such field, or it takes no such value.
        """
        return config_lib.vary(self, changes)

    def config(self, kind: str, num_actions: int, num_default: int) -> RepresentationConfig:
        """The hyper-parameters of an encoder.

        Args:
          kind: `hvae` or `vae`.
          num_actions: that it is trained on.
          num_default: that those of the default split are trained on.
        """
        config = replace(self.model, kind=kind)
        if kind == "vae" and self.vae_steps is not None:
            config = replace(config, num_steps=self.vae_steps)
        if not self.counts_epochs:
            return config
        per_pass, usually = (n // config.actions_per_batch for n in (num_actions, num_default))
        return replace(config, num_steps=config.num_steps * per_pass // usually)


@dataclass(frozen=True)
class LoopConfig:
    """The rhythm of policy training, in updates.

    Attributes:
      chunk_updates: updates per compiled call.
      evaluate_every: updates between evaluations on train and validation sets.
      evaluation_episodes: episodes per evaluation and split.
      evaluation_set_size: actions in its sets; 0 for `sets.size`.
      checkpoint_every: updates between `latest` checkpoints, which are five minutes apart at most.
    """

    chunk_updates: int = 5
    evaluate_every: int = 25
    evaluation_episodes: int = 640
    evaluation_set_size: int = 0
    checkpoint_every: int = 50

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            low = 0 if name == "evaluation_set_size" else 1
            if value < low:
                raise ValueError(f"{name}={value} must be at least {low}.")


@dataclass(frozen=True)
class StageTwoBudget:
    """How much is spent on a policy.

    Attributes:
      num_updates: rollouts with their gradient steps.
      ppo: shapes of the learner.
      sets: which sets it learns with.
      hyperparameters: its numbers.
      network: sizes of the policy's networks.
      loop: evaluations and checkpoints.
      final_episodes: episodes per split of an evaluation after training.
      cost: what it takes; shown before it starts.
    """

    num_updates: int
    final_episodes: int
    cost: str
    ppo: PPOConfig = field(default_factory=PPOConfig)
    sets: SetConfig = field(default_factory=SetConfig)
    hyperparameters: Hyperparameters = field(default_factory=Hyperparameters)
    network: NetworkConfig = field(default_factory=NetworkConfig)
    loop: LoopConfig = field(default_factory=LoopConfig)

    def vary(self, **changes: Any) -> StageTwoBudget:
        """A budget that differs in some fields; `group__field` is the field of a group.

        Example: `paper.vary(num_updates=500, ppo__lr_steps=8_192_000, cost="4 minutes")`.

        Raises:
          ConfigError: there is no such field, or it takes no such value.
        """
        return config_lib.vary(self, changes)


def foretold(preset: StageTwoBudget, config: Any) -> str:
    """What a run of a preset takes, and how many times its steps a config (`TrainConfig`) has."""
    usual = preset.num_updates * preset.ppo.steps_per_update
    return scaled_cost(preset.cost, steps=config.num_updates * config.ppo.steps_per_update / usual)


def scaled_cost(cost: str, **shares: float) -> str:
    """A preset's cost, and what a run has more or less of: `scaled_cost("1 hour", steps=0.5)`."""
    is_other = {what: abs(share - 1.0) > 0.01 for what, share in shares.items()}
    words = [f"{share:.2g} of its {what}" for what, share in shares.items() if is_other[what]]
    return f"{cost} for the preset; this has {' and '.join(words)}" if words else cost


@dataclass(frozen=True)
class Baselines:
    """Where the paper's baselines differ from domain to domain.

    Attributes:
      continuous_rollout_share: steps per update of the continuous output over those of ours.
      sums_gaussian_entropy: its entropy is summed over dimensions instead of averaged.
      fixed_set: `ids -> ids` of the one set that the utility policy scores where it is trained
        without subsampling.
      fixed_set_minibatches: minibatches per pass of the utility policy without subsampling; 0 for
        as many as with it.
      finetune_share: updates of fine-tuning on new actions over those of training.
    """

    continuous_rollout_share: float = 1.0
    sums_gaussian_entropy: bool = False
    fixed_set: Callable[[np.ndarray], np.ndarray] = lambda ids: ids
    fixed_set_minibatches: int = 0
    finetune_share: float = 1.0
