"""Imports run down only: a folder stands on the folders below it, and no import inside a function hides a circle."""

import ast
import re
import sys
import zlib
from pathlib import Path

import pytest
from helpers import ended

ROOT = Path(__file__).parents[1] / "erl_torch"
# From the ground up; a folder may import from those on lines above its own.
FLOORS = (
    {"compiled", "guesses", "lazy"},
    {"checks", "configurations", "labels", "notes", "output", "rng", "files", "parallel", "pictures", "log"},
    {"solution", "mdp", "problem"},
    {"envs", "solvers"},
    {"experience"},
    {"empirical", "evaluation"},
    {"learners", "inverse", "networks"},
    {"run"},
    {"reproduction"},
    {"cli"},
)
BESIDE = {
    ("files", "checks"),
    ("labels", "checks"),
    ("pictures", "labels"),
    ("rng", "checks"),
    ("log", "checks"),
    ("solution", "mdp"),
    ("problem", "mdp"),
    ("networks", "learners"),
}
# The loop that samples as it learns; one call for each of them would cost a tenth of it.
ACROSS = {("learners.s1.kernels", "experience.kernels")}


def modules():
    for path in sorted(ROOT.rglob("*.py")):
        yield ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix("__init__").rstrip("."), path


NAMES = {name for name, _ in modules()}


def imported(path):
    """Modules of the package, relative to it, that ``path`` imports anywhere."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "erl_torch":
            base = node.module.removeprefix("erl_torch").lstrip(".")
            for alias in node.names:
                full = f"{base}.{alias.name}".lstrip(".")
                yield full if full in NAMES else base
        elif isinstance(node, ast.Import):
            for alias in node.names:
                if alias.name.split(".")[0] == "erl_torch":
                    yield alias.name.removeprefix("erl_torch").lstrip(".")


def room(name):
    return name.split(".")[0]


FLOOR = {one: floor for floor, rooms in enumerate(FLOORS) for one in rooms}


@pytest.mark.parametrize("name", sorted(NAMES - {""}))
def test_imports_run_down(name):
    path = dict(modules())[name]
    for other in imported(path):
        if other and room(other) != room(name):
            down = FLOOR[room(other)] < FLOOR[room(name)] or (room(name), room(other)) in BESIDE
            assert down, f"{name} imports {other}"


def test_imports_say_where_from():
    """The tests here would not see others: ``from . import x``, or names of the whole package."""
    for name, path in modules():
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom):
                assert not node.level, f"{name}: a relative import"
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "erl_torch":
                assert node.attr == "__version__", f"{name}: {node.attr} of the whole package"


def test_there_is_no_circle():
    graph = {name: {o for o in imported(path) if o != name and o} for name, path in modules() if name}
    done, now = set(), []

    def visit(name):
        assert name not in now, f"{now[now.index(name) :]} import each other"
        if name not in done:
            now.append(name)
            for other in graph.get(name, ()):
                visit(other)
            now.pop()
            done.add(name)

    for name in graph:
        visit(name)


def test_kernels_call_those_of_their_own_file():
    """Numba's cache does not notice a changed kernel in another file."""
    for name, path in modules():
        if name.endswith("kernels"):
            assert {(name, other) for other in imported(path)} <= ACROSS


# Whoever else runs, solves or learns takes objects.
CONFIGURED = {
    "hydra": {"cli"},
    "omegaconf": {"cli", "reproduction.runner"}
    | {
        f"run.{name}"
        for name in ["build", "classes", "compare", "networks", "origin", "playing", "settings", "training"]
    },
}


@pytest.mark.parametrize("library", CONFIGURED)
def test_configuration_stays_above(library):
    for name, path in modules():
        text = path.read_text()
        if f"import {library}" in text or f"from {library}" in text:
            assert {name, room(name)} & CONFIGURED[library], name


def test_the_loop_that_samples_is_compiled_anew():
    """Its own cache does not see that the sampling has changed; the checksum in its file does."""
    text = (ROOT / "learners/s1/kernels.py").read_text()
    assert int(re.search(r"# experience/kernels.py: (\d+)", text)[1]) == zlib.crc32(
        (ROOT / "experience/kernels.py").read_bytes()
    ), "write the new number there"


def test_copies_of_kernels_are_copies():
    """A helper of kernels in two rooms stands in both files, the same: what is proven of one holds for the other."""
    found = {}
    for name, path in modules():
        if name.endswith("kernels"):
            text = path.read_text()
            for node in ast.parse(text).body:
                if isinstance(node, ast.FunctionDef):
                    found.setdefault(node.name, set()).add(ast.get_source_segment(text, node))
    assert {name for name, sources in found.items() if len(sources) > 1} == set()


@pytest.mark.parametrize("name", ["TabularMDP", "Transitions", "collect", "evaluate", "tabular_mdp"])
def test_names_that_need_no_torch_do_not_load_it(start, name):
    code = f"import sys, erl_torch; erl_torch.{name}; assert 'torch' not in sys.modules"
    assert ended(start(sys.executable, "-c", code, cwd=ROOT.parent))[0] == 0
