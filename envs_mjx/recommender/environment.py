"""The Recommender task: products for a user until the user leaves (docs/recommender.md).

The user browses alone (*organic*), waits for a recommendation (*bandit*) or has left (*stop*). Each
*tick* moves the user's taste; a stretch of browsing is several ticks, which are drawn at once.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from envs_mjx.recommender.products import VECTOR_SIZE, product_constants, product_vectors
from jaxnew.environment import Action, ActionSpec, Environment, Info, ObservationSpec, Transition

ORGANIC, BANDIT, STOP = range(3)

# Mode after a tick, by mode before it (docs/recommender.md, "Ticks").
TRANSITIONS = np.array([[0.74, 0.25, 0.01], [0.05, 0.94, 0.01], [0.0, 0.0, 1.0]])
_DRIFT = 0.1  # Of taste per tick, times |N(0, 1)|.


@dataclass(frozen=True)
class RecommenderSettings:
    """What a run may set; the default is the published task.

    Attributes:
      max_recommendations: recommendations after which an episode is cut, 1 or more.

    Raises:
      ValueError: the number is out of its range.
    """

    max_recommendations: int = 100

    def __post_init__(self) -> None:
        if self.max_recommendations < 1:
            raise ValueError(f"max_recommendations={self.max_recommendations} must be 1 or more.")


@struct.dataclass
class RecommenderParams:
    """Numbers of the task; all are traced, so none needs a new compilation.

    Attributes:
      product_vectors: f32[A, 16] beta.
      product_constants: f32[A] mu.
      max_recommendations: int32[] recommendations after which an episode is cut.
    """

    product_vectors: jax.Array
    product_constants: jax.Array
    max_recommendations: jax.Array | int = RecommenderSettings.max_recommendations


@struct.dataclass
class RecommenderState:
    """One user.

    Attributes:
      omega: f32[16] taste.
      mode: int32[] `ORGANIC`, `BANDIT` or `STOP`; never organic between two steps.
      num_recommendations: int32[] so far in the episode.
      num_clicks: int32[] of them that were clicked.
    """

    omega: jax.Array
    mode: jax.Array
    num_recommendations: jax.Array
    num_clicks: jax.Array


class Recommender(Environment[RecommenderState, RecommenderParams]):
    """Recommend products so that the user clicks them.

    Actions: 10,000 products, `action.id`. An id that does not exist is never clicked.
    Observation: f32[16] `omega / |omega|`; mode, norm and history are hidden.
    Reward: 1.0 for a click, else 0.0.
    Ends: `terminated` when the user has left; `truncated` after `max_recommendations`.
    Starts: taste from N(0, I), then one stretch of browsing, after which 1 user in 26 has already
      left: such an episode ends after its first recommendation unless that is clicked.
    Parameters: `RecommenderParams`.
    Info: `click_through_rate` f32[] clicks per recommendation so far, `num_clicks` int32[],
      `episode_length` int32[] recommendations so far, `invalid_action` bool[]; from `step` also
      `final_observation` f32[16].
    """

    name = "Recommender-v0"
    episode_metrics = ("click_through_rate", "num_clicks", "episode_length")

    def __init__(self, max_recommendations: int = RecommenderSettings.max_recommendations) -> None:
        """Takes the fields of `RecommenderSettings`, which become `default_params`.

        Raises:
          ValueError: a number is out of its range.
        """
        self._settings = RecommenderSettings(max_recommendations)

    @property
    def default_params(self) -> RecommenderParams:
        """The published products, and the task as it was set."""
        return RecommenderParams(
            jnp.asarray(product_vectors()),
            jnp.asarray(product_constants()),
            jnp.int32(self._settings.max_recommendations),
        )

    @property
    def action_spec(self) -> ActionSpec:
        """10,000 products, no position, no stop bit."""
        return ActionSpec(num_actions=len(product_constants()))

    def observation_spec(self, params: RecommenderParams) -> ObservationSpec:
        """f32[16] of length 1."""
        del params
        return ObservationSpec(
            shape=(VECTOR_SIZE,),
            dtype=jnp.float32,
            low=-1.0,
            high=1.0,
            constant=np.zeros(VECTOR_SIZE, bool),
        )

    def max_episode_steps(self, params: RecommenderParams) -> int:
        """`max_recommendations`; `params` must be concrete."""
        return int(params.max_recommendations)

    def reset_env(
        self, key: jax.Array, params: RecommenderParams
    ) -> tuple[jax.Array, RecommenderState]:
        """Draws a user; consumes `key`. Returns (obs f32[16], state)."""
        del params
        key_omega, key_session, key_drift = jax.random.split(key, 3)
        num_ticks, mode = _browsing_session(key_session)
        omega = jax.random.normal(key_omega, (VECTOR_SIZE,), jnp.float32)
        omega = _drift(key_drift, omega, num_ticks)
        state = RecommenderState(omega, mode, jnp.int32(0), jnp.int32(0))
        return _observe(state), state

    def step_env(
        self,
        key: jax.Array,
        state: RecommenderState,
        action: Action,
        params: RecommenderParams,
    ) -> Transition:
        """One recommendation, without auto-reset; consumes `key`.

        Args:
          state: of an episode in progress; what follows an end is undefined.
          action: only `action.id` int32[] is read.

        Returns:
          (obs f32[16], state, reward f32[], terminated bool[], truncated bool[], info).
        """
        key_click, key_mode, key_session, key_drift = jax.random.split(key, 4)
        num_products = params.product_constants.shape[0]
        is_valid = (action.id >= 0) & (action.id < num_products)
        product = jnp.clip(action.id, 0, num_products - 1)
        logit = params.product_vectors[product] @ state.omega + params.product_constants[product]
        is_clicked = is_valid & jax.random.bernoulli(key_click, click_probability(logit))

        # A click sends the user browsing, whatever the tick says: it cancels a stop.
        mode = jnp.where(is_clicked, ORGANIC, _next_mode(key_mode, state.mode))
        session_ticks, session_mode = _browsing_session(key_session)
        is_browsing = mode == ORGANIC
        num_ticks = 1 + jnp.where(is_browsing, session_ticks, 0)
        next_state = RecommenderState(
            omega=_drift(key_drift, state.omega, num_ticks),
            mode=jnp.where(is_browsing, session_mode, mode),
            num_recommendations=state.num_recommendations + 1,
            num_clicks=state.num_clicks + is_clicked.astype(jnp.int32),
        )
        terminated = next_state.mode == STOP
        truncated = ~terminated & (next_state.num_recommendations >= params.max_recommendations)
        info: Info = {
            "click_through_rate": next_state.num_clicks.astype(jnp.float32)
            / next_state.num_recommendations.astype(jnp.float32),
            "num_clicks": next_state.num_clicks,
            "episode_length": next_state.num_recommendations,
            "invalid_action": ~is_valid,
        }
        reward = is_clicked.astype(jnp.float32)
        return _observe(next_state), next_state, reward, terminated, truncated, info


def click_probability(logit: jax.Array) -> jax.Array:
    """Probability that a product is clicked, f32[...] in (0.012982, 0.731059).

    `sig(14 sig(2 sig(0.3 x) - 2) - 6)`: docs/recommender.md, "Click probability".

    Args:
      logit: f32[...] `beta . omega + mu`.
    """
    return jax.nn.sigmoid(14.0 * jax.nn.sigmoid(2.0 * jax.nn.sigmoid(0.3 * logit) - 2.0) - 6.0)


def _next_mode(key: jax.Array, mode: jax.Array) -> jax.Array:
    """int32[] the mode after a tick; consumes `key`."""
    cumulative = jnp.asarray(np.cumsum(TRANSITIONS, axis=1)[:, :-1], jnp.float32)[mode]
    is_past = jax.random.uniform(key, (), jnp.float32) >= cumulative
    return jnp.sum(is_past, dtype=jnp.int32)


def _browsing_session(key: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Ticks of a stretch of browsing, int32[] >= 1, and the mode it leads to; consumes `key`.

    Every tick leaves with probability 0.26, so their number is geometric; where to is independent
    of it (docs/recommender.md, "Browsing").
    """
    key_ticks, key_exit = jax.random.split(key)
    stays, to_bandit, to_stop = TRANSITIONS[ORGANIC]
    num_ticks = jax.random.geometric(key_ticks, np.float32(1.0 - stays), dtype=jnp.int32)
    is_over = jax.random.bernoulli(key_exit, np.float32(to_stop / (to_bandit + to_stop)))
    return num_ticks, jnp.where(is_over, jnp.int32(STOP), BANDIT)


def _drift(key: jax.Array, omega: jax.Array, num_ticks: jax.Array) -> jax.Array:
    """f32[16] taste after `num_ticks` >= 1 ticks; consumes `key`.

    A tick adds `0.1 |n| N(0, I)` with one `n ~ N(0, 1)` for all coordinates. Normal variables add
    by their variances, so k ticks add `0.1 sqrt(Q) N(0, I)` with Q chi-square of k degrees of
    freedom: the same distribution without a loop.
    """
    key_scale, key_direction = jax.random.split(key)
    squares = jax.random.chisquare(key_scale, num_ticks.astype(jnp.float32), dtype=jnp.float32)
    direction = jax.random.normal(key_direction, omega.shape, jnp.float32)
    return omega + _DRIFT * jnp.sqrt(squares) * direction


def _observe(state: RecommenderState) -> jax.Array:
    """f32[16] the direction of the taste."""
    return state.omega / jnp.linalg.norm(state.omega)
