"""Charges and bonuses at the ends of episodes: rules, models, steps, the smallest charge, runs."""

import re

import gymnasium as gym
import numpy as np
import pytest
from helpers import composed, random_mdp
from scipy.optimize import linprog

from erl_torch import (
    CertaintyEquivalence,
    InputError,
    TabularMDP,
    Transitions,
    evaluate_episodes,
    smallest_charge,
    solve_soft_bellman,
    tabular_mdp,
)
from erl_torch.envs.ends import EndReward
from erl_torch.mdp.ends import Failures, chance_of_pairs, failing_ends, with_end_reward
from erl_torch.mdp.from_gymnasium import model_ends
from erl_torch.run.training import train
from erl_torch.solvers.charge import failing_rate

pytestmark = pytest.mark.filterwarnings("ignore::erl_torch.MeanRewardWarning")

LAKE = gym.make("FrozenLake-v1")
HOLES, GOAL = [5, 7, 11, 12], 15


# -- rules ------------------------------------------------------------------------------------------------------------


def test_which_ends_fail_by_default():
    """At most 0, where some other end pays more."""
    reward = [0.0, 0.0, 1.0, -3.0, -3.0]
    over = [True, False, True, True, False]
    state = [5, 1, 15, 7, 7]
    assert failing_ends(reward, over, state, 16).tolist() == [True, False, False, True, False]
    assert failing_ends(reward, over, state, 16, "unpaid").tolist() == [True, False, False, True, False]
    assert failing_ends(reward, over, state, 16, "all").tolist() == [True, False, True, True, False]
    assert failing_ends(reward, over, state, 16, "none").tolist() == [False] * 5
    assert failing_ends(reward, over, state, 16, [15]).tolist() == [False, False, True, False, False]
    # Ends that all pay alike are no failures; the best of bad ends is none either.
    assert not failing_ends([-1.0, -1.0], [True, True], [0, 1], 2).any()
    assert failing_ends([-1.0, -5.0], [True, True], [0, 1], 2).tolist() == [False, True]
    assert failing_ends([-1.0, -5.0], [True, True], [0, 1], 2, "unpaid").tolist() == [True, True]
    assert not failing_ends([0.0, 1.0], [False, False], [0, 1], 2).any()


@pytest.mark.parametrize(
    ("ends", "going_on", "failed"),
    [
        ([-7, -8, -10], [-1, -3, -4], [True, True, True]),  # a breakdown that costs a little less is no success
        ([-7, -7], [-1, -3], [True, True]),
        ([-1, -5], [-1, -1, -1], [False, True]),  # a goal, and a pit, where each step costs 1
        ([-0.1, -5], [-0.1] * 30, [False, True]),  # a mean that rounds
        ([0, -5], [-1, -1], [False, True]),
        ([2, -5], [3, 3], [False, True]),  # what pays is a success
        ([-1, -1], [-1, -40], [False, False]),
    ],
)
def test_the_best_of_bad_ends_is_no_success(ends, going_on, failed):
    """In a log, and in a table: one state, whose actions end or go on."""
    reward = np.array(ends + going_on, float)
    over = np.arange(len(reward)) < len(ends)
    assert failing_ends(reward, over, np.zeros(len(reward), int), 1)[over].tolist() == failed
    env = Lottery(reward, over)
    assert model_ends(env).failed[0, over].tolist() == failed
    if any(failed):
        charged = EndReward(env, -1.0)
        for a, fails in enumerate(failed):
            charged.reset()
            assert charged.step(a)[1] == reward[a] - fails


class Lottery(gym.Env):
    """One state: action a pays reward[a], and ends the episode or not."""

    observation_space = gym.spaces.Discrete(1)
    model_holds = True

    def __init__(self, reward, over):
        self.action_space = gym.spaces.Discrete(len(reward))
        self.P = {0: {a: [(1.0, 0, float(r), bool(end))] for a, (r, end) in enumerate(zip(reward, over, strict=True))}}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return 0, {}

    def step(self, action):
        (_, s, r, end), = self.P[0][int(action)]  # fmt: skip
        return s, r, end, False, {}


@pytest.mark.parametrize(
    ("rule", "best", "text"),
    [
        ("default", None, "failures=default: must be unpaid, all, none, or a list of states"),
        ("losses", 0.0, "failures=losses: must be"),
        ([16], 0.0, r"failures=16: must be states in \[0, 16\)"),
        ([-1], 0.0, "failures=-1: must be a whole number >= 0"),
        ([0.5], 0.0, "failures=0.5: must be a whole number >= 0"),
    ],
)
def test_rules_that_cannot_be_used(rule, best, text):
    with pytest.raises(InputError, match=text):
        Failures.of(rule, best, 16)


def test_a_charge_goes_to_failures_and_a_bonus_to_the_others():
    reward, ended, failed = np.array([1.0, 2.0, 3.0]), [True, True, False], [True, False, False]
    assert with_end_reward(reward, ended, failed, -5).tolist() == [-4, 2, 3]
    assert with_end_reward(reward, ended, failed, 5).tolist() == [1, 7, 3]
    assert with_end_reward(reward, ended, failed, 0).tolist() == [1, 2, 3]
    for nobody, charge, text in (
        (np.zeros(3), -1.0, "no end is a failure"),
        (np.ones(3), 1.0, "every end is a failure"),
    ):
        with pytest.raises(InputError, match=text):
            with_end_reward(reward, np.ones(3), nobody, charge)
    with pytest.raises(InputError, match="no step ends an episode"):
        with_end_reward(reward, np.zeros(3), np.zeros(3), 1.0)


# -- models and steps -------------------------------------------------------------------------------------------------


def test_the_lake_by_hand():
    """A step goes where it is meant to, or to either side, 1/3 each. 14 is left of the goal, 6 between two holes."""
    ends = model_ends(LAKE)
    assert ends.ended[14].tolist() == pytest.approx([0, 1 / 3, 1 / 3, 1 / 3])
    assert not ends.failed[14].any()
    assert ends.failed[6].tolist() == pytest.approx([1 / 3, 2 / 3, 1 / 3, 2 / 3])
    plain, charged = tabular_mdp(LAKE), tabular_mdp(LAKE, end_reward=-3.0)
    assert np.allclose(charged.reward, plain.reward - 3 * ends.failed, rtol=0, atol=1e-15)
    assert (charged.transition != plain.transition).nnz == 0
    bonus = tabular_mdp(LAKE, end_reward=3.0)
    assert np.allclose(bonus.reward, plain.reward + 3 * (ends.ended - ends.failed), rtol=0, atol=1e-15)
    own = tabular_mdp(LAKE, end_reward=-3.0, failures=[15])
    met = np.setdiff1d(np.arange(16), [*HOLES, GOAL])  # the table has rows of the others too
    assert np.allclose(own.reward[met], (plain.reward - 3 * (ends.ended - ends.failed))[met], rtol=0, atol=1e-15)


@pytest.mark.parametrize(
    ("end_reward", "failures"), [(-2.0, "default"), (3.0, "default"), (-1.0, [5, 15]), (-1, "all")]
)
def test_steps_pay_what_the_model_does(end_reward, failures):
    """Each step of the wrapped environment against the table: its reward, given where it led."""
    env = EndReward(gym.make("FrozenLake-v1"), end_reward, failures)
    failing = {5, 15} if failures == [5, 15] else {*HOLES, GOAL} if failures == "all" else set(HOLES)
    env.action_space.seed(0)
    s, _ = env.reset(seed=0)
    seen = set()
    for _ in range(3000):
        s, r, terminated, truncated, info = env.step(env.action_space.sample())
        fails = s in failing
        more = end_reward if terminated and fails == (end_reward < 0) else 0.0
        assert r == float(s == GOAL) + more
        if terminated:
            assert info["failure"] == fails
            seen.add(int(s))
        if terminated or truncated:
            s, _ = env.reset()
    assert seen == {*HOLES, GOAL}


def test_steps_of_an_environment_that_does_not_tell():
    env = gym.make("CartPole-v1")
    env = gym.wrappers.TransformObservation(env, lambda x: np.int64(x[2] > 0), gym.spaces.Discrete(2))
    with pytest.raises(InputError, match="failures=default: must be unpaid, all, none"):
        EndReward(env, -1.0)
    assert EndReward(env, -1.0, "all").rule.failures.every
    for end_reward, rule in ((-1.0, "none"), (1.0, "all")):
        with pytest.raises(InputError, match=f"end_reward={end_reward}"):
            EndReward(env, end_reward, rule)


@pytest.mark.parametrize(
    ("env_id", "end_reward", "failures"),
    [("CliffWalking-v1", -5.0, "default"), ("CliffWalking-v1", 5.0, "unpaid"), ("FrozenLake-v1", -1.0, [0])],
)
def test_what_no_end_gets_is_refused_from_steps_as_of_the_model(env_id, end_reward, failures):
    said = []
    for make in (EndReward, lambda env, x, rule: tabular_mdp(env, end_reward=x, failures=rule)):
        with pytest.raises(InputError, match=f"end_reward={end_reward}: must be 0, or a") as error:
            make(gym.make(env_id), end_reward, failures)
        said.append(str(error.value))
    assert said[0] == said[1]


def test_ends_of_a_windy_lake():
    env = gym.make("erl_torch/WindyFrozenLake-v0", desc=["SHG"], cyclic=False)
    mdp = tabular_mdp(env, end_reward=-7.0)
    assert mdp.reward[:, 0].tolist() == [-1, -9, 0]
    assert tabular_mdp(env, end_reward=7.0).reward[:, 0].tolist() == [-1, -2, 7]
    with pytest.raises(InputError, match=r"end_reward=1\.0: must be 0: no step ends an episode"):
        tabular_mdp(gym.make("erl_torch/WindyCliff-v0"), end_reward=1.0)


@pytest.mark.parametrize(
    ("beta", "charge", "failing", "success"),
    [
        (20, 0, 0.1210263, 0.0058642),
        (100, 0, 0.0826295, 0.0152437),
        (1000, 0, 0.0488650, 0.0178970),
        (20, 1, 0.0108778, 0.0130429),
        (100, 1, 0.0036606, 0.0164108),
        (1000, 1, 0.0036232, 0.0169082),
    ],
)
def test_a_charge_on_the_lake(beta, charge, failing, success):
    ends = model_ends(LAKE)
    mdp = tabular_mdp(LAKE, end_reward=-charge)
    policy = solve_soft_bellman(mdp, beta).policy.numpy()
    assert failing_rate(mdp, policy, ends.failed) == pytest.approx(failing, abs=6e-8)
    assert failing_rate(mdp, policy, ends.ended - ends.failed) == pytest.approx(success, abs=6e-8)


@pytest.mark.parametrize(("beta_bonus", "steps"), [(10, 41.39045), (100, 13.00186), (1000, 13.0), (0, 767.09856)])
def test_a_bonus_on_the_cliff(beta_bonus, steps):
    """Every step pays alike, so that beta times the bonus alone counts."""
    env = gym.make("CliffWalking-v1")
    episode = tabular_mdp(env, "absorb")
    for beta in (1.0, 4.0):
        found = solve_soft_bellman(tabular_mdp(env, end_reward=beta_bonus / beta), beta)
        assert evaluate_episodes(episode, found.policy).steps.value == pytest.approx(steps, abs=6e-6)


# -- the smallest charge ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("beta", "target", "charge", "success"),
    [
        (20, 0.01, 1.075916083, 0.01295312),
        (100, 0.01, 0.210276227, 0.01710522),
        (1000, 0.01, 0.009483966, 0.01795067),
        (20, 0.001, 11.088247, 0.0046663),
        (100, 0.001, 5.950859, 0.0046667),
        (1000, 0.001, 4.795086, 0.0046667),
    ],
)
def test_smallest_charges_of_the_lake(beta, target, charge, success):
    ends = model_ends(LAKE)
    found = smallest_charge(tabular_mdp(LAKE), ends.failed, beta, target)
    assert found.charge == pytest.approx(charge, rel=1e-7)
    assert found.failing_rate == pytest.approx(target, rel=1e-6)
    assert found.failing_rate <= target
    policy = found.solution.policy.numpy()
    assert failing_rate(found.mdp, policy, ends.ended - ends.failed) == pytest.approx(success, abs=6e-8)


@pytest.mark.parametrize(("target", "charge"), [(0.005, 0.7350427350), (0.002, 14 / 3)])
def test_hard_charges_of_the_lake_in_the_limit(target, charge):
    """They are met as beta grows, at a rate of 1/beta."""
    ends = model_ends(LAKE)
    off = [abs(smallest_charge(tabular_mdp(LAKE), ends.failed, beta, target).charge - charge) for beta in (1e4, 1e5)]
    assert off[1] < 0.2 * off[0] < 0.02


def multiplier(mdp, failing, target):
    """Of "max r.x, balance, sum x = 1, F.x <= target" (scipy's HiGHS), and the least F.x."""
    n, n_actions = mdp.n_states, mdp.n_actions
    leave = np.repeat(np.eye(n), n_actions, 0)
    balance = (leave - mdp.transition.toarray()).T
    equal = np.vstack([balance, np.ones(n * n_actions)]), np.append(np.zeros(n), 1.0)
    least = linprog(failing.ravel(), A_eq=equal[0], b_eq=equal[1])
    best = linprog(-mdp.reward.ravel(), failing.reshape(1, -1), [target], *equal)
    return (None if best.status else -best.ineqlin.marginals[0]), least.fun


def test_smallest_charges_are_multipliers():
    rng = np.random.default_rng(5)
    for _ in range(8):
        mdp = random_mdp(rng, 4, 3)
        failing = rng.random((4, 3)) * (rng.random((4, 3)) < 0.6)
        _, least = multiplier(mdp, failing, 1.0)
        free = smallest_charge(mdp, failing, 1e4, 1 - 1e-9)
        assert free.charge == 0
        target = 0.6 * least + 0.4 * free.failing_rate
        if free.failing_rate < 1.05 * least + 1e-6:
            continue
        exact, _ = multiplier(mdp, failing, target)
        assert smallest_charge(mdp, failing, 1e5, target).charge == pytest.approx(exact, abs=2e-3, rel=2e-3)


def test_the_slow_multiplier_comes_to_the_same_charge():
    """c <- max(0, c + a_n (f(c) - target)): dual ascent, as it would be made from tuples."""
    rng = np.random.default_rng(6)
    mdp = random_mdp(rng, 4, 3)
    failing = rng.random((4, 3))
    beta = 5.0
    free = smallest_charge(mdp, failing, beta, 1 - 1e-9).failing_rate
    target = 0.9 * free
    charge = 0.0
    for n in range(400):
        charged = TabularMDP(mdp.transition, mdp.reward - charge * failing, mdp.start)
        policy = solve_soft_bellman(charged, beta).policy.numpy()
        charge = max(0.0, charge + 5.0 / (1 + n) ** 0.6 * (failing_rate(charged, policy, failing) - target))
    assert smallest_charge(mdp, failing, beta, target).charge == pytest.approx(charge, rel=1e-3)


def test_targets_that_no_policy_meets_are_said():
    rng = np.random.default_rng(7)
    mdp = random_mdp(rng, 4, 2)
    failing = 0.2 + 0.5 * rng.random((4, 2))
    _, least = multiplier(mdp, failing, 1.0)
    with pytest.raises(InputError, match="every policy fails at that rate") as error:
        smallest_charge(mdp, failing, 10.0, 0.99 * least)
    said = float(str(error.value).split("at least ")[1].split(":")[0])
    assert 0.998 * least < said <= least * (1 + 1e-6)
    assert smallest_charge(mdp, failing, 10.0, 1.02 * least).failing_rate <= 1.02 * least
    for target in (0.0, 1.0, -1.0):
        with pytest.raises(InputError, match="target="):
            smallest_charge(mdp, failing, 10.0, target)


def test_a_charge_scales_with_the_rewards_and_is_found_where_there_are_none():
    """c(k r, beta/k) = k c(r, beta), at r = 0 too."""
    rng = np.random.default_rng(9)
    mdp, failing = random_mdp(rng, 4, 3), rng.random((4, 3))
    for reward in (mdp.reward, np.zeros((4, 3))):
        one = TabularMDP(mdp.transition, reward, mdp.start)
        target = 0.8 * smallest_charge(one, failing, 2.0, 1 - 1e-9).failing_rate
        charge = smallest_charge(one, failing, 2.0, target).charge
        assert charge > 0
        larger = TabularMDP(mdp.transition, 50 * reward, mdp.start)
        assert smallest_charge(larger, failing, 2.0 / 50, target).charge == pytest.approx(50 * charge, rel=1e-6)


def test_charges_where_actions_are_missing():
    """A missing action, against a copy of another that shares its prior."""
    rng = np.random.default_rng(10)
    mdp, failing = random_mdp(rng, 3, 3), rng.random((3, 3))
    p = mdp.transition.toarray().reshape(3, 3, 3)
    copied, paid, fails, prior = p.copy(), mdp.reward.copy(), failing.copy(), np.full((3, 3), 1 / 3)
    copied[0, 2], paid[0, 2], fails[0, 2], prior[0] = p[0, 0], paid[0, 0], failing[0, 0], [0.25, 0.5, 0.25]
    reward = mdp.reward.copy()
    reward[0, 2] = -np.inf
    mdp, twin = TabularMDP(p, reward, mdp.start), TabularMDP(copied, paid, mdp.start)
    failing[0, 2] = 0.0
    free = smallest_charge(mdp, failing, 3.0, 1 - 1e-9)
    target = 0.9 * free.failing_rate
    charge = smallest_charge(mdp, failing, 3.0, target).charge
    assert charge > 0
    assert charge == pytest.approx(smallest_charge(twin, fails, 3.0, target, prior).charge, rel=1e-6)
    said = []
    for one, chance, own in ((mdp, failing, None), (twin, fails, prior)):
        with pytest.raises(InputError, match="every policy fails at that rate") as error:
            smallest_charge(one, chance, 3.0, 1e-3, own)
        said.append(float(str(error.value).split("at least ")[1].split(":")[0]))
    assert said[0] == pytest.approx(said[1], rel=2e-2)


def test_the_charge_of_a_log():
    """Counted from tuples, the chances near those of the model, and with them the charge."""
    rng = np.random.default_rng(8)
    ends, mdp = model_ends(LAKE), tabular_mdp(LAKE)
    s, a = rng.integers(0, 16, 200_000), rng.integers(0, 4, 200_000)
    failed = rng.random(200_000) < ends.failed[s, a]
    counted = chance_of_pairs(s, a, failed, 16, 4)
    assert np.abs(counted - ends.failed).max() < 5 * np.sqrt(0.25 / 2500)
    assert chance_of_pairs([0], [1], [True], 2, 2).tolist() == [[0, 1], [0, 0]]
    found = smallest_charge(mdp, counted, 20.0, 0.01).charge
    assert found == pytest.approx(1.0759, rel=0.1)


# -- runs -------------------------------------------------------------------------------------------------------------

FEW = ("experience.n_episodes=20", "evaluation.pictures=false", "evaluation.n_episodes=5")


def test_a_run_tells_the_success_rate(tmp_path, capsys):
    result = train(
        composed("env=frozen_lake", "learner=exact", "env.end_reward=-1", "learner.beta=100", *FEW), tmp_path
    )
    episode = tabular_mdp(LAKE, "absorb")
    policy = solve_soft_bellman(tabular_mdp(LAKE, end_reward=-1), 100).policy
    exact = evaluate_episodes(episode, policy, successes=np.arange(16) == GOAL, horizon=100)
    assert result["success_rate"] == pytest.approx(exact.success_rate.value, abs=1e-9)
    assert result["return"] == pytest.approx(exact.mean_return.value, abs=1e-9)  # without the charge
    assert "success rate" in capsys.readouterr().out


def test_a_run_finds_the_charge(tmp_path):
    result = train(
        composed(
            "env=frozen_lake", "learner=exact", "env.end_reward=auto", "env.end_target=0.01", "learner.beta=20", *FEW
        ),
        tmp_path,
    )
    assert any("end_reward=auto: -1.07591608" in text for text in result["notes"])


def test_a_run_from_steps_finds_the_charge_of_its_tuples(tmp_path):
    """The multiplier of the run's own counts: they fail as often as asked for at it, and more often with less."""
    few = ("env.use_model=false", "experience.n_episodes=3000", "evaluation.n_episodes=5", "evaluation.pictures=false")
    asked = (
        "env.end_reward=auto",
        "env.end_target=0.01",
        "learner.beta=20",
        "experience.save_to=" + str(tmp_path / "t.npz"),
    )
    result = train(composed("env=frozen_lake", "learner=certainty_equivalence", *few, *asked), tmp_path / "run")
    charge = -float(re.search(r"end_reward=auto: (\S+), by the counts", " ".join(result["notes"]))[1])
    stream = np.load(tmp_path / "t.npz")
    failed = stream["r"] < -charge / 2
    assert set(np.round(stream["r"][failed], 9)) == {round(-charge, 9)}

    def failing_rate(charge):
        reward = np.where(failed, -charge, stream["r"])
        data = Transitions(stream["s"], stream["a"], reward, stream["s_next"], stream["a_next"])
        policy = CertaintyEquivalence(20.0).fit(data, 16, 4).policy.numpy()
        p, f = np.zeros((16, 16)), np.zeros(16)
        visits = np.zeros((16, 4))
        np.add.at(visits, (data.s, data.a), 1)
        share = policy[data.s, data.a] / visits[data.s, data.a]
        np.add.at(p, (data.s, data.s_next), share)
        np.add.at(f, data.s, share * failed)
        met = visits.any(1)
        p = p[met][:, met]
        long_run = np.linalg.lstsq(np.vstack([p.T - np.eye(len(p)), np.ones(len(p))]), [0] * len(p) + [1], rcond=None)[
            0
        ]
        return long_run @ f[met]

    assert failing_rate(charge) == pytest.approx(0.01, rel=1e-4)
    assert failing_rate(0.99 * charge) > 0.01 * 1.001


def test_a_run_from_steps_learns_of_the_charge(tmp_path):
    """The stream's rewards, and theta of the data with them; the return is the environment's own."""
    few = (
        "env.use_model=false",
        "learner=certainty_equivalence",
        "experience.n_episodes=300",
        "evaluation.n_episodes=5",
    )
    result = train(composed("env=frozen_lake", "env.end_reward=-2", "evaluation.pictures=false", *few), tmp_path)
    exact = solve_soft_bellman(tabular_mdp(LAKE, end_reward=-2), 20).theta
    assert result["theta"] == pytest.approx(exact, abs=0.03)
    assert 0 <= result["return"] <= 1
    assert result["success_rate"] == result["return"]


@pytest.mark.parametrize(
    ("overrides", "text"),
    [
        (["env=frozen_lake", "env.end_reward=lots"], "env.end_reward=lots: must be a finite number"),
        (
            ["env=cliff_walking", "env.end_reward=-1"],
            "env.end_reward=-1.0: must be 0, or a bonus > 0: no end is a failure",
        ),
        (["env=cliff_walking", "env.end_reward=auto"], "env.end_reward=auto: must be a number: no end is a failure"),
        (["env=frozen_lake", "env.failures=[99]"], r"env.failures=99: must be states in \[0, 16\)"),
        (["env=windy_frozen_lake", "env.end_reward=-1"], "env.end_reward=-1.0: must be 0: no step ends an episode"),
        (
            ["env=frozen_lake", "env.end_reward=auto", "env.end_target=2"],
            "env.end_target=2: must be a number in",
        ),
        (
            ["env=cart_pole_v1", "env.end_reward=auto", "+vary.beta=[1,2]"],
            "env.end_reward=auto: must be a number, where there is no model",
        ),
    ],
)
def test_bad_keys_are_named(overrides, text, tmp_path):
    with pytest.raises(InputError, match=text):
        train(composed(*overrides, *FEW), tmp_path)


def test_a_preset_says_which_learner_it_wants(tmp_path):
    """As typed, CartPole-v1 was learnt worse than the prior, with no word of what to do."""
    few = ("experience.n_episodes=3", "experience.episode_length=20", "evaluation.n_episodes=1")
    wanted = "wants learner=s1_efficient"
    for learner, says in (("s1", True), ("s1_efficient", False)):
        short = ("learner.n_epochs=1", "learner.n_bias=1") if learner == "s1" else ()
        result = train(composed("env=cart_pole_v1", f"learner={learner}", *few, *short), tmp_path / learner)
        assert any(wanted in text for text in result["notes"]) == says


def test_an_end_reward_that_no_end_got_is_noted(tmp_path):
    """Learnt from steps, a charge of states in which nothing ends does nothing: a run says so."""
    few = ("env=cart_pole_v1", *FEW, "learner=certainty_equivalence")
    told = [train(composed(*few, f"env.failures={rule}"), tmp_path / rule)["notes"] for rule in ("[14]", "all")]
    assert any("no end of the stream got env.end_reward" in text for text in told[0])
    assert not any("no end of the stream" in text for text in told[1])
