"""How a policy learns: proximal policy optimisation."""

from jaxnew.ppo.advantages import gae
from jaxnew.ppo.config import PPOConfig
from jaxnew.ppo.gradient import TrainState
from jaxnew.ppo.learner import Learner
from jaxnew.ppo.objective import Hyperparameters

__all__ = ["Hyperparameters", "Learner", "PPOConfig", "TrainState", "gae"]
