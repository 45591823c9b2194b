"""Classic average-reward problems against published values, linear programs and closed forms."""

import numpy as np
import pytest
from scipy.optimize import linprog

import erl_torch
from erl_torch import InputError, TabularMDP
from erl_torch.envs.access_control import access_control
from erl_torch.envs.admission import admission
from erl_torch.envs.car_rental import car_rental
from erl_torch.envs.forest import forest
from erl_torch.envs.inventory import inventory
from erl_torch.envs.machine_replacement import machine_replacement
from erl_torch.envs.river_swim import river_swim
from erl_torch.envs.two_choice import two_choice


def best_rate(mdp):
    """The best average reward, by the linear program over occupations x(s, a) of the pairs that there are."""
    n_states, n_actions = mdp.reward.shape
    pairs = np.flatnonzero(mdp.transition.sum(1) > 0)
    balance = -mdp.transition.toarray()[pairs].T
    balance[pairs // n_actions, np.arange(len(pairs))] += 1
    system = np.vstack([balance, np.ones(len(pairs))])
    found = linprog(-mdp.reward.ravel()[pairs], A_eq=system, b_eq=np.eye(n_states + 1)[-1], method="highs")
    assert found.status == 0
    return -found.fun


def improved(mdp):
    """(best average reward, its policy [S]) by policy iteration, where every policy has one closed class."""
    n_states, n_actions = mdp.reward.shape
    p, have = mdp.transition.toarray(), np.asarray(mdp.transition.sum(1) > 0).reshape(n_states, n_actions)
    policy = have.argmax(1)
    while True:
        rows = np.arange(n_states) * n_actions + policy
        system = np.eye(n_states) - p[rows]
        system[:, 0] = 1  # the value of state 0 is 0; its column is the rate's
        value = np.linalg.solve(system, mdp.reward.ravel()[rows])
        rate, value[0] = value[0], 0.0
        q = np.where(have, mdp.reward + (p @ value).reshape(n_states, n_actions), -np.inf)
        better = q.argmax(1)
        keep = q[np.arange(n_states), policy] > q.max(1) - 1e-9
        if keep.all():
            return rate, policy
        policy = np.where(keep, policy, better)


# Best average reward, and theta at beta 1 and 10 with the uniform prior over the actions of each state.
VALUES = {
    "access control": (access_control(), 2.747641951, -2.3429231640, -2.6893777426),
    "access control, free first": (access_control(rule="free_first"), 2.743218182, -2.3063767695, -2.6774255151),
    "RiverSwim": (river_swim(), 0.428622434, -0.0061316252, -0.3593078916),
    "RiverSwim, easy": (river_swim("easy"), 0.897222249, -0.3368916715, -0.8279075309),
    "TwoChoice": (two_choice(), 0.4, -0.3240229014, -0.3861379644),
    "inventory": (inventory(), 97 / 44, -1.4981619060, -2.1083586110),
    "forest of 3": (forest(), 3.24, -2.5512235472, -3.1706852819),
    "forest of 10": (forest(10), 1.549681956, -0.8931563759, -1.4803672398),
    "forest of 300": (forest(300), 9 / 19, -0.2556253734, -0.4050739131),
}


@pytest.mark.parametrize("name", VALUES)
def test_published_values(name):
    mdp, rate, warm, cold = VALUES[name]
    assert best_rate(mdp) == pytest.approx(rate, abs=2e-7)
    for beta, theta in ((1.0, warm), (10.0, cold)):
        best = erl_torch.solve_soft_bellman(mdp, beta)
        assert best.theta_bounds[0] - 1e-10 <= theta <= best.theta_bounds[1] + 1e-10  # printed with ten digits
        assert best.theta == pytest.approx(theta, abs=1e-9)


def test_river_swim_of_large_rewards():
    assert best_rate(river_swim("strehl_littman")) == pytest.approx(2229.357798, rel=1e-8)


@pytest.mark.parametrize(
    ("settings", "threshold", "rate"),
    [((0.6, 0.9, 10, 1), 4, 2.8688783570), ((0.8, 1.0, 5, 1), 2, 1.1657559199), ((0.5, 0.5, 5, 1), 1, 0.75)],
)
def test_admission_is_a_threshold(settings, threshold, rate):
    """The queue with at most T customers has the stationary distribution (lambda / mu)^n."""
    arrives, serves, payment, cost = settings

    def per_step(most):
        weight = (arrives / serves) ** np.arange(most + 1)
        weight /= weight.sum()
        per_time = arrives * payment * (1 - weight[-1]) - cost * (np.arange(most + 1) @ weight)
        return per_time / (arrives + serves)

    by_threshold = [per_step(most) for most in range(21)]
    assert int(np.argmax(by_threshold)) == threshold
    assert by_threshold[threshold] == pytest.approx(rate, abs=1e-10)
    mdp = admission(*settings)
    assert best_rate(mdp) == pytest.approx(rate, abs=2e-7)
    assert improved(mdp)[1][: threshold + 1].tolist() == [1] * threshold + [0]


def test_machine_replacement():
    """Replacing at wear k costs its cycle over the cycle's length."""
    costs = np.array([0.0, 2, 4, 7, 12])
    by_wear = [-(10 + costs[:k].sum() / 0.3) / (1 + k / 0.3) for k in range(1, 5)]
    rate, policy = improved(machine_replacement())
    assert rate == pytest.approx(max(by_wear), abs=1e-12) == pytest.approx(-50 / 23, abs=1e-12)
    assert policy.argmax() == 1 + int(np.argmax(by_wear)) == 2


@pytest.mark.slow
@pytest.mark.parametrize(
    ("settings", "rate"),
    [({}, 49.5703411692), ({"most_drawn": 10}, 49.5493757300), ({"extended": True}, 49.8786481385)],
)
def test_car_rental(settings, rate):
    assert improved(car_rental(**settings))[0] == pytest.approx(rate, abs=1e-9)


def test_access_control_accepts_who_pays_enough():
    policy = improved(access_control())[1].reshape(11, 4)
    assert policy[1:4].tolist() == [[0, 0, 1, 1]] * 3
    assert policy[4:].tolist() == [[0, 1, 1, 1]] * 7


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: access_control(rule="first"), "rule=first: must be accept_first or free_first"),
        (lambda: access_control(priorities=[]), "len(priorities)=0"),
        (lambda: access_control(free_probability=0), "free_probability=0"),
        (lambda: river_swim("hard"), "version=hard: must be osband or easy or strehl_littman"),
        (lambda: two_choice(1), "loop_length=1"),
        (lambda: inventory(demand=[0.5, 0.4]), "demand="),
        (lambda: inventory(price=np.nan), "price=nan"),
        (lambda: forest(1), "n_states=1"),
        (lambda: admission(arrival_rate=0), "arrival_rate=0"),
        (lambda: machine_replacement(costs=[]), "len(costs)=0"),
        (lambda: car_rental(extended=2), "extended=2"),
    ],
)
def test_arguments_are_checked(make, said):
    with pytest.raises(InputError) as caught:
        make()
    assert said in str(caught.value)


# -- the forms of other packages -----------------------------------------------------------------------------


def same(one, other):
    assert abs(one.transition - other.transition).max() < 1e-15
    assert np.array_equal(one.allowed, other.allowed)
    np.testing.assert_allclose(one.reward, other.reward, rtol=0, atol=1e-14)
    np.testing.assert_allclose(one.start, other.start, rtol=0, atol=1e-15)


def random_tables(seed, n_states=5, n_actions=3):
    """(p [S, A, S] with zeros, r(s, a, s') [S, A, S])"""
    rng = np.random.default_rng(seed)
    p = rng.random((n_states, n_actions, n_states)) * (rng.random((n_states, n_actions, n_states)) < 0.6)
    p[..., 0] += 0.1
    return p / p.sum(2, keepdims=True), rng.normal(size=p.shape)


@pytest.mark.parametrize("seed", range(5))
def test_one_matrix_an_action(seed):
    import scipy.sparse as sp

    p, r = random_tables(seed)
    mean = np.einsum("sat,sat->sa", p, r)
    expected = TabularMDP(p, mean)
    by_action = np.moveaxis(p, 1, 0)
    matrices = [sp.csr_matrix(one) for one in by_action]
    rewards = [sp.csr_matrix(one) for one in np.moveaxis(r, 1, 0)]
    same(TabularMDP(matrices, mean), expected)
    same(TabularMDP(p, r), expected)
    same(TabularMDP(matrices, r), expected)
    same(TabularMDP.from_pymdptoolbox(by_action, mean), expected)
    same(TabularMDP.from_pymdptoolbox(tuple(by_action), np.moveaxis(r, 1, 0)), expected)
    same(TabularMDP.from_pymdptoolbox(matrices, rewards), expected)
    objects = np.empty(len(matrices), object)
    objects[:] = matrices
    same(TabularMDP.from_pymdptoolbox(objects, mean), expected)
    same(TabularMDP.from_pymdptoolbox(by_action, mean[:, 0]), TabularMDP(p, np.repeat(mean[:, :1], 3, 1)))


def test_rewards_where_nothing_leads_are_not_looked_at():
    p, r = random_tables(7)
    r[p == 0] = -np.inf
    expected = TabularMDP(p, np.einsum("sat,sat->sa", p, np.where(p > 0, r, 0)))
    same(TabularMDP(p, r), expected)
    same(TabularMDP.from_pymdptoolbox(np.moveaxis(p, 1, 0), np.moveaxis(r, 1, 0)), expected)


def test_pairs_are_those_that_there_are():
    p, r = random_tables(3)
    have = np.random.default_rng(3).random((5, 3)) < 0.6
    have[:, 1] = True
    s, a = np.nonzero(have)
    mean = np.einsum("sat,sat->sa", p, r)
    expected = TabularMDP(p, np.where(have, mean, -np.inf))
    order = np.random.default_rng(4).permutation(len(s))
    same(TabularMDP.from_pairs(s[order], a[order], p[s, a][order], mean[s, a][order]), expected)

    class Product:
        R, Q = np.where(have, mean, -np.inf), p

    class Pairs:
        R, Q, s_indices, a_indices = mean[s, a], p[s, a], s, a

    same(TabularMDP.from_quantecon(Product()), expected)
    same(TabularMDP.from_quantecon(Pairs()), expected)


def test_rules_as_a_function():
    """A walk of which every number is known: two states, the second without its second action."""

    def outcomes(s, a):
        if s == 0:
            return [(0.5, 1, 4.0), (0.25, 0, 0.0), (0.25, 0, 2.0)] if a == 0 else [(1.0, 0, 1.0)]
        return [(1, 0, -1)] if a == 0 else []

    mdp = TabularMDP.from_outcomes(2, 2, outcomes, [1, 0])
    assert mdp.transition.toarray().tolist() == [[0.5, 0.5], [1, 0], [1, 0], [0, 0]]
    assert mdp.reward[mdp.allowed].tolist() == [2.5, 1.0, -1.0]
    assert mdp.allowed.tolist() == [[True, True], [True, False]]
    assert best_rate(mdp) == pytest.approx(4 / 3)  # (2.5 * 2 - 1) / 3: two steps in state 0 for each in state 1


@pytest.mark.parametrize(
    ("outcomes", "said"),
    [
        (lambda s, a: [(1.0, 2, 0.0)], "outcomes(0, 0): s'=2: must be a whole number in [0, 2)"),
        (lambda s, a: [(1.0, 0.5, 0.0)], "outcomes(0, 0): s'=0.5"),
        (lambda s, a: [(1.0, 0)], "outcomes(0, 0)=(1.0, 0): must be entries (probability, s', reward)"),
        (lambda s, a: [(0.5, 0, 0.0)], "transition row 0 (state 0, action 0)=sum 0.5"),
        (lambda s, a: [(-1.0, 0, 0.0)], "outcomes(0, 0): probability=-1.0"),
        (lambda s, a: [(1.0, 0, float("nan"))], "outcomes(0, 0): reward=nan"),
        (lambda s, a: [], "allowed[0]=no action"),
    ],
)
def test_rules_are_checked(outcomes, said):
    with pytest.raises(InputError) as caught:
        TabularMDP.from_outcomes(2, 2, outcomes)
    assert said in str(caught.value)


ROBOT = """# a comment
4 6 8
0 0 1 1 go
0 1 0 1/2 wait
0 1 2 0.5 wait
1 0 2 0.9 on
1 0 3 0.1 on
2 0 0 1 end
3 0 0 1 end
3 1 3 1 stay
"""


def test_files_of_prism(tmp_path):
    files = {
        "model.tra": ROBOT,
        "model.srew": "4 1\n2 1.5\n",
        "model.trew": "4 6 2\n1 0 3 -1\n0 1 2 2\n",
        "model.lab": '0="init" 1="deadlock"\n0: 0\n3: 0 1\n',
    }
    paths = [tmp_path / name for name in files]
    for path, text in zip(paths, files.values(), strict=True):
        path.write_text(text)
    p = np.zeros((4, 2, 4))
    p[0, 0, 1], p[0, 1, [0, 2]], p[1, 0, [2, 3]], p[2, 0, 0], p[3, 0, 0], p[3, 1, 3] = 1, 0.5, (0.9, 0.1), 1, 1, 1
    r = np.array([[0, 1.0], [-0.1, -np.inf], [1.5, -np.inf], [0, 0]])
    same(TabularMDP.from_prism(*paths), TabularMDP(p, r, [0.5, 0, 0, 0.5]))
    paths[0].write_text("2 3\n0 0 .5\n0 1 .5\n1 0 1\n")  # a chain
    paths[1].write_text("2 1\n1 3\n")
    same(TabularMDP.from_prism(*paths[:2]), TabularMDP([[[0.5, 0.5]], [[1, 0]]], [[0], [3]]))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "empty"),
        ("4 6 9\n" + ROBOT.split("\n", 2)[2], "8 transitions"),
        (ROBOT.replace("3 1 3 1 stay", "3 1 4 1 stay"), "a state below 4"),
        (ROBOT.replace("1/2", "1/0"), "a number"),
        (ROBOT.replace("0.5 wait", "0.4 wait"), "state 0, action 1"),
        (ROBOT.replace("2 0 0 1 end\n", "").replace("4 6 8", "4 5 7"), "allowed[2]=no action"),
        (ROBOT.replace("2 0 0 1 end", "2 -1 0 1"), "a whole number"),
    ],
)
def test_files_of_prism_are_checked(tmp_path, text, said):
    path = tmp_path / "model.tra"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        TabularMDP.from_prism(path)
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda p: TabularMDP.from_pairs([0, 0], [0, 0], p[0, :2], [1, 2]), "pairs that come once"),
        (lambda p: TabularMDP.from_pairs([0, 9], [0, 0], p[0, :2], [1, 2]), "states=9"),
        (lambda p: TabularMDP.from_pairs([0.5, 1], [0, 0], p[0, :2], [1, 2]), "whole numbers"),
        (lambda p: TabularMDP.from_quantecon(3), "quantecon's DiscreteDP"),
        (lambda p: TabularMDP.from_pymdptoolbox(p, np.zeros((5, 3))), "transition[0]"),
        (lambda p: TabularMDP.from_pymdptoolbox(np.moveaxis(p, 1, 0), np.zeros((5, 4))), "reward="),
    ],
)
def test_other_forms_are_checked(make, said):
    with pytest.raises(InputError) as caught:
        make(random_tables(0)[0])
    assert said in str(caught.value)


@pytest.mark.parametrize(
    ("srew", "trew", "said"),
    [
        ("4 2\n2 1.5\n", None, "first line=4 2: must be 4 1, for its model and its lines"),
        ("9 1\n2 1.5\n", None, "must be 4 1"),
        ("2 1.5\n1 6\n", None, "must be 4 1"),
        ("4 2\n2 1.5\n2 3\n", None, "a state that comes once"),
        ("4 1\n2\n", None, "line 2=2: must be STATE NUMBER"),
        (None, "4 6 2\n1 0 3 -1\n", "must be 4 6 1"),
        (None, "4 6 1\n1 0 1 -1\n", "of a transition that the model has"),
        (None, "4 6 2\n1 0 3 -1\n1 0 3 2\n", "a transition that comes once"),
    ],
)
def test_rewards_of_prism_are_those_of_the_model(tmp_path, srew, trew, said):
    paths = [tmp_path / name for name in ("m.tra", "m.srew", "m.trew")]
    for path, text in zip(paths, (ROBOT, srew, trew), strict=True):
        path.write_text(text or "")
    with pytest.raises(InputError) as caught:
        TabularMDP.from_prism(paths[0], srew and paths[1], trew and paths[2])
    assert said in str(caught.value)


@pytest.mark.parametrize(
    "make",
    [
        lambda: TabularMDP.from_outcomes(2, 2, None),
        lambda: TabularMDP.from_outcomes(2, 2, lambda s, a: 3),  # type: ignore[return-value]
        lambda: TabularMDP.from_outcomes(10**6, 10**6, lambda s, a: []),
        lambda: TabularMDP.from_pairs([0, 1], [0, 2 * 10**9], np.eye(2), [1, 2]),
        lambda: TabularMDP.from_pairs([0, 1], np.array([0, 2**63], np.uint64), np.eye(2), [1, 2]),
        lambda: TabularMDP.from_prism(None),
    ],
)
def test_what_no_model_can_be_made_of_is_one_line(make):
    with pytest.raises(InputError):
        make()


def test_a_pair_of_no_reward_is_missing():
    mdp = TabularMDP.from_pairs([0, 0, 1], [0, 1, 0], np.eye(2)[[1, 0, 0]], [1.0, -np.inf, 2.0])
    assert mdp.allowed.tolist() == [[True, False], [True, False]]
    same(TabularMDP.from_outcomes(2, 1, lambda s, a: [(1.0, 1 - s, s + 1.0)] if a == 0 else None), TabularMDP(
        np.eye(2)[[1, 0]].reshape(2, 1, 2), [[1.0], [2.0]]
    ))  # fmt: skip
