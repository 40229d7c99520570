"""Hyper-parameters of stage one: what is refused, and what learning in minutes changes."""

import dataclasses

import pytest

from jaxnew.representation.config import RepresentationConfig


@pytest.mark.unit
@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"kind": "gan"}, ValueError, "kind='gan'"),
        ({"hidden_width": 0}, ValueError, "hidden_width=0"),
        ({"num_steps": 2.5}, TypeError, "num_steps=2.5"),
        ({"learning_rate": float("nan")}, ValueError, "learning_rate=nan"),
        ({"gradient_clip": -1.0}, ValueError, "gradient_clip=-1.0"),
        ({"kl_recordings": 0}, ValueError, "kl_recordings=0 must be positive"),
        ({"kl_recordings": 0.5}, TypeError, "kl_recordings=0.5 must be an integer"),
    ],
)
def test_bad_configs_are_refused(changes, error, message):
    with pytest.raises(error, match=message):
        RepresentationConfig(**changes)


@pytest.mark.unit
def test_encoders_in_minutes_keep_networks_and_the_weight_of_the_actions_divergence():
    paper = RepresentationConfig(hidden_width=7, recordings_per_action=464)
    quick = paper.in_minutes(num_steps=9, recordings_per_action=4)
    assert (quick.kl_recordings, quick.recordings_per_action, quick.num_steps) == (464, 4, 9)
    batches = {"num_steps", "recordings_per_action", "kl_recordings"}
    for field in dataclasses.fields(paper):
        now, before = getattr(quick, field.name), getattr(paper, field.name)
        is_changed = field.name in batches or (now is True and before is False)
        assert is_changed or now == before, field.name
    with pytest.raises(TypeError, match="num_stps"):
        paper.in_minutes(num_stps=9)
