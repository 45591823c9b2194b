"""Write the page of the reproduction from full runs.

    python reproduce.py artifact=all scale=full && python benchmarks/reproduction_page.py

Copies the final files from runs/reproduce to docs/results/reproduction (SVG files where they are small), where those of
artifacts that were not run stay as they are, and writes docs/reproduction.md.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

from erl_torch.reproduction import ARTIFACTS

ROOT = Path(__file__).parents[1]
FROM, TO, PAGE = (
    ROOT / "runs" / "reproduce",
    ROOT / "docs" / "results" / "reproduction",
    ROOT / "docs" / "reproduction.md",
)
MOST_SVG = 300_000  # bytes
SOURCES = ("printed", "picture", "stated")  # the paper's
COLUMNS = ("printed", "read off", "computed")
HEAD = """# The whole paper, one command per artifact

    python reproduce.py artifact=NAME                 a small version
    python reproduce.py artifact=NAME scale=full      what this page shows
    python reproduce.py artifact=all scale=full && python benchmarks/reproduction_page.py      this page

`NAME` is one of the artifacts below. Numbers come as CSV and JSON, the picture as PNG and SVG, in
`runs/reproduce/NAME-SCALE-seedSEED`. A run that was stopped or killed goes on with the units of work that are missing.
The same seed gives the same files for any number of `processes`. On one machine a second run gave the same bytes: in
the 32 files of all figures and of Table S1, and in 115 of the 127 units of work of Table S2, which are all of the three
small tasks and four samples of Acrobot as described. The other twelve, minutes each, were not done again. Other
processors and other versions of NumPy, SciPy and Matplotlib may round the last digits otherwise.

**Reproduced** has one meaning. For a number without chance: ours equals it to half a unit of its last digit. For a
mean: ours differs from it by no more than 95 % of differences would, if both samples were of one law. The standard
error of the difference is sqrt(e1^2 + e2^2 + d^2/3), where e1 and e2 are the standard errors of both means and d is
half a unit of the last digit or the error of reading (Student's t, as for normal means). The 95 % hold for all lines
with chance in one column of a table together (Sidak; the thirteenth line of Table S1, a binomial count, is one of
them). A single count is a mean of one. *Allowed* is the largest difference that counts as none. A statement of the
paper in words is compared with our numbers; the page gives the threshold.

Three columns tell where a value comes from: *printed* in the paper, *read off* one of its pictures, or *computed*
independently of this package. Computed values are ours and no claim of the paper: they *agree* or *differ*, by the same
rule. "Met" counts the paper's values alone.

"""


def main() -> None:
    TO.mkdir(parents=True, exist_ok=True)
    abouts = {}
    for name in ARTIFACTS:
        for file in sorted((FROM / f"{name}-full-seed0").glob(f"{name}.*")):
            (TO / file.name).unlink(missing_ok=True)
            if file.suffix != ".svg" or file.stat().st_size < MOST_SVG:
                shutil.copyfile(file, TO / file.name)
        abouts[name] = json.loads((TO / f"{name}.json").read_text())
    lines = ["| artifact | what | verdict | printed, met | read off, met | in words, met | computed, agree |"]
    lines.append("|---" * 7 + "|")
    for name, about in abouts.items():
        met = (share(about["comparisons"], source) for source in (*SOURCES, "computed"))
        what = f"[{title(name)}](#{title(name).lower().replace(' ', '-')})"
        lines.append(f"| {what} | {about['title']} | {about['verdict']} | {' | '.join(met)} |")
    PAGE.write_text(HEAD + "\n".join(lines) + "\n" + "".join(section(name, about) for name, about in abouts.items()))


def share(numbers: list[dict[str, Any]], source: str) -> str:
    its = [number["verdict"] in ("reproduced", "agrees") for number in numbers if number["source"] == source]
    return f"{sum(its)} of {len(its)}" if its else ""


def title(name: str) -> str:
    kind, number = name.split("_")
    return f"{kind.capitalize()} {number.upper()}"


def section(name: str, about: dict[str, Any]) -> str:
    at = f"results/reproduction/{name}"
    files = [f"[{kind.upper()}]({at}.{kind})" for kind in ("csv", "json", "svg") if (TO / f"{name}.{kind}").exists()]
    lines = [
        f"\n## {title(name)}",
        f"\n{about['title'][0].upper()}{about['title'][1:]}: **{about['verdict']}**. {', '.join(files)}.",
        f"\n    {about['command']}\n",
        f"![{title(name)}]({at}.png)\n",
        *(f"- {sentence}" for sentence in about["reading"]),
    ]
    if about["comparisons"]:
        lines += ["\n| | printed | read off | computed | ours | allowed | verdict | |", "|---" * 8 + "|"]
    for number in about["comparisons"]:
        given = (cell(number[column]) for column in COLUMNS)
        allowed = "" if number["within"] is None else f"{number['within']:.2g}"
        cells = (number["quantity"], *given, cell(number["ours"]), allowed, number["verdict"], number["note"])
        lines.append(f"| {' | '.join(cells)} |".replace("||", "&#124;&#124;"))
    return "\n".join(lines) + "\n"


def cell(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, list):
        return ", ".join(map(cell, value))
    return f"{value:.7g}" if isinstance(value, float) else str(value)


if __name__ == "__main__":
    main()
