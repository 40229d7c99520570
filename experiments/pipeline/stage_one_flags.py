"""Flags of what records actions: `collect` and `embed`."""

from __future__ import annotations

from absl import flags

NUM_RECORDINGS = flags.DEFINE_integer(
    "observations_per_action",
    None,
    "Recordings per action; default: what the budget says.",
    lower_bound=1,
)
FRAMES = flags.DEFINE_enum(
    "frames",
    None,
    ["on-demand", "stored"],
    "Of videos: draw the frames of each batch while the batch before is learned from, or draw all "
    "frames once and store them. The result is the same; default: what the budget says.",
)


def stores_drawn() -> bool | None:
    """What `--frames` says; None if nothing."""
    return None if FRAMES.value is None else FRAMES.value == "stored"
