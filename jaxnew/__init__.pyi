"""What `jaxnew` exports, for type checkers; see `__init__.py`."""

from jaxnew.actions import ActionSplit as ActionSplit
from jaxnew.actions import ActionUniverse as ActionUniverse
from jaxnew.checks.environment import check_environment as check_environment
from jaxnew.checks.policy import check_method as check_method
from jaxnew.comparison import Comparison as Comparison
from jaxnew.comparison import compare as compare
from jaxnew.embedding import Encoder as Encoder
from jaxnew.embedding import embed as embed
from jaxnew.environment import Action as Action
from jaxnew.environment import Environment as Environment
from jaxnew.environment import FixedActionSet as FixedActionSet
from jaxnew.observations import Recordings as Recordings
from jaxnew.policy.config import NetworkConfig as NetworkConfig
from jaxnew.policy.method import MethodContext as MethodContext
from jaxnew.policy.method import PolicyMethod as PolicyMethod
from jaxnew.policy.method import make_method as make_method
from jaxnew.ppo import Hyperparameters as Hyperparameters
from jaxnew.ppo import Learner as Learner
from jaxnew.ppo import PPOConfig as PPOConfig
from jaxnew.recording import collect as collect
from jaxnew.recording import record as record
from jaxnew.representation.config import RepresentationConfig as RepresentationConfig
from jaxnew.representation.learner import RepresentationLearner as RepresentationLearner
from jaxnew.representation.table import RepresentationTable as RepresentationTable
from jaxnew.results import Evaluation as Evaluation
from jaxnew.rollout.contract import Episode as Episode
from jaxnew.rollout.contract import Policy as Policy
from jaxnew.rollout.contract import Rollout as Rollout
from jaxnew.rollout.contract import RolloutConfig as RolloutConfig
from jaxnew.rollout.device import DeviceRollout as DeviceRollout
from jaxnew.rollout.host import HostRollout as HostRollout
from jaxnew.run import Run as Run
from jaxnew.runs import Runs as Runs
from jaxnew.sampling import ActionPool as ActionPool
from jaxnew.sampling import Actions as Actions
from jaxnew.sampling import AvailableSet as AvailableSet
from jaxnew.sampling import draw_sets as draw_sets
from jaxnew.sweeping import sweep as sweep
from jaxnew.task.domain import Domain as Domain
from jaxnew.task.domain import load_task as load_task
from jaxnew.task.task import Task as Task
from jaxnew.trainer import Trainer as Trainer
from jaxnew.training import finetune as finetune
from jaxnew.training import train as train

__version__: str
