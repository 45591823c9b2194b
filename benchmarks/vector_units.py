"""Which results depend on the vector units of the processor: runs with and without those of a library.

    python benchmarks/vector_units.py       two minutes

NumPy, torch and OpenBLAS each choose their loops by the processor. Every learner runs once with what there is, and once
with the loops of an older processor in one of the three; printed is the largest difference of theta and of the policy.
"""

from __future__ import annotations

import contextlib
import io
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from hydra import compose, initialize_config_dir

from erl_torch.cli import config
from erl_torch.learners import LEARNERS
from erl_torch.run.training import train

ROOT = Path(__file__).parents[1]
OLDER = {
    "NumPy": {"NPY_DISABLE_CPU_FEATURES": "X86_V3 X86_V4 AVX512_ICL"},
    "torch": {"ATEN_CPU_CAPABILITY": "default"},
    "OpenBLAS": {"OPENBLAS_CORETYPE": "Nehalem"},
}


def runs(folder: Path) -> None:
    config.register()
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        for learner in LEARNERS:
            for env in ("windy_cliff", "windy_maze", "frozen_lake"):
                given = [f"learner={learner}", f"env={env}", "experience.n_episodes=20", "evaluation.pictures=false"]
                with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
                    train(compose("train", given), folder / f"{learner}-{env}")


def main() -> None:
    with tempfile.TemporaryDirectory() as there:
        whole = Path(there) / "whole"
        subprocess.run([sys.executable, __file__, str(whole)], check=True)
        for library, settings in OLDER.items():
            folder = Path(there) / library
            subprocess.run([sys.executable, __file__, str(folder)], check=True, env={**os.environ, **settings})
            same, worst = 0, {"theta": 0.0, "policy": 0.0, "gap": 0.0}
            for path in sorted(whole.glob("*/solution.npz")):
                name = path.parent.name
                with np.load(path) as a, np.load(folder / name / "solution.npz") as b:
                    same += all(np.array_equal(a[k], b[k], equal_nan=a[k].dtype.kind == "f") for k in a.files)
                    for key in worst.keys() & set(a.files):
                        worst[key] = max(worst[key], float(np.abs(a[key] - b[key]).max()))
            figures = ", ".join(f"{key} {value:.1e}" for key, value in worst.items())
            n = len(list(whole.iterdir()))
            print(f"{library}: {same} of {n} runs have the same bits; largest difference: {figures}", flush=True)


if __name__ == "__main__":
    runs(Path(sys.argv[1])) if sys.argv[1:] else main()
