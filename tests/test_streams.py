"""Streams of any size: the same bits however they are cut and wherever they are read from; damage is named."""

import contextlib
import importlib
import io
import json
import os
import re
import runpy
import warnings
from dataclasses import fields
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
from helpers import composed, random_mdp

from erl_torch import (
    AlgorithmS1,
    CertaintyEquivalence,
    EfficientS1,
    InputError,
    ListedS1,
    Replicas,
    Transitions,
    collect,
    read_experience,
    write_experience,
)
from erl_torch.empirical.counts import empirical_mdp, tally
from erl_torch.envs.discretise import Discretise
from erl_torch.experience.collect import record
from erl_torch.experience.experience import Parts
from erl_torch.experience.formats import FORMATS
from erl_torch.experience.formats.format import Options
from erl_torch.experience.formats.minari import Minari
from erl_torch.experience.formats.npy import ColumnWriter, check_target
from erl_torch.experience.recording import FileRecording
from erl_torch.experience.transitions import COLUMNS, regroup
from erl_torch.labels import Labels
from erl_torch.learners import LEARNERS
from erl_torch.rng import streams
from erl_torch.run.training import train

ROOT = Path(__file__).parents[1]
MDP = random_mdp(np.random.default_rng(0), 5, 3)
PLAIN = collect(MDP, 13, 1000, 1)
NOISY = Transitions(
    PLAIN.s, PLAIN.a, PLAIN.r + np.random.default_rng(2).standard_normal(len(PLAIN)), PLAIN.s_next, PLAIN.a_next
)
SHORT = NOISY.first(40)
# (2, 1) leads to where nothing is known: EfficientS1 leaves it out.
ENDS = NOISY.where(np.arange(6000))
ENDS.s_next[-1], ENDS.s[-1], ENDS.a[-1] = 5, 2, 1


class Cut:
    """A recording in memory, cut into pieces of ``rows``."""

    def __init__(self, data, rows):
        self.data, self.rows = data, rows

    def __len__(self):
        return len(self.data)

    def check_range(self, n_states, n_actions):
        self.data.check_range(n_states, n_actions)

    def chunks(self, multiple=1):
        pieces = (self.data.where(slice(i, i + self.rows)) for i in range(0, len(self.data), self.rows))
        return regroup(pieces, multiple)

    def checksum(self):
        return self.data.checksum()


def written(folder, data, kind):
    """``data`` in a file of each format that needs no plugin, or Parquet."""
    path = folder / {"npz": "t.npz", "columns": "t", "parquet": "t.parquet"}[kind]
    if kind == "npz":
        return data.save(path)
    if kind == "columns":
        return write_experience(data, path)
    import pyarrow as pa
    import pyarrow.parquet as pq

    pq.write_table(pa.table({n: getattr(data, n) for n in COLUMNS}), path, row_group_size=777, write_page_checksum=True)
    return path


def same(found, expected):
    """All tables and figures, bit for bit."""
    for field in fields(expected):
        x, y = getattr(found, field.name), getattr(expected, field.name)
        if isinstance(y, torch.Tensor):
            assert torch.equal(x, y), field.name
        elif isinstance(y, dict):
            assert all(np.array_equal(x[k], y[k], equal_nan=True) for k in y), field.name
        else:
            assert x == y or (x != x and y != y), field.name


OPTIONS = {"s1": {"n_epochs": 2, "n_bias": 2, "beta": 3.0}, "s1_efficient": {"n_epochs": 1, "n_bias": 3, "beta": 3.0}}
LEARN = {
    name: learner(**OPTIONS.get(name, {"beta": 3.0, **({} if name == "certainty_equivalence" else {"n_epochs": 2})}))
    for name, learner in LEARNERS.items()
    if name != "exact"
} | {
    "s1 rescaled often": AlgorithmS1(3.0, n_epochs=2, n_bias=2, rescale_every=13, lr_psi=1.0),
    "published": EfficientS1.published(3.0, n_epochs=2, n_bias=2),
    "in logarithms": EfficientS1(3.0, n_epochs=2, n_bias=2, log_domain="on", mean_reward=False),
}


@pytest.mark.parametrize("name", sorted(LEARN))
def test_learners_do_not_see_how_a_stream_is_cut(name):
    for data, cuts in ((PLAIN, (1000, 4999)), (NOISY, (1000, 12_999)), (SHORT, (1, 7)), (ENDS, (1000,))):
        whole = LEARN[name].fit(data, 6, 3)
        for rows in cuts:
            same(LEARN[name].fit(Cut(data, rows), 6, 3), whole)


@pytest.mark.parametrize("kind", ["npz", "columns", "parquet"])
def test_files_are_the_stream_in_memory(tmp_path, kind):
    path = written(tmp_path, NOISY, kind)
    for rows in (1000, len(NOISY) - 1):
        found = read_experience(path, 5, 3, chunk=rows)
        assert isinstance(found, FileRecording)
        assert (len(found), found.checksum()) == (len(NOISY), NOISY.checksum())
        assert found.load().checksum() == NOISY.checksum()
        for name in ("s1", "certainty_equivalence", "s1_efficient", "differential_soft_q"):
            same(LEARN[name].fit(found, 5, 3), LEARN[name].fit(NOISY, 5, 3))
    assert isinstance(read_experience(path, 5, 3), Transitions)
    path = written(tmp_path, SHORT, kind)
    for rows in (1, 7):
        found = FileRecording(path, 5, 3, chunk=rows)
        assert found.checksum() == SHORT.checksum()
        same(LEARN["s1"].fit(found, 5, 3), LEARN["s1"].fit(SHORT, 5, 3))


def test_chunks_are_multiples_and_parts_are_kept_in_memory_only():
    for rows, multiple in ((1, 5), (7, 5), (100, 7), (3, 1), (40, 100)):
        chunks = list(Cut(SHORT, rows).chunks(multiple))
        assert all(len(chunk) % multiple == 0 for chunk in chunks[:-1])
        assert np.array_equal(np.concatenate([chunk.r for chunk in chunks]), SHORT.r)
    made = []
    for data, expected in ((SHORT, 1), (Cut(SHORT, 10), 8)):
        made.clear()
        parts = Parts(data, made.append)
        assert len(list(parts)) == len(list(parts))
        assert len(made) == expected


def test_the_tally_counts():
    rng = np.random.default_rng(0)
    n = 30_000  # more distinct (s,a,s') than the tables begin with
    s, a, s_next = rng.integers(40, size=n), rng.integers(3, size=n), rng.integers(40, size=n)
    data = Transitions(s, a, rng.standard_normal(n), s_next, 0 * s)
    found = tally(Cut(data, 1234), 40, 3, 0.5)
    dense = np.zeros((120, 40))
    np.add.at(dense, (s * 3 + a, s_next), 1)
    rows = np.repeat(np.arange(120), np.diff(found.indptr))
    assert np.array_equal(dense[rows, found.indices], found.counts)
    assert found.counts.sum() == n
    assert np.array_equal(found.visits, dense.sum(1))
    weight = np.zeros((120, 40))
    for k, j in zip(s * 3 + a, s_next, strict=True):
        weight[k] *= 0.5
        weight[k, j] += 0.5
    np.testing.assert_allclose(found.psi_weight, weight[rows, found.indices], rtol=1e-12)
    model = empirical_mdp(data, 40, 3)
    for k in (0, 77):
        here = data.r[s * 3 + a == k]
        np.testing.assert_allclose(model.reward.ravel()[k], here.mean(), rtol=1e-12)
        np.testing.assert_allclose(model.reward_variance.ravel()[k], here.var(ddof=1), rtol=1e-12)
    with pytest.raises(InputError, match="below 2"):
        tally(data, 2**30, 3)


@pytest.mark.parametrize("kind", ["npz", "columns", "parquet"])
@pytest.mark.parametrize(
    ("column", "value", "said"),
    [
        ("s", 5, r"s\[3000\]=5: must be a whole number in \[0, 5\)"),
        ("a_next", -1, r"a_next\[3000\]=-1: must be a whole number in \[0, 3\)"),
        ("r", np.nan, r"r\[3000\]=nan: must be finite"),
    ],
)
def test_bad_tuples_are_named_or_counted(tmp_path, kind, column, value, said):
    data = NOISY.where(np.arange(5000))
    getattr(data, column)[[3000, 4000]] = value
    path = written(tmp_path, data, kind)
    with pytest.raises(InputError, match=re.escape(str(path)) + ": " + said):
        FileRecording(path, 5, 3, chunk=700)
    found = FileRecording(path, 5, 3, chunk=700, on_bad="skip")
    good = data.where(np.delete(np.arange(5000), [3000, 4000]))
    assert (found.n_skipped, len(found), found.checksum()) == (2, 4998, good.checksum())
    assert found.first_skipped == f"{column}[3000]={value}"
    same(LEARN["s1"].fit(found, 5, 3), LEARN["s1"].fit(good, 5, 3))
    assert found.n_skipped == 2


def test_missing_values_of_parquet_are_bad_tuples(tmp_path):
    import pyarrow as pa
    import pyarrow.parquet as pq

    columns = {name: getattr(SHORT, name).tolist() for name in COLUMNS}
    columns["s"][5] = columns["r"][7] = None
    pq.write_table(pa.table(columns), tmp_path / "t.parquet")
    with pytest.raises(InputError, match=r"s\[5\]=missing: must be a whole number in \[0, 5\)"):
        FileRecording(tmp_path / "t.parquet", 5, 3)
    assert FileRecording(tmp_path / "t.parquet", 5, 3, on_bad="skip").n_skipped == 2


def test_short_and_damaged_columns(tmp_path):
    path = write_experience(PLAIN, tmp_path / "t")
    whole = (path / "r.npy").read_bytes()
    (path / "r.npy").write_bytes(whole[: 128 + 8 * 9000 + 3])
    with pytest.raises(InputError, match=r"t: r\[9000\]=missing: must be there: 13000 rows are announced"):
        FileRecording(path, 5, 3)
    found = FileRecording(path, 5, 3, on_bad="skip", chunk=1000)
    assert (len(found), found.n_skipped) == (9000, 4000)
    assert found.checksum() == PLAIN.first(9000).checksum()
    for content, said in (
        (whole + b"1", "1 bytes too many"),
        (whole + whole[-8:], "as long as its header says"),
        (b"", "readable"),
        (whole.replace(b"<f8", b"|O8"), "readable"),
        (whole.replace(b"(13000,)", b"(650,20)"), "shape"),
        (whole.replace(b"<f8", b"<c8"), "complex"),
    ):
        (path / "r.npy").write_bytes(content)
        with pytest.raises(InputError, match=said):
            FileRecording(path, 5, 3)
    (path / "r.npy").unlink()
    with pytest.raises(InputError, match=r"lacks r\.npy"):
        FileRecording(path, 5, 3)
    path = write_experience(PLAIN, tmp_path / "floats")
    s = PLAIN.s.astype(float)
    np.save(path / "s.npy", s)  # numbers that are whole
    assert read_experience(path, 5, 3).checksum() == PLAIN.checksum()
    s[[7, 9]] = 0.5, np.nan
    np.save(path / "s.npy", s)
    with pytest.raises(InputError, match=r"s\[7\]=0.5: must be a whole number in \[0, 5\)"):
        FileRecording(path, 5, 3)
    assert FileRecording(path, 5, 3, on_bad="skip").n_skipped == 2


def test_refusals(tmp_path):
    with pytest.raises(InputError, match=r"none\.npz: must be there: a CSV, Parquet, JSON-lines or npz file"):
        read_experience(tmp_path / "none.npz", 5, 3)
    path = written(tmp_path, PLAIN, "npz")
    with pytest.raises(InputError, match="on_bad=ignore"):
        read_experience(path, 5, 3, on_bad="ignore")
    with pytest.raises(InputError, match="chunk=0"):
        read_experience(path, 5, 3, chunk=0)
    with pytest.raises(InputError, match="0 good tuples"):
        read_experience(written(tmp_path, Transitions([9], [9], [0.0], [9], [9]), "columns"), 5, 3, on_bad="skip")
    found = FileRecording(path, 5, 3, chunk=1000)
    with pytest.raises(InputError, match="those it was opened with"):
        CertaintyEquivalence().fit(found, 4, 3)
    with pytest.raises(InputError, match="implementation=literal"):
        AlgorithmS1(implementation="literal").fit(found, 5, 3)
    with pytest.raises(InputError, match="in memory"):
        Replicas.of(AlgorithmS1(), beta=[1.0, 2.0]).fit(found, 5, 3)
    PLAIN.first(500).save(path)
    with pytest.raises(InputError, match="must be left as it was"):
        AlgorithmS1().fit(found, 5, 3)


@pytest.mark.parametrize(
    ("path", "module_name"),
    [("minari:t.parquet", "minari"), ("t.parquet", "rows"), ("t.npz", "npy"), ("t", "npy"), ("d.parquet", "npy")],
)
def test_the_first_format_that_claims_a_path_reads_it(tmp_path, monkeypatch, path, module_name):
    monkeypatch.chdir(tmp_path)
    for name in ("t.parquet", "t.npz"):
        (tmp_path / name).touch()
    for name in ("t", "d.parquet"):
        (tmp_path / name).mkdir()
    first = next(module for module in FORMATS if module.claims(path))
    assert first is importlib.import_module(f"erl_torch.experience.formats.{module_name}")
    assert not any(module.claims("nowhere.parquet") for module in FORMATS)


def test_a_format_of_ones_own(tmp_path):
    csv = runpy.run_path(str(ROOT / "examples" / "own_format.py"))["Csv"]()
    path = tmp_path / "t.csv"
    rows = zip(*(getattr(NOISY, name).tolist() for name in COLUMNS), strict=True)
    text = "s,a,r,s_next,a_next\n" + "".join(f"{s},{a},{r!r},{s_next},{a_next}\n" for s, a, r, s_next, a_next in rows)
    path.write_text(text)
    for chunk in (700, 1 << 20):
        data = read_experience(path, 5, 3, chunk=chunk, format=csv)
        assert isinstance(data, FileRecording) == (chunk == 700)
        assert data.checksum() == NOISY.checksum()
        same(LEARN["s1"].fit(data, 5, 3), LEARN["s1"].fit(NOISY, 5, 3))
    path.write_text(text + "5,0,nan,0,0\n4,0,1.0,0,0\n")
    with pytest.raises(InputError, match=re.escape(f"{path}: s[13000]=5: must be a whole number in [0, 5)")):
        read_experience(path, 5, 3, format=csv)
    data = read_experience(path, 5, 3, format=csv, on_bad="skip", chunk=700)
    assert (len(data), data.n_skipped) == (13_001, 1)
    path.write_text(text + "five\n")
    with pytest.raises(InputError, match="must be a readable CSV file"):
        read_experience(path, 5, 3, format=csv)
    with pytest.raises(InputError, match=r"t\.txt: must be claimed by the given format"):
        read_experience(tmp_path / "t.txt", 5, 3, format=csv)


@pytest.mark.parametrize("change", [{"r": None}, {"r": np.ones(39)}, {"s": np.ones((40, 1), int)}])
def test_what_a_format_reads_must_be_five_columns(change):
    class Broken:
        path, short = "t", 0

        def claims(self, path):
            return True

        def reader(self, path, options):
            return self

        def batches(self, rows, strict):
            yield {**vars(SHORT), **change}

    with pytest.raises(InputError, match=r"^path=t=shapes .* from row 0 on: must be five columns of one length"):
        read_experience("t", 5, 3, format=Broken())


def test_a_failure_names_its_tuple_wherever_it_is_read_from():
    data = Transitions(PLAIN.s, PLAIN.a, PLAIN.r.copy(), PLAIN.s_next, PLAIN.a_next)
    data.r[7777:] -= 300.0
    found = [ListedS1(3.0, lr_u=0.8).fit(d, 5, 3) for d in (data, Cut(data, 999))]
    assert int(re.search(r"at tuple (\d+)", found[0].message)[1]) > 7777  # in the third chunk
    same(found[1], found[0])


def test_columns_are_written_whole_or_not_at_all(tmp_path):
    path = tmp_path / "deep" / "t"

    def interrupted():
        with ColumnWriter(path) as writer:
            writer.append(PLAIN)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert list((tmp_path / "deep").iterdir()) == []
    assert record(MDP, path, 13, 1000, 1) == path
    assert read_experience(path, 5, 3).checksum() == PLAIN.checksum()
    assert np.array_equal(np.load(path / "s_next.npy", mmap_mode="r"), PLAIN.s_next)
    write_experience(Cut(PLAIN, 999), path)
    assert read_experience(path, 5, 3).checksum() == PLAIN.checksum()
    write_experience(SHORT, path)  # replaced
    assert len(read_experience(path, 5, 3)) == 40
    assert [p.name for p in (tmp_path / "deep").iterdir()] == ["t"]
    (path / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match="what is there is none"):
        write_experience(SHORT, path)
    assert (path / "notes.txt").exists()


def test_recording_moves_the_generators_as_collecting_does(tmp_path):
    behaviour = np.full((5, 3), 1 / 3)
    draws = []
    for work in (collect, lambda source, *rest: collect(source, *rest, save_to=tmp_path / "t")):
        rng = streams(3)
        work(MDP, 4, 250, rng, behaviour)
        draws.append([generator.random() for generator in rng])
    assert draws[0] == draws[1]
    assert read_experience(tmp_path / "t", 5, 3).checksum() == collect(MDP, 4, 250, 3, behaviour).checksum()


@pytest.mark.parametrize("vector", [False, True])
def test_environments_are_recorded_piece_by_piece(tmp_path, vector):
    made = [gym.make_vec("FrozenLake-v1", 3) if vector else gym.make("FrozenLake-v1") for _ in range(2)]
    reported = []
    saved = collect(made[0], 220 if vector else 1600, 50, 0, report=reported.append, save_to=tmp_path / "t")
    data = collect(made[1], 220 if vector else 1600, 50, 0)
    assert len(data) > 10_000
    assert len(reported) > 1
    assert reported[-1] == len(data)
    assert saved.checksum() == read_experience(tmp_path / "t", 16, 4).checksum() == data.checksum()


def damaged(rng, folder, kind):
    """A file in which something is wrong."""
    data = NOISY.first(200)
    path = written(folder, data, kind)
    damage = rng.choice(["cut", "flip", "type", "name", "zero", "longer"])
    file = path / f"{rng.choice(COLUMNS)}.npy" if kind == "columns" else path
    content = bytearray(file.read_bytes())
    if damage == "cut":
        content = content[: rng.integers(len(content))]
    elif damage == "flip":
        for at in rng.integers(len(content), size=rng.integers(1, 4)):
            content[at] ^= 1 << int(rng.integers(8))
    elif damage == "zero":
        at = int(rng.integers(len(content)))
        content[at : at + 64] = bytes(len(content[at : at + 64]))
    elif damage == "longer":
        content += bytes(rng.integers(256, size=int(rng.integers(1, 200)), dtype=np.uint8))
    else:
        columns = {name: getattr(data, name) for name in COLUMNS}
        name = str(rng.choice(COLUMNS))
        wrong = rng.choice(["<U3", "f4", "c16", "u8", "i1", "?", "O", "M8[s]", "2d"])
        column = columns.pop(name)
        columns[name if damage == "type" else "S"] = column.reshape(-1, 2) if wrong == "2d" else column.astype(wrong)
        if kind == "columns":
            (path / f"{name}.npy").unlink()
            for key, value in columns.items():
                np.save(path / f"{key}.npy", value)
        elif kind == "npz":
            np.savez(path, **columns)
        else:
            import pyarrow as pa
            import pyarrow.parquet as pq

            with contextlib.suppress(pa.ArrowException):  # what it cannot write needs no reading
                pq.write_table(pa.table({k: pa.array(list(v)) for k, v in columns.items()}), path)
        return path
    file.write_bytes(content)
    return path


def refusal(path, on_bad):
    """What is said of a file that is refused; "" if learning from it runs."""
    with contextlib.redirect_stderr(io.StringIO()) as said:
        try:
            CertaintyEquivalence().fit(read_experience(path, 5, 3, on_bad=on_bad, chunk=64), 5, 3)
        except InputError as error:
            return str(error)
        finally:
            assert said.getvalue() == ""
    return ""


@pytest.mark.parametrize("kind", ["npz", "columns", "parquet"])
def test_damaged_files_run_or_say_why(tmp_path, kind):
    rng = np.random.default_rng(0)
    said = []
    for i in range(40):
        folder = tmp_path / str(i)
        folder.mkdir()
        said.append(refusal(damaged(rng, folder, kind), str(rng.choice(["stop", "skip"]))))
        assert "\n" not in said[-1]
    assert sum(map(bool, said)) > 10


def test_command_line(tmp_path, typed_here):
    options = ["learner.n_epochs=2", "learner.n_bias=1", "evaluation.pictures=false", "evaluation.certify=false"]
    simulated = [*options, "experience.n_episodes=20", "experience.episode_length=100"]
    code, _, error = typed_here("train.py", *simulated, "experience.save_to=t/", "hydra.run.dir=a")
    assert code == 0, error
    recorded = [*options, "env=windy_cliff", "experience=recorded", "experience.path=t"]
    code, _, error = typed_here("train.py", *recorded, "experience.chunk=100", "hydra.run.dir=b")
    assert code == 0, error
    results = [json.loads((tmp_path / name / "result.json").read_text()) for name in "ab"]
    assert len({(r["theta"], r["rho"], r["n_tuples"]) for r in results}) == 1
    s = np.load(tmp_path / "t" / "s.npy")
    s[[3, 9]] = 77
    np.save(tmp_path / "t" / "s.npy", s)
    code, _, error = typed_here("train.py", *recorded, "hydra.run.dir=d")
    assert (code, error) == (1, "error: experience.path=t: s[3]=77: must be a whole number in [0, 15)\n")
    code, _, error = typed_here("train.py", *recorded, "experience.on_bad=skip", "hydra.run.dir=e")
    assert code == 0, error
    assert "note: t: 2 bad tuples of 2,000 left out; the first is s[3]=77\n" in error
    assert json.loads((tmp_path / "e" / "result.json").read_text())["n_skipped"] == 2


# -- Minari ------------------------------------------------------------------------------------------------


class Episode:
    def __init__(self, observations, actions, rewards, terminated, truncated=False):
        self.observations, self.actions = np.array(observations), np.array(actions)
        self.rewards = np.array(rewards, float)
        n = len(actions)
        self.terminations = np.array([False] * (n - 1) + [terminated])
        self.truncations = np.array([False] * (n - 1) + [truncated])


EPISODES = [
    Episode([0, 1, 4], [2, 1], [-1, 0], True),
    Episode([2, 3, 2], [0, 1], [-1, -1], False, True),
    Episode([3, 1, 4], [1, 2], [-1, 0], True),
]


def test_minari_episodes_become_tuples(tmp_path, monkeypatch):
    import minari
    from minari.data_collector import EpisodeBuffer

    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    buffers = [
        EpisodeBuffer(i, None, None, list(e.observations), list(e.actions), list(e.rewards), list(e.terminations),
                      list(e.truncations), None)
        for i, e in enumerate(EPISODES)
    ]  # fmt: skip
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # Minari's own, of what a data set should say of itself
        minari.create_dataset_from_buffers(
            "erl/test-v0",
            buffers,
            observation_space=gym.spaces.Discrete(5),
            action_space=gym.spaces.Discrete(3),
            eval_env=None,
            **dict.fromkeys(("description", "algorithm_name", "author", "author_email", "code_permalink"), "x"),
        )
    prior = np.array([[0.5, 0.25, 0.25]] * 5)
    found = {
        rows: read_experience("minari:erl/test-v0", 5, 3, on_prior=True, prior_policy=prior, chunk=rows, seed=5)
        for rows in (1, 2, 100)
    }
    data = found[100]
    # Terminated: on to the next episode, the last to the first. Truncated: to the state reached.
    assert data.s.tolist() == [0, 1, 2, 3, 3, 1]
    assert data.a.tolist() == [2, 1, 0, 1, 1, 2]
    assert data.s_next.tolist() == [1, 2, 3, 2, 1, 0]
    assert data.r.tolist() == [-1, 0, -1, -1, -1, 0]
    x = streams(5).behaviour.random(6)
    drawn = (np.cumsum(prior[0]) <= x[:, None]).sum(1)
    assert data.a_next.tolist() == [1, 0, 1, drawn[3], 2, 2]
    assert {found[rows].checksum() for rows in found} == {data.checksum()}
    other = read_experience("minari:erl/test-v0", 5, 3, prior_policy=prior, seed=5)
    assert np.array_equal(other.a_next, drawn)
    with pytest.raises(InputError, match=r"s\[0\]|s_next\[1\]|in \[0, 2\)"):
        read_experience("minari:erl/test-v0", 2, 3)
    with pytest.raises(InputError, match="none-v0: must be a readable Minari data set"):
        read_experience("minari:erl/none-v0", 5, 3)


def test_minari_boxes_are_binned():
    """Observations by the environment's own bins, actions by the nearest of its values."""
    env = Discretise(gym.make("Pendulum-v1"), 4, actions=5)  # -2, -1, 0, 1, 2
    source = Minari("minari:none", Options(64, 5, env))
    actions = np.array([[1.2], [-1.6], [2.0], [0.4]], np.float32)
    assert source._actions(actions, env.env, 4).tolist() == [3, 0, 4, 2]
    seen = np.array([[-0.9, 0.1, 7.0], [0.9, -0.6, -1.0]])
    assert source._states(seen, env.env.observation_space, 2).tolist() == [0 + 2 * 4 + 3 * 16, 3 + 0 * 4 + 1 * 16]


def test_minari_spaces_of_parts_are_numbered(tmp_path, monkeypatch):
    """The same episodes, with observations of two parts and actions of one bit each, are the same tuples by name."""
    import minari
    from minari.data_collector import EpisodeBuffer

    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    seen = {"row": np.array([0, 1, 1]), "column": np.array([1, 2, 0])}
    actions, ends, never = [np.array([1, 0], np.int8)] * 2, [False, True], [False, False]
    buffers = [EpisodeBuffer(i, None, None, seen, actions, [0.0, 1.0], ends, never, None) for i in range(2)]
    space = gym.spaces.Dict(row=gym.spaces.Discrete(2), column=gym.spaces.Discrete(3))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        minari.create_dataset_from_buffers(
            "erl/parts-v0",
            buffers,
            observation_space=space,
            action_space=gym.spaces.MultiBinary(2),
            eval_env=None,
            **dict.fromkeys(("description", "algorithm_name", "author", "author_email", "code_permalink"), "x"),
        )
    labels = Labels.of_space(space)
    data = read_experience("minari:erl/parts-v0", 6, 4)
    assert [labels.decode(int(s)) for s in data.s[:2]] == [{"row": 0, "column": 1}, {"row": 1, "column": 2}]
    assert [labels.decode(int(s)) for s in data.s_next[:2]] == [{"row": 1, "column": 2}, {"row": 0, "column": 1}]
    assert data.a.tolist() == [2] * 4


def kept(path):
    """Everything at ``path``, links by where they lead."""
    entries = [path, *(path.rglob("*") if path.is_dir() and not path.is_symlink() else [])]
    return {p: p.readlink() if p.is_symlink() else p.is_dir() or p.read_bytes() for p in entries}


def test_save_to_replaces_recordings_and_nothing_else(tmp_path):
    def run(target, *replicas):
        small = ("experience.n_episodes=1", "experience.episode_length=100", "learner.n_bias=1", "learner.n_epochs=1")
        small += ("evaluation.pictures=false", f"experience.save_to={target}")
        cfg = composed(*small, *replicas)
        train(cfg, tmp_path / f"run{len(list(tmp_path.iterdir()))}")

    text, model, more, folder = (tmp_path / name for name in ("notes.txt", "mdp.npz", "more.npz", "folder"))
    text.write_text("mine")
    MDP.save(model)
    np.savez(more, **vars(SHORT), mine=np.ones(3))
    folder.mkdir()
    (folder / "s.npy").write_text("mine")
    SHORT.save(tmp_path / "elsewhere.npz")
    write_experience(SHORT, tmp_path / "elsewhere")
    link, link_to_columns = tmp_path / "link.npz", tmp_path / "columns"
    link.symlink_to(tmp_path / "elsewhere.npz")
    link_to_columns.symlink_to(tmp_path / "elsewhere")
    half = tmp_path / "half"  # columns by name, of another type
    half.mkdir()
    for name in ("s", "a", "r", "s_next", "a_next"):
        np.save(half / f"{name}.npy", np.zeros((2, 2)))
    links = [f"{link_to_columns}/", link]
    targets = [text, model, more, folder, text / "y.npz", *links, *(f"{path}/" for path in (folder, half, text))]
    before = kept(tmp_path)
    for target in targets:
        with pytest.raises(InputError, match=r"^experience.save_to="):
            check_target("experience.save_to", target)
    with pytest.raises(InputError, match=r"^experience.save_to="):
        run(text)
    with pytest.raises(InputError, match=r"^experience.save_to="):
        run(text, "shared_stream=true", "++vary.beta=[1,2]")
    assert kept(tmp_path) == before
    for target in [tmp_path / "new.npz", f"{tmp_path}/new/"] * 2:
        run(target)
        assert len(read_experience(target, 15, 4)) == 100
    assert not [p for p in tmp_path.iterdir() if p.name.startswith(".")]


def test_the_old_recording_stays_until_the_new_one_is_whole(tmp_path, monkeypatch):
    write_experience(SHORT, tmp_path / "t")
    before = kept(tmp_path)
    rename = os.rename

    def failing(source, target):
        if str(source).endswith(".tmp"):
            raise OSError(28, "No space left on device")
        rename(source, target)

    with monkeypatch.context() as patch:
        patch.setattr(os, "rename", failing)
        with pytest.raises(OSError, match="No space left"):
            write_experience(PLAIN, tmp_path / "t")
    assert kept(tmp_path) == before
    write_experience(PLAIN, tmp_path / "t")
    assert len(read_experience(tmp_path / "t", 5, 3)) == len(PLAIN)


def test_streams_whose_length_shows_late_are_refused_before_they_fill_the_memory(monkeypatch):
    env = gym.make("FrozenLake-v1")
    monkeypatch.setattr("erl_torch.checks.free_memory", lambda: 0.479e6)  # nearly 20,000 tuples
    with pytest.raises(InputError, match=r"n_episodes=1000000: must be smaller: .* needs 0.00048 GB of memory"):
        collect(env, 10**6, 10**6, 0)
    assert len(collect(env, 100, 10**6, 0)) < 10**4
    vector = gym.make_vec("FrozenLake-v1", 2)
    with pytest.raises(InputError, match="n_episodes=100000000: must be smaller"):
        collect(vector, 10**8, 10**8)
    with pytest.raises(InputError, match="GB of disk, and"):
        collect(MDP, 10**10, 10**10, save_to="nowhere/t")
