"""Recommender: what it is made of, and what each budget spends (docs/recommender.md)."""

from __future__ import annotations

import numpy as np

from envs_mjx.recommender import Recommender, RecommenderSettings, product_universe
from jaxnew.actions import random_halves_split
from jaxnew.ppo import Hyperparameters, PPOConfig
from jaxnew.rollout.contract import RolloutConfig
from jaxnew.sampling import SetConfig
from jaxnew.task.budgets import Baselines, LoopConfig, StageTwoBudget
from jaxnew.task.presentation import Measured, Presentation
from jaxnew.task.task import Task

_PAPER = StageTwoBudget(
    num_updates=4882,
    final_episodes=5000,
    cost="about 2 hours on one core",
    # Microbatches of 32 transitions keep their 500 x 32 x 64 numbers in the caches.
    ppo=PPOConfig(rollout=RolloutConfig(num_steps=256), microbatch_size=32),
    sets=SetConfig(size=500),
    hyperparameters=Hyperparameters(entropy_coefficient=0.01),
    # During training, sets of 50 products; sets of 500 are for the reported numbers.
    loop=LoopConfig(evaluate_every=20, evaluation_episodes=160, evaluation_set_size=50),
)


TASK = Task(
    name="recommender",
    make_environment=Recommender,
    environment=RecommenderSettings(),
    make_universe=product_universe,
    splits={"default": random_halves_split},
    stage_two={
        "smoke": _PAPER.vary(
            num_updates=4,
            final_episodes=128,
            cost="seconds",
            ppo__rollout__num_envs=8,
            ppo__rollout__num_steps=32,
            ppo__microbatch_size=0,
            ppo__lr_steps=1024,
            sets__size=50,
            loop__chunk_updates=2,
            loop__evaluate_every=2,
            loop__evaluation_episodes=64,
            loop__evaluation_set_size=20,
            loop__checkpoint_every=2,
        ),
        "laptop": _PAPER.vary(
            num_updates=250,
            ppo__lr_steps=250 * _PAPER.ppo.steps_per_update,
            cost="about 6 minutes on one core",
        ),
        "paper": _PAPER,
        # Fully observable: twice the steps.
        "paper-mu": _PAPER.vary(
            num_updates=9765, ppo__lr_steps=80_000_000, cost="about 4 hours on one core"
        ),
    },
    selection_metric="click_through_rate",
    # 2,000 of the products, drawn once.
    baselines=Baselines(
        fixed_set=lambda ids: np.random.RandomState(42).choice(ids, 2000, replace=False)
    ),
    shown=Presentation(
        paper_environment="Recommender",
        measured=Measured(
            training={
                "ours": 5_800,
                "continuous": 15_600,
                "nearest-neighbour": 6_500,
                "no-subsampling": 3_100,
            },
            evaluation=400,
        ),
        anchors="experiments.untrained.recommender:measure_anchors",
    ),
)
