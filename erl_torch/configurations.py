"""Where the configurations are: ``conf/`` of the tree that the package stands in, else as installed."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path


def folder() -> Path:
    """The folder with ``train.yaml``, ``env/``, ``learner/`` and so on."""
    beside = Path(__file__).resolve().parents[1] / "conf"
    return beside if (beside / "train.yaml").exists() else Path(str(files("erl_torch.conf")))


def names(group: str) -> list[str]:
    """The configurations of ``group``: its files, without ``.yaml``."""
    return sorted(path.stem for path in (folder() / group).glob("*.yaml"))
