"""Transitions: validation, and files that never carry pickles or half a write."""

import zipfile

import numpy as np
import pytest
import torch
from helpers import DATA

from erl_torch import InputError, Transitions, read_experience

COLUMNS = {
    "s": [0, 1, 2],
    "a": [1, 0, 1],
    "r": [-1.0, 0.5, 0.0],
    "s_next": [1, 2, 0],
    "a_next": [0, 1, 1],
}


def test_dtypes_and_tensors():
    data = Transitions(**{name: torch.tensor(values) for name, values in COLUMNS.items()})
    assert [getattr(data, n).dtype for n in COLUMNS] == [np.int32, np.int32, np.float64, np.int32, np.int32]
    assert len(data) == 3


def test_round_trip_is_exact_and_repeatable(tmp_path):
    data = Transitions(**COLUMNS)
    first, second = data.save(tmp_path / "a.npz"), data.save(tmp_path / "deep" / "b.npz")
    assert first.read_bytes() == second.read_bytes()
    loaded = Transitions.load(first)
    for name in COLUMNS:
        assert np.array_equal(getattr(loaded, name), getattr(data, name))
    assert sorted(p.name for p in tmp_path.rglob("*")) == ["a.npz", "b.npz", "deep"]


def test_loads_any_npz_with_the_columns(authors, authors_tuples):
    loaded = Transitions.load(DATA / "windy_cliff_s1.npz")
    assert np.array_equal(loaded.s_next, authors_tuples.s_next)
    assert len(loaded) == 20_000


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"s": [0, -1, 2]}, r"s\[1\]=-1: must be a whole number"),
        ({"s": [0, 2**31, 2]}, r"s\[1\]=2147483648"),
        ({"a": [1.0, 0.5, 0.0]}, r"a\[1\]=0.5: must be a whole number in \[0, 2\*\*31\)"),
        ({"a": [1.0, 0.0, np.nan]}, r"a\[2\]=nan: must be a whole number"),
        ({"a": [1.0, np.inf, 0.0]}, r"a\[1\]=inf: must be a whole number"),
        ({"r": [0.0, np.nan, 0.0]}, r"r\[1\]=nan: must be finite"),
        ({"r": ["a", "b", "c"]}, r"r=list of dtype <U1: must be an array of real numbers"),
        ({"s_next": [0, 1]}, r"columns=lengths .*'s_next': 2.*: must be of one length"),
        ({"a_next": [[0, 1, 2]]}, r"a_next=array of shape \(1, 3\): must be one-dimensional"),
        ({name: [] for name in COLUMNS}, r"transitions=0 tuples: must be at least one tuple"),
    ],
)
def test_refuses(change, message):
    with pytest.raises(InputError, match=message):
        Transitions(**(COLUMNS | change))


def test_bad_files_are_named(tmp_path):
    good = Transitions(**COLUMNS).save(tmp_path / "good.npz")
    whole = good.read_bytes()
    cases = {
        "missing.npz": None,
        "empty.npz": b"",
        "text.npz": b"hello",
        "cut.npz": whole[: len(whole) // 2],
        "flipped.npz": whole[:60] + bytes([whole[60] ^ 255]) + whole[61:],
    }
    for name, content in cases.items():
        if content is not None:
            (tmp_path / name).write_bytes(content)
        with pytest.raises(InputError, match=name) as error:
            Transitions.load(tmp_path / name)
        assert "\n" not in str(error.value)


def moved(whole, name):
    """The header of one array eight bytes shorter: entries move by one, and eight bytes are left at the end."""
    at = whole.find(b"\x93NUMPY", whole.find(f"{name}.npy".encode())) + 8
    return whole[:at] + bytes([whole[at] - 8]) + whole[at + 1 :]


def swallowed(whole, name):
    """The directory's entry before that of one array takes the rest for its comment."""
    entry = whole.rfind(b"PK\x01\x02", 0, whole.rfind(f"{name}.npy".encode()) - 46)
    after = len(whole) - 22 - whole.find(b"PK\x01\x02", entry + 1)
    return whole[: entry + 32] + after.to_bytes(2, "little") + whole[entry + 34 :]


def renamed(whole, name):
    """Another name in the directory alone."""
    at = whole.rfind(f"{name}.npy".encode())
    return whole[:at] + b"R" + whole[at + 1 :]


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (moved, "r.npy: Bad CRC-32"),
        (swallowed, "7 members are announced, and 6 listed"),
        (renamed, "R.npy: File name in directory"),
    ],
)
def test_damage_that_leaves_arrays_readable_is_seen(tmp_path, damage, said):
    rng = np.random.default_rng(0)
    r, whole = rng.normal(size=4096), np.arange(4096) % 3
    arrays = {"s": whole, "a": whole, "s_next": whole, "a_next": whole, "note": 1, "r": r, "more": 2}
    np.savez(tmp_path / "good.npz", **arrays)
    content = (tmp_path / "good.npz").read_bytes()
    assert np.array_equal(Transitions.load(tmp_path / "good.npz").r, r)
    name = {swallowed: "more"}.get(damage, "r")
    (tmp_path / "bad.npz").write_bytes(damage(content, name))
    with pytest.raises(InputError, match=rf"^path=\S*bad.npz: must be a readable npz file .*{said}"):
        Transitions.load(tmp_path / "bad.npz")
    with pytest.raises(InputError, match=r"bad\.npz"):
        read_experience(tmp_path / "bad.npz", 3, 3)


def test_an_array_is_in_a_file_once(tmp_path):
    with zipfile.ZipFile(tmp_path / "twice.npz", "w") as archive:
        for name in ("s.npy", "s"):
            with archive.open(name, "w") as file:
                np.save(file, np.arange(3))
    for read in (Transitions.load, lambda path: read_experience(path, 3, 3)):
        with pytest.raises(InputError, match=r"twice\.npz: must be .*\(s is there twice\)"):
            read(tmp_path / "twice.npz")


def test_pickles_are_refused(tmp_path):
    np.savez(tmp_path / "p.npz", **{n: np.array(v, dtype=object) for n, v in COLUMNS.items()})
    with pytest.raises(InputError, match=r"p\.npz.*without pickled objects"):
        Transitions.load(tmp_path / "p.npz")


def test_missing_column_and_bad_row_name_the_file(tmp_path):
    np.savez(tmp_path / "few.npz", s=[0])
    with pytest.raises(InputError, match=r"few\.npz: must be .* it lacks a"):
        Transitions.load(tmp_path / "few.npz")
    np.savez(tmp_path / "nan.npz", **(COLUMNS | {"r": [0.0, 0.0, np.inf]}))
    with pytest.raises(InputError, match=r"nan\.npz: r\[2\]=inf"):
        Transitions.load(tmp_path / "nan.npz")
