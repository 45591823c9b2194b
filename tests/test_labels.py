"""Labels: numbers of states and actions, and back; spaces against Gymnasium's own ``contains`` and ``sample``."""

import itertools
import math

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st

from erl_torch import InputError
from erl_torch.files import read_npz, write_npz
from erl_torch.labels import Labels

SMALL = st.integers(1, 3)
LEAVES = st.one_of(
    st.builds(lambda n, start: spaces.Discrete(n, start=start), SMALL, st.integers(-5, 5)),
    st.builds(
        lambda sizes, start: spaces.MultiDiscrete(sizes, start=[start] * len(sizes)),
        st.lists(SMALL, min_size=1, max_size=2),
        st.integers(-2, 2),
    ),
    st.sampled_from([spaces.MultiBinary(1), spaces.MultiBinary(2), spaces.MultiBinary((1, 2))]),
    st.builds(lambda low, n: spaces.Box(low, low + n, (2,), np.int64), st.integers(-3, 3), st.integers(0, 2)),
    st.just(spaces.MultiDiscrete(np.array([[2, 1], [1, 2]]))),
)
SPACES = st.recursive(
    LEAVES,
    lambda inner: st.one_of(
        st.lists(inner, min_size=1, max_size=2).map(spaces.Tuple),
        st.dictionaries(st.text("abz. ", max_size=3), inner, min_size=1, max_size=2).map(spaces.Dict),
    ),
    max_leaves=3,
)
TEXTS = st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]), max_size=8)
LABELS = st.recursive(
    st.one_of(st.integers(), TEXTS),
    lambda inner: st.one_of(
        st.lists(inner, max_size=3).map(tuple), st.dictionaries(TEXTS, inner, min_size=1, max_size=2)
    ),
    max_leaves=4,
)


def size_by_hand(space):
    """How many members, from the definition of each space."""
    match space:
        case spaces.Discrete():
            return int(space.n)
        case spaces.MultiDiscrete():
            return math.prod(int(n) for n in space.nvec.ravel())
        case spaces.MultiBinary():
            return 2 ** math.prod(space.shape)
        case spaces.Box():
            return math.prod(int(n) for n in (space.high - space.low + 1).ravel())
        case spaces.Tuple():
            return math.prod(map(size_by_hand, space.spaces))
        case _:
            return math.prod(map(size_by_hand, space.spaces.values()))


@settings(max_examples=60, deadline=None)
@given(SPACES)
def test_numbers_of_a_space_are_one_to_one(space):
    labels = Labels.of_space(space)
    assert len(labels) == size_by_hand(space)
    members = [labels.member(i) for i in range(len(labels))]
    assert all(space.contains(member) for member in members)
    assert [labels.encode(member) for member in members] == list(range(len(labels)))
    assert [labels.encode(label) for label in labels] == list(range(len(labels)))
    assert [labels.encode(text) for text in labels.texts.tolist()] == list(range(len(labels)))
    assert len(set(labels.texts.tolist())) == len(labels)
    space.seed(0)
    for _ in range(5):
        sample = space.sample()
        assert gym.spaces.utils.flatten(space, labels.member(labels.encode(sample))).tolist() == (
            gym.spaces.utils.flatten(space, sample).tolist()
        )


@settings(max_examples=60, deadline=None)
@given(SPACES, st.integers(1, 4))
def test_a_batch_is_its_members_one_by_one(space, n):
    labels = Labels.of_space(space)
    batch = gym.vector.utils.batch_space(space, n)
    batch.seed(0)
    values = batch.sample()
    one_by_one = [labels.encode(value) for value in gym.vector.utils.iterate(batch, values)]
    assert labels.encode_batch(values, n).tolist() == one_by_one


def test_the_last_entry_counts_fastest():
    space = spaces.Tuple((spaces.Discrete(2, start=1), spaces.MultiDiscrete([2, 3])))
    expected = [(i, (j, k)) for i, j, k in itertools.product((1, 2), range(2), range(3))]
    assert list(Labels.of_space(space)) == expected
    parts = {"b": spaces.Discrete(2), "a": spaces.Discrete(3)}
    for one in (spaces.Dict(**parts), spaces.Dict(parts), spaces.Dict(dict(reversed(parts.items())))):
        named = [{"a": i, "b": j} for i, j in itertools.product(range(3), range(2))]
        assert list(Labels.of_space(one)) == named


@settings(max_examples=100, deadline=None)
@given(st.lists(LABELS, min_size=1, max_size=8))
def test_labels_come_back_from_their_texts(tmp_path_factory, values):
    labels = Labels.of_values(values)
    path = tmp_path_factory.mktemp("labels") / "labels.npz"
    write_npz(path, {"labels": labels.texts})
    again = Labels.of_texts(read_npz(path)["labels"])
    assert again == labels
    for value in values:
        assert again.encode(value) == labels.encode(value)
        assert labels.text(labels.encode(value)) == again.text(again.encode(value))


def test_a_text_that_is_written_otherwise_stays_a_text():
    texts = ["3.0", "True", "1_0", "0x1f", "(1,2)", "3", "(1, 2)"]
    labels = Labels.of_texts(texts)
    assert labels.texts.tolist() == texts
    assert [*labels] == [*texts[:5], 3, (1, 2)]


def test_order_is_that_of_first_appearance_and_equal_texts_are_one_label():
    labels = Labels.of_values(["b", 3, "a", "3", np.int64(3), 3.0, (1, "x"), [1, "x"], np.array([1, 2])])
    assert list(labels) == ["b", 3, "a", (1, "x"), (1, 2)]
    assert labels.encode("(1, 'x')") == 3
    assert Labels.of_values(np.array(["b", "a", "b"])) == Labels.of_values(["b", "a"])
    assert Labels.of_values(["b", "a"]) != Labels.of_values(["a", "b"])
    assert list(Labels.of_values(np.array([5, 2, 5, -1]))) == [5, 2, -1]


def test_a_dict_is_one_label_in_any_order():
    labels = Labels.of_values([{"b": 1, "a": (2,)}])
    assert labels.encode({"a": [2], "b": 1}) == 0
    assert labels.texts.tolist() == ["{'a': (2,), 'b': 1}"]


@pytest.mark.parametrize("column", [["x", "y", "x", "x"], np.array(["x", "y", "x", "x"]), ("x", "y", "x", "x")])
def test_a_column_is_encoded(column):
    labels = Labels.of_values(["y", "z", "x"])
    assert labels.encode_all(column).tolist() == [2, 0, 2, 2]


@pytest.mark.parametrize("column", [["b", "a", "c", "c"], np.array(["b", "a", "c", "c"])])
def test_the_first_wrong_row_of_a_column_is_named(column):
    labels = Labels.of_values(["b"])
    with pytest.raises(InputError, match=r"^state\[1\]=a: must be one of b"):
        labels.encode_all(column, "state")
    with pytest.raises(InputError, match=r"^state\[0\]=z: must be one of b"):
        labels.encode_all(np.array(["z", "a"]), "state")  # the first in place, not in value


def test_whole_numbers_are_taken_from_floats_and_nothing_else_is():
    labels = Labels.of_space(spaces.Discrete(3, start=1))
    assert [labels.encode(x) for x in (1, 2.0, np.float32(3), np.array(2), "3")] == [0, 1, 2, 1, 2]
    for wrong in (0, 4, 0.5, 1.5, np.nan, np.inf, 2**70, None, "up", [1], np.array([1]), 1j, 1e300):
        with pytest.raises(InputError, match=r"in Discrete\(3, start=1\)"):
            labels.encode(wrong)


@pytest.mark.parametrize(
    ("space", "wrong", "words"),
    [
        (spaces.MultiDiscrete([2, 2]), [0, 2], "MultiDiscrete"),
        (spaces.MultiDiscrete([2, 2]), [0, 1, 0], r"shape \(3,\)"),
        (spaces.MultiBinary(2), [0, 0.5], "MultiBinary"),
        (spaces.Tuple((spaces.Discrete(2),) * 2), (0,), "a tuple of 2"),
        (spaces.Tuple((spaces.Discrete(2),) * 2), 0, "a tuple of 2"),
        (spaces.Dict(cell=spaces.Discrete(2)), {"cel": 0}, "keys cell"),
        (spaces.Dict(cell=spaces.Discrete(2)), {"cell": 0, "more": 0}, "keys cell"),
        (spaces.Dict(cell=spaces.Discrete(2)), (0,), "dict with cell"),
    ],
)
def test_what_is_outside_its_space_is_named(space, wrong, words):
    with pytest.raises(InputError, match=words) as error:
        Labels.of_space(space).encode(wrong, "observation")
    assert str(error.value).startswith("observation=")
    assert "\n" not in str(error.value)


def test_the_place_in_a_batch_is_named():
    labels = Labels.of_space(spaces.MultiDiscrete([2, 3]))
    with pytest.raises(InputError, match=r"^observation\[2\]=\[1 3\]"):
        labels.encode_batch(np.array([[0, 0], [1, 2], [1, 3]]), 3, "observation")


@pytest.mark.parametrize(
    "space",
    [
        spaces.Discrete(3, start=-5),
        spaces.MultiDiscrete([3, 3], start=[-2, -2]),
        spaces.Box(-3, -1, (2,), np.int64),
        spaces.Box(-(2**63), -(2**63) + 2, (1,), np.int64),
    ],
)
@pytest.mark.parametrize("kind", [np.int8, np.int64, np.uint8, np.uint32, np.uint64])
def test_numbers_far_outside_a_space_are_refused(space, kind):
    """Differences from a lowest entry below 0 leave the range of int64; 2**64 - 1 as an int64 is -1."""
    labels = Labels.of_space(space)
    extremes = {int(np.iinfo(kind).max), int(np.iinfo(kind).max) - 1, int(np.iinfo(kind).max) // 2 + 1}
    if np.iinfo(kind).min == -128:
        extremes.add(-128)
    for value in extremes:
        wrong = np.full(np.shape(labels.decode(0)), value, kind)
        with pytest.raises(InputError, match=r"^label="):
            labels.encode(wrong)
        with pytest.raises(InputError, match=r"^label\[0\]="):
            labels.encode_batch(wrong[None], 1)
    for number in range(len(labels)):
        assert labels.encode(labels.member(number)) == number


def test_a_space_of_one_member_without_entries():
    labels = Labels.of_space(spaces.Box(0, 2, (0,), np.int64))
    assert (len(labels), labels.encode(np.zeros(0, np.int64)), labels.decode(0)) == (1, 0, ())
    assert labels.encode_batch(np.zeros((3, 0), np.int64), 3).tolist() == [0, 0, 0]


@pytest.mark.parametrize(
    ("space", "words"),
    [
        (spaces.MultiBinary(31), r"2,147,483,648 members"),
        (spaces.MultiBinary(1000), "about 1e301 members"),
        (spaces.Box(0, 255, (7, 7, 3), np.uint8), "about 1e354 members"),
        (spaces.Box(2**63, 2**63 + 1, (1,), np.uint64), r"below 2\*\*63"),
        (spaces.Box(0, 1, (2,)), "a finite space"),
        (spaces.Tuple((spaces.Discrete(2), spaces.Text(3))), "a finite space"),
    ],
)
def test_spaces_that_are_not_finite_or_too_large_are_refused(space, words):
    with pytest.raises(InputError, match=words):
        Labels.of_space(space)
    assert len(Labels.of_space(spaces.Discrete(2**31 - 1))) == 2**31 - 1  # computed, not listed


@pytest.mark.parametrize("wrong", [0.5, None, "a\0", "\ud800", b"a", {1: 2}, object(), (1, None)])
def test_what_is_no_label_is_named(wrong):
    with pytest.raises(InputError, match=r"^labels\[1\]="):
        Labels.of_values(["fine", wrong])


def test_wrong_texts_and_numbers_are_named():
    with pytest.raises(InputError, match="0 of them"):
        Labels.of_values([])
    with pytest.raises(InputError, match="labels=a: must be there once"):
        Labels.of_texts(["a", "b", "a"])
    with pytest.raises(InputError, match="must be texts"):
        Labels.of_texts([3])
    labels = Labels.of_values(["left", "right"])
    for number in (-1, 2, 0.5):
        with pytest.raises(InputError, match="number="):
            labels.decode(number)
    with pytest.raises(InputError, match=r"one of left, right \(did you mean left\?\)"):
        labels.encode("lefft")
