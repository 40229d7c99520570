"""The floor of an update: operations and bytes, by hand and by XLA's count."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import pytest

from experiments.benchmarks import _floor

# Grid World at the paper's shapes: 81 numbers observed, d = 16, 1024 skills, sets of 50, 32 x 512
# steps, 4 epochs of 4 gradient steps.
PAPER = _floor.Shapes(
    obs_size=81,
    representation_size=16,
    num_actions=1024,
    set_size=50,
    steps=16_384,
    epochs=4,
    gradient_steps=16,
)


@pytest.mark.unit
def test_operations_of_one_transition_by_hand() -> None:
    # An encoder: 81 * 64 + 64 * 64 = 9280 multiply-adds forward; backward the weight gradients of
    # both layers and the input gradient of the second: 5184 + 4096 + 4096 = 13376.
    assert _floor.encoder_madds(PAPER) == (9280, 13_376)
    # Forward: two encoders (18560), the value (64), the state's half (4096), the scores
    # (50 * 64 = 3200): 25920. Backward: 2 * 13376 and twice the other three: 26752 + 14720.
    assert _floor.transition_madds(PAPER) == (25_920, 41_472)


@pytest.mark.unit
def test_operations_of_one_update_by_hand() -> None:
    # Projection of 1024 rows: 16 * 64 + 64 * 64 = 5120 each; backward 1024 + 2 * 4096 = 9216.
    assert _floor.projection_madds(PAPER) == (5_242_880, 9_437_184)
    # Rollout: 16384 * 25920 + 5242880 = 429,916,160. Learning: 4 * 16384 * 67392 = 4,416,602,112
    # and 16 * 14,680,064 = 234,881,024. Two operations for each multiply-add.
    assert _floor.update_operations(PAPER) == 2 * (429_916_160 + 4_416_602_112 + 234_881_024)


@pytest.mark.oracle
def test_operations_agree_with_what_xla_counts() -> None:
    """For the matrix products of one transition, forward; XLA counts two per multiply-add."""
    from jaxnew.policy import UtilityMethod

    method = UtilityMethod()
    params = method.init(jax.random.key(0), jnp.zeros(81), 16)

    def forward(obs: jax.Array, projected: jax.Array) -> tuple[jax.Array, jax.Array]:
        distribution = method.distribution(params, obs, projected, jnp.ones(50, bool))
        return distribution.logits, method.value(params, obs)

    program = jax.jit(forward).lower(jnp.zeros(81), jnp.zeros((50, 64))).compile()
    counted = program.cost_analysis()["flops"]
    needed = 2 * _floor.transition_madds(PAPER)[0]
    # XLA also counts biases, additions and ReLUs: 2 * 50 * 64 for the latter two, some 400 biases.
    assert needed < counted < 1.25 * needed


@pytest.mark.unit
def test_bytes_of_one_update_by_hand() -> None:
    cached, memory = _floor.update_bytes(PAPER)
    # 50 rows of 64 floats are 12800 bytes; read in the rollout, and four times per epoch.
    assert cached == 16_384 * 12_800 * (1 + 4 * 4)
    # 81 floats, 50 ids and mask bytes, five numbers: 324 + 250 + 20 = 594 bytes; written in the
    # rollout, and moved three times per epoch.
    assert memory == 16_384 * 594 * (1 + 4 * 3)


@pytest.mark.unit
def test_floor_is_the_larger_of_operations_and_bytes() -> None:
    rates = {"operations": 1e11, "cached_bytes": 1e11, "memory_bytes": 1e10}
    floor = _floor.floor_seconds(PAPER, rates)
    # 10,162,798,592 operations at 1e11; 3,565,158,400 bytes at 1e11 and 126,517,248 at 1e10.
    assert floor["operations_s"] == pytest.approx(0.10162798592)
    assert floor["bytes_s"] == pytest.approx(0.035651584 + 0.0126517248)
    assert floor["max_s"] == floor["operations_s"]
    assert floor["sum_s"] == pytest.approx(0.10162798592 + 0.0483033088)
