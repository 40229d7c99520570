"""Hyper-parameters of stage 1."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

KINDS = ("hvae", "vae")


@dataclass(frozen=True)
class RepresentationConfig:
    """Hyper-parameters of stage 1; the defaults are those of Grid World.

    `docs/method.md`, "HVAE", has those of all domains.

    Attributes:
      kind: "hvae" or "vae" (the flat baseline).
      encoder_width: E, hidden width of the recording encoder per direction.
      inference_width: Ho, hidden width of the action inference network (HVAE only).
      hidden_width: H, hidden width of all other networks.
      action_latent: dc, size of the HVAE's action representation.
      observation_latent: dz, size of a recording's latent; of the representation for the flat VAE.
      actions_per_batch: B, train actions per gradient step.
      recordings_per_action: S, recordings of each per gradient step. The flat VAE draws
        `A_train * max(1, floor(B * S / A_train))` recordings instead.
      num_steps: gradient steps of the whole training. The flat VAE's reference is 10,000.
      learning_rate: of RAdam.
      gradient_clip: every gradient entry is clamped to +- this.
      has_optimal_variance: the Gaussian likelihood has the variance that fits the batch's errors
        best, see `objective.optimal_log_variance`; False: one that is learned.
      kl_recordings: n, the action's divergence counts 1/n per recording, as if each action had n
        recordings in the batch; None: as many as it has (HVAE only).
      standardizes: encoder and decoder read and write vectors in units of their mean, deviation and
        step size, see `encoders.Scales`; the decoder reads back probabilities of categories, and
        its images start as their mean colour. False: as they are.
      predicts_changes: the decoder adds what it gives to the last step, of a video to the last
        frame's code, and starts from the first frame; False: it gives the step.
      reads_changes: the encoder reads how far each step, or pixel, is from the one before, too.

    Raises:
      TypeError: a count is not an integer.
      ValueError: a field is out of its range.
    """

    kind: str = "hvae"
    encoder_width: int = 64
    inference_width: int = 128
    hidden_width: int = 64
    action_latent: int = 16
    observation_latent: int = 16
    actions_per_batch: int = 128
    recordings_per_action: int = 672
    num_steps: int = 40_000
    learning_rate: float = 1e-3
    gradient_clip: float = 0.5
    has_optimal_variance: bool = False
    kl_recordings: int | None = None
    standardizes: bool = False
    predicts_changes: bool = False
    reads_changes: bool = False

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ValueError(f"kind={self.kind!r} is unknown; choose one of {KINDS}.")
        for field in fields(self):
            value, kind = getattr(self, field.name), str(field.type)
            if value is None or kind in ("str", "bool"):
                continue
            if kind.startswith("int") and not isinstance(value, int):
                raise TypeError(f"{field.name}={value!r} must be an integer.")
            if not value > 0:
                raise ValueError(f"{field.name}={value!r} must be positive.")

    def in_minutes(self, **changes: Any) -> RepresentationConfig:
        """The same networks with what lets them learn in minutes instead of days.

        `docs/method.md`, "Encoders in minutes". The action's divergence keeps the weight that it
        has with this config's recordings, however few a step draws.

        Args:
          changes: other fields, such as the sizes of batches.
        """
        return replace(
            self,
            has_optimal_variance=True,
            kl_recordings=self.recordings_per_action,
            standardizes=True,
            predicts_changes=True,
            reads_changes=True,
            **changes,
        )
