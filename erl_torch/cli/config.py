"""What Hydra is told: the schemas of ``conf/``, and the resolvers that name run directories."""

from __future__ import annotations

import re
from typing import Any

from hydra.core.config_store import ConfigStore
from omegaconf import OmegaConf

from erl_torch.run.settings import SCHEMAS, Compare, Play, Reproduce, Train


def slug(text: Any) -> str:
    """``text`` as part of a file name: no separators, nothing a shell would touch."""
    return re.sub(r"[^A-Za-z0-9_.=+]+", "-", str(text)).strip("-.") or "run"


def run_name(number: int, overrides: str) -> str:
    """``NNN-key=value-...`` of a multirun job: keys without their group, at most 80 characters."""
    parts = [part.lstrip("+~").split(".")[-1] if "=" not in part else
             part.split("=", 1)[0].lstrip("+~").split(".")[-1] + "=" + part.split("=", 1)[1]
             for part in overrides.split(",") if part]  # fmt: skip
    return f"{int(number):03d}-{slug('-'.join(parts))}"[:80]


def register() -> None:
    """Make the schemas and resolvers known to Hydra; harmless when repeated."""
    store = ConfigStore.instance()
    for group, options in SCHEMAS.items():
        for name, schema in options.items():
            store.store(group=f"schema/{group}", name=name, node=schema)
    store.store(group="schema", name="train", node=Train)
    store.store(group="schema", name="compare", node=Compare)
    store.store(group="schema", name="reproduce", node=Reproduce)
    store.store(group="schema", name="play", node=Play)
    OmegaConf.register_new_resolver("slug", slug, replace=True)
    OmegaConf.register_new_resolver("run_name", run_name, replace=True)
