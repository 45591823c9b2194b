"""TensorBoard: one event file a run. Tags, units and formulas: docs/logging.md."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import Any

import numpy as np
from torch.utils.tensorboard import SummaryWriter
from torch.utils.tensorboard.summary import hparams

RETURNS = {
    "Returns": {
        "reward per step and objective": ["Multiline", ["eval/reward_per_step", "eval/objective"]],
        "episode return": ["Multiline", ["eval/return"]],
    }
}
S1_LAYOUT = {
    "rho and theta": {
        "rho": ["Multiline", ["s1/rho"]],
        "theta": ["Multiline", ["s1/theta"]],
        "biasing": ["Multiline", ["s1/bias_iteration", "s1/psi_epochs"]],
        "psi error": ["Multiline", ["s1/psi_error"]],
    },
    "Reward bias": {"delta": ["Multiline", ["s1/delta_max", "s1/delta_mean"]]},
} | RETURNS
LEARNER_LAYOUT = {
    "theta": {
        "theta": ["Multiline", ["learner/theta"]],
        "bound on the loss in the empirical model": ["Multiline", ["learner/empirical_width"]],
    },
    "Reward bias": {"delta": ["Multiline", ["learner/delta_max", "learner/delta_mean"]]},
    "Action values": {"q": ["Multiline", ["learner/q_min", "learner/q_max"]]},
} | RETURNS
EXACT_LAYOUT = {
    "theta": {
        "theta with its bounds": ["Margin", ["exact/theta", "exact/theta_lower", "exact/theta_upper"]],
        "KL to the dynamics": ["Multiline", ["exact/kl_max"]],
    },
    "Reward bias": {"delta": ["Multiline", ["exact/delta_max", "exact/delta_mean"]]},
} | RETURNS


def replica_layout(groups: Sequence[str]) -> dict[str, Any]:
    """Boards of a run of replicas: the mean in its quartiles and in its extremes, a group below the other."""
    return {
        title: {
            f"{group}: {name}, {band}": ["Margin", [f"{group}/{name}_{key}" for key in ("mean", *ends)]]
            for group in groups
            for name in names
            for band, ends in (("quartiles", ("q25", "q75")), ("extremes", ("min", "max")))
        }
        for title, names in {
            "rho and theta": ("theta", "rho", "empirical_width"),
            "Reward bias": ("delta_max",),
            "Returns": ("reward_per_step", "objective", "return"),
        }.items()
    }


class Board:
    """Writes records against tuples streamed. A context manager: what was logged survives an exception."""

    def __init__(
        self, directory: str | os.PathLike[str], hyperparameters: Mapping[str, Any], layout: Mapping[str, Any]
    ) -> None:
        self._writer = SummaryWriter(str(directory))
        self._writer.add_custom_scalars(layout)
        # Session start and end go into the run's own file: add_hparams would open a run directory more.
        # No experiment summary: TensorBoard takes the first it finds and hides other runs' columns.
        _, self._session_start, self._session_end = hparams(dict(hyperparameters), {})  # type: ignore[no-untyped-call]
        self._summary(self._session_start)

    def scalars(self, values: Mapping[str, float], step: int) -> None:
        """One record; keys are full tags."""
        for tag, value in values.items():
            self._writer.add_scalar(tag, value, step)

    def picture(self, tag: str, pixels: np.ndarray, step: int) -> None:
        """An image [H, W, 3] uint8."""
        self._writer.add_image(tag, pixels, step, dataformats="HWC")

    def text(self, tag: str, markdown: str) -> None:
        self._writer.add_text(tag, markdown)

    def __enter__(self) -> Board:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._summary(self._session_end)
        self._writer.close()

    def _summary(self, summary: Any) -> None:
        self._writer._get_file_writer().add_summary(summary)  # type: ignore[no-untyped-call]
