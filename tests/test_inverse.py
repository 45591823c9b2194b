"""From behaviour to reward: derivatives of the solution against differences, and rewards found again."""

import numpy as np
import pytest
import scipy.sparse as sp
import torch
from helpers import maze

from erl_torch import InputError, TabularMDP, soft_bellman
from erl_torch.envs.windy_cliff import WindyCliffEnv
from erl_torch.inverse import derivatives

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
    theta, value, log_policy = soft_bellman(*tensors(r, p, prior), 2.0, optimism=optimism)
    v, g = relative_value(p, r, prior, 2.0, optimism)
    assert theta.item() == pytest.approx(-g, abs=1e-12)
    assert value.detach().numpy() == pytest.approx(v, abs=1e-11)
    assert log_policy.exp().sum(1).detach().numpy() == pytest.approx(np.ones(4), abs=1e-13)


@pytest.mark.parametrize("reference", [None, 2])
@pytest.mark.parametrize("optimism", OPTIMISM)
def test_gradients_of_dense_problems(optimism, reference):
    r, p, prior = random_problem(2)
    inputs = *tensors(r, p, prior), torch.tensor(2.0, dtype=torch.float64, requires_grad=True)

    def solve(*x):
        return soft_bellman(*x, reference=reference, optimism=optimism)

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
    assert torch.autograd.gradcheck(solve, inputs, atol=1e-7, rtol=1e-5)
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

    def loss(*x):
        theta, value, log_policy = soft_bellman(*x, 5.0, pattern, 13, optimism=optimism)
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
    optimiser = torch.optim.LBFGS([reward], max_iter=100, line_search_fn="strong_wolfe", tolerance_change=0)

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


def test_a_problem_without_a_solution_is_refused_by_its_status():
    stay = torch.eye(2, dtype=torch.float64)[:, None, :].expand(2, 2, 2)
    with pytest.raises(InputError, match="REDUCIBLE"):
        soft_bellman(torch.zeros(2, 2, dtype=torch.float64), stay, beta=1.0)
