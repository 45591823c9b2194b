"""All 19,440 mazes of Table S1 by both rules: converged eigenvectors, and the authors' capped power iteration.

    python benchmarks/table_s1_by_power.py     a quarter of an hour on two cores; killed and started again, it goes on

Prints a Markdown table; files: runs/reproduce/table_s1_by_power-full-seed0.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from erl_torch.reproduction import runner, table_s1
from erl_torch.reproduction.artifact import Units


def units(scale: str, seed: int) -> Units:
    return {name: {**unit, "n_power": unit["n"]} for name, unit in table_s1.units(scale, seed).items()}


def main() -> None:
    every = replace(table_s1.ARTIFACT, name="table_s1_by_power", units=units)
    output = runner.run([every], Path("runs/reproduce"), "full", processes=2)[every.name]
    print("| size | density | mean k, published | authors' rule | converged | three largest, published | authors' rule "
          "| converged | counts that differ | longer than any converged |")  # fmt: skip
    print("|---" * 10 + "|")
    for group in output.data["groups"]:
        power = group["by_power_iteration"]
        cells = (
            group["size"], f"{group['density']:.2f}", group["published_mean_k"],
            f"{power['mean_k']:.2f} \u00b1 {power['standard_error']:.2f}",
            f"{group['mean_k']:.2f} \u00b1 {group['standard_error']:.2f}",
            *(", ".join(map(str, it)) for it in (group["published_largest"], power["largest"], group["largest"])),
            power["counts_that_differ"], power["longer_than_any_exact"],
        )  # fmt: skip
        print("| " + " | ".join(map(str, cells)) + " |")


if __name__ == "__main__":
    main()
