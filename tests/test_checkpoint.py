"""A run that is ended at any moment and started again is the run that was not: same bits, one event file."""

import json
import pydoc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers import composed, events, random_mdp, scalars

from erl_torch import AlgorithmS1, InputError, NonFiniteError, Replicas, Simulation, Solution, Status, collect
from erl_torch.learners import LEARNERS
from erl_torch.log.event_file import EventFile
from erl_torch.run.checkpoint import COMMON, Checkpoints, decode, encode
from erl_torch.run.training import train

pytestmark = pytest.mark.slow  # whole runs
SMALL = (
    "experience.n_episodes=3",
    "evaluation.n_episodes=2",
    "evaluation.horizon=50",
    "checkpoint_every=0",
    "evaluation.pictures=false",
)
SHORT = {"s1": ("learner.n_epochs=3", "learner.n_bias=3"), "s1_efficient": ("learner.n_bias=4",)}


class Killed(BaseException):
    """As SIGKILL: nothing of the run's own catches it."""


def after(calls, error):
    """A safe point that ends the run at its n-th call."""
    count = 0

    def safe_point():
        nonlocal count
        count += 1
        if count == calls:
            raise error

    return safe_point


def names(directory):
    return sorted(p.name if "tfevents" not in p.name else "events" for p in directory.iterdir() if p.is_file())


def ended(cfg, directory, epochs, error=Killed):
    """A run that is ended after so many epochs more."""
    before = 0 if cfg.n_replicas > 1 else 2  # safe points while the experience is collected
    with pytest.raises(error):
        train(cfg, directory, after(before + epochs, error()))


@pytest.mark.parametrize(
    ("learner", "error"), [("s1", SystemExit), *((name, Killed) for name in LEARNERS if name != "exact")]
)
def test_bits_of_an_ended_run_are_those_of_a_whole_one(tmp_path, learner, error):
    cfg = composed(f"learner={learner}", *SMALL, *SHORT.get(learner, ()))
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    train(cfg, whole)
    ended(cfg, cut, 1, error)
    assert (cut / "checkpoints").exists()
    if learner != "certainty_equivalence":  # which has one epoch
        ended(cfg, cut, 2, error)
    result = train(cfg, cut)
    assert result["status"] in ("completed", "converged", "uncertified")  # the last: few passes
    assert names(cut) == names(whole) == ["events", "result.json", "settings.json", "solution.npz"]
    assert (cut / "solution.npz").read_bytes() == (whole / "solution.npz").read_bytes()
    assert scalars(cut) == scalars(whole)


@pytest.mark.parametrize("learner", ["s1", "s1_efficient", "q_learning"])
def test_replicas_go_on_too(tmp_path, learner):
    arguments = ("n_replicas=2", "++vary.beta=[3,10]", f"learner={learner}", *SMALL, *SHORT.get(learner, ()))
    cfg = composed(*arguments)
    train(cfg, tmp_path / "whole")
    ended(cfg, tmp_path / "cut", 1)
    ended(cfg, tmp_path / "cut", 2, SystemExit)
    train(cfg, tmp_path / "cut")
    assert names(tmp_path / "cut") == names(tmp_path / "whole")
    assert (tmp_path / "cut/replicas.npz").read_bytes() == (tmp_path / "whole/replicas.npz").read_bytes()
    assert scalars(tmp_path / "cut") == scalars(tmp_path / "whole")


def test_exact_solution_begins_anew(tmp_path):
    cfg = composed("learner=exact", *SMALL[1:])
    train(cfg, tmp_path / "whole")
    with pytest.raises(Killed):
        train(cfg, tmp_path / "cut", after(2, Killed()))
    train(cfg, tmp_path / "cut")
    assert scalars(tmp_path / "cut") == scalars(tmp_path / "whole")


@pytest.fixture
def cut(tmp_path):
    """(configuration, directory of a run ended after its fourth epoch, the newest checkpoint last)."""
    cfg = composed(*SMALL, *SHORT["s1"])
    ended(cfg, tmp_path / "run", 4)
    return cfg, tmp_path / "run", sorted((tmp_path / "run/checkpoints").iterdir())


def test_the_last_two_are_kept(cut):
    assert [path.name for path in cut[2]] == [f"{step:018d}.ckpt" for step in (9000, 12000)]


@pytest.mark.parametrize("damage", ["cut", "flipped", "empty", "other"])
def test_a_damaged_checkpoint_is_passed_over(tmp_path, cut, capsys, damage):
    cfg, directory, paths = cut
    body = bytearray(paths[-1].read_bytes())
    body[len(body) // 2] ^= 1
    spoilt = {"cut": body[: len(body) // 2], "flipped": body, "empty": b"", "other": b"hello\nworld"}[damage]
    paths[-1].write_bytes(spoilt)
    (directory / "checkpoints/.x.ckpt.99.tmp").write_bytes(b"half")
    train(cfg, directory)
    said = capsys.readouterr().err
    assert f"warning: {paths[-1]} cannot be read" in said
    train(cfg, tmp_path / "whole")
    assert (directory / "solution.npz").read_bytes() == (tmp_path / "whole/solution.npz").read_bytes()
    assert scalars(directory) == scalars(tmp_path / "whole")


def test_without_a_good_checkpoint_the_run_begins_anew(tmp_path, cut):
    cfg, directory, paths = cut
    for path in paths:
        path.write_bytes(b"")
    train(cfg, directory)
    train(cfg, tmp_path / "whole")
    assert scalars(directory) == scalars(tmp_path / "whole")
    assert names(directory) == names(tmp_path / "whole")


def test_other_settings_are_refused_by_name(cut):
    _, directory, _ = cut
    before = {path: path.read_bytes() for path in directory.rglob("*") if path.is_file()}
    other = composed(*SMALL, *SHORT["s1"], "learner.beta=5", "env.trap_reward=-4", "checkpoint_every=7", "threads=2")
    with pytest.raises(InputError) as error:
        train(other, directory)
    said = str(error.value)
    assert said.startswith(f"hydra.run.dir={directory}: must be of a run with these settings, or a new one: not ")
    assert "env.trap_reward=-4 (there: -5.0)" in said
    assert "learner.beta=5 (there: 10.0)" in said
    assert "threads" not in said  # results do not depend on it
    assert {path: path.read_bytes() for path in directory.rglob("*") if path.is_file()} == before


def files(directory):
    return {path: path.read_bytes() for path in directory.rglob("*") if path.is_file()}


def test_checkpoints_know_their_settings(tmp_path, cut):
    cfg, directory, _ = cut
    (directory / "settings.json").unlink()
    before = files(directory)
    with pytest.raises(InputError, match=r"not learner\.beta=7 \(there: 10\.0\)"):
        train(composed(*SMALL, *SHORT["s1"], "learner.beta=7"), directory)
    assert files(directory) == before
    train(cfg, directory)
    train(cfg, tmp_path / "whole")
    assert (directory / "solution.npz").read_bytes() == (tmp_path / "whole/solution.npz").read_bytes()
    assert names(directory) == names(tmp_path / "whole")


def test_checkpoints_of_another_version_stay(cut, monkeypatch):
    cfg, directory, _ = cut
    monkeypatch.setattr("erl_torch.run.checkpoint.FORMAT", 5)
    before = files(directory)
    with pytest.raises(
        InputError, match=r"checkpoint=.*12000.ckpt: must be of this version \(it is of format 4, not 5"
    ):
        train(cfg, directory)
    assert files(directory) == before


@pytest.mark.parametrize("damaged", ["result.json", "settings.json"])
@pytest.mark.parametrize("content", ["", '{"status": "comp', "[]", "3", "{}", "\udcff", None])
def test_a_damaged_file_is_named_and_all_else_stays(tmp_path, damaged, content):
    """... of a complete run, which began anew and deleted its log. None is a directory, as of a botched copy."""
    cfg = composed(*SMALL, *SHORT["s1"])
    train(cfg, tmp_path)
    (tmp_path / damaged).unlink()
    if content is None:
        (tmp_path / damaged).mkdir()
    else:
        (tmp_path / damaged).write_bytes(content.encode(errors="surrogateescape"))
    before = files(tmp_path)
    with pytest.raises(
        InputError, match="{}|of a run with these settings".format(damaged.replace(".", r"\."))
    ) as error:
        train(cfg, tmp_path)
    assert "\n" not in str(error.value)
    assert files(tmp_path) == before


def test_results_of_unknown_settings_stay(tmp_path):
    train(composed(*SMALL, *SHORT["s1"]), tmp_path)
    (tmp_path / "settings.json").unlink()
    for name in ("result.json", "solution.npz"):
        before = files(tmp_path)
        with pytest.raises(InputError, match=f"it holds a {name} without the settings.json behind it"):
            train(composed(*SMALL, *SHORT["s1"], "learner.beta=7"), tmp_path)
        assert files(tmp_path) == before
        (tmp_path / name).unlink()


def test_a_log_that_is_not_the_run_s_own_stays(tmp_path):
    EventFile(tmp_path).close()
    (other,) = tmp_path.iterdir()
    other = other.rename(other.with_name("events.out.tfevents.1.other"))
    with pytest.raises(InputError):
        train(
            composed("learner=certainty_equivalence", "experience.n_episodes=1", "experience.episode_length=1"),
            tmp_path,
        )
    assert [*tmp_path.iterdir()] == [other]
    train(composed(*SMALL, *SHORT["s1"]), tmp_path)
    assert other.exists()
    assert len(list(tmp_path.glob("events.*"))) == 2


@pytest.mark.parametrize("damage", ["cut", "deleted", "empty", "grown"])
def test_the_log_may_be_damaged_before_a_run_goes_on(tmp_path, cut, capsys, damage):
    cfg, directory, _ = cut
    train(cfg, tmp_path / "whole")
    (log,) = directory.glob("events.*")
    body = log.read_bytes()
    old = scalars(directory)["learner/theta"]
    if damage == "deleted":
        log.unlink()
    else:
        log.write_bytes({"cut": body[: len(body) // 2], "empty": b"", "grown": body + body[:1000]}[damage])
    kept = scalars(directory).get("learner/theta", []) if damage != "deleted" else []
    train(cfg, directory)
    assert (directory / "solution.npz").read_bytes() == (tmp_path / "whole/solution.npz").read_bytes()
    whole = scalars(tmp_path / "whole")["learner/theta"]
    said = capsys.readouterr().err.count("has lost what it held at the checkpoint")
    assert names(directory) == names(tmp_path / "whole")
    if damage == "grown":
        assert said == 0
        assert scalars(directory)["learner/theta"] == whole
    else:
        assert said == 1
        assert len(kept) < len(old)
        assert scalars(directory)["learner/theta"] == kept + whole[len(old) :]


class Bug(Exception):
    pass


@pytest.mark.parametrize(
    ("place", "error", "replicas"),
    [
        ("learner", Bug("why"), ()),
        ("learner", MemoryError("Unable to allocate 9 TiB"), ()),
        ("evaluation", Bug("why"), ()),
        ("log", OSError(28, "No space left on device"), ()),
        ("learner", Bug("why"), ("n_replicas=2",)),
        ("evaluation", MemoryError(), ("n_replicas=2",)),
        ("log", Bug("why"), ("n_replicas=2",)),
    ],
)
def test_any_error_keeps_what_was_learnt(tmp_path, monkeypatch, error, place, replicas):
    """... as it was after the last whole epoch, wherever in the next one it came."""
    cfg = composed(*SMALL, *SHORT["s1"], *replicas)
    train(cfg, tmp_path / "whole")
    target, name = {
        "learner": (AlgorithmS1, "step") if not replicas else (Replicas, "iterate"),
        "evaluation": ("erl_torch.run.replicas.Judges", "__call__")
        if replicas
        else ("erl_torch.run.single", "evaluate"),
        "log": ("erl_torch.log.tensorboard.Board", "scalars"),
    }[place]
    if isinstance(target, str):
        target = pydoc.locate(target)
    before = getattr(target, name)
    calls = 0

    def failing(*arguments, **more):
        nonlocal calls
        calls += 1
        if (place, replicas) == ("learner", ("n_replicas=2",)):
            return broken(before(*arguments, **more))
        if calls == (40 if (place, replicas) == ("log", ("n_replicas=2",)) else 5):
            raise error
        return before(*arguments, **more)

    def broken(states):
        for n, state in enumerate(states):
            if n == 4:
                raise error
            yield state

    with monkeypatch.context() as patch:
        patch.setattr(target, name, failing)
        with pytest.raises(type(error)) as raised:
            train(cfg, tmp_path / "cut")
    assert raised.value is error
    result = json.loads((tmp_path / "cut" / "result.json").read_text())
    assert result["status"] == "stopped"
    assert result["message"] == f"{type(error).__name__}: {error}"
    table = "replicas.npz" if replicas else "solution.npz"
    assert (tmp_path / "cut" / table).exists()
    assert list((tmp_path / "cut" / "checkpoints").glob("*.ckpt"))
    train(cfg, tmp_path / "cut")
    assert (tmp_path / "cut" / table).read_bytes() == (tmp_path / "whole" / table).read_bytes()
    assert scalars(tmp_path / "cut") == scalars(tmp_path / "whole")


def test_an_error_after_the_learning_keeps_it(tmp_path, monkeypatch):
    def failing(*_, **__):
        raise MemoryError

    cfg = composed(*SMALL, *SHORT["s1"])
    with monkeypatch.context() as patch:
        patch.setattr("erl_torch.run.single.with_bounds", failing)
        with pytest.raises(MemoryError):
            train(cfg, tmp_path)
    result = json.loads((tmp_path / "result.json").read_text())
    assert (result["status"], result["message"]) == ("stopped", "MemoryError: ")
    assert Solution.load(tmp_path / "solution.npz").status is Status.COMPLETED  # the learning is
    assert train(cfg, tmp_path)["gap"] is not None


def test_a_certificate_beyond_memory_is_named(tmp_path, monkeypatch):
    def failing(*_, **__):
        raise MemoryError("SuperLU: not enough memory")

    monkeypatch.setattr("erl_torch.run.single.solve_soft_bellman", failing)
    with pytest.raises(
        InputError, match=r"^evaluation.certify=true: must be false: .* needs more memory than there is"
    ):
        train(composed(*SMALL, *SHORT["s1"]), tmp_path)
    assert not any(tmp_path.iterdir())


def test_another_stream_is_refused(tmp_path):
    mdp = random_mdp(np.random.default_rng(0), 4, 2)
    mdp.save(tmp_path / "mdp.npz")
    collect(mdp, 1, 1000, 0).save(tmp_path / "t.npz")
    arguments = ("env=mdp", f"env.path={tmp_path}/mdp.npz", "experience=recorded", f"experience.path={tmp_path}/t.npz")
    cfg = composed(*arguments, *SMALL[1:], *SHORT["s1"])
    with pytest.raises(Killed):
        train(cfg, tmp_path / "run", after(3, Killed()))
    collect(mdp, 1, 1000, 1).save(tmp_path / "t.npz")
    with pytest.raises(InputError, match="experience=another stream: must be the one that the run"):
        train(cfg, tmp_path / "run")


def test_a_complete_run_is_not_repeated(tmp_path, capsys):
    cfg = composed(*SMALL, *SHORT["s1"])
    first = train(cfg, tmp_path)
    files = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    assert train(cfg, tmp_path) == first
    assert "is complete" in capsys.readouterr().err
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == files


def test_interval(tmp_path, monkeypatch):
    now = [0.0]
    monkeypatch.setattr("erl_torch.run.checkpoint.time.monotonic", lambda: now[0])
    saved = Checkpoints(tmp_path, {}, 10.0)
    for step, at in enumerate((9.9, 10.0, 15.0, 20.1)):
        now[0] = at
        saved.offer(step, dict)
    assert sorted(p.name for p in (tmp_path / "checkpoints").iterdir()) == [f"{i:018d}.ckpt" for i in (1, 3)]
    never = Checkpoints(tmp_path / "never", {}, None)
    now[0] = 1e9
    never.offer(1, dict)
    assert not (tmp_path / "never").exists()
    never.offer(1, dict, now=True)
    assert len(list((tmp_path / "never/checkpoints").iterdir())) == 1


def test_the_newest_checkpoint_is_read(tmp_path):
    saved = Checkpoints(tmp_path, {}, 0.0)
    for step in (3, 20, 100):
        saved.offer(step, lambda: {"n": step})  # noqa: B023 (called at once)
    assert saved.read() == {"n": 100}


def test_a_bit_flipped_in_a_table_is_seen(tmp_path, capsys):
    """Wherever it is: torch reads on over most."""
    saved = Checkpoints(tmp_path, {}, 0.0)
    saved.offer(1, lambda: {"table": np.linspace(0.0, 1.0, 1000)})
    (path,) = (tmp_path / "checkpoints").iterdir()
    whole = path.read_bytes()
    for at in range(0, len(whole), 97):
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :])
        assert saved.read() is None, at
    assert "cannot be read" in capsys.readouterr().err


def test_settings_that_are_new_or_gone_are_refused(tmp_path):
    Checkpoints(tmp_path, {"beta": 1.0, "prior": None}, 0.0).start()
    Checkpoints(tmp_path, {"beta": 1.0, "prior": None, "threads": 3}, 0.0)
    for settings, said in (
        ({"beta": 1.0, "prior": None, "lr_u": 0.1}, r"lr_u=0.1 \(there: None\)"),
        ({"prior": None}, r"beta=None \(there: 1.0\)"),
        ({"beta": 2.0, "prior": None}, r"beta=2.0 \(there: 1.0\)"),
    ):
        with pytest.raises(InputError, match=said):
            Checkpoints(tmp_path, settings, 0.0)


def test_values_come_back_as_they_were():
    learner = AlgorithmS1(beta=10.0, lr_u=0.5, lr_rho=1e-3, n_epochs=2, n_bias=1)
    mdp = random_mdp(np.random.default_rng(0), 3, 2)
    state: Any
    *_, state = Replicas.of(learner, 2).iterate(Simulation(mdp, 1, 100, range(2)), 3, 2)
    error = NonFiniteError(3, "why")
    solution = learner.fit(collect(mdp, 1, 100, 0), 3, 2)
    there = {"a": [1, 2.5, None, True, "x"], "b": (state, error, solution), 3: np.arange(3.0), "c": 2**100}
    back = decode(encode(there), (*COMMON, *Replicas.of(learner, 2).states))
    assert back["a"] == there["a"]
    assert back["c"] == 2**100
    assert np.array_equal(back[3], there[3])
    again, failure, answer = back["b"]
    assert (failure.step, failure.cause) == (3, "why")
    assert np.array_equal(again.u, state.u)
    assert torch.equal(again.policy, state.policy)
    assert isinstance(answer, Solution)
    assert answer.status is Status.COMPLETED
    with pytest.raises(ValueError, match="unknown class Path"):
        decode({"class": "Path", "fields": {}}, COMMON)


def test_checksum_sees_every_column():
    data = collect(random_mdp(np.random.default_rng(0), 4, 3), 1, 50, 0)
    found = {data.checksum()}
    for name in ("s", "a", "r", "s_next", "a_next"):
        column = getattr(data, name).copy()
        column[-1] += 1
        found.add(type(data)(**{**vars(data), name: column}).checksum())
    assert len(found) == 6


def test_event_file_is_cut_and_gone_on_with(tmp_path):
    from torch.utils.tensorboard import summary

    file = EventFile(tmp_path)
    file.add(summary.scalar("x", 1.0), 1)
    size = file.flush()
    file.add(summary.scalar("x", 2.0), 2)
    file.close()
    (path,) = tmp_path.iterdir()
    path.write_bytes(path.read_bytes()[:-3])  # killed in the midst of a record
    file = EventFile(tmp_path, size)
    file.add(summary.scalar("x", 3.0), 2)
    file.close()
    assert [(e.step, e.value) for e in events(tmp_path).Scalars("x")] == [(1, 1.0), (2, 3.0)]
    assert len(list(tmp_path.iterdir())) == 1
    assert file.fresh is False


@pytest.mark.parametrize("value", ["-1", "nan"])
def test_bad_interval_is_named(tmp_path, value):
    with pytest.raises(InputError, match=r"checkpoint_every=.*must be seconds >= 0, or null"):
        train(composed(f"checkpoint_every={value}"), tmp_path)


def test_damaged_settings_are_named(tmp_path):
    (tmp_path / "settings.json").write_text("{")
    with pytest.raises(InputError, match=r"settings=.*settings\.json: must be readable JSON"):
        train(composed(*SMALL), tmp_path)
    assert json.dumps(sorted(p.name for p in Path(tmp_path).iterdir())) == '["settings.json"]'


@pytest.mark.parametrize("replicas", [(), ("n_replicas=2",)])
def test_input_that_shows_as_bad_once_learning_begins_leaves_nothing(tmp_path, replicas):
    one = ("experience.n_episodes=1", "experience.episode_length=1")
    cfg = composed("learner=certainty_equivalence", *one, *replicas)
    with pytest.raises(InputError, match="transitions=a stream that never returns to any state"):
        train(cfg, tmp_path)
    assert not any(tmp_path.iterdir())


def test_a_checkpoint_that_cannot_be_reached_stays(tmp_path, capsys):
    """... as on a disk that is not mounted: it may be whole. A damaged one goes."""
    saved = Checkpoints(tmp_path, {}, 0.0)
    for step in (1, 2):
        saved.offer(step, lambda: {"n": step})  # noqa: B023 (called at once)
    _, newest = sorted((tmp_path / "checkpoints").iterdir())
    newest.unlink()
    newest.symlink_to(tmp_path / "not mounted")
    assert saved.read() == {"n": 1}
    assert newest.is_symlink()
    newest.unlink()
    newest.write_bytes(b"damaged")
    assert saved.read() == {"n": 1}
    assert not newest.exists()
    assert capsys.readouterr().err.count(f"warning: {newest} cannot be read") == 2


def test_leftovers_of_a_killed_run_go(tmp_path):
    saved = Checkpoints(tmp_path, {}, 0.0)
    saved.offer(1, lambda: {"n": 1})
    leftovers = [tmp_path / ".solution.npz.99.tmp", tmp_path / "checkpoints" / ".x.ckpt.99.tmp"]
    for path in (*leftovers, tmp_path / "mine.tmp"):
        path.write_bytes(b"half")
    assert saved.read() == {"n": 1}
    assert all(path.exists() for path in leftovers)  # whoever only looks takes nothing away
    assert saved.start() == {"n": 1}
    assert not any(path.exists() for path in leftovers)
    assert (tmp_path / "mine.tmp").exists()


@pytest.mark.parametrize("learnt", [True, False])
def test_bad_input_takes_nothing_away_that_was_learnt(tmp_path, learnt):
    saved = Checkpoints(tmp_path, {}, 0.0)
    saved.start()
    saved.offer(1, lambda: {"n": 1})
    EventFile(tmp_path).close()
    with pytest.raises(InputError), saved.refusing(lambda: learnt):
        raise InputError("x", 1, "another")
    assert (tmp_path / "settings.json").exists() is learnt
    assert (tmp_path / "checkpoints").exists() is learnt
    assert bool(list(tmp_path.glob("events.*"))) is learnt
    (tmp_path / "settings.json").touch()
    with pytest.raises(ZeroDivisionError), saved.refusing(lambda: False):
        raise ZeroDivisionError
    assert (tmp_path / "settings.json").exists()
