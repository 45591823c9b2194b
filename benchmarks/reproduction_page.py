"""The page of the reproduction out of full runs.

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
SOURCES = {"paper": "", "oracle": " \u2020"}
HEAD = """# The whole paper, one command each

    python reproduce.py artifact=NAME                 a small version
    python reproduce.py artifact=NAME scale=full      what this page shows
    python reproduce.py artifact=all scale=full

`NAME` is one of the artifacts below. Numbers come as CSV and JSON, the picture as PNG and SVG, in
`runs/reproduce/NAME-SCALE-seedSEED`. The same seed gives the same files, byte for byte, for any number of `processes`,
and also if the run was stopped or killed and started again: it goes on with the units of work that are missing.

Verdicts: *reproduced* (equal to the digits given), *reproduced in distribution* (a random quantity: the published value
lies where one more of our replicas would), *not reproduced*. Values marked \u2020 are not in the paper: they were
computed independently of this package, to high precision or on other samples.

Wall clock on two cores of a shared server (2026-11-25): `table_s1 scale=full` 2 min 28 s, `table_s2 scale=full` with
its sampling 2 min 44 s, all other artifacts at full scale together 56 s, `artifact=all scale=quick` 37 s.


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
    lines = ["| artifact | what | verdict | numbers met |", "|---|---|---|---|"]
    for name, about in abouts.items():
        numbers = about["published_against_ours"]
        met = sum(number["verdict"] != "not reproduced" for number in numbers)
        what = f"[{title(name)}](#{title(name).lower().replace(' ', '-')})"
        lines.append(f"| {what} | {about['title']} | {about['verdict']} | {met} of {len(numbers)} |")
    PAGE.write_text(HEAD + "\n".join(lines) + "\n" + "".join(section(name, about) for name, about in abouts.items()))


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
        "\n| | published | ours | verdict | |\n|---|---|---|---|---|",
    ]
    for number in about["published_against_ours"]:
        shown = (cell(number[key]) for key in ("published", "ours"))
        lines.append(
            f"| {number['quantity']}{SOURCES[number['source']]} | {' | '.join(shown)} | {number['verdict']} "
            f"| {number['note']} |".replace("||", "&#124;&#124;")
        )
    return "\n".join(lines) + "\n"


def cell(value: Any) -> str:
    if isinstance(value, list):
        return ", ".join(map(cell, value))
    return f"{value:.7g}" if isinstance(value, float) else str(value)


if __name__ == "__main__":
    main()
