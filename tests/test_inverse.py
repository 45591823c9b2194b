"""From behaviour to reward: derivatives of the solution against differences, and rewards found again."""

import re

import numpy as np
import pytest
import scipy.sparse as sp
import torch
from helpers import ROOT, maze
from mpmath import mp
from oracle import stationary

from erl_torch import (
    InputError,
    Note,
    Status,
    TabularMDP,
    Transitions,
    collect,
    empirical_mdp,
    fit_reward,
    soft_bellman,
    solve_soft_bellman,
)
from erl_torch.envs.windy_cliff import WindyCliffEnv
from erl_torch.inverse import derivatives
from erl_torch.solvers.policy import objective

CLIFF = WindyCliffEnv().mdp
OPTIMISM = [1.0, 0.5, 0.0, -1.0, -3.0]


def relative_value(p, r, prior, beta, optimism, rounds=20_000):
    """(V of mean 0, g) by relative value iteration from the equation, p [S, A, S] dense; half of the old V stays."""
    kappa, v = optimism * beta, np.zeros(len(r))
    for _ in range(rounds):
        certain = p @ v if kappa == 0 else np.log((p * np.exp(kappa * (v - v.max()))).sum(2)) / kappa + v.max()
        q = beta * (r + certain)
        top = np.where(prior > 0, q, -np.inf).max(1, keepdims=True)
        backed_up = (np.log((prior * np.exp(q - top)).sum(1)) + top[:, 0]) / beta
        step = backed_up - v
        if np.ptp(step) < 1e-14:
            break
        v = v + 0.5 * (step - step.mean())
    return v - v.mean(), step.mean()


def tensors(*tables):
    return tuple(torch.tensor(np.asarray(table, float), requires_grad=True) for table in tables)


def random_problem(seed, n_states=4, n_actions=3):
    """(reward, transition [S, A, S] of full support, prior)."""
    rng = np.random.default_rng(seed)
    p = 0.9 * rng.dirichlet(np.full(n_states, 0.7), size=(n_states, n_actions)) + 0.1 / n_states
    return rng.normal(size=(n_states, n_actions)), p, rng.dirichlet(np.full(n_actions, 3.0), size=n_states)


# -- the solution as a function ---------------------------------------------------------------------------------


@pytest.mark.parametrize("optimism", OPTIMISM)
def test_function_solves_the_equation(optimism):
    r, p, prior = random_problem(1)
    x, y, z = tensors(r, p, prior)
    theta, value, log_policy = soft_bellman(x, y, z, 2.0, optimism=optimism)
    v, g = relative_value(p, r, prior, 2.0, optimism)
    assert theta.item() == pytest.approx(-g, abs=1e-12)
    assert value.detach().numpy() == pytest.approx(v, abs=1e-11)
    assert log_policy.exp().sum(1).detach().numpy() == pytest.approx(np.ones(4), abs=1e-13)


@pytest.mark.parametrize(("optimism", "reference"), [*((x, None) for x in OPTIMISM), (0.5, 1)])
def test_gradients_of_dense_problems(optimism, reference):
    r, p, prior = random_problem(2, 3, 2)
    inputs = *tensors(r, p, prior), torch.tensor(2.0, dtype=torch.float64, requires_grad=True)

    def solve(r, p, prior, beta):
        return soft_bellman(r, p, prior, beta, reference=reference, optimism=optimism)

    assert torch.autograd.gradcheck(solve, inputs, atol=1e-7, rtol=1e-5)


@pytest.mark.parametrize("optimism", OPTIMISM)
def test_gradients_of_sparse_problems_with_missing_actions(optimism):
    """A ring: two successors a pair; two pairs have prior 0, one of them without a row."""
    rng = np.random.default_rng(3)
    n, prior = 5, rng.dirichlet([2.0, 2.0, 2.0], size=5)
    p = np.zeros((n, 3, n))
    for s in range(n):
        for a in range(3):
            p[s, a, [(s + a) % n, (s + 3) % n]] = rng.dirichlet([2.0, 2.0])
    p[1, 2] = 0.0
    kept = np.ones((n, 3), bool)
    kept[1, 2] = kept[3, 0] = False
    pattern = sp.csr_array(p.reshape(3 * n, n))
    logits = np.log(prior)

    def solve(r, values, logits, beta):
        weights = torch.where(torch.from_numpy(kept), logits, -torch.inf).softmax(1)
        theta, value, log_policy = soft_bellman(r, values, weights, beta, pattern, optimism=optimism)
        return theta, value, log_policy[torch.from_numpy(kept)]

    inputs = *tensors(rng.normal(size=(n, 3)), pattern.data, logits), *tensors(1.5)
    assert torch.autograd.gradcheck(solve, inputs, atol=1e-7, rtol=1e-5, fast_mode=True)  # along random directions
    theta, value, log_policy = soft_bellman(inputs[0], inputs[1], torch.where(torch.from_numpy(kept), 0.5, 0.0).div(
        torch.from_numpy(kept.sum(1, keepdims=True) * 0.5)), 1.5, pattern, optimism=optimism)  # fmt: skip
    assert (log_policy[~torch.from_numpy(kept)] == -torch.inf).all()
    (theta + value @ value + log_policy[torch.from_numpy(kept)].sum()).backward()
    assert (inputs[0].grad[~torch.from_numpy(kept)] == 0).all()
    assert (inputs[1].grad.numpy()[np.isin(np.repeat(np.arange(15), np.diff(pattern.indptr)), [5, 9])] == 0).all()


@pytest.mark.parametrize("optimism", OPTIMISM)
def test_gradients_on_the_cliff(optimism):
    """Along random directions, tangent to the simplex where it is one, by differences of higher order."""
    rng, pattern = np.random.default_rng(4), CLIFF.transition
    width = np.diff(pattern.indptr)
    rows = np.repeat(np.arange(len(width)), width)
    weight = torch.from_numpy(rng.normal(size=(15, 4)))
    by_value = torch.from_numpy(rng.normal(size=15))
    direction = rng.normal(size=(15, 4)), pattern.data * rng.normal(size=pattern.nnz), rng.normal(size=(15, 4)) / 4
    direction[1][:] -= pattern.data * np.bincount(rows, direction[1])[rows]
    direction[2][:] -= direction[2].mean(1, keepdims=True)
    inputs = tensors(CLIFF.reward, pattern.data, np.full((15, 4), 0.25))

    def loss(r, values, prior):
        theta, value, log_policy = soft_bellman(r, values, prior, 5.0, pattern, 13, optimism=optimism)
        return theta + by_value @ value + (weight * log_policy).sum()

    loss(*inputs).backward()
    for i, along in enumerate(direction):
        exact = float((inputs[i].grad.numpy() * along).sum())

        def at(h, i=i, along=along):
            moved = [x.detach() for x in inputs]
            moved[i] = moved[i] + h * torch.from_numpy(along)
            return loss(*moved).item()

        difference = [(at(h) - at(-h)) / (2 * h) for h in (1e-4, 2e-4)]
        assert exact == pytest.approx((4 * difference[0] - difference[1]) / 3, rel=2e-6, abs=1e-6)


@pytest.mark.parametrize("optimism", OPTIMISM)
def test_rows_stand_for_the_rows_divided_by_their_sums(optimism):
    r, p, prior = tensors(*random_problem(5))
    theta, value, log_policy = soft_bellman(r, p, prior, 2.0, optimism=optimism)
    (theta + value[0] + log_policy[1, 2]).backward()
    assert (p * p.grad).sum(2).detach().numpy() == pytest.approx(np.zeros((4, 3)), abs=1e-12)
    assert (prior * prior.grad).sum(1).detach().numpy() == pytest.approx(np.zeros(4), abs=1e-12)


def many_digits_log_policy(p, r, optimism, v):
    """log pi*(0|0) by Newton steps in 50 digits, beta 1 and the uniform prior, from a value ``v`` that is near."""
    n, n_actions, kappa = len(r), len(r[0]), mp.mpf(optimism)
    pairs = [(s, a) for s in range(n) for a in range(n_actions)]
    for _ in range(30):
        mean = {(s, a): sum(p[s][a][t] * mp.exp(kappa * v[t]) for t in range(n)) for s, a in pairs}
        certain = {
            (s, a): mp.log(mean[s, a]) / kappa if kappa else sum(p[s][a][t] * v[t] for t in range(n)) for s, a in pairs
        }
        q = {(s, a): r[s][a] + certain[s, a] for s, a in pairs}
        backed_up = [mp.log(sum(mp.exp(q[s, a]) for a in range(n_actions)) / n_actions) for s in range(n)]
        system, right = mp.zeros(n + 1, n + 1), mp.zeros(n + 1, 1)
        for s, a in pairs:
            chosen = mp.exp(q[s, a] - backed_up[s]) / n_actions
            for t in range(n):
                system[s, t] -= chosen * p[s][a][t] * mp.exp(kappa * v[t]) / mean[s, a]
        for s in range(n):
            system[s, s] += 1
            system[s, n], right[s] = 1, backed_up[s] - v[s]
        system[n, 0] = 1
        step = mp.lu_solve(system, right)
        if max(abs(step[s]) for s in range(n)) < mp.mpf(10) ** -35:
            break
        v = [v[s] + step[s] for s in range(n)]
    return mp.log(mp.exp(q[0, 0] - backed_up[0]) / n_actions)


@pytest.mark.slow
@pytest.mark.parametrize("optimism", [0.0, 1.0, -1.0])
def test_gradients_of_nearly_closed_chains_against_many_digits(optimism):
    """Two pairs of states that are left with chance 1e-6."""
    rng, p = np.random.default_rng(0), np.zeros((4, 2, 4))
    for s in range(4):
        for a in range(2):
            own, other = ([0, 1], [2, 3]) if s < 2 else ([2, 3], [0, 1])
            p[s, a, own], p[s, a, other] = rng.dirichlet([1, 1]) * (1 - 1e-6), 5e-7
    reward, values = tensors(rng.normal(size=(4, 2)), p)
    _, value, log_policy = soft_bellman(reward, values, beta=1.0, optimism=optimism)
    log_policy[0, 0].backward()
    with mp.workdps(50):
        rows = [[[mp.mpf(x) / sum(map(mp.mpf, row)) for x in row] for row in rows] for rows in p.tolist()]
        near, h, found = [mp.mpf(x) for x in value.tolist()], mp.mpf(10) ** -15, np.zeros((4, 2))
        for s, a in np.ndindex(4, 2):
            ends = []
            for sign in (1, -1):
                moved = [[mp.mpf(x) for x in row] for row in reward.tolist()]
                moved[s][a] += sign * h
                ends.append(many_digits_log_policy(rows, moved, optimism, near))
            found[s, a] = float((ends[0] - ends[1]) / (2 * h))
    assert reward.grad.numpy() == pytest.approx(found, abs=1e-8 * np.abs(found).max())


def test_gradient_of_theta_is_the_share_of_time_and_needs_no_equation(monkeypatch):
    def refuse(*arguments):
        raise AssertionError("an equation is solved")

    monkeypatch.setattr(derivatives.Bordered, "transposed", refuse)
    mdp, known = maze(1)
    reward, values = tensors(mdp.reward, mdp.transition.data)
    theta, _, log_policy = soft_bellman(reward, values, beta=float(known["beta"]), pattern=mdp.transition)
    theta.backward()
    share = -reward.grad.numpy()
    assert share.sum() == pytest.approx(1.0, abs=1e-12)
    assert share.ravel() @ mdp.transition == pytest.approx(share.sum(1), abs=1e-12)  # what flows in flows out
    expected = share.sum(1, keepdims=True) * log_policy.exp().detach().numpy()
    assert share == pytest.approx(expected, abs=1e-14)


def test_gauge_does_not_matter_to_what_does_not_depend_on_it():
    found = []
    for reference in (None, 0, 3):
        reward, p, prior = tensors(*random_problem(6))
        _, value, log_policy = soft_bellman(reward, p, prior, 2.0, reference=reference)
        assert (value.mean() if reference is None else value[reference]).item() == pytest.approx(0.0, abs=1e-15)
        ((value[1] - value[2]) ** 2 + log_policy[0, 1]).backward()
        found.append(reward.grad.numpy())
    assert found[0] == pytest.approx(found[1], abs=1e-12)
    assert found[0] == pytest.approx(found[2], abs=1e-12)


def test_rewards_are_designed_by_gradients():
    """Which reward makes the policy spend its time as another one does? Descent on the share of time finds one."""
    rng = np.random.default_rng(7)
    p = torch.from_numpy(rng.dirichlet(np.ones(3), size=(3, 2)))
    reward = torch.zeros(3, 2, dtype=torch.float64, requires_grad=True)
    optimiser = torch.optim.LBFGS([reward], max_iter=40, line_search_fn="strong_wolfe", tolerance_change=0)

    def share(policy):
        chain = torch.einsum("sa,sat->st", policy, p)
        return torch.linalg.solve((torch.eye(3) - chain).T + 1.0, torch.ones(3, dtype=torch.float64))

    aim = share(torch.from_numpy(rng.dirichlet(np.ones(2), size=3)))

    def closure():
        optimiser.zero_grad()
        loss = ((share(soft_bellman(reward, p, beta=1.0).log_policy.exp()) - aim) ** 2).sum()
        loss.backward()
        return loss

    optimiser.step(closure)
    assert closure().item() < 1e-16


@pytest.mark.parametrize(
    ("change", "key"),
    [
        (dict(reward=torch.zeros(4, 3)), "reward"),
        (dict(reward=np.zeros((4, 3))), "reward"),
        (dict(transition=torch.ones(4, 3, 4, dtype=torch.float64)), "transition row 0 (state 0, action 0)"),
        (dict(transition=torch.ones(4, dtype=torch.float64), pattern=sp.csr_array((12, 3))), "pattern"),
        (dict(transition=torch.ones(4, dtype=torch.float64), pattern=sp.csr_array((12, 4))), "transition"),
        (dict(reference=4), "reference"),
        (dict(beta=0.0), "beta"),
        (dict(beta=torch.ones(1, dtype=torch.float64)), "beta"),
        (dict(optimism=np.nan), "optimism"),
        (dict(max_steps=1), "reward"),
    ],
)
def test_bad_arguments_of_the_function(change, key):
    r, p, prior = tensors(*random_problem(8))
    with pytest.raises(InputError) as error:
        soft_bellman(**{"reward": r, "transition": p, "prior_policy": prior, "beta": 2.0, "max_steps": 50} | change)
    assert error.value.key == key


@pytest.mark.parametrize(
    "value",
    [
        None,
        1.0,
        "r",
        [[0.0]],
        np.zeros((4, 3)),
        torch.tensor(0.0),
        torch.zeros(3),
        torch.zeros(4, 0),
        torch.zeros(4, 3),
    ],
)
@pytest.mark.parametrize("key", ["reward", "transition", "prior_policy"])
def test_what_is_no_tensor_of_the_right_shape_is_refused_by_name(key, value):
    """With the default prior too, which is made from the reward's shape; float32 is refused whatever the shape."""
    r, p, prior = tensors(*random_problem(8))
    tables = [value] if not isinstance(value, torch.Tensor) else [value, value.double()]
    good = {"reward": (4, 3), "transition": (4, 3, 4), "prior_policy": ()}[key]  # a prior of zeros has no sum
    for table in tables:
        if key == "prior_policy" and table is None:
            continue
        if isinstance(table, torch.Tensor) and table.dtype == torch.float64 and table.shape == good:
            continue
        given = {"reward": r, "transition": p, "beta": 2.0} | {key: table}
        for more in ({}, {"prior_policy": prior}):
            with pytest.raises(InputError) as error:
                soft_bellman(**(more | given))
            assert error.value.key.startswith(key)
            assert "\n" not in str(error.value)


@pytest.mark.parametrize("part", ["indices", "indptr"])
def test_a_pattern_that_is_no_matrix_is_refused(part):
    reward, p, _ = random_problem(8)
    pattern = sp.csr_array(p.reshape(12, 4))
    setattr(pattern, part, pattern.indices + 4 if part == "indices" else pattern.indptr[:-2])
    with pytest.raises(InputError, match=r"^pattern"):
        soft_bellman(torch.from_numpy(reward), torch.from_numpy(p.ravel()), beta=2.0, pattern=pattern)


def test_a_problem_without_a_solution_is_refused_by_its_status():
    stay = torch.eye(2, dtype=torch.float64)[:, None, :].expand(2, 2, 2)
    with pytest.raises(InputError, match="REDUCIBLE"):
        soft_bellman(torch.zeros(2, 2, dtype=torch.float64), stay, beta=1.0)


# -- rewards from behaviour -------------------------------------------------------------------------------------

BETA = 10.0
EXPERT = solve_soft_bellman(CLIFF, BETA).policy.numpy()
TILES = np.stack([CLIFF.reward[:, 0] == -5, CLIFF.reward[:, 0] == -1], 1).astype(float)  # trap, step; the goal pays 0


def lost(policy):
    """g* - J in the cliff."""
    return -solve_soft_bellman(CLIFF, BETA).theta - objective(CLIFF, policy, np.full((15, 4), 0.25), BETA)


def linear_problem(seed=0, n_states=6, n_actions=3, n_features=3):
    """(MDP without rewards, features [S, A, F], weights, a function weights -> policy by the test's own solver)."""
    rng = np.random.default_rng(seed)
    p = 0.95 * rng.dirichlet(np.full(n_states, 0.5), size=(n_states, n_actions)) + 0.05 / n_states
    features, start = rng.normal(size=(n_states, n_actions, n_features)), rng.dirichlet(np.ones(n_states))
    prior = np.full((n_states, n_actions), 1 / n_actions)

    def policy(w, beta=2.0, optimism=0.0):
        v, _ = relative_value(p, features @ w, prior, beta, optimism)
        kappa = optimism * beta
        certain = p @ v if kappa == 0 else np.log((p * np.exp(kappa * v)).sum(2)) / kappa
        weight = prior * np.exp(beta * (features @ w + certain))
        return weight / weight.sum(1, keepdims=True)

    return TabularMDP(p, np.zeros((n_states, n_actions)), start), features, rng.normal(size=n_features), policy


@pytest.mark.parametrize("features", [TILES, np.eye(15), None], ids=["tiles", "states", "table"])
def test_the_cliff_s_reward_from_its_exact_policy(features):
    fit = fit_reward(EXPERT, features, mdp=CLIFF, beta=BETA, exact=True)
    assert fit.converged
    assert fit.solution.status is Status.CONVERGED
    assert lost(fit.solution.policy.numpy()) < 1e-7
    assert fit.gap < 1e-7
    assert fit.standard_error is None
    assert fit.n_steps == np.inf
    if features is TILES:
        assert fit.weights == pytest.approx([-5.0, -1.0], abs=1e-5)
        assert fit.reward == pytest.approx(CLIFF.reward, abs=1e-5)
        assert fit.message == ""


@pytest.mark.slow
def test_the_cliff_s_reward_from_ten_thousand_steps():
    for seed in range(3):
        data = collect(CLIFF, 1, 10_000, seed, EXPERT)
        for features in (TILES, np.eye(15), None):
            fit = fit_reward(data, features, mdp=CLIFF, beta=BETA)
            assert lost(fit.solution.policy.numpy()) < 2e-3
            assert "no demonstration meets" in fit.message  # the expert falls once in 500,000 steps
        assert fit_reward(data, TILES, mdp=CLIFF, beta=BETA, names=["trap", "step"]).unmet == (0,)


@pytest.mark.parametrize("optimism", [0.0, 0.5, 1.0])
def test_weights_are_found_again(optimism):
    mdp, features, w, policy = linear_problem()
    fit = fit_reward(policy(w, optimism=optimism), features, mdp=mdp, beta=2.0, exact=True, optimism=optimism)
    assert fit.weights == pytest.approx(w, abs=1e-7)
    assert fit.gap == pytest.approx(0.0, abs=1e-12)
    assert fit.identified.all()
    assert fit.solution.optimism == optimism


def test_objective_is_concave_and_is_the_likelihood_of_the_flow():
    """l(w) = beta (<d_E, r_w> - g_w) by the own solver here: the fit is its maximum, and it is concave along lines."""
    mdp, features, _, policy = linear_problem(1)
    rng, prior = np.random.default_rng(1), np.full((6, 3), 1 / 3)
    p, expert = mdp.transition.toarray().reshape(6, 3, 6), rng.dirichlet(np.ones(3), size=6)  # no expert of any w
    share = stationary(np.einsum("sa,sat->st", expert, p))[:, None] * expert

    def likelihood(w):
        return (share * np.log(policy(w) / prior)).sum()

    def formula(w):
        return 2.0 * ((share * (features @ w)).sum() - relative_value(p, features @ w, prior, 2.0, 0.0)[1])

    fit = fit_reward(expert, features, mdp=mdp, beta=2.0, exact=True)
    assert fit.log_likelihood == pytest.approx(likelihood(fit.weights), abs=1e-12)
    for _ in range(10):
        a, b = rng.normal(size=(2, 3))
        assert formula(a) == pytest.approx(likelihood(a), abs=1e-12)
        assert formula(a) <= fit.log_likelihood
        assert formula((a + b) / 2) >= (formula(a) + formula(b)) / 2


def test_information_is_the_second_derivative():
    mdp, features, w, policy = linear_problem(2)
    p, prior = mdp.transition.toarray().reshape(6, 3, 6), np.full((6, 3), 1 / 3)
    fit = fit_reward(policy(w), features, mdp=mdp, beta=2.0, exact=True)
    h, axes = 1e-3, np.eye(3)

    def rate(w):
        return relative_value(p, features @ w, prior, 2.0, 0.0)[1]

    second = np.array([
        [(rate(w + h * (i + j)) - rate(w + h * (i - j)) - rate(w - h * (i - j)) + rate(w - h * (i + j))) / (4 * h * h)
         for j in axes] for i in axes
    ])  # fmt: skip
    assert fit.eigenvalues == pytest.approx(np.linalg.eigvalsh(2.0 * second), rel=1e-4)
    steps = 1e9  # of the stream of the expert's flow: the errors are those of the inverse information
    flow = stationary(np.einsum("sa,sat->st", policy(w), p))[:, None] * policy(w)
    counted = fit_reward(steps * flow, features, mdp=mdp, beta=2.0)
    expected = np.sqrt(np.diag(np.linalg.inv(2.0 * second * steps)))
    assert counted.standard_error == pytest.approx(expected, rel=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize(("episodes", "length"), [(1, 1000), (250, 4)])
def test_errors_are_those_that_are_said_also_where_demonstrations_restart(episodes, length):
    mdp, features, w, policy = linear_problem(3)
    found, said = [], []
    for seed in range(40):
        fit = fit_reward(collect(mdp, episodes, length, seed, policy(w)), features, mdp=mdp, beta=2.0)
        found.append(fit.weights - w)
        said.append(fit.standard_error)
    z = np.array(found) / np.array(said)
    assert np.abs(z.mean(0)).max() < 4 / np.sqrt(40)  # no bias
    assert z.std(0) == pytest.approx(np.ones(3), abs=4 / np.sqrt(80))


def test_a_table_tells_all_but_shaping():
    """Of S A rewards S directions are hidden: r = Phi(s) - E Phi(s') + c. The others' are found again."""
    mdp, features, w, policy = linear_problem(4)
    fit = fit_reward(policy(w), mdp=mdp, beta=2.0, exact=True)
    assert fit.unidentified.shape == (18, 6)
    assert not fit.identified.any()
    rows = np.repeat(np.eye(6), 3, axis=0)
    shaping = np.column_stack([rows - mdp.transition.toarray(), np.ones(18)])
    inside = fit.unidentified @ (fit.unidentified.T @ shaping)
    assert inside == pytest.approx(shaping, abs=1e-9)
    off = (fit.reward - features @ w).ravel()
    assert fit.unidentified @ (fit.unidentified.T @ off) == pytest.approx(off, abs=1e-6)
    assert fit.solution.policy.numpy() == pytest.approx(policy(w), abs=1e-8)
    assert "6 of 18 directions" in fit.message


def test_shaped_and_repeated_features_are_named():
    mdp, features, w, policy = linear_problem(5)
    potential = np.arange(6.0)
    hidden = potential[:, None] - (mdp.transition @ potential).reshape(6, 3) + 3.0
    more = np.concatenate([features, hidden[:, :, None], 2 * features[:, :, :1]], axis=2)
    fit = fit_reward(policy(w), more, mdp=mdp, beta=2.0, exact=True, names=["a", "b", "c", "shaped", "double"])
    assert fit.identified.tolist() == [False, True, True, False, False]
    assert fit.weights[1:3] == pytest.approx(w[1:], abs=1e-6)
    assert fit.weights[3] == pytest.approx(0.0, abs=1e-9)
    assert fit.weights[0] + 2 * fit.weights[4] == pytest.approx(w[0], abs=1e-6)
    assert "not told apart" in str(fit).splitlines()[3]


def test_scale_of_features_does_not_matter_to_what_is_told():
    mdp, features, w, policy = linear_problem(6)
    scale = np.array([1e-4, 1.0, 1e3])
    fit = fit_reward(policy(w), features * scale, mdp=mdp, beta=2.0, exact=True)
    assert fit.identified.all()
    assert fit.weights * scale == pytest.approx(w, abs=1e-6)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("optimism", [0.0, 1.0])
@pytest.mark.parametrize("scale", [[1e-90] * 3, [1e90] * 3, [1e8, 1.0, 1e-8], [1e90, 1e-90, 1.0]])
def test_weights_and_errors_are_in_the_units_of_features(scale, optimism):
    """Features times c: weights / c and errors / c, the same likelihood, policy and loss; nothing gets lost."""
    mdp, features, w, policy = linear_problem(6)
    counts = np.round(200 * policy(w, optimism=optimism))

    def fit(features):
        return fit_reward(counts, features, mdp=mdp, beta=2.0, optimism=optimism)

    one, other = fit(features), fit(features * np.array(scale))
    assert other.weights * scale == pytest.approx(one.weights, rel=1e-6)
    assert other.standard_error * scale == pytest.approx(one.standard_error, rel=1e-6)
    assert other.log_likelihood == pytest.approx(one.log_likelihood, abs=1e-12)
    assert other.gap == pytest.approx(one.gap, abs=1e-9)
    assert (one.identified & other.identified).all()
    assert one.message == other.message == ""


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("pseudo_count", [1e-100, 1e100])
def test_errors_are_numbers_at_the_ends_of_pseudo_count(pseudo_count):
    """One step alone; where the prior outweighs it, the fit is the prior, and its weights are 0."""
    mdp, features, _, _ = linear_problem(6)
    counts = np.zeros((6, 3))
    counts[2, 1] = 1.0
    fit = fit_reward(counts, features, mdp=mdp, beta=2.0, pseudo_count=pseudo_count)
    assert (fit.standard_error >= 0).all()
    assert (np.isfinite(fit.standard_error) | ~fit.identified).all()
    if pseudo_count > 1:
        assert fit.weights == pytest.approx(np.zeros(3), abs=1e-7)


def test_a_difference_that_rounding_hides_is_no_identified_weight():
    """Two features that differ by 1e-8: their information by 1e-16 of the sum's. Together they are one, told."""
    mdp, features, w, policy = linear_problem(6)
    twins = np.stack([features[:, :, 0], features[:, :, 0] + 1e-8 * features[:, :, 1], features[:, :, 2]], 2)
    fit = fit_reward(np.round(200 * policy(w)), twins, mdp=mdp, beta=2.0)
    assert fit.identified.tolist() == [False, False, True]
    assert np.isinf(fit.standard_error).tolist() == [True, True, False]
    assert "0, 1 is lost in rounding" in fit.message


@pytest.mark.parametrize("optimism", [0.0, 1.0])
def test_a_likelihood_without_a_maximum_is_said_to_have_none(optimism):
    """Every finite table leaves each action a chance, so that an expert who never takes one is only approached."""
    mdp = linear_problem(10)[0]
    expert = np.eye(3)[[0, 1, 2, 0, 1, 2]]
    fit = fit_reward(expert, mdp=mdp, beta=2.0, exact=True, optimism=optimism)
    assert not fit.converged
    assert "no maximum" in fit.message
    assert "penalty" in fit.message
    kept = fit_reward(expert, mdp=mdp, beta=2.0, exact=True, penalty=1e-3, optimism=optimism)
    assert kept.converged
    assert "maximum" not in kept.message
    counted = fit_reward(10 * expert, mdp=mdp, beta=2.0, optimism=optimism)  # the pseudo-counts keep them too
    assert "no maximum" not in counted.message


def test_a_single_feature_whose_weight_runs_away_is_named_so():
    """An action that is never taken, and a feature that marks it: the larger its cost, the likelier."""
    mdp, features, w, policy = linear_problem(6)
    expert = policy(w)
    expert[:, 2] = 0.0
    marks = np.zeros((6, 3, 1))
    marks[:, 2] = 1e3
    expert /= expert.sum(1, keepdims=True)
    fit = fit_reward(expert, np.concatenate([features, marks], 2), mdp=mdp, beta=2.0, exact=True)
    assert not fit.converged or "level" in fit.message
    assert "penalty" in fit.message
    assert fit.weights[3] * 1e3 < -5


def test_only_the_share_of_actions_in_a_state_enters():
    """Cut, shuffled, and visited as one likes: the same policy, the same weights; the errors differ."""
    mdp, features, w, policy = linear_problem(7)
    often = 1e6 * np.array([1, 2, 3, 4, 5, 6.0])[:, None] * policy(w)
    rare = 1e6 * np.array([6, 5, 4, 3, 2, 1.0])[:, None] * policy(w)
    fits = [fit_reward(counts, features, mdp=mdp, beta=2.0) for counts in (often, rare)]
    assert fits[0].weights == pytest.approx(fits[1].weights, abs=1e-5)
    assert not np.allclose(fits[0].standard_error, fits[1].standard_error, rtol=0.01)


def test_missing_actions_and_states_never_seen():
    """Pair (2, 1) does not exist; nobody was seen in state 5, where the prior stands for the expert."""
    mdp, features, w, _ = linear_problem(8)
    allowed = np.ones((6, 3), bool)
    allowed[2, 1] = False
    mdp = TabularMDP(mdp.transition, features @ w, mdp.start, allowed=allowed)
    expert = solve_soft_bellman(mdp, 2.0).policy.numpy()
    data = collect(mdp, 1, 3000, 0, expert)
    fit = fit_reward(data.where(data.s != 5), features, mdp=mdp, beta=2.0)
    assert np.isfinite(fit.weights).all()
    assert "in states without a step" in fit.message
    assert fit.solution.policy[2, 1] == 0
    whole = fit_reward(data, features, mdp=mdp, beta=2.0)
    assert np.abs((whole.weights - w) / whole.standard_error).max() < 4
    odd = Transitions(
        np.append(data.s, 2),
        np.append(data.a, 1),
        np.append(data.r, 0.0),
        np.append(data.s_next, 0),
        np.append(data.a_next, 0),
    )
    with pytest.warns(Note, match="1 of 3,001 tuples are left out"):
        again = fit_reward(odd, features, mdp=mdp, beta=2.0)
    assert again.weights == pytest.approx(whole.weights, abs=1e-12)
    assert fit_reward(expert, mdp=mdp, beta=2.0, exact=True).weights.shape == (17,)


def test_counts_in_the_place_of_a_model():
    mdp, features, w, policy = linear_problem(9)
    data = collect(mdp, 1, 200_000, 0, policy(w))
    fit = fit_reward(data, features, mdp=empirical_mdp(data, 6, 3), beta=2.0)
    assert fit.weights == pytest.approx(w, abs=0.05)
    known = fit_reward(data, features, mdp=mdp, beta=2.0)
    assert fit.weights == pytest.approx(known.weights, abs=0.05)


def test_penalty_keeps_weights_small():
    """An expert that always takes action 0: no finite reward makes that optimal."""
    mdp = linear_problem(10)[0]
    expert = np.repeat([[1.0, 0.0, 0.0]], 6, axis=0)
    fits = [fit_reward(expert, mdp=mdp, beta=2.0, exact=True, penalty=x) for x in (1e-2, 1e-4)]
    assert all(fit.converged for fit in fits)
    assert np.abs(fits[0].weights).max() < np.abs(fits[1].weights).max() < 100
    assert "weights grow without end" not in fits[1].message
    unbounded = fit_reward(expert, mdp=mdp, beta=2.0, exact=True)
    assert unbounded.converged or "weights grow without end" in unbounded.message


def test_a_feature_that_tells_nothing_has_an_infinite_error():
    mdp, features, w, policy = linear_problem(11)
    more = np.concatenate([features, np.ones((6, 3, 1)), np.zeros((6, 3, 1))], axis=2)
    fit = fit_reward(1e4 * policy(w), more, mdp=mdp, beta=2.0)
    assert fit.identified.tolist() == [True, True, True, False, False]
    assert np.isinf(fit.standard_error[3:]).all()
    assert fit.standard_error[:3] == pytest.approx(
        fit_reward(1e4 * policy(w), features, mdp=mdp, beta=2.0).standard_error, rel=1e-6
    )
    assert fit.unmet == (4,)


def test_a_policy_that_is_taken_for_counts_is_noted():
    mdp, features, w, policy = linear_problem(12)
    with pytest.warns(Note, match="exact=True"):
        fit_reward(policy(w), features, mdp=mdp, beta=2.0)


@pytest.mark.parametrize(
    ("change", "key"),
    [
        (dict(optimism=-0.1), "optimism"),
        (dict(optimism=np.inf), "optimism"),
        (dict(beta=-1.0), "beta"),
        (dict(penalty=-1.0), "penalty"),
        (dict(pseudo_count=0.0), "pseudo_count"),
        (dict(pseudo_count=1e-300), "pseudo_count"),
        (dict(pseudo_count=1e300), "pseudo_count"),
        (dict(penalty=1e300, features=np.full((6, 1), 1e-90)), "penalty"),
        (dict(features=np.full((6, 1), 1e200)), "features"),
        (dict(features=np.full((6, 1), 1e-200)), "features"),
        (dict(demonstrations=np.full((6, 3), 1e300)), "demonstrations[0, 0]"),
        (dict(features=np.zeros((6, 2, 3))), "features"),
        (dict(features=np.full((6, 1), np.nan)), "features[0, 0]"),
        (dict(names=["one"]), "names"),
        (dict(demonstrations=np.zeros((6, 3))), "demonstrations"),
        (dict(demonstrations=-np.ones((6, 3))), "demonstrations[0, 0]"),
        (dict(demonstrations=Transitions([7], [0], [0.0], [0], [0])), "s[0]"),
        (dict(demonstrations=Transitions([1], [0], [0.0], [0], [0]), exact=True), "exact"),
        (dict(mdp="cliff"), "mdp"),
        (dict(mdp=TabularMDP(np.eye(6)[:, None].repeat(3, 1), np.zeros((6, 3)))), "mdp"),
        (dict(tol=0.0), "tol"),
        (dict(max_iterations=0), "max_iterations"),
    ],
)
def test_bad_arguments_of_the_fit(change, key):
    mdp, features, _, _ = linear_problem()
    with pytest.raises(InputError) as error:
        fit_reward(**{"demonstrations": np.ones((6, 3)), "features": features, "mdp": mdp, "beta": 2.0} | change)
    assert error.value.key == key


def test_feature_matching_is_inconsistent_where_walks_restart():
    """The occupancy of episodes of 4 steps, exact: what matches its features is far from the truth; the balanced flow
    is not."""
    mdp, features, w, policy = linear_problem(3)
    p, expert = mdp.transition.toarray().reshape(6, 3, 6), policy(w)
    chain, occupancy, now = np.einsum("sa,sat->st", expert, p), np.zeros(6), mdp.start
    for _ in range(4):
        occupancy, now = occupancy + now / 4, now @ chain
    shares = occupancy[:, None] * expert
    assert fit_reward(shares, features, mdp=mdp, beta=2.0, exact=True).weights == pytest.approx(w, abs=1e-6)
    matched = stationary(chain)[:, None] * expert
    assert np.abs(((shares - matched)[:, :, None] * features).sum((0, 1))).max() > 0.02  # its gradient at the truth


def test_the_page_s_example_prints_what_the_page_says(capsys):
    page = (ROOT / "docs" / "inverse.md").read_text()
    names = {}
    for name in ("cliff", "function"):
        code, output = re.search(
            rf"<!-- example: {name} -->\n```python\n(.*?)```\n\n```text\n(.*?)```", page, re.S
        ).groups()
        exec(code, names)
        assert capsys.readouterr().out == output


@pytest.mark.parametrize("optimism", [0.0, 1.0, 2.0])
def test_gap_is_what_the_demonstrated_policy_loses(optimism):
    """g* - J(pi_E) by the limits of the test's own backups, for an expert that the feature does not explain."""
    rng, beta = np.random.default_rng(7), 2.0
    p, prior = rng.dirichlet(np.ones(3), (3, 2)), np.full((3, 2), 0.5)
    policy = rng.dirichlet(np.ones(2), 3)
    fit = fit_reward(
        policy,
        rng.normal(size=(3, 2, 1)),
        mdp=TabularMDP(p, np.zeros((3, 2))),
        beta=beta,
        optimism=optimism,
        exact=True,
    )

    def mean(value):
        kappa = optimism * beta
        return np.log(p @ np.exp(kappa * value)) / kappa if kappa else p @ value

    def rate(backup):
        value = np.zeros(3)
        for _ in range(4000):
            new = backup(fit.reward + mean(value))
            step, value = new - value, new - new[0]
        return step.mean()

    best = rate(lambda q: np.log((prior * np.exp(beta * q)).sum(1)) / beta)
    own = rate(lambda q: (policy * (q - np.log(policy / prior) / beta)).sum(1))
    assert fit.gap == pytest.approx(best - own, abs=1e-9)
    assert fit.gap > 1e-3


@pytest.mark.parametrize("optimism", [0.0, 1.0])
@pytest.mark.parametrize("kind", ["constant", "shaping", "both"])
def test_features_that_tell_nothing_identify_nothing(kind, optimism):
    """A constant, and Phi(s) - E Phi(s'): no behaviour depends on either, at optimism 0 (a constant at any)."""
    rng = np.random.default_rng(1)
    p = rng.dirichlet(np.ones(4), (4, 2))
    constant = np.ones((4, 2, 1))
    shaping = (np.arange(4.0)[:, None] - p @ np.arange(4.0))[:, :, None]
    features = {"constant": constant, "shaping": shaping, "both": np.concatenate([constant, shaping], 2)}[kind]
    if optimism and kind != "constant":
        pytest.skip("shaping changes what an optimist does")
    counts = rng.integers(1, 50, (4, 2))
    found = fit_reward(
        counts, features, mdp=TabularMDP(p, np.zeros((4, 2)), np.full(4, 0.25)), beta=3.0, optimism=optimism
    )
    assert not found.identified.any()
    assert found.unidentified.shape == (features.shape[2], features.shape[2])
    assert found.standard_error is None or np.isinf(found.standard_error).all()
    assert found.gap == 0 or not np.signbit(found.gap)


@pytest.mark.parametrize("scale", [(1.0, 1.0, 1.0, 1.0), (1.0, 100.0, 0.01, 5.0)])
def test_directions_that_are_not_told_are_kept_at_zero(scale):
    """A shaping feature and a repeated one, of sizes that differ: the weights have no part in what is not told."""
    mdp, features, w, policy = linear_problem(3)
    shaping = (np.arange(6.0)[:, None] - mdp.transition.toarray().reshape(6, 3, 6) @ np.arange(6.0))[:, :, None]
    table = np.concatenate([features[:, :, :2], shaping, features[:, :, :1]], axis=2) * np.array(scale)
    fit = fit_reward(1e4 * policy(w), table, mdp=mdp, beta=2.0)
    assert fit.unidentified.shape == (4, 2)
    assert np.abs(fit.unidentified.T @ fit.weights).max() < 1e-9 * np.abs(fit.weights).max()


def log_likelihood(mdp, features, beta, optimism, s, a, weight):
    """Mean of log pi_w(a|s) as a function of w."""

    def of(w):
        model = TabularMDP(mdp.transition, features @ w, mdp.start)
        policy = solve_soft_bellman(model, beta, optimism=optimism).policy.numpy()
        return float((weight * np.log(policy[s, a])).sum() / weight.sum())

    return of


def gradient(function, w, h=1e-5):
    return np.array([(function(w + h * e) - function(w - h * e)) / (2 * h) for e in np.eye(len(w))])


@pytest.mark.parametrize("penalty", [0.02, 0.3])
def test_penalty_is_of_the_log_likelihood_of_a_step(penalty):
    """At the maximum of L(w) - penalty |w|^2/2 its slope is 0, L by the exact solver, whatever the size of features."""
    mdp, features, w, policy = linear_problem(4)
    features = features * np.array([1.0, 3.0, 0.5])
    expert = policy(w)
    fit = fit_reward(expert, features, mdp=mdp, beta=2.0, exact=True, penalty=penalty)
    p = np.einsum("sa,sat->st", expert, mdp.transition.toarray().reshape(6, 3, 6))
    share = np.linalg.lstsq(np.vstack([p.T - np.eye(6), np.ones(6)]), np.r_[np.zeros(6), 1.0], rcond=None)[0]
    s, a = np.divmod(np.arange(18), 3)
    of = log_likelihood(mdp, features, 2.0, 0.0, s, a, (share[:, None] * expert).ravel())
    assert gradient(of, fit.weights) == pytest.approx(penalty * fit.weights, abs=1e-6)


def test_above_0_the_likelihood_of_the_steps_is_maximal():
    """Of walks that restart: every step counts once, and none is weighed by a flow."""
    mdp, features, w, _ = linear_problem(5)
    optimism, beta = 0.5, 2.0
    expert = solve_soft_bellman(
        TabularMDP(mdp.transition, features @ w, mdp.start), beta, optimism=optimism
    ).policy.numpy()
    rng = np.random.default_rng(0)
    p = mdp.transition.toarray().reshape(6, 3, 6)
    rows = []
    for _ in range(60):
        s = 0
        for _ in range(6):
            a = int(rng.choice(3, p=expert[s]))
            after = int(rng.choice(6, p=p[s, a]))
            rows.append((s, a, after))
            s = after
    s, a, after = map(np.array, zip(*rows, strict=True))
    data = Transitions(s, a, np.zeros(len(s)), after, a)
    fit = fit_reward(data, features, mdp=mdp, beta=beta, optimism=optimism, pseudo_count=1e-9)
    of = log_likelihood(mdp, features, beta, optimism, s, a, np.ones(len(s)))
    assert gradient(of, fit.weights) == pytest.approx(np.zeros(3), abs=1e-6)
