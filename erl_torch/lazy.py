"""Load a package's names on first use, so that its import stays light."""

from __future__ import annotations

import importlib
import warnings
from collections.abc import Callable, Mapping
from typing import NamedTuple


class Renamed(NamedTuple):
    """An old name that still loads."""

    module: str  # its module, relative to the package
    name: str  # its name there
    instead: str  # the name to use today


def loader(
    package: str, home: Mapping[str, str], renamed: Mapping[str, Renamed] | None = None
) -> Callable[[str], object]:
    """Make the ``__getattr__`` of ``package``, whose names are in its modules ``home``.

    A name in ``renamed`` loads with a DeprecationWarning. Any other name raises AttributeError.
    """

    def load(name: str) -> object:
        old = (renamed or {}).get(name)
        if old is not None:
            warnings.warn(f"{package}.{name} is deprecated: use {old.instead}", DeprecationWarning, stacklevel=2)
        elif name not in home:
            raise AttributeError(f"module '{package}' has no attribute '{name}'")
        module, attribute = (home[name], name) if old is None else (old.module, old.name)
        value: object = getattr(importlib.import_module(f"{package}.{module}"), attribute)
        return value

    return load
