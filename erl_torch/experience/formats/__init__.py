"""File formats of experience, one module per format; the first of ``FORMATS`` that claims a path reads it."""

from __future__ import annotations

from erl_torch.experience.formats import minari, npy, rows
from erl_torch.experience.formats.format import ALLOWED as ALLOWED
from erl_torch.experience.formats.format import Format

FORMATS: tuple[Format, ...] = (minari, rows, npy)  # npy is last: it claims all that exists
