"""TabularMDP: every form of input, every refusal."""

import numpy as np
import pytest
import scipy.sparse as sp
import torch

from erl_torch import InputError, TabularMDP
from erl_torch.mdp import check_policy

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
        ((FLAT[:5], R), r"transition=array of shape \(5, 3\): must be of shape \[6, 3\]"),
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
