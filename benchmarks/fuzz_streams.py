"""Damaged experience files: each is learnt from, or refused with one line that names it.

    python benchmarks/fuzz_streams.py [FILES] [SEED]      default 1000 and 0; a third of each format

Files are cut, have bits flipped, stretches zeroed or bytes added, columns of other types or names (the damage of
tests/test_streams.py, with other seeds).
"""

from __future__ import annotations

import collections
import sys
import tempfile
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from test_streams import damaged, refusal

KINDS = ("npz", "columns", "parquet")


def main(n: int, seed: int) -> None:
    rng = np.random.default_rng([seed, 1])
    found: dict[tuple[str, str], int] = collections.Counter()
    for i in range(n):
        kind = KINDS[i % len(KINDS)]
        with tempfile.TemporaryDirectory() as folder:
            on_bad = str(rng.choice(["stop", "skip"]))
            path = damaged(rng, Path(folder), kind)
            said = refusal(path, on_bad)
            wrong = "\n" in said or (said and path.name not in said)
            if wrong:
                print(f"file {i}, {kind}: {said!r}")
            found[kind, "wrong" if wrong else "refused" if said else "learnt from"] += 1
    for (kind, outcome), count in sorted(found.items()):
        print(f"{kind:8} {outcome:12} {count}")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 1000, int(sys.argv[2]) if len(sys.argv) > 2 else 0)
