"""The informative behaviour policy: its design against brute force, its effect, its bits, its complaints."""

import itertools

import numpy as np
import pytest
from helpers import composed, random_mdp

from erl_torch import InputError, collect, empirical_mdp, theta_uncertainty
from erl_torch.empirical import informative
from erl_torch.empirical.informative import collect_informative, informative_policy
from erl_torch.envs.windy_cliff import WindyCliffEnv
from erl_torch.evaluation import Judge
from erl_torch.run.training import train
from erl_torch.solvers.policy import induced_distribution


def left(mdp, estimate, policy, n_more):
    """Variance of theta's estimate after ``n_more`` tuples of ``policy``, to first order, by its definition."""
    weight = estimate.variance * estimate.visits
    share = induced_distribution(mdp, policy)[:, None] * policy
    return float((weight / np.maximum(estimate.visits + n_more * share, 1)).sum())


@pytest.mark.parametrize("seed", range(3))
def test_no_policy_of_a_grid_is_better(seed):
    """Of all policies on a grid none is much better; shares of time are those of the model, not quite the true ones."""
    rng = np.random.default_rng(seed)
    mdp = random_mdp(rng, 2, 2)
    model = empirical_mdp(collect(mdp, 20, 500, seed), 2, 2)
    estimate = theta_uncertainty(model, 2.0)
    policy = informative_policy(model, 2.0, 100_000, explore=0.0)
    grid = np.linspace(0, 1, 21)
    rows = [np.array([[x, 1 - x], [y, 1 - y]]) for x, y in itertools.product(grid, grid)]
    best = min(left(mdp, estimate, row, 100_000) for row in rows)
    assert left(mdp, estimate, policy, 100_000) <= 1.05 * best


def test_tuples_go_where_theta_is_uncertain():
    """The cliff: as many tuples give an interval several times narrower, around the same theta."""
    mdp, beta = WindyCliffEnv().mdp, 10.0
    widths = {}
    for name, data in (
        ("prior", collect(mdp, 100, 1000, 1)),
        ("informative", collect_informative(mdp, 100, 1000, beta, 1)),
    ):
        low, high = theta_uncertainty(empirical_mdp(data, 15, 4), beta).interval(0.99)
        assert low <= 1.0101363366 <= high
        widths[name] = high - low
    assert widths["informative"] < 0.5 * widths["prior"]


def test_same_seed_same_bits_and_the_first_round_is_the_priors():
    mdp = WindyCliffEnv().mdp
    one, two = (collect_informative(mdp, 20, 100, 10.0, 3, rounds=4) for _ in range(2))
    prior = collect(mdp, 5, 100, 3)
    for name in ("s", "a", "r", "s_next", "a_next"):
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name))
        np.testing.assert_array_equal(getattr(one, name)[:500], getattr(prior, name))
    assert len(one) == 2000


def test_missing_actions_are_never_taken():
    rng = np.random.default_rng(0)
    allowed = np.array([[True, False, True], [True, True, False], [False, True, True]])
    from erl_torch import TabularMDP

    p = rng.dirichlet(np.ones(3), (3, 3))
    mdp = TabularMDP(p, rng.normal(size=(3, 3)), allowed=allowed)
    data = collect_informative(mdp, 20, 50, 1.0, prior_policy=mdp.uniform_policy)
    assert allowed[data.s, data.a].all()
    assert allowed[data.s_next, data.a_next].all()


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"explore": 1.5}, "explore=1.5: must be a number in"),
        ({"rounds": 0}, "rounds=0: must be a whole number >= 1"),
        ({"n_episodes": 0}, "n_episodes=0: must be a whole number >= 1"),
    ],
)
def test_complaints(change, text):
    with pytest.raises(InputError, match=text):
        collect_informative(WindyCliffEnv().mdp, **{"n_episodes": 2, "episode_length": 5, "beta": 1.0} | change)


@pytest.mark.slow
def test_a_run_learns_from_it(tmp_path):
    """Off the prior: the learner must be one that lets any policy act. Its policy is near the optimum's worth."""
    few = ("experience=informative", "experience.n_episodes=40", "evaluation.pictures=false")
    result = train(composed("learner=s1_efficient", *few), tmp_path)
    mdp = WindyCliffEnv().mdp
    prior = Judge(mdp, np.full((15, 4), 0.25), 1000).objective(np.full((15, 4), 0.25), 10.0)
    assert prior < result["objective"] <= -1.0101363366
    assert result["objective"] > -1.0101363366 - 0.002


def test_one_stream_is_not_designed_for_several_problems(tmp_path):
    """Replicas of other beta would each need a stream of their own."""
    few = ("env=windy_cliff", "experience=informative", "learner=s1_efficient", "experience.n_episodes=5")
    for key in ("beta", "optimism"):
        with pytest.raises(InputError, match=rf"vary.{key}=.*one value, for which the stream is designed"):
            train(composed(*few, f"+vary.{key}=[0.5,1]"), tmp_path / key)


@pytest.mark.parametrize("rounds", [1, 2, 7])
def test_every_round_but_the_first_is_designed_for_the_problem_that_is_asked(monkeypatch, rounds):
    """... of its own beta and optimism, from the tuples so far."""
    asked = []
    real = informative_policy

    def noted(model, beta, n_more, *arguments, **more):
        asked.append((int(model.visits.sum()), beta, more["optimism"]))
        return real(model, beta, n_more, *arguments, **more)

    monkeypatch.setattr(informative, "informative_policy", noted)
    data = collect_informative(WindyCliffEnv().mdp, 14, 50, 3.0, optimism=-0.5, rounds=rounds)
    assert [one[1:] for one in asked] == [(3.0, -0.5)] * (rounds - 1)
    assert [one[0] for one in asked] == [len(data) * k // rounds for k in range(1, rounds)]


def test_the_design_is_of_its_own_optimism():
    """What narrows theta's interval at optimism 1 is another policy than what narrows it at 0."""
    model = empirical_mdp(collect(WindyCliffEnv().mdp, 20, 1000, 0), 15, 4)
    at = {o: informative_policy(model, 10.0, 10_000, optimism=o) for o in (0.0, 1.0)}
    assert np.abs(at[0.0] - at[1.0]).max() > 0.05
