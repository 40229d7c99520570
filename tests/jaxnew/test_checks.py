"""Planted mistakes in environments and policies: each is told in a sentence that names it."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

import jaxnew
from jaxnew.checks.environment import check_forms
from jaxnew.environment import Action, ActionSpec, Environment, ObservationSpec
from jaxnew.policy.distributions import Categorical
from jaxnew.representation.table import engineered_table
from jaxnew.task.places import UsageError
from tests import toy_device

pytestmark = pytest.mark.contract


@struct.dataclass
class State:
    """place f32[2], steps int32[]."""

    place: jax.Array
    steps: jax.Array


class Sound(Environment[State, None]):
    """Actions 0 to 3 push a point; three steps. Mistakes are planted in its subclasses."""

    name = "Sound-v0"
    episode_metrics = ("is_success",)
    default_params = None
    action_spec = ActionSpec(4)

    def observation_spec(self, params: None) -> ObservationSpec:
        return ObservationSpec((2,), jnp.float32, -4.0, 4.0)

    def max_episode_steps(self, params: None) -> int:
        return 3

    def reset_env(self, key: jax.Array, params: None) -> tuple[jax.Array, State]:
        place = jax.random.uniform(key, (2,), jnp.float32)
        return place, State(place, jnp.int32(0))

    def step_env(self, key: jax.Array, state: State, action: Action, params: None) -> Any:
        is_valid = (action.id >= 0) & (action.id < 4)
        place = state.place + jnp.where(is_valid, action.id.astype(jnp.float32) / 4.0, 0.0)
        state = State(place, state.steps + 1)
        terminated = place[0] > 2.0
        info = {"is_success": terminated, "invalid_action": ~is_valid}
        reward = place[1]
        return place, state, reward, terminated, ~terminated & (state.steps >= 3), info


def step_with(**changes: Callable[[Any], Any]) -> Any:
    """A `step_env` whose parts are changed, by their names."""
    names = ("obs", "state", "reward", "terminated", "truncated", "info")

    def step_env(self: Any, *arguments: Any) -> Any:
        parts = Sound.step_env(self, *arguments)
        same: Callable[[Any], Any] = lambda part: part  # noqa: E731
        return tuple(changes.get(n, same)(part) for n, part in zip(names, parts, strict=True))

    return step_env


def reset_with(change: Callable[[jax.Array, State], Any]) -> Any:
    return lambda self, key, params: change(*Sound.reset_env(self, key, params))


def without(info: dict[str, Any], name: str) -> dict[str, Any]:
    return {key: value for key, value in info.items() if key != name}


def step_without_final(self: Any, *arguments: Any) -> Any:
    *parts, info = Environment.step(self, *arguments)
    return *parts, without(info, "final_observation")


FORMS: dict[str, tuple[dict[str, Any], str]] = {
    "shape of the first observation": (
        {"reset_env": reset_with(lambda obs, state: (obs[:1], state))},
        r"reset_env: the observation is float32\[1\]; it must be float32\[2\]",
    ),
    "dtype of observations": (
        {"step_env": step_with(obs=lambda x: x.astype(jnp.int32))},
        r"step_env: the observation is int32\[2\]; it must be float32\[2\]",
    ),
    "reward of one element": (
        {"step_env": step_with(reward=lambda x: x[None])},
        r"step_env: the reward is float32\[1\]; it must be float32\[\]",
    ),
    "whole reward": (
        {"step_env": step_with(reward=lambda x: x.astype(jnp.int32))},
        r"the reward is int32\[\]; it must be float32\[\]",
    ),
    "a number for an end": (
        {"step_env": step_with(terminated=lambda x: x.astype(jnp.float32))},
        r"terminated is float32\[\]; it must be bool\[\]",
    ),
    "another tree": (
        {"step_env": step_with(state=lambda s: (s.place, s.steps))},
        r"step_env gives PyTreeDef\(\(\*, \*\)\), and .*reset_env PyTreeDef\(CustomNode\(State",
    ),
    "another dtype in the state": (
        {"step_env": step_with(state=lambda s: replace(s, steps=s.steps.astype(jnp.float32)))},
        r"step_env: steps is float32\[\], and .*reset_env gives int32\[\]",
    ),
    "a Python number in the state": (
        {"reset_env": reset_with(lambda obs, state: (obs, replace(state, steps=0)))},
        r"reset_env: steps is a Python number, .* write jnp.int32\(",
    ),
    "no final observation": (
        {"step": step_without_final},
        "step: info lacks 'final_observation'",
    ),
    "no word of invalid ids": (
        {"step_env": step_with(info=lambda info: without(info, "invalid_action"))},
        "step_env: info lacks 'invalid_action'",
    ),
    "a metric that is not there": (
        {"episode_metrics": ("height",)},
        "info lacks 'height', which episode_metrics names",
    ),
    "five parts": (
        {"step_env": lambda self, *arguments: Sound.step_env(self, *arguments)[:5]},
        "step_env gives 5 parts; it must give 6: observation, state, reward",
    ),
    "an if on a traced number": (
        {"step_env": step_with(reward=lambda x: x if x > 0 else -x)},
        "step_env fails: TracerBoolConversionError: Attempted boolean conversion",
    ),
    "a list of numbers for a spec": (
        {"observation_spec": lambda self, params: (2,)},
        r"observation_spec gives \(2,\); it must be an ObservationSpec",
    ),
    "a limit that is traced": (
        {"max_episode_steps": lambda self, params: jnp.int32(3)},
        "max_episode_steps gives .*; it must be 1 or more, an int",
    ),
}


def reset_with_a_key_for_two(self: Any, key: jax.Array, params: None) -> Any:
    obs, state = Sound.reset_env(self, key, params)
    return obs, replace(state, place=obs + jax.random.normal(key, (2,), jnp.float32))


PLAYED: dict[str, tuple[dict[str, Any], str]] = {
    "NaN": (
        {"step_env": step_with(obs=lambda x: jnp.where(x[0] > 0.5, jnp.nan, x))},
        "step: the observation is not finite",
    ),
    "beyond the bounds": (
        {"observation_spec": lambda self, params: ObservationSpec((2,), np.float32, 0.0, 1.0)},
        r"step: the observation has numbers from .* observation_spec says 0.0 to 1.0",
    ),
    "an infinite reward": (
        {"step_env": step_with(reward=lambda x: x / 0.0)},
        "step: a reward is inf",
    ),
    "one start for all keys": (
        {"reset_env": lambda self, key, params: Sound.reset_env(self, jax.random.key(0), params)},
        "reset_env: 16 keys gave one and the same start",
    ),
    "a key for two": (
        {"reset_env": reset_with_a_key_for_two},
        "reset_env fails: KeyReuseError: .*already consumed|KeyReuseError: Previously-consumed",
    ),
    "ids that are accepted silently": (
        {"step_env": step_with(info=lambda i: {**i, "invalid_action": jnp.bool_(False)})},
        r"\[False, False, False, False\] for the ids \[-1, 0, 3, 4\] of 4 actions",
    ),
    "no end": (
        {"step_env": step_with(truncated=lambda x: x & False)},
        "an episode did not end within max_episode_steps, 3",
    ),
    "a final observation of another time": (
        {
            "step": lambda self, *a: (
                *(p := Environment.step(self, *a))[:5],
                {**p[5], "final_observation": a[1].place},
            )
        },
        r"step: info\['final_observation'\] is not the observation that is returned",
    ),
}


def planted(mistake: dict[str, Any]) -> Sound:
    made: Sound = type("Mine", (Sound,), mistake)()
    return made


def told(call: Callable[[], None]) -> str:
    with pytest.raises(UsageError) as caught:
        call()
    text = str(caught.value)
    assert "\n" not in text
    assert text.startswith("Mine")
    return text


@pytest.mark.parametrize("what", FORMS)
def test_forms_of_an_environment(what: str) -> None:
    """They are seen without running anything."""
    mistake, message = FORMS[what]
    assert re.search(message, told(lambda: check_forms(planted(mistake), None)))


@pytest.mark.parametrize("what", PLAYED)
def test_what_an_environment_does(what: str) -> None:
    mistake, message = PLAYED[what]
    assert re.search(message, told(lambda: jaxnew.check_environment(planted(mistake))))


def test_a_sound_environment() -> None:
    jaxnew.check_environment(Sound())
    fixed = planted(PLAYED["one start for all keys"][0])
    jaxnew.check_environment(fixed, has_fixed_start=True)


class Params(dict[str, Any]):
    """No pytree: JAX sees one leaf that is no array."""


class Head:
    """A softmax over products of state and action. Mistakes are planted in its subclasses."""

    name = "sound"

    def init(self, key: jax.Array, obs: jax.Array, representation_size: int) -> Any:
        return {"w": 0.1 * jax.random.normal(key, (obs.shape[-1], representation_size))}

    def project(self, params: Any, representations: jax.Array) -> jax.Array:
        return representations

    def logits(self, params: Any, obs: jax.Array, projected: jax.Array, mask: jax.Array) -> Any:
        return jnp.sum((obs @ params["w"])[..., None, :] * projected, axis=-1)

    def distribution(self, params: Any, obs: Any, projected: Any, mask: Any) -> Any:
        return Categorical.masked(self.logits(params, obs, projected, mask), mask)

    def value(self, params: Any, obs: jax.Array) -> jax.Array:
        return jnp.sum(obs @ params["w"], axis=-1)

    def decode(self, sample: Any, available: Any, table: jax.Array) -> Action:
        return Action.of(available.id_of(sample))


@struct.dataclass
class Improper(Categorical):
    """Whose log-probabilities are scores."""

    def log_prob(self, choice: jax.Array) -> jax.Array:
        return jnp.take_along_axis(self.logits, choice[..., None], axis=-1)[..., 0]


class Plain:
    """A distribution that JAX cannot look into."""

    def __init__(self, inside: Categorical) -> None:
        self.inside = inside


def scores(change: Callable[..., jax.Array]) -> dict[str, Any]:
    return {
        "logits": lambda self, params, obs, projected, mask: change(
            Head.logits(self, params, obs, projected, mask), projected, mask
        )
    }


def distribution(change: Callable[[Categorical], Any]) -> dict[str, Any]:
    return {"distribution": lambda self, *arguments: change(Head.distribution(self, *arguments))}


def unmasked(self: Any, params: Any, obs: Any, projected: Any, mask: Any) -> Categorical:
    return Categorical(jnp.broadcast_to(self.logits(params, obs, projected, mask), (32, 8)))


HEADS: dict[str, tuple[dict[str, Any], str]] = {
    "no member": ({"value": property()}, "lacks value; see jaxnew.PolicyMethod"),
    "parameters that are no pytree": (
        {"init": lambda self, key, obs, size: Params(w=jnp.zeros(3))},
        "init fails: TypeError: .*Params",
    ),
    "scores of another shape": (
        {"logits": lambda self, params, obs, projected, mask: jnp.zeros((*obs.shape[:-1], 3))},
        "distribution of sets .* fails: .*incompatible|distribution of sets .* fails: .*broadcast",
    ),
    "one row for all actions": (
        {"project": lambda self, params, rows: rows.mean(axis=0)},
        r"project gives float32\[8\] for f32\[24, 8\]; it must give a row for each action",
    ),
    "a value of one element": (
        {"value": lambda self, params, obs: (obs @ params["w"])[..., :1]},
        r"value is float32\[32, 1\]; it must be float32\[32\]",
    ),
    "a distribution that is no pytree": (
        distribution(Plain),
        "distribution of sets .* fails: TypeError: .*Plain",
    ),
    "an action that is no int32": (
        {"decode": lambda self, s, a, t: replace(Action.of(s), id=a.id_of(s) * 1.0)},
        r"decode: id is float32\[32\]; it must be int32\[32\]",
    ),
    "an id alone": (
        {"decode": lambda self, sample, available, table: available.id_of(sample)},
        "decode gives a .*, not a jaxnew.Action",
    ),
    "no mask": ({"distribution": unmasked}, "acts outside its set: a sample is decoded to"),
    "a place for an id": (
        {"decode": lambda self, sample, available, table: Action.of(sample)},
        "acts outside its set",
    ),
    "a preference for the first": (
        scores(lambda logits, rows, mask: logits - jnp.arange(8.0)),
        "depends on the order of the set",
    ),
    "a look at the padding": (
        scores(lambda logits, rows, mask: logits * (1.0 + rows.mean(axis=(-2, -1))[..., None])),
        "depends on the padding of a set",
    ),
    "scores for log-probabilities": (
        distribution(lambda found: Improper(found.logits)),
        "log_prob is not that of sample: in one state the 8 choices were drawn with shares",
    ),
    "NaN": (
        {"value": lambda self, params, obs: jnp.log(-jnp.sum(obs**2, axis=-1))},
        "value is not finite on random parameters and states",
    ),
}


@pytest.mark.parametrize("what", HEADS)
def test_what_a_policy_does(what: str) -> None:
    mistake, message = HEADS[what]
    mine = type("Mine", (Head,), mistake)
    if what == "no member":
        mine = type("Mine", (), {k: v for k, v in vars(Head).items() if k != "value"})
    text = told(lambda: jaxnew.check_method(mine()))
    assert re.search(message, text), text


def test_a_sound_policy() -> None:
    jaxnew.check_method(Head())
    spec = ActionSpec(24, position_dim=2)
    with pytest.raises(UsageError, match=r"decode: position is float32\[32, 0\]; .*\[32, 2\]"):
        jaxnew.check_method(Head(), action_spec=spec)


@pytest.mark.parametrize("name", ["continuous", "discrete", "random"])
def test_policies_of_the_project(name: str) -> None:
    """With a position beside the choice."""
    spec = ActionSpec(24, position_dim=2)
    context = jaxnew.MethodContext(train_ids=np.arange(10), action_spec=spec)
    jaxnew.check_method(jaxnew.make_method(name, context), action_spec=spec)


class Unmasked(Head):
    """For `--method`: it was trained outside its set without a word."""

    def __init__(self, context: Any) -> None:
        del context

    distribution = unmasked


class Silent(toy_device.Ladder):
    """Takes every id without a word."""

    def step_env(self, *arguments: Any) -> Any:
        *parts, info = super().step_env(*arguments)
        return *parts, {**info, "invalid_action": jnp.bool_(False)}


@pytest.mark.parametrize("start", [jaxnew.train, jaxnew.sweep])
def test_runs_of_mistakes_do_not_begin(start: Callable[..., Any], tmp_path: Path) -> None:
    task = toy_device.TASK
    table = engineered_table(task.make_universe(), "gt3")
    seed = {"seeds": [1]} if start is jaxnew.sweep else {"seed": 1}
    for changes, method, message in (
        ({}, "tests.jaxnew.test_checks:Unmasked", "Unmasked acts outside its set"),
        ({"make_environment": Silent}, "ours", r"Silent.step: info\['invalid_action'\] is"),
    ):
        mine = replace(task, **changes)
        with pytest.raises(UsageError, match=message):
            start(mine, table, method=method, budget="smoke", runs=tmp_path, **seed)
    assert list(tmp_path.rglob("config.json")) == []
