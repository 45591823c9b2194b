"""All 19,440 mazes of Table S1 by both rules: converged eigenvectors, and the authors' capped power iteration.

python benchmarks/table_s1_by_power.py     half an hour on two cores; killed and started again, it goes on

Files: runs/reproduce/table_s1_by_power-full-seed0, as ``reproduce.py artifact=table_s1`` writes them.
"""

from dataclasses import replace
from pathlib import Path

from erl_torch.reproduction import runner, table_s1


def units(scale, seed):
    return {name: {**unit, "n_power": unit["n"]} for name, unit in table_s1.units(scale, seed).items()}


if __name__ == "__main__":
    every = replace(table_s1.ARTIFACT, name="table_s1_by_power", units=units)
    output = runner.run([every], Path("runs/reproduce"), "full", processes=2)[every.name]
    print(runner.summary(every, output))
