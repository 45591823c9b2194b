"""The paper's artifacts: their interface, the numbers they must meet, and a runner that survives being killed."""

import json
import os
import signal
import sys

import numpy as np
import pytest
from helpers import ROOT, composed, ended, random_mdp, wait_until

from erl_torch import InputError, estimate_mdp, iterate_biasing
from erl_torch.reproduction import ARTIFACTS, SCALES, control, load, runner
from erl_torch.reproduction.artifact import (
    AGREES,
    COLUMNS,
    DIFFERS,
    NOT_REPRODUCED,
    NOTHING,
    ORACLE,
    PICTURE,
    REPRODUCED,
    VERDICTS,
    Artifact,
    Comparison,
    Output,
    compared,
    compared_means,
    compared_samples,
)
from erl_torch.reproduction.figure_3 import moving_average, normalised


@pytest.fixture(autouse=True)
def own_cache(tmp_path_factory, monkeypatch):
    monkeypatch.setenv("ERL_TORCH_CACHE", str(tmp_path_factory.getbasetemp() / "cache"))


# -- every artifact ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ARTIFACTS)
def test_units_are_named_and_plain(name, tmp_path):
    its = load(name)
    assert its.name == name
    for scale in SCALES:
        units = its.units(scale, 3)
        assert json.loads(json.dumps(units)) == units
        assert len({json.dumps(settings, sort_keys=True) for settings in units.values()}) == len(units)
        kept = runner._units(its, tmp_path, scale, 3)  # raises for a name that no file could have
        assert [unit.path.parent.parent.name for unit in kept.values()] == [
            f"{its.units_of or name}-{scale}-seed3"
        ] * len(units)
    assert len(its.units("quick", 0)) <= len(its.units("full", 0))


@pytest.mark.parametrize("name", [name for name in ARTIFACTS if load(name).units_of])
def test_shared_units_mean_the_same(name):
    its = load(name)
    other = load(its.units_of)
    assert its.work is other.work
    assert its.version == other.version
    assert its.units("full", 1).items() <= other.units("full", 1).items()


def tiny(name):
    """Results of a few small units; the first is worked twice."""
    its = load(name)
    units = its.units("quick", 0)
    if name == "table_s2":
        small = {"task": "pendulum", "n_samples": 20, "episodes": 2}
        first, second = twice(its.work, small | {"seed": 0}), arrays(its.work(**small, seed=1))
        return dict.fromkeys(units, first) | {unit.replace("as_published", "sample1"): second for unit in units}
    if name == "figure_5":
        small = {**next(iter(units.values())), "n_episodes": 10, "n_epochs": 3}
        return dict.fromkeys(units, twice(its.work, small))
    if name == "figure_2":
        units = dict(list(units.items())[:2])
    (first, settings), *others = units.items()
    return {first: twice(its.work, settings)} | {unit: arrays(its.work(**settings)) for unit, settings in others}


def arrays(result):
    return {key: np.asarray(value) for key, value in result.items()}


def twice(work, settings):
    first, second = (arrays(work(**settings)) for _ in range(2))
    assert first.keys() == second.keys()
    for key, value in first.items():
        np.testing.assert_array_equal(value, second[key])
        assert value.dtype.kind in "fiubU"
    return first


@pytest.fixture(scope="module")
def outputs(tmp_path_factory):
    os.environ["ERL_TORCH_CACHE"] = str(tmp_path_factory.getbasetemp() / "cache")
    names = ("figure_1", "figure_2", "figure_4", "figure_5", "figure_s2", "table_s2")
    results = {name: tiny(name) for name in names}
    results["figure_3"] = results["table_s2"]
    return {name: load(name).assemble(its, "quick") for name, its in results.items()}


@pytest.mark.slow
def test_outputs_can_be_written_and_name_every_published_number(outputs, tmp_path, monkeypatch):
    monkeypatch.setattr(runner, "DPI", 30)
    for name, output in outputs.items():
        runner._write(load(name), output, tmp_path, "quick", 0)
        about = json.loads((tmp_path / f"{name}.json").read_text())
        assert about["verdict"] in VERDICTS
        assert about["command"] == f"python reproduce.py artifact={name} scale=quick seed=0"
        assert bool(about["comparisons"]) == (name != "figure_s2")
        lines = (tmp_path / f"{name}.csv").read_text().splitlines()
        assert len(lines) == len(output.rows) + 1
        assert (tmp_path / f"{name}.png").read_bytes().startswith(b"\x89PNG")
        assert (tmp_path / f"{name}.svg").stat().st_size > 1000
        text = runner.summary(load(name), output)
        assert all(c.quantity in text and c.verdict in (*VERDICTS, AGREES, DIFFERS) for c in output.comparisons)
        for c, row in zip(output.comparisons, about["comparisons"], strict=True):
            given = {"printed": row["printed"], "read off": row["read off"], "computed": row["computed"]}
            assert [name for name, value in given.items() if value is not None] == [COLUMNS[c.source]]
    wanted: dict[str, list[float]] = {
        "figure_4": [-756.59, -1000.0, -946.76, -997.14, -947.14],
        "figure_5": [-1.29, -0.985, -0.957, -0.966, -0.966, -1.626, -0.956],
        "table_s2": [28, 38, 29, 58],
    }
    for name, numbers in wanted.items():
        references = [c.reference for c in outputs[name].comparisons]
        assert all(references.count(number) >= numbers.count(number) for number in numbers)


@pytest.mark.slow
def test_exact_numbers(outputs):
    """Everything that does not hang on a sample meets its oracle."""
    for name in ("figure_1", "figure_2", "figure_4"):
        assert {c.verdict for c in outputs[name].comparisons} <= {REPRODUCED, AGREES}
    exact = [c for c in outputs["figure_5"].comparisons if not c.note]
    assert len(exact) == 14
    assert {(c.source, c.verdict) for c in exact} == {(PICTURE, REPRODUCED), (ORACLE, AGREES)}


def test_verdicts():
    assert compared("a", 1.0, 1.04, 0.05).verdict == REPRODUCED
    assert compared("a", 1.0, 1.06, 0.05).verdict == NOT_REPRODUCED
    assert compared("a", 1.0, 1.04, 0.05, PICTURE).verdict == REPRODUCED
    assert compared("a", 1.0, 1.04, 0.05, ORACLE).verdict == AGREES
    assert compared("a", 1.0, np.nan, 0.05, ORACLE).verdict == DIFFERS
    lines = [compared("a", 1.0, 1.0, 0.0), compared("b", 1.0, 2.0, 0.0, ORACLE)]
    assert Output([], lines, None).verdict == REPRODUCED  # a computed value is no claim of the paper
    assert Output([], [*lines, compared("c", 1.0, 2.0, 0.0)], None).verdict == NOT_REPRODUCED
    assert Output([], lines[1:], None).verdict == NOTHING


def test_means_of_one_law_are_told_apart_as_often_as_stated():
    """12 lines, each a mean of 5 rounded to .1 against one of 40: all reproduced in 95 % of tables."""
    rng, tables = np.random.default_rng(0), 400
    clean = 0
    for _ in range(tables):
        ours, published = rng.normal(size=(12, 40)), rng.normal(size=(12, 5)).mean(1).round(1)
        found = [compared_samples("", p, x, 5, 0.05, 12) for p, x in zip(published, ours, strict=True)]
        clean += all(c.verdict == REPRODUCED for c in found)
    assert abs(clean / tables - 0.95) < 3 * np.sqrt(0.95 * 0.05 / tables)


def test_tolerance_of_means():
    """Tabulated quantiles: 1.960 (normal), 2.093 (Student, 19 degrees of freedom)."""
    assert compared_means("", 0.0, 0.0, 3.0, 4.0, 0.0, 1).within == pytest.approx(1.95996 * 5, rel=1e-5)
    assert compared_means("", 0.0, 0.0, 0.0, 0.0, 3.0, 1).within == pytest.approx(1.95996 * np.sqrt(3), rel=1e-5)
    draws = np.random.default_rng(0).normal(size=20)
    one = compared_samples("", 0.0, draws, 1, 0.0, 1)
    assert one.within == pytest.approx(2.09302 * draws.std(ddof=1) * np.sqrt(1.05), rel=1e-5)
    assert compared_samples("", 2.0, np.full(3, 2.0), 1, 0.0, 1).verdict == REPRODUCED
    assert compared_samples("", 3.0, np.full(3, 2.0), 1, 0.0, 1).verdict == NOT_REPRODUCED


def test_moving_average_and_normalisation():
    np.testing.assert_allclose(moving_average(np.array([1.0, 3, 5, 7]), 2), [1, 2, 4, 6])
    np.testing.assert_allclose(moving_average(np.array([1.0, 3])), [1, 2])
    np.testing.assert_allclose(normalised(np.array([-4.0, 0, 4])), [0, 0.5, 1])


@pytest.mark.parametrize("of", ["random", "mountain_car"])
def test_power_iteration_meets_the_exact_solver(of):
    mdp = random_mdp(np.random.default_rng(3), 20, 3)
    if of == "mountain_car":
        mdp = estimate_mdp(of, bins=8, n_samples=50, start="uniform").mdp
    exact = list(iterate_biasing(mdp, 2.0, max_steps=60))
    states = list(control.biasing_by_power(mdp, 2.0))
    assert states[-1].kl < control.KL_TO_STOP
    for a, b in zip(states, exact, strict=False):
        assert a.theta == pytest.approx(b.theta, abs=1e-8)
        assert a.kl == pytest.approx(b.kl.max(), rel=1e-5, abs=1e-9)
        np.testing.assert_allclose(a.policy.numpy(), b.policy, atol=1e-6)


def test_cut_off_power_iterations():
    mdp = estimate_mdp("pendulum", bins=8, n_samples=50, start="uniform").mdp
    cut = next(control.biasing_by_power(mdp, 2.0, most_power_steps=5))
    loose, exact = (next(control.biasing_by_power(mdp, 2.0, tolerance=t)) for t in (1e-3, 0.0))
    assert cut.power_steps == 5 < loose.power_steps
    assert abs(loose.theta - exact.theta) < 0.01 < abs(cut.theta - exact.theta)


# -- the runner -------------------------------------------------------------------------------------------

MODULE = """
import os
from pathlib import Path
import numpy as np
from matplotlib.figure import Figure
from erl_torch.reproduction.artifact import Artifact, Output, compared

def units(scale, seed):
    return {f"unit{i}": {"i": i, "seed": seed} for i in range(6)}

def work(i, seed):
    with open(os.environ["DONE"], "a") as log:
        log.write(f"{i} ")
    if i >= int(os.environ.get("HOLD", 6)):
        (Path(os.environ["DONE"]).parent / "held").touch()
        os.read(os.open(os.environ["GATE"], os.O_RDONLY), 1)  # until it is killed
    return {"value": np.random.default_rng([seed, i]).random(3), "i": i}

def assemble(results, scale):
    rows = [{"i": int(r["i"]), "first": float(r["value"][0])} for r in results.values()]
    figure = Figure()
    figure.add_subplot().plot([row["first"] for row in rows], label="first")
    return Output(rows, [compared("i", 5, rows[-1]["i"], 0)], figure, ["one"], {"sum": sum(r["first"] for r in rows)})

ARTIFACT = Artifact("small", "a small one", units, work, assemble)
"""
START = """
import sys
from pathlib import Path
from erl_torch.reproduction.runner import run
from small import ARTIFACT
run([ARTIFACT], Path(sys.argv[1]), "quick", 7)
"""


@pytest.fixture
def small(tmp_path, monkeypatch):
    (tmp_path / "small.py").write_text(MODULE)
    (tmp_path / "start.py").write_text(START)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("DONE", str(tmp_path / "done"))
    import small

    yield small.ARTIFACT
    del sys.modules["small"]


def worked(tmp_path):
    """Units done since the last call."""
    log = tmp_path / "done"
    units = log.read_text().split() if log.exists() else []
    log.unlink(missing_ok=True)
    return units


def finals(directory):
    return {p.name: p.read_bytes() for p in (directory / "small-quick-seed7").iterdir() if p.is_file()}


def test_killed_and_started_again(small, tmp_path, start):
    """SIGKILL in the middle; then the rest, by two processes: the files of an undisturbed run."""
    runner.run([small], tmp_path / "whole", "quick", 7)
    assert sorted(worked(tmp_path)) == list("012345")
    assert len(finals(tmp_path / "whole")) == 4
    killed = tmp_path / "killed"
    gate = tmp_path / "gate"
    os.mkfifo(gate)
    more = {"PYTHONPATH": f"{ROOT}{os.pathsep}{tmp_path}", "HOLD": "3", "GATE": str(gate)}
    first = start(sys.executable, "start.py", killed, cwd=tmp_path, env={**os.environ, **more})
    wait_until((tmp_path / "held").exists, "the fourth unit")
    first.send_signal(signal.SIGKILL)
    ended(first)
    kept = len(list((killed / "small-quick-seed7" / "units").glob("*.npz")))
    assert kept == 3
    assert len(worked(tmp_path)) == kept + 1
    runner.run([small], killed, "quick", 7, processes=2)
    assert len(worked(tmp_path)) == 6 - kept
    assert finals(killed) == finals(tmp_path / "whole")


def test_damaged_and_foreign_units_are_done_anew(small, tmp_path):
    runner.run([small], tmp_path, "quick", 7)
    before = finals(tmp_path)
    worked(tmp_path)
    units = tmp_path / "small-quick-seed7" / "units"
    whole = (units / "unit2.npz").read_bytes()
    for damage in (whole[:-40], whole[:60] + bytes([whole[60] ^ 255]) + whole[61:], b""):
        (units / "unit2.npz").write_bytes(damage)
        runner.run([small], tmp_path, "quick", 7)
        assert worked(tmp_path) == ["2"]
        assert finals(tmp_path) == before
    (units / "unit3.npz").write_bytes(whole)  # of another unit
    runner.run([small], tmp_path, "quick", 7)
    assert worked(tmp_path) == ["3"]
    assert finals(tmp_path) == before
    newer = Artifact("small", small.title, small.units, small.work, small.assemble, version=2)
    runner.run([newer], tmp_path, "quick", 7)
    assert len(worked(tmp_path)) == 6
    runner.run([newer], tmp_path, "quick", 7)
    assert worked(tmp_path) == []


def test_shared_units_are_done_once_and_a_stop_keeps_what_is_done(small, tmp_path):
    twin = Artifact("twin", "the same units", small.units, small.work, small.assemble, units_of="small")
    calls = iter(range(100))

    def stop():
        if next(calls) == 4:
            raise SystemExit(130)

    with pytest.raises(SystemExit):
        runner.run([small, twin], tmp_path, "quick", 7, safe_point=stop)
    assert len(worked(tmp_path)) == 4
    outputs = runner.run([small, twin], tmp_path, "quick", 7)
    assert len(worked(tmp_path)) == 2
    assert list(outputs) == ["small", "twin"]
    assert (tmp_path / "twin-quick-seed7" / "twin.csv").read_bytes() == finals(tmp_path)["small.csv"]


def test_a_bad_name_of_a_unit(small, tmp_path):
    bad = Artifact("small", "", lambda scale, seed: {"../unit": {}}, small.work, small.assemble)
    with pytest.raises(ValueError, match="is no name"):
        runner.run([bad], tmp_path, "quick")


# -- the command ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["artifact=figure_9"], "artifact=figure_9: must be figure_1 or "),
        (["artifact=figure_4", "scale=huge"], "scale=huge: must be quick or full"),
        (["artifact=figure_4", "seed=-1"], "seed=-1: must be"),
        (["artifact=figure_4", "processes=0"], "processes=0: must be"),
        (["artifact=figure_4", "+sed=1"], "sed=1: must be left out"),
        ([], "artifact=.*: must be given"),
    ],
)
def test_complaints(tmp_path, overrides, message):
    with pytest.raises(InputError, match=message):
        runner.reproduce(composed(*overrides, command="reproduce"), tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_command(tmp_path, capsys):
    (output,) = runner.reproduce(composed("artifact=figure_4", "processes=1", command="reproduce"), tmp_path).values()
    assert isinstance(output, Output)
    assert isinstance(output.comparisons[0], Comparison)
    said = capsys.readouterr().out
    assert "-756.59" in said
    assert said.count(AGREES) == len(output.comparisons)
    assert REPRODUCED not in said
    assert said.splitlines()[2].split() == ["computed", "ours", "verdict"]  # nothing of it is the paper's
    assert said.count(NOTHING) == 1  # all were computed independently
    names = {p.name for p in (tmp_path / "figure_4-quick-seed0").iterdir()}
    assert names == {"units", *(f"figure_4.{kind}" for kind in ("csv", "json", "png", "svg"))}


def test_help_is_light_and_names_the_artifacts(start):
    code = (
        "import runpy, sys; sys.argv = ['reproduce.py', '--help']; runpy.run_path('reproduce.py', run_name='__main__');"
        "assert not {'torch', 'matplotlib', 'numba'} & set(sys.modules)"
    )
    status, out, err = ended(start(sys.executable, "-c", code, cwd=ROOT))
    assert status == 0, err
    assert all(name in out for name in ARTIFACTS)
