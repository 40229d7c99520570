"""How a policy learns: proximal policy optimisation."""

from jaxnew.ppo.advantages import gae
from jaxnew.ppo.learner import Learner, PPOConfig, TrainState
from jaxnew.ppo.objective import Hyperparameters

__all__ = ["Hyperparameters", "Learner", "PPOConfig", "TrainState", "gae"]
