"""Random play: our Grid World, raw and with auto-reset, and other JAX grid environments.

    python -m experiments.benchmarks.environment
    python -m experiments.benchmarks.environment --games=grid_world,navix

One scan of T steps over N environments: a random action for each from one draw, a vmapped step, the
observation carried so that it is really made. The peers are different games with one move per
decision; ours has five. They need not be installed, and this module needs of this project's own
dependencies only jax, flax, chex and absl-py, so that it can run in an environment for the peers:

    python -m venv peers && peers/bin/pip install absl-py chex flax navix xminigrid gymnax
    PYTHONPATH=. peers/bin/python -m experiments.benchmarks.environment
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

from envs_mjx.grid_world import GridWorld
from envs_mjx.grid_world.skills import NUM_MOVES, NUM_SKILLS
from experiments.benchmarks import _measure as m
from jaxnew.environment import Action

ARGUMENTS = m.Benchmark(__doc__)
ARGUMENTS.define(
    "list", "games", ["grid_world", "navix", "xminigrid", "gymnax"], "What to measure."
)


@dataclass(frozen=True)
class Game:
    """An environment seen by random play.

    Attributes:
      description: what it is.
      num_actions: actions are `0..num_actions-1`.
      reset: key -> carry, for one environment. The carry holds the observation.
      step: (key, carry, action) -> (carry, reward); with auto-reset, but for ours when it is raw.
    """

    description: str
    num_actions: int
    reset: Callable[[jax.Array], Any]
    step: Callable[[jax.Array, Any, jax.Array], tuple[Any, jax.Array]]


def grid_world(has_auto_reset: bool = True) -> Game:
    """Ours; `step_env` without auto-reset, which plays on after an end and draws nothing."""
    env = GridWorld()
    params = env.default_params
    step_one = env.step if has_auto_reset else env.step_env

    def reset(key: jax.Array) -> Any:
        return env.reset(key, params)

    def step(key: jax.Array, carry: Any, action: jax.Array) -> tuple[Any, jax.Array]:
        obs, state, reward, *_ = step_one(key, carry[1], Action.of(action), params)
        return (obs, state), reward

    return Game(
        "jaxnew GridWorld-v0, 9x9 with lava, f32[81], five moves a decision",
        NUM_SKILLS,
        reset,
        step,
    )


def navix_game() -> Game:
    """Navix' lava gap on our grid size; it resets in the step after the end."""
    from navix import observations, rewards, terminations
    from navix.environments.lava_gap import LavaGap

    env = LavaGap.create(
        9,
        9,
        observation_fn=observations.symbolic,
        reward_fn=rewards.on_goal_reached,
        termination_fn=terminations.compose(
            terminations.on_goal_reached, terminations.on_lava_fall
        ),
    )

    def step(key: jax.Array, carry: Any, action: jax.Array) -> tuple[Any, jax.Array]:
        del key  # In its state.
        carry = env.step(carry, action)
        return carry, carry.reward

    return Game(
        "Navix LavaGap 9x9, symbolic uint8[9, 9, 3]: another game, one move a decision",
        len(env.action_set),
        env.reset,
        step,
    )


def xminigrid_game() -> Game:
    """XLand-MiniGrid's empty room, which is what it has nearest; there is no lava in it."""
    import xminigrid
    from xminigrid.wrappers import GymAutoResetWrapper

    env, params = xminigrid.make("MiniGrid-Empty-8x8")
    params = params.replace(height=9, width=9)
    env = GymAutoResetWrapper(env)

    def step(key: jax.Array, carry: Any, action: jax.Array) -> tuple[Any, jax.Array]:
        del key  # In its state.
        carry = env.step(params, carry, action)
        return carry, carry.reward

    return Game(
        "XLand-MiniGrid Empty 9x9, view uint8[7, 7, 2]: another game, one move a decision",
        env.num_actions(params),
        lambda key: env.reset(params, key),
        step,
    )


def gymnax_game() -> Game:
    """Gymnax' four rooms with map observations, its nearest to a grid with a goal."""
    import gymnax

    env, params = gymnax.make("FourRooms-misc", use_visual_obs=True)

    def step(key: jax.Array, carry: Any, action: jax.Array) -> tuple[Any, jax.Array]:
        obs, state, reward, *_ = env.step(key, carry[1], action, params)
        return (obs, state), reward

    return Game(
        "gymnax FourRooms 13x13, map f32[13, 13, 2]: another game, one move a decision",
        env.num_actions,
        lambda key: env.reset(key, params),
        step,
    )


PEERS = {"navix": navix_game, "xminigrid": xminigrid_game, "gymnax": gymnax_game}


def random_play(game: Game, num_steps: int) -> Callable[[jax.Array, Any], tuple[Any, jax.Array]]:
    """(key, carries [N]) -> (carries after `num_steps` steps, summed reward f32[N])."""

    def play(key: jax.Array, carry: Any) -> tuple[Any, jax.Array]:
        num_envs = jax.tree.leaves(carry)[0].shape[0]

        def body(state: tuple[Any, jax.Array], key: jax.Array) -> tuple[Any, None]:
            carry, total = state
            key_action, key_step = jax.random.split(key)
            actions = jax.random.randint(key_action, (num_envs,), 0, game.num_actions)
            keys = jax.random.split(key_step, num_envs)
            carry, reward = jax.vmap(game.step)(keys, carry, actions)
            return (carry, total + reward), None

        start = carry, jnp.zeros(num_envs)
        return jax.lax.scan(body, start, jax.random.split(key, num_steps))[0]

    return play


def subject(game: Game, num_envs: int, num_steps: int) -> m.Subject:
    """Random play of one game from fresh starts."""
    reset = jax.jit(jax.vmap(game.reset))

    def inputs(key: jax.Array) -> tuple[Any, ...]:
        key_play, key_reset = jax.random.split(key)
        return key_play, reset(jax.random.split(key_reset, num_envs))

    return m.compiled(random_play(game, num_steps), inputs)


def games_of(report: m.Report, names: list[str]) -> dict[str, Game]:
    """Ours in two forms, and the peers that can be imported; a line for each that cannot."""
    games = {}
    if "grid_world" in names:
        games = {"raw": grid_world(has_auto_reset=False), "auto-reset": grid_world()}
    for name in [name for name in PEERS if name in names]:
        try:
            games[name] = PEERS[name]()
            report.add_versions(name)
        except ImportError as err:
            print(f"  {name} is left out ({err}); to compare with it: pip install {name}")
    return games


def main() -> None:
    report = m.Report("environment", ARGUMENTS)
    games = games_of(report, ARGUMENTS.games)
    num_steps = 8 if report.is_quick else 512
    for num_envs in (4,) if report.is_quick else (32, 1024):
        timings = report.measure({k: subject(v, num_envs, num_steps) for k, v in games.items()})
        for name, game in games.items():
            decisions, moves = num_envs * num_steps, 1 if name in PEERS else NUM_MOVES
            report.timing(
                name if name in PEERS else f"grid_world, {name}",
                timings[name],
                work={"decisions": decisions, "moves": decisions * moves},
                num_envs=num_envs,
                includes=["auto-reset"] * (name != "raw") + ["random actions"],
                how=f"{game.description}; a scan of {num_steps} steps from fresh starts",
            )
        if "auto-reset" not in games:
            continue
        pairs = {"auto-reset / raw": ("auto-reset", "raw")}
        pairs |= {f"{name} / grid_world": (name, "auto-reset") for name in games if name in PEERS}
        how = f"{m.RATIO}, for the same number of decisions"
        for case, (one, other) in pairs.items():
            report.ratio(f"{case}, {num_envs} envs", timings[one], timings[other], how=how)


if __name__ == "__main__":
    ARGUMENTS.start(main)
