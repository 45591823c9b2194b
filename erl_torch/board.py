"""TensorBoard: one event file a run. Tags, units and formulas: docs/logging.md."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import Any

import numpy as np
from torch.utils.tensorboard import summary

from erl_torch.event_file import EventFile

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
    """Writes records against tuples streamed. A context manager: what was logged survives an exception.

    Args:
        directory: the run's.
        hyperparameters: numbers, booleans and text.
        layout: of the Custom Scalars tab.
        size: of the event file at the checkpoint that the run goes on from; 0 begins it.
    """

    def __init__(
        self,
        directory: str | os.PathLike[str],
        hyperparameters: Mapping[str, Any],
        layout: Mapping[str, Any],
        size: int = 0,
    ) -> None:
        self._file = EventFile(directory, size)
        # Session start and end go into the run's own file: add_hparams would open a run directory more.
        # No experiment summary: TensorBoard takes the first it finds and hides other runs' columns.
        _, session_start, self._session_end = summary.hparams(dict(hyperparameters), {})  # type: ignore[no-untyped-call]
        if not size:
            self._file.add(summary.custom_scalars(layout))  # type: ignore[no-untyped-call]
            self._file.add(session_start)

    def scalars(self, values: Mapping[str, float], step: int) -> None:
        """One record; keys are full tags."""
        for tag, value in values.items():
            self._file.add(summary.scalar(tag, value), step)  # type: ignore[no-untyped-call]

    def picture(self, tag: str, pixels: np.ndarray, step: int) -> None:
        """An image [H, W, 3] uint8."""
        self._file.add(summary.image(tag, pixels, dataformats="HWC"), step)  # type: ignore[no-untyped-call]

    def text(self, tag: str, markdown: str) -> None:
        self._file.add(summary.text(tag, markdown))  # type: ignore[no-untyped-call]

    def flush(self) -> int:
        """Hand all records to the system; the size of the event file."""
        return self._file.flush()

    def __enter__(self) -> Board:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.add(self._session_end)
        self._file.close()
