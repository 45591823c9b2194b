"""The runner behind ``reproduce.py``: units of work, each kept in one file, and the final files made from them.

For every artifact the folder ``<artifact>-<scale>-seed<seed>`` holds

    units/NAME.npz    the result of ``work`` for one unit, with the settings behind it
    NAME.csv .json    the numbers; those of others beside ours, each in the column of its source
    NAME.png .svg     the picture

A unit's file is written under a temporary name and renamed, so that a run killed at any moment leaves whole units
only. Started again, it does the missing ones. A unit whose file is damaged, or of other settings or another version of
the artifact, is done anew. Final files depend on the unit files alone, and have no clock in them. They are the same
byte for byte, however often the run was interrupted and however many processes took part.

An artifact is a module with an ``ARTIFACT``: see ``artifact.py`` for the interface, ``figure_4.py`` for a short
example. Artifacts that share units (``units_of``) do them once.
"""

from __future__ import annotations

import contextlib
import csv
import io
import json
import re
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import matplotlib as mpl
import numpy as np
import torch
from omegaconf import DictConfig
from tqdm import tqdm

from erl_torch import checks, parallel
from erl_torch.checks import InputError
from erl_torch.files import read_npz, write_bytes, write_json, write_npz
from erl_torch.reproduction import ARTIFACTS, SCALES, load
from erl_torch.reproduction.artifact import COLUMNS, Artifact, Output
from erl_torch.run.settings import check_reproduction_keys

DPI = 130
FINGERPRINT = "fingerprint"


class _Unit(NamedTuple):
    path: Path
    fingerprint: str
    work: Callable[[], Mapping[str, object]]


def reproduce(cfg: DictConfig, directory: Path, safe_point: Callable[[], None] = lambda: None) -> dict[str, Output]:
    """Run ``cfg`` (as composed from ``conf/reproduce.yaml``) and print the summary. Raises InputError."""
    check_reproduction_keys(cfg)
    checks.one_of("artifact", cfg.artifact, (*ARTIFACTS, "all"))
    checks.one_of("scale", cfg.scale, SCALES)
    checks.at_least("seed", cfg.seed, 0)
    checks.workers("processes", cfg.processes)
    checks.processes("processes", cfg.processes)
    torch.set_num_threads(1)
    names = list(ARTIFACTS) if cfg.artifact == "all" else [cfg.artifact]
    outputs = run([load(name) for name in names], directory, cfg.scale, cfg.seed, cfg.processes, safe_point)
    for name, output in outputs.items():
        folder = _folder(directory, name, cfg.scale, cfg.seed).resolve()
        with contextlib.suppress(ValueError):
            folder = folder.relative_to(Path.cwd())
        print(f"\n{summary(load(name), output)}\n  files: {folder}")
    return outputs


def run(
    artifacts: Sequence[Artifact],
    directory: Path,
    scale: str,
    seed: int = 0,
    processes: int = 1,
    safe_point: Callable[[], None] = lambda: None,
) -> dict[str, Output]:
    """Do the missing units of ``artifacts`` and write their final files under ``directory``.

    ``safe_point`` is called between units, and now and then while processes work; it may raise to end the run.
    """
    units = {a.name: _units(a, directory, scale, seed) for a in artifacts}
    every = {unit.path: unit for own in units.values() for unit in own.values()}
    done = {path for path, unit in every.items() if _kept(unit) is not None}
    todo = {path: unit.work for path, unit in every.items() if path not in done}
    outputs: dict[str, Output] = {}

    def finish() -> None:
        """Write the final files of every artifact whose units are all done."""
        for a in artifacts:
            own = units[a.name]
            if a.name in outputs or not {unit.path for unit in own.values()} <= done:
                continue
            results = {name: _kept(unit) for name, unit in own.items()}
            if all(result is not None for result in results.values()):
                outputs[a.name] = a.assemble(results, scale)  # type: ignore[arg-type]
                _write(a, outputs[a.name], _folder(directory, a.name, scale, seed), scale, seed)

    finish()
    with tqdm(
        total=len(every), initial=len(done), desc="reproducing", unit=" units", disable=None,
        bar_format="{l_bar}{bar:20}| {n_fmt}/{total_fmt}{unit}, {elapsed}<{remaining}",
    ) as bar:  # fmt: skip
        for path, values in parallel.results(todo, processes, safe_point):
            write_npz(path, {**values, FINGERPRINT: every[path].fingerprint})
            done.add(path)
            bar.update()
            finish()
    return {a.name: outputs[a.name] for a in artifacts}


def summary(artifact: Artifact, output: Output) -> str:
    """One line per comparison: the printed, read off or computed number, ours, verdict; empty columns are left out."""
    used = {COLUMNS[c.source] for c in output.comparisons}
    columns = [name for name in dict.fromkeys(COLUMNS.values()) if name in used]
    names = ["quantity", *columns, "ours", "verdict"]
    cells = [["", *names[1:]], *([_cell(c.row()[name]) for name in names] for c in output.comparisons)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    lines = []
    for quantity, *values, verdict in cells if used else []:
        aligned = [f"{value:>{width}}" for value, width in zip(values, widths[1:-1], strict=True)]
        lines.append("  ".join([f"  {quantity:{widths[0]}}", *aligned, verdict]))
    return "\n".join([f"{artifact.name}: {artifact.title}", *lines, f"  {output.verdict}"])


# -- units ------------------------------------------------------------------------------------------------


def _folder(directory: Path, name: str, scale: str, seed: int) -> Path:
    return directory / f"{name}-{scale}-seed{seed}"


def _units(a: Artifact, directory: Path, scale: str, seed: int) -> dict[str, _Unit]:
    folder = _folder(directory, a.units_of or a.name, scale, seed) / "units"
    units = {}
    for name, settings in a.units(scale, seed).items():
        if not re.fullmatch(r"[\w.+=-]{1,100}", name):
            raise ValueError(f"{name!r} is no name for the file of a unit")
        # The name of the work is part of it, so that artifacts that share units mean the same by them.
        about = {"work": f"{a.work.__module__}.{a.work.__qualname__}", "version": a.version, "settings": settings}
        units[name] = _Unit(folder / f"{name}.npz", json.dumps(about, sort_keys=True), partial(a.work, **settings))
    return units


def _kept(unit: _Unit) -> dict[str, np.ndarray] | None:
    """The arrays of the unit's file; None if it is missing, damaged, or of other settings."""
    try:
        arrays = read_npz(unit.path)
    except InputError:
        return None
    return arrays if str(arrays.pop(FINGERPRINT, "")) == unit.fingerprint else None


# -- final files ------------------------------------------------------------------------------------------


def _write(artifact: Artifact, output: Output, folder: Path, scale: str, seed: int) -> None:
    table = io.StringIO(newline="")
    writer = csv.DictWriter(table, list(output.rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(output.rows)
    write_bytes(folder / f"{artifact.name}.csv", table.getvalue().encode())
    for kind in ("png", "svg"):
        picture = io.BytesIO()
        # Ids by hash, no date, no version: the same picture is the same file.
        metadata = {"Software": None} if kind == "png" else {"Date": None, "Creator": None}
        with mpl.rc_context({"svg.hashsalt": "erl_torch"}):
            output.figure.savefig(picture, format=kind, dpi=DPI, metadata=metadata)
        write_bytes(folder / f"{artifact.name}.{kind}", picture.getvalue())
    about = {
        "artifact": artifact.name,
        "title": artifact.title,
        "command": f"python reproduce.py artifact={artifact.name} scale={scale} seed={seed}",
        "verdict": output.verdict,
        "reading": list(output.reading),
        "comparisons": [c.row() for c in output.comparisons],
        **output.data,
    }
    write_json(folder / f"{artifact.name}.json", about)


def _cell(value: object) -> str:
    if value is None:
        return ""
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(map(_cell, value)) + "]"
    return f"{value:.6g}" if isinstance(value, float) else str(value)
