"""Utility policies in float64 NumPy, on parameters of `UtilityMethod` and `ModulatedMethod`.

Written from `docs/method.md`, "Policy networks".
"""

from __future__ import annotations

from typing import Any

import jax
import numpy as np


def dense(layer: dict[str, Any], x: np.ndarray) -> np.ndarray:
    return x @ np.asarray(layer["kernel"], np.float64) + np.asarray(layer["bias"], np.float64)


def encode(layers: dict[str, Any], obs: np.ndarray) -> np.ndarray:
    """`dense, tanh, dense, tanh`."""
    hidden = np.tanh(dense(layers["Dense_0"], np.asarray(obs, np.float64)))
    return np.tanh(dense(layers["Dense_1"], hidden))


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
    return dense(utility["score"], np.maximum(hidden, 0.0))[..., 0]


def modulated_utilities(
    params: dict[str, Any], obs: np.ndarray, representations: np.ndarray
) -> np.ndarray:
    """f64[..., m] as `utilities`, with h numbers in the hidden layer and w in f(s) and a:

    a_i = ReLU( Lin(d,w)(c_i) );  u_i = Lin(w,h)(f(s)) . ReLU( Lin(2w,h)( [f(s), a_i] ) ).
    """
    utility = params["utility"]
    features = encode(params["encoder"], obs)
    embedded = np.maximum(dense(utility["embed"], np.asarray(representations, np.float64)), 0.0)
    repeated = np.repeat(features[..., None, :], embedded.shape[-2], axis=-2)
    hidden = np.maximum(dense(utility, np.concatenate([repeated, embedded], axis=-1)), 0.0)
    return np.einsum("...h,...mh->...m", dense(utility["score"], features), hidden)


def log_softmax(utility: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """f64[..., m] log-probabilities over the real entries, -inf elsewhere."""
    utility = np.where(mask, utility, -np.inf)
    shifted = utility - utility.max(axis=-1, keepdims=True)
    return shifted - np.log(np.exp(shifted).sum(axis=-1, keepdims=True))


def randomized(params: Any, seed: int, scale: float = 0.3) -> Any:
    """Parameters of the same shapes with N(0, scale^2) numbers: biases matter, nothing is tiny."""
    rng = np.random.default_rng(seed)
    return jax.tree.map(lambda x: np.asarray(rng.normal(0, scale, x.shape), np.float32), params)
