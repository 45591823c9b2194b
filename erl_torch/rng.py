"""Named, independent random streams from one seed."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from erl_torch import checks


class Streams(NamedTuple):
    """One generator per purpose, so that more evaluation never changes the experience."""

    environment: np.random.Generator
    behaviour: np.random.Generator
    evaluation: np.random.Generator


def streams(seed: int) -> Streams:
    """The named streams of ``seed``, a whole number >= 0. Raises InputError."""
    children = np.random.SeedSequence(checks.at_least("seed", seed, 0)).spawn(len(Streams._fields))
    return Streams(*(np.random.default_rng(child) for child in children))
