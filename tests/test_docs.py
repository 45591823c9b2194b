"""The documentation against the package. That the site builds, links and all, is tried by .ci/run."""

import inspect
import re
import runpy

import pytest
from helpers import ROOT

import erl_torch
import erl_torch.envs
import erl_torch.learners

DOCS = ROOT / "docs"
PUBLIC = {f"erl_torch.{name}": getattr(erl_torch, name) for name in erl_torch.__all__}
MORE = {
    f"{module.__name__}.{name}": getattr(module, name)
    for module in (erl_torch.envs, erl_torch.learners)
    for name in module.__all__
    if name != "LEARNERS"
}


def test_every_public_name_is_in_the_api_reference():
    shown = {
        line.removeprefix("::: ").rsplit(".", 1)[-1]
        for page in (DOCS / "api").glob("*.md")
        for line in page.read_text().splitlines()
        if line.startswith("::: ")
    }
    assert {name.rsplit(".", 1)[-1] for name in PUBLIC | MORE} <= shown


@pytest.mark.parametrize("name", sorted(PUBLIC | MORE))
def test_docstring(name):
    """There is one; what it calls arguments are arguments, and where it lists them it lists all."""
    thing = (PUBLIC | MORE)[name]
    text = inspect.getdoc(thing) or ""
    assert text
    section = re.search(r"^Args:\n((?: {4}.*\n?|\n)+)", text, re.M)
    if section is None:
        return
    documented = {
        argument.strip()
        for entry in re.findall(r"^ {4}(\w[\w, ]*):", section[1], re.M)
        for argument in entry.split(",")
    }
    known = set(inspect.signature(thing).parameters)
    assert documented <= known
    assert known <= documented


def test_every_example_is_listed():
    page = (DOCS / "examples.md").read_text()
    for path in (ROOT / "examples").iterdir():
        assert path.suffix not in (".py", ".ipynb") or f"| `{path.name}` |" in page


def test_tables_of_what_is_logged_are_those_of_the_code():
    """If not: python docs/tools/quantities.py"""
    page = (DOCS / "logging.md").read_text()
    assert runpy.run_path(str(DOCS / "tools" / "quantities.py"))["current"](page) == page
