"""What is handed in: any array of real numbers is taken, and all else gets one line that names it."""

import math
import warnings
from dataclasses import fields, replace
from fractions import Fraction
from functools import partial
from typing import Any

import numpy as np
import pytest
import scipy.sparse as sp
import torch
from helpers import random_mdp

import erl_torch
from erl_torch import (
    AlgorithmS1,
    CertaintyEquivalence,
    EfficientS1,
    InputError,
    Replicas,
    Simulation,
    Solution,
    Status,
    TabularMDP,
    Transitions,
    certify,
    checks,
    collect,
    evaluate,
    perron,
    solve_biasing,
    solve_soft_bellman,
)
from erl_torch.envs.shift import DynamicsShiftEnv
from erl_torch.learners import LEARNERS

P = np.full((2, 2, 2), 0.5)
R = np.array([[0.0, 1.0], [2.0, 3.0]])
MDP = TabularMDP(P, R)
TABLE = np.array([[0.25, 0.75], [0.5, 0.5]])  # exact in half precision too
# Torch calls some of its sparse layouts and nested tensors beta.
beta = pytest.mark.filterwarnings("ignore:.*(Sparse|nested).*:UserWarning")


def tensor(**options):
    return torch.tensor(TABLE, **options)


def rows():
    return torch.tensor([0, 2, 4]), torch.tensor([0, 1, 0, 1]), tensor().flatten()


@beta
@pytest.mark.parametrize(
    "made",
    [
        lambda: TABLE,
        TABLE.tolist,
        lambda: tuple(map(tuple, TABLE.tolist())),
        lambda: TABLE.astype(np.float16),
        lambda: TABLE.astype(np.longdouble),
        lambda: TABLE.astype(">f8"),
        lambda: np.asfortranarray(TABLE),
        lambda: np.ma.array(TABLE),
        lambda: [[Fraction(1, 4), Fraction(3, 4)], [0.5, np.float32(0.5)]],
        lambda: [torch.tensor([0.25, 0.75]), torch.tensor([0.5, 0.5])],
        tensor,
        lambda: tensor(dtype=torch.float16),
        lambda: tensor(dtype=torch.bfloat16),
        lambda: tensor(requires_grad=True),
        lambda: tensor().T.contiguous().T,
        lambda: tensor().to_sparse(),
        lambda: tensor(dtype=torch.bfloat16).to_sparse(),
        lambda: tensor().to_sparse(1),
        lambda: torch.sparse_csr_tensor(*rows(), (2, 2)),  # type: ignore[call-arg]
        lambda: sp.csr_array(TABLE),
        lambda: sp.coo_matrix(TABLE),
        lambda: sp.dia_array(TABLE),
    ],
)
def test_whatever_holds_real_numbers_is_taken(made):
    for found in (checks.array("x", made(), (2, 2)), checks.array("x", made(), ("n", "n"))):
        assert found.dtype == np.float64
        assert found.flags.c_contiguous
        assert np.array_equal(found, TABLE)
    whole = checks.sparse("x", made(), ("n", 2))
    assert whole.dtype == np.float64
    assert np.array_equal(whole.toarray(), TABLE)


def test_what_is_taken_is_a_copy():
    for value in (TABLE, tensor(), np.ma.array(TABLE)):
        before = TABLE.copy()
        checks.array("x", value, (2, 2))[:] = 9.0
        checks.sparse("x", value, (2, 2)).data[:] = 9.0
        assert np.array_equal(np.asarray(value), before)


NO_ARRAY = [
    (lambda: None, "x=None: must be an array of real numbers"),
    (lambda: "0.5", "x=str of dtype <U3: must be an array of real numbers"),
    (lambda: TABLE.astype(str), "x=ndarray of dtype <U32: must be an array of real"),
    (lambda: TABLE + 0j, "x=ndarray of dtype complex128: must be an array of real"),
    (lambda: TABLE.astype("M8[s]"), r"x=ndarray of dtype datetime64\[s\]: must be an array of real"),
    (lambda: TABLE.astype("m8[s]"), r"x=ndarray of dtype timedelta64\[s\]: must be an array of real"),
    (lambda: [[0.5, None], [0.5, 0.5]], "x=list of dtype object: must be an array of real"),
    (lambda: [[0.5, "0.5"], [0.5, 0.5]], "x=list of dtype <U32: must be an array of real"),
    (lambda: [[0.5], [0.5, 0.5]], "x=list: must be an array of real"),
    (lambda: [[10**400, 1], [1, 1]], "x=list: must be an array of real"),
    (lambda: object(), "x=object of dtype object: must be an array of real"),
    (lambda: np.ma.array(TABLE, mask=[[1, 0], [0, 0]]), "x=an array with masked entries: must be an array without"),
    (lambda: [[np.ma.masked, 0.5], [0.5, 0.5]], "x=an array with masked entries: must be an array without"),
    (lambda: [np.ma.array([1.0, 2], mask=[1, 0])] * 2, "x=an array with masked entries: must be an array without"),
    (lambda: tensor(device="meta"), "x=Tensor of dtype torch.float64: must be a tensor with data"),
    (lambda: tensor(dtype=torch.complex64), "x=Tensor of dtype torch.complex64: must be an array of real"),
    (lambda: tensor(dtype=torch.complex64).conj(), "x=Tensor of dtype torch.complex64: must be an array of real"),
    (lambda: torch.nested.nested_tensor([torch.ones(2)] * 2), "x=Tensor of dtype torch.float32: must be an array of"),
    (
        lambda: torch.sparse_coo_tensor([[0, 1], [0, 99]], [1.0, 1.0], (2, 2), check_invariants=False),
        "x=Tensor of dtype torch.float32: must be a tensor with data, and with indices in range",
    ),
    (
        lambda: torch.sparse_csr_tensor([0, 1, 9], [0, 1], [1.0, 1.0], (2, 2), check_invariants=False),
        "x=Tensor of dtype torch.float32: must be a tensor with data, and with indices in range",
    ),
    (lambda: sp.csr_array(TABLE + 0j), "x=csr_array of dtype complex128: must be a matrix of real numbers"),
    (lambda: out_of_range(sp.csr_array(TABLE)), "x=sparse matrix: must be one with indices in range"),
    (lambda: out_of_range(sp.csc_array(TABLE)), "x=sparse matrix: must be one with indices in range"),
    (lambda: TABLE[0], r"x=array of shape \(2,\): must be of shape \[2, n\]"),
    (lambda: TABLE[None], r"x=array of shape \(1, 2, 2\): must be of shape \[2, n\]"),
    (lambda: TABLE[:, :0], r"x=array of shape \(2, 0\): must be of shape \[2, n\]"),
    (lambda: TABLE[:1], r"x=array of shape \(1, 2\): must be of shape \[2, n\]"),
]


def out_of_range(matrix):
    matrix.indices = matrix.indices.copy()
    matrix.indices[0] = 10**6
    return matrix


@beta
@pytest.mark.parametrize(("made", "message"), NO_ARRAY)
def test_whatever_holds_no_real_numbers_is_named(made, message):
    for check in (checks.array, checks.sparse):
        with pytest.raises(InputError, match=f"^{message}") as error:
            check("x", made(), (2, "n"))
        assert "\n" not in str(error.value)


def test_entries_are_named():
    for bad, said in ((np.nan, "nan"), (np.inf, "inf"), (np.longdouble("1e4000"), "inf")):
        table = TABLE.astype(np.longdouble)
        table[1, 0] = bad
        with pytest.raises(InputError, match=rf"^x\[1, 0\]={said}: must be finite$"):
            checks.array("x", table, (2, 2))
    with pytest.raises(InputError, match=r"^x\[0, 1\]=-0\.75: must be finite and >= 0$"):
        checks.array("x", TABLE * [1, -1], (2, 2), checks.NOT_NEGATIVE)


@pytest.mark.parametrize(
    "call",
    [
        lambda huge: TabularMDP(P, huge),
        lambda huge: TabularMDP(huge, R),
        lambda huge: perron(huge),
        lambda huge: checks.array("x", torch.zeros(1).expand(*huge.shape), ("n", "n")),
        lambda huge: checks.array("x", sp.coo_array(huge.shape), ("n", "n")),
    ],
)
def test_room_is_asked_for_before_it_is_taken(call):
    """A table of 8 TB without content: broadcast, or sparse. The shape may be what is refused first."""
    huge = np.broadcast_to(0.0, (10**6, 10**6))
    with pytest.raises(InputError, match=r"smaller: in double precision it needs 8e\+03 GB|of shape \[4, 2\]"):
        call(huge)


# -- one number -----------------------------------------------------------------------------------------


class Odd:
    def __str__(self):
        return "two\nlines " * 1000


NO_NUMBER = [None, True, "1", b"1", 1j, [1.0], (), {}, np.array(1.0), np.ones(2), torch.tensor(1.0), Odd(), object]
OUT_OF_RANGE = [math.nan, math.inf, -math.inf, 0, -1, 10**400, -(10**400)]
NO_COUNT = [0, -1, 0.5, 2.0, 2**63, np.uint64(2**63)]
GENERATOR = np.random.default_rng(0)
POLICY = np.full((2, 2), 0.5)
DATA = collect(MDP, 1, 50, 0)
MODEL = erl_torch.empirical_mdp(DATA, 2, 2)
SOLVED = solve_soft_bellman(MDP, 1.0)


def below(n):
    """... where 0 is in range."""
    return -1 if n is NO_COUNT[0] else n


CONTINUOUS: dict[str, Any] = {
    "beta": [
        partial(solve_soft_bellman, MDP),
        partial(solve_biasing, MDP),
        partial(certify, SOLVED, MDP),
        lambda beta: evaluate(MDP, POLICY, beta, GENERATOR),
        partial(MODEL.problem),
        AlgorithmS1,
        CertaintyEquivalence,
    ],
    "tol": [lambda tol: solve_soft_bellman(MDP, 1.0, tol=tol), lambda tol: solve_biasing(MDP, 1.0, tol=tol)],
    "rtol": [partial(perron, TABLE)],
    "level": [erl_torch.theta_uncertainty(MODEL, 1.0).interval],
    "lr_u": [lambda lr_u: AlgorithmS1(lr_u=lr_u)],
}
COUNTS = {
    "max_steps": [
        lambda n: solve_soft_bellman(MDP, 1.0, max_steps=n),
        lambda n: solve_biasing(MDP, 1.0, max_steps=n),
        lambda n: perron(TABLE, max_steps=n),
    ],
    "n_episodes": [
        lambda n: evaluate(MDP, POLICY, 1.0, GENERATOR, n_episodes=n),
        lambda n: collect(MDP, n, 10),
        lambda n: Simulation(MDP, n, 10, [0]),
    ],
    "horizon": [lambda n: evaluate(MDP, POLICY, 1.0, GENERATOR, horizon=n)],
    "episode_length": [lambda n: collect(MDP, 10, n)],
    "n_epochs": [lambda n: AlgorithmS1(n_epochs=n)],
    "n_replicas": [lambda n: Replicas.of(AlgorithmS1(), n)],
    "n_states": [lambda n: AlgorithmS1().init(n, 2), lambda n: AlgorithmS1().fit(DATA, n, 2)],
    "n_actions": [lambda n: AlgorithmS1().init(2, n), lambda n: CertaintyEquivalence().fit(DATA, 2, n)],
    "n_resamples": [lambda n: erl_torch.bootstrap_theta(MODEL, 1.0, n_resamples=n)],
    "n_steps": [lambda n: SOLVED.value_functions(below(n))],
    "seed": [lambda n: collect(MDP, 1, 9, below(n)), lambda n: erl_torch.bootstrap_theta(MODEL, 1.0, seed=below(n))],
}


@pytest.mark.parametrize("key", [*CONTINUOUS, *COUNTS])
def test_numbers_out_of_range_are_named(key):
    values = (*NO_NUMBER, *(OUT_OF_RANGE if key in CONTINUOUS else NO_COUNT))
    for call in {**CONTINUOUS, **COUNTS}[key]:
        for value in values:
            with pytest.raises(InputError, match=f"^{key}=") as error:
                call(value)
            assert "\n" not in str(error.value)
            assert len(str(error.value)) < 700


def test_numbers_of_numpy_count_as_python_s():
    """One in single precision would make arithmetic of single precision, a small whole number would overflow."""
    single = solve_soft_bellman(MDP, np.float32(0.1)).theta
    assert single == solve_soft_bellman(MDP, float(np.float32(0.1))).theta
    learner = AlgorithmS1(beta=np.float32(2.5), lr_u=1, n_epochs=np.int8(2), n_bias=np.int64(1), clip_rho=np.True_)
    kinds = {"beta": float, "lr_u": float, "n_epochs": int, "n_bias": int, "clip_rho": bool}
    assert {name: type(getattr(learner, name)) for name in kinds} == kinds
    assert len(collect(MDP, np.int8(100), np.int8(100))) == 10_000  # type: ignore[call-overload]
    assert Simulation(MDP, np.int8(100), np.int8(100), [0]).n_tuples == 10_000
    with pytest.raises(InputError, match=r"^clip_rho=1 \(int\): must be True or False"):
        AlgorithmS1(clip_rho=1)


FLAGS = [
    (lambda other: TabularMDP(P, R, normalise=other), "normalise"),
    (lambda other: Simulation(MDP, 1, 1, [0], keep=other), "keep"),
    (lambda other: erl_torch.envs.GridWorld(("SG",), cyclic=other), "cyclic"),
    (lambda other: DynamicsShiftEnv(shifted=other), "shifted"),
    (lambda other: erl_torch.estimate_mdp("pendulum", cache=other), "cache"),
    (lambda other: erl_torch.estimate_mdp("pendulum", progress=other), "progress"),
    *(
        (lambda other, learner=learner, name=field.name: learner(**{name: other}), field.name)
        for learner in LEARNERS.values()
        for field in fields(learner)
        if field.type == "bool"
    ),
]


@pytest.mark.parametrize(("call", "key"), FLAGS)
def test_flags_of_another_kind_are_named(call, key):
    for other in (0, 1.0, "abc", "True", [True]):
        with pytest.raises(InputError, match=rf"^{key}=.* \(\w+\): must be True or False$"):
            call(other)


@pytest.mark.parametrize(
    ("call", "key"),
    [
        (lambda other: solve_soft_bellman(other, 1.0), "mdp"),
        (lambda other: solve_biasing(other, 1.0), "mdp"),
        (lambda other: solve_biasing(MDP, 1.0, target=other), "target"),
        (lambda other: evaluate(other, POLICY, 1.0, GENERATOR), "source"),
        (lambda other: evaluate(MDP, POLICY, 1.0, GENERATOR, mdp=other), "mdp"),
        (lambda other: evaluate(MDP, POLICY, 1.0, other), "rng"),
        (lambda other: collect(other, 1, 1), "source"),
        (lambda other: Simulation(other, 1, 1, [0]), "mdp"),
        (lambda other: certify(other, MDP, 1.0), "solution"),
        (lambda other: certify(SOLVED, MDP, 1.0, best=other), "best"),
        (lambda other: AlgorithmS1().fit(other, 2, 2), "transitions"),
        (lambda other: erl_torch.empirical_mdp(other, 2, 2), "transitions"),
        (erl_torch.tabular_mdp, "env"),
        (lambda other: erl_torch.theta_uncertainty(other, 1.0), "model"),
        (lambda other: erl_torch.policy_uncertainty(other, POLICY, 1.0), "model"),
        (lambda other: erl_torch.bootstrap_theta(other, 1.0), "model"),
        (lambda other: next(EfficientS1().online(other, 2, 2)), "chunks?"),
        (Replicas.of, "learner"),
        (lambda other: Replicas([other]), "learners"),
    ],
)
def test_things_of_another_kind_are_named(call, key):
    for other in ("x", 3, POLICY):
        with pytest.raises(InputError, match=rf"^{key}=.* \((str|int|ndarray)\): must be ") as error:
            call(other)
        assert "\n" not in str(error.value)


def test_what_has_a_length_but_no_room_is_refused_first():
    columns = {name: [0] for name in ("s", "a", "s_next", "a_next")}
    for n in (10**15, 10**25):
        with pytest.raises(InputError, match=r"^r=array of shape \(\d+,\): must be smaller: .* GB are free$"):
            Transitions(r=range(n), **columns)
        with pytest.raises(InputError, match=r"^reward=array of shape \(2, \d+\): must be smaller: "):
            TabularMDP(P, [range(n), range(n)])


def test_parts_of_another_kind_are_named():
    with pytest.raises(InputError, match=r"^chunk=.* \(ndarray\): must be Transitions$"):
        list(EfficientS1().online([DATA, POLICY], 2, 2))  # type: ignore[list-item]
    with pytest.raises(InputError, match=r"^n_replicas=.*: must be a whole number >= 1$"):
        Replicas.of(AlgorithmS1(), sp.csr_array(TABLE), beta=[1.0, 2.0])
    with pytest.raises(InputError, match=r"^learners=3 \(int\): must be a list$"):
        Replicas(3)


def test_a_model_of_other_sizes_is_named_and_a_policy_off_the_prior_is_worth_nothing():
    other = TabularMDP(np.full((3, 2, 3), 1 / 3), np.zeros((3, 2)))
    with pytest.raises(InputError, match=r"^mdp=MDP of shape \(3, 2\): must be of shape \[2, 2\]"):
        evaluate(MDP, POLICY, 1.0, GENERATOR, mdp=other)
    assert evaluate(MDP, POLICY, 1.0, GENERATOR, prior_policy=[[1, 0], [0.5, 0.5]]).objective == -np.inf


# -- solvers' matrices ----------------------------------------------------------------------------------


def test_perron_takes_and_refuses():
    expected = math.log((5 + math.sqrt(33)) / 2)  # of [[1, 2], [3, 4]]
    whole = torch.tensor([[1, 2], [3, 4]])
    for matrix in (whole, whole.bfloat16(), whole.to_sparse(), [[1, 2], [3, 4]], sp.coo_array(whole.numpy())):
        assert perron(matrix).log_root == pytest.approx(expected, abs=1e-14)
    largest = perron(np.full((2, 2), 1e300))
    assert largest.log_root == pytest.approx(math.log(2e300), abs=1e-12)
    for bad, said in ((1e308, r"1e\+308"), (-1.0, r"-1\.0"), (np.nan, "nan")):
        with pytest.raises(InputError, match=rf"^matrix\[0, 1\]={said}: must be finite and >= 0, at most 1e\+300$"):
            perron([[1.0, bad], [1.0, 1.0]])
    for bad in (np.ones(3), np.ones((2, 2, 2)), np.ones((2, 3)), np.zeros((0, 0)), sp.csr_array((2, 3))):
        with pytest.raises(InputError, match=r"^matrix=array of shape \(.*\): must be of shape \[n, n\], square$"):
            perron(bad)


def test_repr_is_short():
    mdp = random_mdp(np.random.default_rng(0), 50, 3)
    assert repr(mdp).startswith("TabularMDP(50 states, 3 actions, 7500 transitions, rewards in [-0.9")
    assert len(repr(TabularMDP(P, R * 1e99))) < 100


# -- saved solutions ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "solution",
    [
        SOLVED,
        solve_soft_bellman(TabularMDP(np.eye(2)[:, None].repeat(2, 1), R), 1.0),  # reducible: no theta
        solve_soft_bellman(TabularMDP(P, R * 1e5), 1.0),  # u beyond double precision
        AlgorithmS1(n_epochs=1, n_bias=1, beta=1.0).fit(DATA, 2, 2),
        CertaintyEquivalence().fit(DATA.first(3), 2, 2),  # pairs without visits
    ],
    ids=["solved", "reducible", "large", "learnt", "unvisited"],
)
def test_solutions_come_back_as_they_were(tmp_path, solution):
    again = Solution.load(solution.save(tmp_path / "a.npz"))
    for item in fields(Solution):
        value, found = getattr(solution, item.name), getattr(again, item.name)
        if item.name == "history":
            assert value.keys() == found.keys()
            assert all(np.array_equal(value[name], found[name]) for name in value)
        elif isinstance(value, torch.Tensor):
            assert torch.equal(value, found)
        else:
            assert (value, type(value)) == (found, type(found))
    assert again.save(tmp_path / "b.npz").read_bytes() == (tmp_path / "a.npz").read_bytes()


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("theta", "x", "theta=x: must be a finite number"),
        ("theta", np.nan, "theta=nan: must be a finite number"),
        ("theta", [1.0, 2.0], r"theta=array of shape \(2,\): must be a single value"),
        ("rho", -1.0, r"rho=-1\.0: must be a number >= 0"),
        ("beta", np.nan, "beta=nan: must be a finite number > 0"),
        ("gap", np.nan, "gap=nan: must be a number >= 0"),
        ("reward_bias_max", np.nan, "reward_bias_max=nan: must be a finite number"),
        ("n_steps", 1.5, r"n_steps=1\.5: must be a whole number >= 0"),
        ("k", -1, "k=-1: must be a whole number >= 0"),
        ("status", "FOO", "status=FOO: must be COMPLETED or"),
        ("status", 3, "status=3: must be COMPLETED or"),
        ("message", 3, r"message=3 \(int\): must be text"),
        ("theta_bounds", 1.0, r"theta_bounds=array of shape \(\): must be of shape \[2\]"),
        ("theta_bounds", [1.0, -1.0], r"theta_bounds=\(1\.0, -1\.0\): must be in order"),
        ("theta_bounds", ["a", "b"], "theta_bounds=ndarray of dtype <U1: must be an array of real numbers"),
        ("policy", 1.0, r"policy=array of shape \(\): must be of shape \[n_states, n_actions\]"),
        ("policy", [["a"]], "policy=ndarray of dtype <U1: must be an array of real numbers"),
        ("policy", np.full((2, 2), np.nan), r"policy\[0, 0\]=nan: must be finite and >= 0"),
        ("policy", np.ones((2, 2)), r"policy\[0\]=sum 2: must be 1 in sum"),
        ("policy", None, "policy=None: must be there, as Solution.save writes it"),
        ("u", np.ones(7), r"u=array of shape \(7,\): must be of shape \[n_states, n_actions\]"),
        ("u", np.ones((3, 2)), r"u=array of shape \(3, 2\): must be of shape \[2, 2\], to go with the policy"),
        ("psi", np.ones(7), r"psi=array of shape \(7,\): must be of shape \[2\], to go with the policy"),
        ("value", [0.0, np.nan], r"value\[1\]=nan: must be a number"),
        ("history", [1, 2], r"history=array of shape \(2,\): must be left out"),
        ("extra", 1, r"extra=array of shape \(\): must be left out"),
        ("history/theta", 1.0, r"history/theta=array of shape \(\) and dtype float64: must be numbers"),
        ("history/theta", ["a"], r"history/theta=array of shape \(1,\) and dtype <U1: must be numbers"),
    ],
)
def test_damaged_solutions_are_named(tmp_path, key, value, said):
    arrays = {**SOLVED.arrays(), key: np.asarray(value)}
    if value is None:
        del arrays[key]
    path = tmp_path / "damaged.npz"
    np.savez(path, **arrays)
    with pytest.raises(InputError, match=f"^path={path}: {said}") as error:
        Solution.load(path)
    assert "\n" not in str(error.value)


def test_value_functions_need_what_they_use():
    with pytest.raises(InputError, match=r"^n_steps=5: must be 0: this solution has no theta"):
        replace(SOLVED, theta=None).value_functions(5)
    with pytest.raises(InputError, match=r"^beta=None: must be known"):
        replace(SOLVED, beta=None, value=None).value_functions(1)


def test_nothing_is_dropped_with_a_warning():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for bad in (R + 1j, np.ma.array(R, mask=True), R.astype("M8[s]"), R.astype(str)):
            with pytest.raises(InputError, match=r"^reward="):
                TabularMDP(P, bad)
            with pytest.raises(InputError, match=r"^r="):
                Transitions([0, 1], [0, 0], bad[0], [1, 0], [0, 0])
    assert SOLVED.status is Status.CONVERGED
