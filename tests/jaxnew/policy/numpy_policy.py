"""Utility policies in float64 NumPy, on parameters of `UtilityMethod` and `ModulatedMethod`.

Written from `docs/method.md`, "Policy networks".
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import numpy as np


def dense(layer: dict[str, Any], x: np.ndarray) -> np.ndarray:
    return x @ np.asarray(layer["kernel"], np.float64) + np.asarray(layer["bias"], np.float64)


def relu(x: np.ndarray) -> np.ndarray:
    return np.maximum(x, 0.0)


def encode(
    layers: dict[str, Any], obs: np.ndarray, activation: Callable[..., np.ndarray] = np.tanh
) -> np.ndarray:
    """Two dense layers, each with its activation."""
    hidden = activation(dense(layers["Dense_0"], np.asarray(obs, np.float64)))
    return activation(dense(layers["Dense_1"], hidden))


def value(params: dict[str, Any], obs: np.ndarray) -> np.ndarray:
    """f64[...] the critic: a trunk of its own and dense 1."""
    critic = params["critic"]
    return dense(critic["value"], encode(critic["VectorEncoder_0"], obs))[..., 0]


def utilities(params: dict[str, Any], obs: np.ndarray, representations: np.ndarray) -> np.ndarray:
    """f64[..., m] from obs [..., n] and representations [..., m, d]:

    a_i = Lin(d,64)(c_i);  u_i = Lin(64,1)( ReLU( Lin(128,64)( [f(s), a_i] ) ) ).
    """
    utility = params["utility"]
    features = encode(params["encoder"], obs)
    embedded = dense(utility["embed"], np.asarray(representations, np.float64))
    features = np.broadcast_to(features[..., None, :], (*embedded.shape[:-1], features.shape[-1]))
    hidden = dense(utility, np.concatenate([features, embedded], axis=-1))
    return dense(utility["score"], relu(hidden))[..., 0]


def modulated(
    params: dict[str, Any], obs: np.ndarray, representations: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """f64[..., m] utilities and f64[..., m, 4] log-odds of a failure:

    a_i = ReLU( Lin(d,w)(c_i) );  x_i = ReLU( Lin(2w,h)( [f(s), a_i] ) );
    u_i = Lin(w,h)(f(s)) . x_i;

    and for each of the heads, with k = 32 numbers in its own hidden layer,

    x_i = ReLU( Lin(2w,k)( [f(s), a_i] ) );  o_i = Lin(w,k)(f(s)) . x_i + Lin(w,1)(f(s)).
    """
    utility, failure = params["utility"], params["failure"]
    features = encode(params["encoder"], obs, relu)
    embedded = relu(dense(utility["embed"], np.asarray(representations, np.float64)))
    repeated = np.repeat(features[..., None, :], embedded.shape[-2], axis=-2)
    hidden = relu(dense(utility, np.concatenate([repeated, embedded], axis=-1)))
    scores = np.einsum("...h,...mh->...m", dense(utility["score"], features), hidden)
    odds = []
    of_state = np.asarray(failure["of_state"]["kernel"], np.float64)
    weights = dense(failure["weights"], features)
    for head in range(4):
        mine, last = slice(32 * head, 32 * head + 32), slice(33 * head, 33 * head + 33)
        of_action = {name: x[..., mine] for name, x in failure["of_action"].items()}
        hidden = relu((features @ of_state[:, mine])[..., None, :] + dense(of_action, embedded))
        of_head = weights[..., last]
        odds.append(np.einsum("...k,...mk->...m", of_head[..., :-1], hidden) + of_head[..., -1:])
    return scores, np.stack(odds, axis=-1)


def modulated_utilities(
    params: dict[str, Any], obs: np.ndarray, representations: np.ndarray
) -> np.ndarray:
    """f64[..., m] those that it learns with."""
    return modulated(params, obs, representations)[0]


def cautious_utilities(
    params: dict[str, Any], obs: np.ndarray, representations: np.ndarray
) -> np.ndarray:
    """f64[..., m] those of evaluations: u_i - 8 ln(1 + e^o_i), of the largest o_i of all heads."""
    scores, odds = modulated(params, obs, representations)
    return scores - 8.0 * np.logaddexp(0.0, odds.max(axis=-1))


def log_softmax(utility: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """f64[..., m] log-probabilities over the real entries, -inf elsewhere."""
    utility = np.where(mask, utility, -np.inf)
    shifted = utility - utility.max(axis=-1, keepdims=True)
    return shifted - np.log(np.exp(shifted).sum(axis=-1, keepdims=True))


def randomized(params: Any, seed: int, scale: float = 0.3) -> Any:
    """Parameters of the same shapes with N(0, scale^2) numbers: biases matter, nothing is tiny."""
    rng = np.random.default_rng(seed)
    return jax.tree.map(lambda x: np.asarray(rng.normal(0, scale, x.shape), np.float32), params)
