"""File formats of experience, one module per format; the first of ``FORMATS`` that claims a path reads it."""

from __future__ import annotations

from erl_torch.experience.formats import minari, npy, parquet
from erl_torch.experience.formats.format import Format

FORMATS: tuple[Format, ...] = (minari, parquet, npy)  # npy is last: it claims all that exists
ALLOWED = "there: an npz or Parquet file, a directory of columns, or minari:DATASET"
