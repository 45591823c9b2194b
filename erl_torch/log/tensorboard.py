"""TensorBoard: one event file a run. Tags, units and formulas: docs/logging.md."""

from __future__ import annotations

import json
import os
import re
import shlex
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from omegaconf import DictConfig, OmegaConf
from tensorboard.plugins.custom_scalar import layout_pb2
from tensorboard.plugins.hparams import api_pb2, plugin_data_pb2
from torch.utils.tensorboard import summary

from erl_torch.checks import InputError
from erl_torch.files import began_with
from erl_torch.log.event_file import EventFile, Mark

Band = tuple[str, str, str]  # tags of value, lower and upper end
Chart = Sequence[str | Band]  # lines (patterns of tags), or bands
Boards = dict[str, dict[str, Chart]]  # charts by title, by board


def _band(value: str) -> Band:
    return value, f"{value}_lower", f"{value}_upper"


CONVERGENCE, BIAS, RETURNS = "Did theta converge?", "Reward bias", "Returns"
# The same lines in every run: TensorBoard shows the union of all runs' layouts.
LINES = {
    CONVERGENCE: {
        "theta; theta* of the model, ends of the data's 95%": [
            "(s1|learner|exact)/theta$",
            "optimal/theta$",
            "data/theta_(lower|upper)$",
        ],
        "rho; of the optimum": ["(s1|learner)/rho$", "optimal/rho$"],
        "error of psi, relative": ["s1/psi_error$"],
        "biasing iteration": ["(s1|learner)/bias_iteration$"],
        "loss in the empirical model, at most": ["learner/empirical_width$"],
        "KL to the dynamics, nats": ["exact/kl_max$"],
        "action values, extremes": ["learner/q_(min|max)$"],
    },
    BIAS: {
        "delta, largest; of the optimum": ["(s1|learner|exact)/delta_max$", "optimal/delta_max$"],
        "delta, mean; of the optimum": ["(s1|learner|exact)/delta_mean$", "optimal/delta_mean$"],
    },
    RETURNS: {
        "objective; optimal, prior": ["(eval|optimal|prior)/objective$"],
        "reward a step; optimal, prior": ["(eval|optimal|prior)/reward_per_step$"],
        "return of an episode; optimal, prior": ["(eval|optimal|prior)/return$"],
    },
}


def layout(learnt: Iterable[str], constant: Iterable[str]) -> Boards:
    """The boards of a run that writes the tags ``learnt``, and ``constant`` ones as lines and bands beside them."""
    written, known = list(learnt), set(constant)
    boards: Boards = {
        board: {
            title: list(patterns)
            for title, patterns in charts.items()
            if any(re.match(patterns[0], tag) for tag in written)
        }
        for board, charts in LINES.items()
    }
    # A chart of bands complains of each tag that is missing, and takes no patterns.
    bands = [_band(name) for name in ("optimal/theta", "data/theta") if f"{name}_lower" in known]
    for tag in ("s1/theta", "learner/theta"):
        if tag in written and bands:
            boards[CONVERGENCE][f"{tag} in its bands: proven, data's 95%"] = [(tag, tag, tag), *bands]
    if "exact/theta" in written:
        boards[CONVERGENCE]["exact/theta in its proven bounds"] = [_band("exact/theta")]
    return boards


def replica_layout(groups: Mapping[str, Iterable[str]], names: Iterable[str]) -> Boards:
    """The boards of a run of replicas.

    Args:
        groups: by the name of each, the quantities whose optimum is known.
        names: the quantities that are logged; those of board Returns have a prior.
    """
    written = set(names)

    def bands(group: str, name: str, board: str) -> Chart:
        # The band of each value alone: a chart has one for a tag.
        found = [
            tuple(f"{group}/{name}_{k}" for k in ends) for ends in (("mean", "q25", "q75"), ("median", "min", "max"))
        ]
        lines = ["optimal"] * (name in groups[group]) + ["prior"] * (board == RETURNS)
        return [(a, b, c) for a, b, c in found] + [(f"{group}/{name}_{line}",) * 3 for line in lines]

    return {
        board: {f"{group}: {name}": bands(group, name, board) for group in groups for name in mine if name in written}
        for board, mine in {
            CONVERGENCE: ("theta", "rho", "empirical_width"),
            BIAS: ("delta_max",),
            RETURNS: ("objective", "reward_per_step", "return"),
        }.items()
    }


def hyperparameters(cfg: DictConfig, **more: Any) -> dict[str, int | float | str]:
    """Settings of a run by name, as tab HParams takes them: numbers and text (a truth value would show as 1.0)."""
    settings: Any = OmegaConf.to_container(cfg, resolve=True)
    env = {f"env.{k}": v for k, v in settings["env"].items() if k not in ("name", "id", "suggest")}
    learner = {k: v for k, v in settings["learner"].items() if k != "name"}
    found = {"env": cfg.env.name, "learner": cfg.learner.name, **learner, **env, "seed": cfg.seed, **more}
    return {
        key: value if isinstance(value, (int, float, str)) and not isinstance(value, bool) else json.dumps(value)
        for key, value in found.items()
        if value is not None and value != {}
    }


def command(directory: Path) -> str | None:
    """What was typed to make the run in ``directory``; None where that was not the command line.

    Raises InputError for a damaged note of it.
    """
    typed = began_with(directory)
    return None if typed is None else shlex.join(["python", "train.py", *typed])


class Board:
    """Writes records against tuples streamed. A context manager: what was logged survives an exception.

    Args:
        directory: the run's.
        hyperparameters: as ``hyperparameters`` gives them.
        boards: charts of tab Custom Scalars.
        mark: of the event file at the checkpoint that the run goes on from; None begins it.
    """

    def __init__(
        self,
        directory: str | os.PathLike[str],
        hyperparameters: Mapping[str, int | float | str],
        boards: Boards,
        mark: Mark | None = None,
    ) -> None:
        self._file = EventFile(directory, mark)
        self.directory = Path(directory)
        self._lines: dict[str, float] = {}
        # Session start and end go into the run's own file: add_hparams would open a run directory more.
        # No experiment summary: TensorBoard takes the first it finds and hides other runs' columns.
        _, session_start, self._session_end = summary.hparams(dict(hyperparameters), {})  # type: ignore[no-untyped-call]
        if self._file.fresh:
            shown = summary.custom_scalars({})  # type: ignore[no-untyped-call]
            shown.value[0].tensor.string_val[0] = _layout(boards).SerializeToString()
            self._file.add(shown)
            self._file.add(session_start)

    def record(self, values: Mapping[str, float], step: int) -> None:
        """One record; keys are full tags."""
        self.scalars({**values, **self._lines}, step)

    def lines(self, values: Mapping[str, float]) -> None:
        """Constants, written beside every record from now on."""
        self._lines.update(values)

    def scalars(self, values: Mapping[str, float], step: int) -> None:
        """Scalars that are no part of a record."""
        for tag, value in values.items():
            self._file.add(summary.scalar(tag, value), step)  # type: ignore[no-untyped-call]

    def picture(self, tag: str, pixels: np.ndarray, step: int) -> None:
        """An image [H, W, 3] uint8."""
        self._file.add(summary.image(tag, pixels, dataformats="HWC"), step)  # type: ignore[no-untyped-call]

    def texts(self, configuration: str) -> None:
        """The resolved configuration (YAML) and the command behind the run."""
        texts = {"configuration": f"```yaml\n{configuration}```"}
        try:
            typed = command(self.directory)
        except InputError as error:
            typed = None
            print(f"warning: the log does without the command behind the run ({error})", file=sys.stderr)
        if typed is not None:
            texts["command"] = f"```\n{typed}\n```"
        for tag, markdown in texts.items():
            self._file.add(summary.text(tag, markdown))  # type: ignore[no-untyped-call]

    def mark(self) -> Mark:
        """Where the event file can be gone on with, once it is flushed."""
        return self._file.mark()

    def flush(self) -> Mark:
        """Hand all records to the system; the mark."""
        return self._file.flush()

    def __enter__(self) -> Board:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is not None:
            self.failed()
        self._file.add(self._session_end)
        self._file.close()

    def failed(self) -> None:
        """Tab HParams shall call the run a failure."""
        plugin = self._session_end.value[0].metadata.plugin_data
        content = plugin_data_pb2.HParamsPluginData.FromString(plugin.content)
        content.session_end_info.status = api_pb2.STATUS_FAILURE
        plugin.content = content.SerializeToString()


def _layout(boards: Boards) -> Any:
    """As the protocol buffer; torch's ``add_custom_scalars`` takes one band a chart."""

    def chart(title: str, entries: Chart) -> Any:
        lines = [entry for entry in entries if isinstance(entry, str)]
        if lines:
            return layout_pb2.Chart(title=title, multiline=layout_pb2.MultilineChartContent(tag=lines))
        bands = [
            layout_pb2.MarginChartContent.Series(value=entry[0], lower=entry[1], upper=entry[2]) for entry in entries
        ]
        return layout_pb2.Chart(title=title, margin=layout_pb2.MarginChartContent(series=bands))

    return layout_pb2.Layout(
        category=[
            layout_pb2.Category(title=board, chart=[chart(title, entries) for title, entries in charts.items()])
            for board, charts in boards.items()
            if charts
        ]
    )
