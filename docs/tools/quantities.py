"""The tables of docs/logging.md, made from ``erl_torch.log.quantities``: python docs/tools/quantities.py

They stand between comments in the page, so that it reads well on a code host too. tests/test_docs.py fails where they
are not those of the code.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from erl_torch.log.quantities import PREFIXES, QUANTITIES, Quantity
from erl_torch.networks.quantities import NETWORK_QUANTITIES

PAGE = Path(__file__).parents[1] / "logging.md"


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in lines)


def _code(names: Iterable[str]) -> str:
    return ", ".join(f"`{name}`" for name in names)


def tables() -> dict[str, str]:
    """Each table by the name in its comment."""

    def rows(quantities: Iterable[Quantity]) -> Iterable[Sequence[str]]:
        for q in quantities:
            tags = [*q.tags, *([f"GROUP/{q.name}"] if q.replicas else [])]
            yield _code(tags), q.unit, f"`{q.result}`" if q.result else "", q.meaning

    head = ("tags", "unit", "in `result.json`", "what it is")
    return {
        "prefixes": _table(("tags", "what they are"), [(f"`{k}/...`", text) for k, text in PREFIXES.items()]),
        "quantities": _table(head, rows(QUANTITIES)),
        "networks": _table(head, rows(NETWORK_QUANTITIES)),
    }


def current(page: str) -> str:
    """``page`` with its tables as the code has them. Raises LookupError where the place of one is missing."""
    for name, table in tables().items():
        before, begin, rest = page.partition(f"<!-- {name} -->\n")
        _, end, after = rest.partition("\n<!-- end -->")
        if not (begin and end):
            raise LookupError(f"docs/logging.md has no place for the table '{name}'")
        page = f"{before}{begin}\n{table}\n{end}{after}"
    return page


if __name__ == "__main__":
    PAGE.write_text(current(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
