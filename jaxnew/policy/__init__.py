"""Stage 2: what acts. A policy scores any list of action representations."""

from jaxnew.policy.distributions import Categorical
from jaxnew.policy.method import (
    METHODS,
    PolicyMethod,
    distribution_and_value,
    make_method,
    method_of_evaluations,
)
from jaxnew.policy.utility import UtilityMethod

__all__ = [
    "METHODS",
    "Categorical",
    "PolicyMethod",
    "UtilityMethod",
    "distribution_and_value",
    "make_method",
    "method_of_evaluations",
]
