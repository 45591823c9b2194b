"""TabularMDP: every form of input, every refusal."""

import math

import numpy as np
import pytest
import scipy.sparse as sp
import torch

from erl_torch import InputError, Note, TabularMDP
from erl_torch.mdp.tabular import check_policy, check_prior, normalise_rows

P = np.array([[[0.5, 0.5, 0.0], [0.0, 0.0, 1.0]]] * 3)  # [S, A, S] = [3, 2, 3]
FLAT = P.reshape(6, 3)
R = -np.arange(6.0).reshape(3, 2)


@pytest.mark.parametrize(
    "transition",
    [
        P,
        FLAT,
        FLAT.tolist(),
        sp.csr_array(FLAT),
        sp.coo_matrix(FLAT),
        torch.from_numpy(P),
        torch.from_numpy(FLAT).to_sparse(),
        torch.from_numpy(FLAT).to_sparse_coo(),
        torch.from_numpy(FLAT).float(),
    ],
    ids=lambda t: type(t).__name__,
)
def test_takes_any_form(transition):
    mdp = TabularMDP(transition, R)
    assert (mdp.n_states, mdp.n_actions) == (3, 2)
    assert mdp.transition.dtype == mdp.reward.dtype == mdp.start.dtype == np.float64
    assert np.array_equal(mdp.transition.toarray(), FLAT)
    assert mdp.transition.nnz == 9  # zeros are not stored
    assert np.allclose(mdp.start, 1 / 3)


@pytest.mark.filterwarnings("ignore:Sparse")  # torch calls its CSR layout and its checks beta
def test_takes_torch_csr():
    indptr, indices, values = (torch.tensor(x) for x in ([0, 1, 2], [1, 0], [1.0, 1.0]))
    csr = torch.sparse_csr_tensor(indptr, indices, values, (2, 2))
    mdp = TabularMDP(csr, [[0.0], [1.0]])
    assert np.array_equal(mdp.transition.toarray(), [[0, 1], [1, 0]])


def test_sums_repeated_entries():
    rows, cols = np.repeat(np.arange(6), 2), np.zeros(12, int)
    mdp = TabularMDP(sp.coo_array((np.full(12, 0.5), (rows, cols)), shape=(6, 3)), R)
    assert np.array_equal(mdp.transition.toarray()[:, 0], np.ones(6))
    assert mdp.transition.nnz == 6


def test_copies_its_input():
    csr = sp.csr_array(FLAT)
    mdp = TabularMDP(csr, R)
    csr.data[:] = 0
    assert np.array_equal(mdp.transition.toarray(), FLAT)


def changed(array, index, value):
    array = array.copy()
    array[index] = value
    return array


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((changed(FLAT, (3, 0), 0.4), R), r"transition row 3 \(state 1, action 1\)=sum 1.4: must be 1 in sum"),
        (
            (changed(FLAT, (2, 0), np.nan), R),
            r"transition row 2 \(state 1, action 0\)=nan: must be finite and >= 0",
        ),
        (
            (changed(FLAT, (0, slice(None)), [1.5, -0.5, 0]), R),
            r"transition row 0 .*=-0.5: must be finite and >= 0",
        ),
        (
            (FLAT[:5], R),
            r"transition=array of shape \(5, 3\): must be of shape \[6, 3\] \(\[S\*A, S\]\) or "
            r"\[3, 2, 3\] \(\[S, A, S\]\), as reward is \[3, 2\] \(\[S, A\]\): one of the two is wrong$",
        ),
        (
            (sp.csr_array(FLAT[:5]), R),
            r"transition=array of shape \(5, 3\): must be of shape \[6, 3\] \(\[S\*A, S\]\), as reward is \[3, 2\] ",
        ),
        ((P, changed(R, (1, 0), np.inf)), r"reward\[1, 0\]=inf: must be finite"),
        ((P, changed(R, (1, 0), -1e300)), r"reward\[1, 0\]=-1e\+300: must be finite, and at most 1e\+100 in size"),
        ((P, R.ravel()), r"reward=array of shape \(6,\): must be of shape \[n_states, n_actions\]"),
        ((P, "reward"), r"reward=str of dtype <U6: must be an array of real numbers"),
        ((P, R, [0.5, 0.5]), r"start=array of shape \(2,\): must be of shape \[3\]"),
        ((P, R, [0.5, 0.5, 0.5]), r"start=sum 1.5: must be 1 in sum, within 1e-05"),
        ((P, R, [1.5, -0.5, 0.0]), r"start\[1\]=-0.5: must be finite and >= 0"),
    ],
)
def test_refuses(arguments, message):
    with pytest.raises(InputError, match=message) as error:
        TabularMDP(*arguments)
    assert "\n" not in str(error.value)


def test_policies_are_checked():
    assert np.array_equal(check_policy("p", None, 2, 4), np.full((2, 4), 0.25))
    for bad, message in [
        (np.full((2, 3), 1 / 3), "shape"),
        (np.full((2, 4), 0.3), r"p\[0\]=sum 1.2: must be 1 in sum"),
        (np.array([[2.0, -1, 0, 0]] * 2), ">= 0"),
    ]:
        with pytest.raises(InputError, match=message):
            check_policy("p", bad, 2, 4)


def test_policies_start_and_rewards_are_copied():
    """Rows off by less than 1e-5 are divided in place, and the caller may go on to use his arrays."""
    policy, start, reward = np.full((3, 2), 0.5 + 1e-6), np.full(3, (1 + 1e-6) / 3), R.copy()
    before = policy.copy(), start.copy()
    with pytest.warns(Note):
        found = check_policy("p", policy, 3, 2)
    with pytest.warns(Note):
        mdp = TabularMDP(P, reward, start)
    assert np.array_equal(policy, before[0])
    assert np.array_equal(start, before[1])
    np.testing.assert_allclose(found, 0.5, rtol=1e-15)
    np.testing.assert_allclose(mdp.start, 1 / 3, rtol=1e-15)
    policy[:], start[:], reward[:] = np.nan, np.nan, np.nan
    assert np.isfinite(found).all()
    assert np.isfinite(mdp.start).all()
    assert np.array_equal(mdp.reward, R)


def test_load_scales_rows_only_if_asked_to(tmp_path):
    np.savez(tmp_path / "m.npz", transition=3 * P, reward=R)
    message = r"m\.npz: transition row 0 \(state 0, action 0\)=sum 3: must be 1 in sum"
    with pytest.raises(InputError, match=message) as error:
        TabularMDP.load(tmp_path / "m.npz")
    assert str(error.value.within("env")).startswith(f"env.path={tmp_path}")
    with pytest.warns(Note, match=r"by up to 2\.0e\+00"):
        mdp = TabularMDP.load(tmp_path / "m.npz", normalise=True)
    assert np.array_equal(mdp.transition.toarray(), FLAT)


def test_the_smallest_prior():
    """Below 2.2e-308 a number has lost digits, and 1e-307 is the limit."""
    for smallest in (np.array([[1e-307, 1.0]]), np.array([[0.0, 1.0]])):
        assert np.array_equal(check_prior("p", smallest, 1, 2), smallest)
    for bad in (9e-308, 5e-324):
        with pytest.raises(InputError, match=rf"^p\[0, 0\]={bad}: must be >= 1e-307, or 0"):
            check_prior("p", [[bad, 1.0]], 1, 2)


def test_rows_of_the_smallest_numbers_sum_to_one_after_division():
    """... though entries below double precision's normal numbers have few digits: their sum is exact."""
    for smallest in (1.0, 3.0, 7.0):
        tiny = smallest * 5e-324
        data = np.array([tiny, 2 * tiny, 4 * tiny, 4 * tiny])
        largest = normalise_rows(str, np.array([0, 4]), data, np.inf)
        assert largest == 1.0
        assert abs(math.fsum(data) - 1) <= 1e-15
        np.testing.assert_allclose(data, np.array([1, 2, 4, 4]) / 11, rtol=1e-15)
    rng = np.random.default_rng(0)
    for _ in range(200):
        data = rng.random(5) * 10.0 ** rng.integers(-323, -300, 5)
        if not data.any():
            continue
        normalise_rows(str, np.array([0, 5]), data, np.inf)
        assert abs(math.fsum(data) - 1) <= 2e-15


def test_sums_that_overflow_are_refused():
    """... whatever the tolerance, and with them the rows beside them are looked at."""
    for tolerance, allowed in ((np.inf, "of a finite sum > 0"), (1e-5, "1 in sum, within 1e-05")):
        for data in ([1e308, 1e308, 0.5, 0.5], [0.5, 0.5, 1e308, 1e308]):
            row = 0 if data[0] > 1 else 1
            with pytest.raises(InputError, match=rf"^{row}=sum (inf|nan): must be {allowed}"):
                normalise_rows(str, np.array([0, 2, 4]), np.array(data), tolerance)
    for normalise in (False, True):
        with pytest.raises(InputError, match=r"transition row 0 \(state 0, action 0\)=sum"):
            TabularMDP([[1e308, 1e308], [0.3, 0.3]], [[0.0], [0.0]], normalise=normalise)
        with pytest.raises(InputError, match=r"start=sum"):
            TabularMDP([[0.5, 0.5], [0.5, 0.5]], [[0.0], [0.0]], [1e308, 1e308], normalise=normalise)
    with pytest.raises(InputError, match=r"p\[0\]=sum"):
        check_policy("p", [[1e308, 1e308], [0.2, 0.2]], 2, 2)
