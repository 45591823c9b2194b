"""Names that load on first use, so that importing a package stays light."""

from __future__ import annotations

import importlib
import warnings
from collections.abc import Callable, Mapping
from typing import NamedTuple


class Renamed(NamedTuple):
    """An old name that still loads."""

    module: str  # where it is, relative to the package
    name: str  # what it is called there
    instead: str  # what to write today


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
            renamed_to: object = getattr(importlib.import_module(f"{package}.{old.module}"), old.name)
            return renamed_to
        if name not in home:
            raise AttributeError(f"module '{package}' has no attribute '{name}'")
        value: object = getattr(importlib.import_module(f"{package}.{home[name]}"), name)
        return value

    return load
