"""What the picture of the dial shows: variance of rewards against closed forms and moments, falls, exact lines."""

import numpy as np
import pytest
from helpers import composed, random_mdp, random_policy

from erl_torch import TabularMDP, solve_soft_bellman
from erl_torch.envs.windy_cliff import WindyCliffEnv
from erl_torch.files import read_npz
from erl_torch.run.dial import exact_line, world
from erl_torch.run.training import train
from erl_torch.solvers.policy import reward_variance


def two_states(a, b):
    """A chain that leaves state 0 with chance a, state 1 with chance b; reward 1 in state 1."""
    p = np.array([[[1 - a, a]], [[b, 1 - b]]])
    return TabularMDP(p, np.array([[0.0], [1.0]]))


@pytest.mark.parametrize(("a", "b"), [(0.3, 0.2), (0.9, 0.8), (1e-3, 2e-3), (0.5, 0.5)])
def test_variance_of_two_states(a, b):
    """d0 d1 (1 + r)/(1 - r) with the chain's second eigenvalue r = 1 - a - b."""
    d = b / (a + b) * a / (a + b)
    found = reward_variance(two_states(a, b), np.ones((2, 1)))
    assert found == pytest.approx(d * (2 - a - b) / (a + b), rel=1e-9)


def test_variance_is_the_growth_of_the_second_moment():
    """... of the sum of rewards, carried from step to step over all paths."""
    rng = np.random.default_rng(3)
    mdp, policy = random_mdp(rng, 4, 3), random_policy(rng, 4, 3)
    p = mdp.transition.toarray().reshape(4, 3, 4)
    # By state: chance, and first and second moment of the sum there.
    chance, first, second, variances = mdp.start.copy(), np.zeros(4), np.zeros(4), []
    for _ in range(400):
        weight, r = policy[:, :, None] * p, mdp.reward[:, :, None]

        def carried(table, weight=weight):
            return (table[:, None, None] * weight).sum((0, 1))

        one = (chance[:, None, None] * weight * r).sum((0, 1))
        two = ((2 * first[:, None, None] * r + chance[:, None, None] * r**2) * weight).sum((0, 1))
        chance, first, second = carried(chance), carried(first) + one, carried(second) + two
        variances.append(second.sum() - first.sum() ** 2)
    assert reward_variance(mdp, policy) == pytest.approx(variances[-1] - variances[-2], rel=1e-8)


def test_variance_of_one_closed_set_and_of_two():
    p = np.zeros((3, 1, 3))
    p[0, 0, 1:] = 0.5
    p[1, 0, 1] = p[2, 0, 2] = 1.0
    assert np.isnan(reward_variance(TabularMDP(p, np.zeros((3, 1)), np.array([1.0, 0, 0])), np.ones((3, 1))))
    assert reward_variance(TabularMDP(p, np.ones((3, 1)), np.array([0, 1.0, 0])), np.ones((3, 1))) == 0.0


def test_falls_of_the_cliff():
    """Counted in a long walk of the environment itself."""
    env = WindyCliffEnv()
    policy = solve_soft_bellman(env.mdp, 10.0, optimism=1.0).policy.numpy()
    found = world(env.mdp, policy, env.grid)
    rng, n = np.random.default_rng(0), 40_000
    draws, falls, total = rng.random(n), 0, 0.0
    state, _ = env.reset(seed=1)
    for draw in draws:
        falls += env.grid.tiles[state] == "H"
        state, reward, *_ = env.step(int(np.searchsorted(np.cumsum(policy[state])[:-1], draw)))
        total += reward
    assert found.falls == pytest.approx(falls / n, abs=4 * np.sqrt(found.falls / n))
    assert found.reward == pytest.approx(total / n, abs=4 * np.sqrt(found.variance / n))


def test_lines_are_exact_and_theta_never_rises():
    env = WindyCliffEnv()
    line = exact_line(env.mdp, 10.0, np.full((15, 4), 0.25), [-0.5, 1.0], env.grid)
    assert {-0.5, 0.0, 1.0} <= set(line.optimism)
    assert (np.diff(line.figures["theta"]) > 0).sum() == 0
    at = list(line.optimism)
    step = at[at.index(0.0) + 1]
    near = solve_soft_bellman(env.mdp, 10.0, optimism=1e-4).theta
    assert line.tangent[1] == pytest.approx((near - line.tangent[0]) / 1e-4, rel=1e-3)
    assert step > 0


@pytest.mark.slow
def test_replicas_whose_optimism_varies_draw_it(tmp_path):
    short = ("experience.n_episodes=3", "learner.n_epochs=1", "learner.n_bias=1", "evaluation.pictures=false")
    cfg = composed("n_replicas=2", "++vary.optimism=[1,0,-0.5]", *short)
    result = train(cfg, tmp_path)
    assert (tmp_path / "dial.png").read_bytes().startswith(b"\x89PNG")
    assert [group["optimism"] for group in result["groups"]] == [1, 0, -0.5]
    assert read_npz(tmp_path / "replicas.npz")["vary/optimism"].tolist() == [1, 1, 0, 0, -0.5, -0.5]
    # What is optimised over settings is what a policy is worth in the real world.
    worth = [group["objective_real"]["mean"] for group in result["groups"]]
    assert result["objective"] == max(worth)


def test_the_tangent_is_of_the_prior_that_is_given():
    """d theta/d optimism at 0, by differences, under a prior that is not uniform."""
    rng = np.random.default_rng(0)
    mdp, prior = random_mdp(rng, 4, 3), rng.dirichlet(np.ones(3), 4)
    line = exact_line(mdp, 2.0, prior, [-0.5, 0.5], None)
    h = 1e-4
    around = [solve_soft_bellman(mdp, 2.0, prior, optimism=o).theta for o in (-h, 0.0, h)]
    assert line.tangent == pytest.approx((around[1], (around[2] - around[0]) / (2 * h)), abs=1e-6)
