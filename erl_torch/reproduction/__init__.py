"""Every figure and table of the paper and its supplement, rebuilt: one module each, one runner for all.

A new one is a module with an ``ARTIFACT`` (see ``artifact.py``) and its line below. This module is light, because the
command line reads the names from it before anything heavy is imported.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from erl_torch.reproduction.artifact import Artifact

# name of the artifact and its module: what it shows
ARTIFACTS = {
    "figure_1": "windy cliff: optimistic and optimal",
    "figure_2": "a random windy maze",
    "figure_3": "control tasks: returns in the original environments",
    "figure_4": "dynamics shift",
    "figure_5": "Algorithm S1 on the windy cliff",
    "figure_s1": "spread of the counts of Table S1",
    "figure_s2": "the control tasks",
    "table_s1": "random windy mazes: biasing iterations",
    "table_s2": "control tasks: biasing iterations",
}
SCALES = ("quick", "full")


def load(name: str) -> Artifact:
    """The artifact of that name, which is one of ``ARTIFACTS``."""
    artifact: Artifact = importlib.import_module(f"erl_torch.reproduction.{name}").ARTIFACT
    return artifact
