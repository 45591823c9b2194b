"""Load a package's names on first use, so that its import stays light."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping


def loader(package: str, home: Mapping[str, str]) -> Callable[[str], object]:
    """The ``__getattr__`` of ``package``; ``home`` gives the module of each name. AttributeError for other names."""

    def load(name: str) -> object:
        if name not in home:
            raise AttributeError(f"module '{package}' has no attribute '{name}'")
        value: object = getattr(importlib.import_module(f"{package}.{home[name]}"), name)
        return value

    return load
