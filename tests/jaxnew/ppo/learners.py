"""A small learner on a probe environment, for the tests beside this file."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np

from jaxnew.policy import make_method
from jaxnew.ppo import Learner, PPOConfig
from jaxnew.rollout.contract import RolloutConfig
from jaxnew.rollout.device import DeviceRollout
from jaxnew.sampling import Actions
from tests import probe_environments as probe

N, T, A, M, WIDTH, D = 4, 8, 7, 4, 5, 3  # Sets drawn by sorting, which compiles faster.
CONFIG = PPOConfig(
    rollout=RolloutConfig(num_envs=N, num_steps=T),
    num_epochs=2,
    num_minibatches=2,
    microbatch_size=4,
    lr_steps=10 * N * T,
)
BOOTSTRAPPED = replace(
    CONFIG,
    rollout=replace(CONFIG.rollout, bootstraps_time_limits=True),
    time_limits_are_ends=False,
)
TABLE = np.random.default_rng(0).normal(size=(A, D)).astype(np.float32)
ACTIONS = Actions.of(TABLE, np.arange(A), M, padded_size=WIDTH)
NO_STEP = jnp.int32(0)


def learner_of(config: PPOConfig, method: str = "ours") -> Learner:
    policy = make_method(method)
    return Learner(
        DeviceRollout(probe.TableWorld(A), probe.ladder(A), policy, config.rollout), config
    )
