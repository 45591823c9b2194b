"""TensorBoard: one event file per run, and its boards. Quantities: ``erl_torch.log.quantities``."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from tensorboard.plugins.custom_scalar import layout_pb2
from tensorboard.plugins.hparams import api_pb2, plugin_data_pb2
from torch.utils.tensorboard import summary

from erl_torch.log.event_file import PATTERN, EventFile, Mark
from erl_torch.log.quantities import BY_NAME, QUANTITIES, Quantity

# Prefix and end of a constant's tag -> the run that it is.
BESIDE = {
    ("optimal", ""): "optimum",
    ("prior", ""): "prior",
    ("data", "_lower"): "data_95_low",
    ("data", "_upper"): "data_95_high",
}
CONSTANT = tuple(f"{prefix}/" for prefix, _ in BESIDE)

Band = tuple[str, str, str]  # tags of value, lower and upper end
Chart = Sequence[str | Band]  # lines (patterns of tags), or bands
Boards = Mapping[str, dict[str, Chart]]  # charts by title, by board


def _band(value: str) -> Band:
    return value, f"{value}_lower", f"{value}_upper"


def charts(table: Sequence[Quantity] = QUANTITIES, alone: bool = False) -> Boards:
    """Lines by chart and board, the same in every run: TensorBoard shows the union of all runs' layouts.

    ``alone``: without the lines of constants, which are runs of their own.
    """
    boards: dict[str, dict[str, list[str | Band]]] = {}
    for quantity in table:
        if quantity.board:
            title = quantity.chart or quantity.axis
            lines = [line for line in quantity.lines if not (alone and line.startswith(CONSTANT))]
            title = title.partition(";")[0] if alone else title
            boards.setdefault(quantity.board, {}).setdefault(title, []).extend(lines)
    return {board: dict(titles) for board, titles in boards.items()}


def beside(constants: Mapping[str, float]) -> dict[str, dict[str, float]]:
    """``constants`` (by tag) as runs of their own: by name of the run, under the tags of what they are held against.

    A chart has one colour and one name per run. So the optimum is a run that has always had the best theta.
    """
    runs: dict[str, dict[str, float]] = {}
    for tag, value in constants.items():
        prefix, _, name = tag.partition("/")
        found = re.fullmatch(r"(\w+?)(_lower|_upper)?", name)
        quantity = BY_NAME.get(found[1]) if found else None
        run = BESIDE.get((prefix, found[2] or "")) if found else None
        if quantity is not None and run is not None:
            home = "learner" if "learner" in quantity.prefixes else "eval"
            runs.setdefault(run, {})[f"{home}/{quantity.name}"] = value
    return runs


def of_sweep(directory: str | os.PathLike[str]) -> bool:
    """Whether the run in ``directory`` is a job of a sweep, beside others."""
    return Path(directory).resolve().parent.joinpath("sweep.json").exists()


def layout(
    learnt: Iterable[str], constant: Iterable[str], table: Sequence[Quantity] = QUANTITIES, alone: bool = False
) -> Boards:
    """The boards of a run of one learner.

    Args:
        learnt: tags that are written at each record.
        constant: tags of the constants beside them, which become lines and bands.
        table: all quantities, as ``with_own`` gives them.
        alone: the constants are runs of their own, as ``beside`` makes them.
    """
    written, constants = set(learnt), set(constant)

    def has_data(chart: Chart) -> bool:
        return any(re.match(entry, tag) for entry in chart if isinstance(entry, str) for tag in written)

    boards: Boards = {
        board: {title: chart for title, chart in titles.items() if has_data(chart)}
        for board, titles in charts(table, alone).items()
    }
    for quantity in table:
        tag = f"learner/{quantity.name}"
        # A chart of bands complains of each tag that is missing, and takes no patterns.
        bands = [_band(f"{k}/{quantity.name}") for k in quantity.ends if f"{k}/{quantity.name}_lower" in constants]
        if not quantity.board or tag not in written:
            continue
        if f"{tag}_lower" in written:
            boards[quantity.board][f"{tag} in its proven bounds"] = [_band(tag)]
        elif bands and not alone:
            boards[quantity.board][f"{tag} in its bands: proven, data's 95%"] = [(tag, tag, tag), *bands]
    return boards


def replica_layout(
    groups: Mapping[str, Iterable[str]], names: Iterable[str], table: Sequence[Quantity] = QUANTITIES
) -> Boards:
    """The boards of a run of replicas.

    Args:
        groups: the names of the quantities whose optimum is known, by the name of each group.
        names: the quantities that are logged.
        table: all quantities, as ``with_own`` gives them.
    """
    written = set(names)
    boards: dict[str, dict[str, Chart]] = {quantity.board: {} for quantity in table if quantity.board}
    shown = [quantity for quantity in table if quantity.board and quantity.replicas and quantity.name in written]
    for group, optima in groups.items():
        for quantity in shown:
            tag = f"{group}/{quantity.name}"
            lines = ["optimal"] * (quantity.name in optima) + ["prior"] * ("prior" in quantity.prefixes)
            # The band of each value alone: a chart has one band per tag.
            boards[quantity.board][f"{group}: {quantity.name}"] = [
                (f"{tag}_mean", f"{tag}_q25", f"{tag}_q75"),
                (f"{tag}_median", f"{tag}_min", f"{tag}_max"),
                *((f"{tag}_{line}",) * 3 for line in lines),
            ]
    return boards


def hyperparameters(
    settings: Mapping[str, Any], shown: Iterable[str] | None = None, **more: object
) -> dict[str, int | float | str]:
    """The settings of a run by name, as tab HParams takes them: numbers and text.

    Truth values and lists become JSON, since a truth value would show as 1.0. What is None or {} is left out.

    Args:
        settings: the configuration as plain containers, with ``env``, ``learner`` and ``seed``.
        shown: dotted keys of those that are wanted; None is all of environment and learner.
        more: settings that are no part of it.
    """
    env = {f"env.{k}": v for k, v in settings["env"].items() if k not in ("class", "name", "id", "suggest")}
    learner = {k: v for k, v in settings["learner"].items() if k not in ("class", "name")}
    names = {"env": settings["env"]["name"], "learner": settings["learner"]["name"]}
    values = {**names, **learner, **env, "seed": settings["seed"], **more}
    if shown is not None:
        for group in ("experience", "evaluation"):
            values |= {f"{group}.{k}": v for k, v in settings[group].items() if k not in ("class", "name")}
            values[group] = settings[group]["name"]
        wanted = {re.sub(r"^learner\.(?!class$)|\.(class|id)$", "", key) for key in shown}
        wanted |= {"beta"} if "env" in wanted else set()  # an environment suggests its own
        values = {key: value for key, value in values.items() if key in wanted}
    return {
        key: value if isinstance(value, (int, float, str)) and not isinstance(value, bool) else json.dumps(value)
        for key, value in values.items()
        if value is not None and value != {}
    }


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
        self._beside: dict[str, tuple[EventFile, Mapping[str, float]]] = {}
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
        self._constants(step)

    def lines(self, values: Mapping[str, float]) -> None:
        """Constants, written beside every record from now on; of a run that is no job of a sweep as runs, too."""
        self._lines.update(values)
        if not of_sweep(self.directory):
            self.runs_beside(beside(values))

    def runs_beside(self, runs: Mapping[str, Mapping[str, float]]) -> None:
        """Constants as runs of their own, in directories below this one, from step 0 to each record.

        They are begun anew where a run goes on: a point more of a constant changes nothing.
        """
        for name, values in runs.items():
            for path in (self.directory / name).glob(PATTERN):
                path.unlink(missing_ok=True)
            self._beside[name] = EventFile(self.directory / name), values
        self._constants(0)

    def _constants(self, step: int) -> None:
        for file, values in self._beside.values():
            for tag, value in values.items():
                file.add(summary.scalar(tag, value), step)  # type: ignore[no-untyped-call]

    def scalars(self, values: Mapping[str, float], step: int) -> None:
        """Scalars that are no part of a record."""
        for tag, value in values.items():
            self._file.add(summary.scalar(tag, value), step)  # type: ignore[no-untyped-call]

    def picture(self, tag: str, pixels: np.ndarray, step: int) -> None:
        """An image [H, W, 3] uint8."""
        self._file.add(summary.image(tag, pixels, dataformats="HWC"), step)  # type: ignore[no-untyped-call]

    def texts(self, texts: Mapping[str, str]) -> None:
        """Markdown by tag, for tab Text."""
        for tag, markdown in texts.items():
            self._file.add(summary.text(tag, markdown))  # type: ignore[no-untyped-call]

    def mark(self) -> Mark:
        """Where the event file can be gone on with, once it is flushed."""
        return self._file.mark()

    def flush(self) -> Mark:
        """Hand all records to the system; the mark."""
        for file, _ in self._beside.values():
            file.flush()
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
        for file, _ in self._beside.values():
            file.close()

    def failed(self) -> None:
        """Tab HParams shall call the run a failure."""
        plugin = self._session_end.value[0].metadata.plugin_data
        content = plugin_data_pb2.HParamsPluginData.FromString(plugin.content)
        content.session_end_info.status = api_pb2.STATUS_FAILURE
        plugin.content = content.SerializeToString()


def _layout(boards: Boards) -> layout_pb2.Layout:
    """``boards`` as the protocol buffer; torch's ``add_custom_scalars`` takes only one band per chart."""

    def chart(title: str, entries: Chart) -> layout_pb2.Chart:
        lines = [entry for entry in entries if isinstance(entry, str)]
        if lines:
            return layout_pb2.Chart(title=title, multiline=layout_pb2.MultilineChartContent(tag=lines))
        bands = [
            layout_pb2.MarginChartContent.Series(value=entry[0], lower=entry[1], upper=entry[2]) for entry in entries
        ]
        return layout_pb2.Chart(title=title, margin=layout_pb2.MarginChartContent(series=bands))

    return layout_pb2.Layout(
        category=[
            layout_pb2.Category(title=board, chart=[chart(title, entries) for title, entries in titles.items()])
            for board, titles in boards.items()
            if titles
        ]
    )
