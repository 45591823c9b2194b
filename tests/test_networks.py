"""Networks: updates against autograd and exact fixed points, replay, live environments, bits."""

import math
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from scipy.special import logsumexp

from erl_torch import InputError, NonFiniteError, solve_soft_bellman
from erl_torch.envs.windy_cliff import WindyCliffEnv
from erl_torch.networks import autograd, kernels
from erl_torch.networks.episodes import Stage
from erl_torch.networks.export import export_policy
from erl_torch.networks.layout import mlp
from erl_torch.networks.learner import LIMIT, AverageSoftQ, DeepS1
from erl_torch.networks.live import Exploration, Live
from erl_torch.networks.policy import ActorPolicy, NetworkPolicy, Prior, load_policy
from erl_torch.networks.problem import BoxProblem
from erl_torch.networks.replay import COLUMNS, Replay, Steps
from erl_torch.networks.seeds import Seeds

KINDS = [AverageSoftQ, DeepS1]


class Noisy(gym.Env):
    """A walk on a line with noise; ends at its right, pays what it is."""

    def __init__(self, ends=True):
        self.observation_space = gym.spaces.Box(-9, 9, (2,), np.float32)
        self.action_space = gym.spaces.Discrete(3, start=-1)
        self.ends = ends

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x = self.np_random.normal(size=2) * 0.1
        return self.x.astype(np.float32), {}

    def step(self, action):
        assert action in (-1, 0, 1)
        self.x = self.x + np.array([0.3 * action, 0.0]) + 0.1 * self.np_random.normal(size=2)
        return self.x.astype(np.float32), float(-(self.x[0] ** 2)), bool(self.ends and self.x[0] > 1), False, {}


def problem(**settings):
    return BoxProblem(lambda: Noisy(), 2, 3, -1, time_limit=50, **settings)


def steps(n=300, n_actions=3, d=2, seed=0):
    rng = np.random.default_rng(seed)
    return Steps(
        rng.normal(size=(n, d)), rng.integers(n_actions, size=n), rng.normal(size=n), rng.normal(size=(n, d)),
        rng.random(n) < 0.1,
    )  # fmt: skip


SMALL = {"beta": 2.0, "batch": 16, "hidden": (12, 8), "n_steps": 3000, "epoch_steps": 400}


def same(one, other):
    for name in ("weights", "lagged", "m", "v"):
        assert torch.equal(getattr(one, name), getattr(other, name)), name
    assert np.array_equal(one.numbers, other.numbers)
    assert np.array_equal(one.random, other.random)
    for key, value in one.figures.items():
        assert np.array_equal(value, other.figures[key], equal_nan=True), key


# -- updates ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"optimism": 1.0},
        {"optimism": -0.5},
        {"support_penalty": 0.3},
        {"on_termination": "episodic"},
        {"reward_scale": 0.1},
    ],
)
def test_compiled_updates_are_those_of_autograd(kind, settings):
    """Weights, Adam's means, the lagged copy, g and the figures, after 20 updates."""
    compiled = kind(**SMALL, **settings, path="compiled")
    plain = replace(compiled, path="autograd")
    where = BoxProblem(lambda: Noisy(), 2, 3)
    one, other = (
        next(each.run(where, steps())) for each in (replace(compiled, n_steps=20), replace(plain, n_steps=20))
    )
    for name in ("weights", "lagged"):
        assert torch.allclose(getattr(one, name), getattr(other, name), atol=2e-6), name
    assert np.allclose(one.numbers, other.numbers, rtol=1e-4, atol=1e-6)
    assert np.array_equal(one.random, other.random)
    start = compiled.begin(where, steps())
    assert not torch.allclose(one.weights, start.weights, atol=1e-3)  # it has learnt


def test_the_slope_is_that_of_the_loss():
    """Central differences of the squared loss as it is written, in double precision."""
    layout = mlp(2, (5, 4), 3)
    rng = np.random.default_rng(1)
    w = torch.from_numpy(rng.normal(size=layout.size))
    x, k, y = torch.from_numpy(rng.normal(size=(6, 2))), rng.integers(3, size=6), torch.from_numpy(rng.normal(size=6))

    def loss(weights):
        hidden = x
        at = 0
        for i, (n, m) in enumerate([(2, 5), (5, 4), (4, 3)]):
            hidden = hidden @ weights[at : at + n * m].reshape(n, m) + weights[at + n * m : at + (n + 1) * m]
            hidden = hidden.clamp(min=0) if i < 2 else hidden
            at += (n + 1) * m
        return (0.5 * (hidden[torch.arange(6), k] - y) ** 2).mean()

    assert torch.allclose(
        layout.output(w, x)[torch.arange(6), k], layout.output(w, x).gather(1, torch.from_numpy(k)[:, None])[:, 0]
    )
    arrays = [np.zeros(layout.size, np.float32) for _ in range(2)]
    f = w.numpy().astype(np.float32)
    numbers, random = np.zeros(kernels.N_NUMBERS), np.array([3], np.uint64)
    chosen = autograd.drawn(random.copy(), 64, 6)
    before = f.copy()
    kernels.advance(
        f, f.copy(), *arrays, numbers, random, x.numpy().astype(np.float32), k.astype(np.int32),
        np.zeros(6, np.float32), np.zeros((6, 2), np.float32), np.zeros(6, bool), 6, 1, 5, 4, 64, False, 1.0, 0.0,
        np.log(np.full(3, 1 / 3)), 1e-3, 1e-3, 1, 1.0, 1e-9, 0.0, False, LIMIT,
    )  # fmt: skip
    after = layout.output(torch.from_numpy(before).double(), torch.zeros(1, 2).double())[0].numpy()
    target = float(logsumexp(after + np.log(1 / 3)))

    def whole(weights):
        q = layout.output(weights, x[chosen])[torch.arange(64), torch.from_numpy(k[chosen])]
        return (0.5 * (q - target) ** 2).mean()

    slope = np.array(
        [
            float(whole(w + 1e-5 * unit) - whole(w - 1e-5 * unit)) / 2e-5
            for unit in torch.eye(layout.size, dtype=torch.float64)
        ]
    )
    assert arrays[0] == pytest.approx(0.1 * slope, abs=3e-6)  # Adam's first mean
    assert arrays[1] == pytest.approx(1e-3 * slope**2, rel=1e-3, abs=1e-8)
    moved = np.abs(slope) > 1e-4
    assert (before - f)[moved] == pytest.approx(1e-3 * np.sign(slope[moved]), rel=1e-2)  # its first step
    assert float(loss(w)) > 0


@pytest.mark.parametrize("kind", KINDS)
def test_bits_do_not_depend_on_how_updates_are_cut(kind):
    where = BoxProblem(lambda: Noisy(), 2, 3)
    *_, whole = kind(**SMALL | {"epoch_steps": 3000}).run(where, steps())
    *_, cut = kind(**SMALL | {"epoch_steps": 7, "n_steps": 3000}).run(where, steps())
    for name in ("weights", "lagged", "m", "v"):
        assert torch.equal(getattr(whole, name), getattr(cut, name))


def test_minibatches_are_uniform_and_independent():
    drawn = autograd.drawn(np.array([12345], np.uint64), 200_000, 10)
    counts = np.bincount(drawn, minlength=10)
    assert ((counts - 20_000) ** 2 / 20_000).sum() < 40
    pairs = np.bincount(drawn[1:] * 10 + drawn[:-1], minlength=100)
    assert ((pairs - 2000) ** 2 / 2000).sum() < 180


def test_one_row_at_a_time_is_the_network():
    layout = mlp(3, (7, 5), 4)
    rng = np.random.default_rng(2)
    w, x = rng.normal(size=layout.size).astype(np.float32), rng.normal(size=(50, 3)).astype(np.float32)
    out = np.zeros((50, 4), np.float32)
    kernels.values(w, 7, 5, 4, x, out)
    assert out == pytest.approx(layout.output(torch.from_numpy(w), torch.from_numpy(x)).numpy(), rel=1e-4, abs=1e-5)


def test_actions_are_drawn_from_the_policy():
    layout = mlp(2, (6, 6), 3)
    w = np.random.default_rng(3).normal(size=layout.size).astype(np.float32)
    x = np.array([[0.3, -0.7]], np.float32)
    p = NetworkPolicy(layout, torch.from_numpy(w), 1.5)(x)[0]
    n = 20_000
    drawn = [kernels.act(w, 6, 6, np.log(np.full(3, 1 / 3)), 1.5, x, (i + 0.5) / n) for i in range(n)]
    assert np.bincount(drawn, minlength=3) / n == pytest.approx(p, abs=2 / n)


# -- fixed points ----------------------------------------------------------------------------------------------------


def cliff_steps(n, seed):
    """Tuples of the windy cliff with one-hot observations; half the actions uniform, half optimal."""
    mdp = WindyCliffEnv().mdp
    rng = np.random.default_rng(seed)
    best = solve_soft_bellman(mdp, 10.0).policy.numpy()
    p = mdp.transition.toarray().reshape(mdp.n_states, mdp.n_actions, mdp.n_states)
    s, rows = rng.choice(mdp.n_states, p=mdp.start), []
    for _ in range(n):
        policy = best[s] if rng.random() < 0.5 else np.full(mdp.n_actions, 1 / mdp.n_actions)
        a = rng.choice(mdp.n_actions, p=policy / policy.sum())
        after = rng.choice(mdp.n_states, p=p[s, a])
        rows.append((s, a, mdp.reward[s, a], after))
        s = after
    s, a, r, after = map(np.array, zip(*rows, strict=True))
    one = np.eye(mdp.n_states)
    return mdp, Steps(one[s], a, r, one[after], np.zeros(n, bool))


def table(mdp, learner, where, state):
    policy: Any = learner.policy(where, state)
    return policy(np.eye(mdp.n_states, dtype=np.float32))


def gap(mdp, learner, where, state):
    policy = table(mdp, learner, where, state)
    return worth(mdp, solve_soft_bellman(mdp, 10.0).policy.numpy()) - worth(mdp, policy)


def long_run(mdp, policy):
    p = np.einsum("sa,sat->st", policy, mdp.transition.toarray().reshape(mdp.n_states, mdp.n_actions, mdp.n_states))
    system = np.vstack([p.T - np.eye(len(p)), np.ones(len(p))])
    return np.linalg.lstsq(system, np.r_[np.zeros(len(p)), 1.0], rcond=None)[0]


def worth(mdp, policy, beta=10.0):
    share = long_run(mdp, policy)
    with np.errstate(divide="ignore", invalid="ignore"):
        kl = np.where(policy > 0, policy * np.log(policy * mdp.n_actions), 0.0).sum(1)
    return float(share @ ((policy * mdp.reward).sum(1) - kl / beta))


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_the_cliff_is_learnt_and_optimism_is_where_theory_puts_it(kind):
    """Squared loss: the optimum. Exponential loss: the policy of control as inference, which loses .371."""
    mdp, data = cliff_steps(20_000, 0)
    where = BoxProblem(lambda: Noisy(), mdp.n_states, mdp.n_actions)
    settings = {"beta": 10.0, "n_steps": 12_000, "epoch_steps": 12_000, "lr": 2e-3, "tau": 0.05}
    right = kind(**settings)
    *_, state = right.run(where, data)
    assert 0 <= gap(mdp, right, where, state) < 2e-3
    assert state.theta == pytest.approx(solve_soft_bellman(mdp, 10.0).theta, abs=0.03)
    if kind is AverageSoftQ:
        optimistic = kind(**settings, optimism=1.0)
        *_, state = optimistic.run(where, data)
        hopeful = solve_soft_bellman(mdp, 10.0, optimism=1.0).policy.numpy()
        best = solve_soft_bellman(mdp, 10.0).policy.numpy()
        assert worth(mdp, best) - worth(mdp, hopeful) == pytest.approx(0.371, abs=1e-3)
        policy = table(mdp, optimistic, where, state)
        assert divergence(mdp, hopeful, policy) < 0.02
        assert divergence(mdp, best, policy) > 0.3
        assert gap(mdp, optimistic, where, state) > 0.3


def divergence(mdp, policy, other):
    """KL(policy || other) a step, in the long run of ``policy``."""
    apart = (policy * np.log(np.maximum(policy, 1e-300) / other)).sum(1)
    return float(long_run(mdp, policy) @ apart)


def test_the_fixed_point_of_hubers_loss_is_not_the_optimum():
    """Why no error is clipped: the exact fixed point of smooth-L1 on the cliff loses .091."""
    mdp, beta = WindyCliffEnv().mdp, 10.0
    p = mdp.transition.toarray().reshape(mdp.n_states, mdp.n_actions, mdp.n_states)
    q = np.zeros((mdp.n_states, mdp.n_actions))

    def minimum(target):  # of E huber(beta (target - q)), threshold 1, by its derivative
        low, high = np.full(q.shape, target.min() - 1), np.full(q.shape, target.max() + 1)
        for _ in range(60):
            middle = (low + high) / 2
            slope = (p * np.clip(beta * (target - middle[..., None]), -1, 1)).sum(2)
            low, high = np.where(slope > 0, middle, low), np.where(slope > 0, high, middle)
        return (low + high) / 2

    for _ in range(600):
        v = logsumexp(beta * q, axis=1, b=1 / mdp.n_actions) / beta
        q = 0.5 * q + 0.5 * minimum(mdp.reward[..., None] + v - v[0])
    policy = np.exp(beta * q - logsumexp(beta * q, axis=1, keepdims=True))
    lost = worth(mdp, solve_soft_bellman(mdp, beta).policy.numpy()) - worth(mdp, policy)
    assert lost == pytest.approx(0.0910, abs=2e-4)


def test_one_power_step_is_relative_value_iteration():
    """V + (1/beta) log M_V 1 = TV, M_V written out: sum_a pi0 exp(beta (r + E V - V(s))) times E 1."""
    mdp, beta = WindyCliffEnv().mdp, 10.0
    p = mdp.transition.toarray().reshape(mdp.n_states, mdp.n_actions, mdp.n_states)
    v = np.random.default_rng(0).normal(size=mdp.n_states)
    q = mdp.reward + p @ v
    m = np.einsum("sa,sat->st", np.exp(beta * (q - v[:, None])) / mdp.n_actions, p)
    once = v + np.log(m @ np.ones(mdp.n_states)) / beta
    assert once == pytest.approx(logsumexp(beta * q, axis=1, b=1 / mdp.n_actions) / beta)
    solved = solve_soft_bellman(mdp, beta)
    again = solved.value.numpy()
    kept = mdp.reward + p @ again
    rate = logsumexp(beta * kept, axis=1, b=1 / mdp.n_actions) / beta - again
    assert rate == pytest.approx(-solved.theta)  # a fixed point, but for the rate


@pytest.mark.parametrize("kind", KINDS)
def test_a_shift_of_all_values_changes_neither_policy_nor_theta(kind):
    """V + c: the last biases of Q and V, in weights and lagged copy, and g, all by c."""
    where, learner = BoxProblem(lambda: Noisy(), 2, 3), kind(**SMALL | {"n_steps": 400, "lr": 1e-12})
    state = learner.begin(where, steps())
    q, v = learner.layouts(where)
    weights, lagged, numbers = state.weights.clone(), state.lagged.clone(), state.numbers.copy()
    for layout, vector in ((q, weights[: q.size]), (v, weights[q.size :]), (v or q, lagged)):
        if layout is not None:
            layout.layers(vector)[-1][1].add_(5.0)
    moved = replace(state, weights=weights, lagged=lagged, numbers=numbers)
    one, other = (next(learner.run(where, steps(), each)) for each in (state, moved))
    assert one.theta == pytest.approx(other.theta, abs=2e-5)
    x = np.random.default_rng(0).normal(size=(20, 2)).astype(np.float32)
    assert learner.policy(where, one)(x) == pytest.approx(learner.policy(where, other)(x), abs=1e-5)


# -- environments ----------------------------------------------------------------------------------------------------


def watched(**settings):
    """A problem whose environment notes what it is asked and answers."""
    told = []

    class Watched(Noisy):
        def reset(self, *, seed=None, options=None):
            found = super().reset(seed=seed)
            told.append(("reset", found[0]))
            return found

        def step(self, action):
            found = super().step(action)
            told.append(("step", action, *found[:3]))
            return found

    return BoxProblem(lambda: Watched(), 2, 3, -1, **settings), told


def test_what_is_stored_is_what_the_environment_did():
    """An end leads to where the next episode begins; a time limit stores the true next observation."""
    where, told = watched(end_reward=-7.0)
    learner = DeepS1(**SMALL | {"n_steps": 800, "epoch_steps": 130}, train_time_limit=20, explore_hold=3.0)
    *_, state = learner.run(where, Live(where, 4))
    now, at, length = told[0][1], 0, 0
    limits = ends = 0
    i = 1
    while at < 800:
        _, action, after, reward, terminated = told[i]
        i, length = i + 1, length + 1
        row = {name: getattr(state.replay, name)[at] for name in COLUMNS}
        assert np.array_equal(row["observation"], now)
        assert row["action"] == action + 1
        assert row["reward"] == pytest.approx(reward + (-7.0 if terminated else 0.0), rel=1e-6)
        assert row["ended"] == terminated
        over = terminated or length == 20
        if over:
            assert told[i][0] == "reset"
            now, i, length = told[i][1], i + 1, 0
            limits, ends = limits + (not terminated), ends + terminated
            assert np.array_equal(row["following"], now if terminated else after)
            assert not np.array_equal(after, now)
        else:
            now = after
            assert np.array_equal(row["following"], after)
        at += 1
    assert limits > 3
    assert ends > 3
    assert state.walk.n_steps == state.replay.n == 800


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("size", [None, 500])
def test_a_run_that_goes_on_has_the_same_bits(kind, size):
    """From any state, with another environment: it is brought to where it was; also with a ring of few tuples."""
    learner = kind(**SMALL, explore_hold=4.0, replay_size=size)
    whole = list(learner.run(problem(), Live(problem(), 5)))
    for i in (0, 3, 5):
        *_, last = learner.run(problem(), Live(problem(), 5), whole[i])
        same(whole[-1], last)
        assert all(np.array_equal(getattr(whole[-1].replay, name), getattr(last.replay, name)) for name in COLUMNS)


def test_states_are_values():
    """Nothing that comes later changes an earlier state, a ring of tuples among it."""
    learner = DeepS1(**SMALL, replay_size=500)
    kept = []
    for state in learner.run(problem(), Live(problem(), 5)):
        columns = {name: getattr(state.replay, name)[: state.replay.n].copy() for name in COLUMNS}
        kept.append((state, state.weights.clone(), columns))
    for state, weights, columns in kept:
        assert torch.equal(state.weights, weights)
        for name, column in columns.items():
            assert np.array_equal(getattr(state.replay, name)[: state.replay.n], column)


def test_a_ring_holds_the_newest_tuples():
    learner = AverageSoftQ(**SMALL, replay_size=500)
    *_, ring = learner.run(problem(), Live(problem(), 5))
    where, told = watched(time_limit=50)
    *_, again = learner.run(where, Live(where, 5))
    assert len(ring.replay.reward) == ring.replay.n == 500
    rewards = [row[3] for row in told if row[0] == "step"]
    assert len(rewards) == 3000
    in_order = np.roll(again.replay.reward, -again.replay.at)
    assert in_order == pytest.approx(rewards[-500:], rel=1e-6)
    assert np.array_equal(again.replay.reward, ring.replay.reward)


def test_an_environment_that_does_not_repeat_itself_is_named():
    class Forgetful(Noisy):
        def reset(self, *, seed=None, options=None):
            return super().reset(seed=None)

    where = BoxProblem(lambda: Forgetful(), 2, 3, -1, time_limit=50, name="forgetful")
    learner = AverageSoftQ(**SMALL)
    state = next(learner.run(where, Live(where, 0)))
    with pytest.raises(InputError, match="env=forgetful: must be one whose steps are a function of the seed"):
        next(learner.run(where, Live(where, 0), state))


@pytest.mark.parametrize("threads", [1, 3])
def test_seeds_have_the_bits_of_their_own_runs(threads):
    learner, seeds = DeepS1(**SMALL), (3, 4, 9)
    *_, together = Seeds(learner, seeds, threads).run(problem(), [Live(problem(), seed) for seed in seeds])
    for seed, one in zip(seeds, together.each, strict=True):
        *_, alone = learner.run(problem(), Live(problem(), seed))
        same(alone, one)
    assert together.metrics()["theta"].shape == (3,)
    assert len({float(one.theta) for one in together.each}) == 3


@pytest.mark.parametrize("hold", [1.0, 5.0])
def test_the_share_of_exploring_steps_is_the_one_asked_for(hold):
    """However long an exploratory action is held."""
    schedule = Exploration(0.3, 0.3, 1.0, hold)
    rng = np.random.default_rng(0)
    held = exploring = 0
    n = 200_000
    for step in range(n):
        if held:
            held, exploring = held - 1, exploring + 1
        elif rng.random() < schedule.begins(step, n):
            exploring, held = exploring + 1, int(rng.geometric(1 / hold)) - 1
    assert exploring / n == pytest.approx(0.3, abs=4 * np.sqrt(0.3 * hold * 2 / n))


def test_the_schedule_goes_down_on_a_line():
    schedule = Exploration(1.0, 0.1, 0.5, 1.0)
    assert [schedule.share(step, 1000) for step in (0, 250, 500, 900)] == pytest.approx([1.0, 0.55, 0.1, 0.1])


def test_episodes_begin_alike_for_every_policy():
    stage = Stage(problem(), 6, 30, 0)
    first, again = (stage.play(Prior(3), False) for _ in range(2))
    assert np.array_equal(first.returns, again.returns)
    assert first.kl == pytest.approx(0.0, abs=1e-12)

    class Right:
        def draw(self, observation, uniform):
            return np.full(len(observation), 2), np.full(len(observation), math.log(3))

    to_the_right = stage.play(Right(), False)
    assert to_the_right.kl == pytest.approx(math.log(3))
    assert to_the_right.ended.all()
    assert to_the_right.steps.max() < first.steps.max()
    rate = to_the_right.rate(-7.0)
    assert rate == pytest.approx((to_the_right.returns.sum() - 42.0) / to_the_right.steps.sum())
    stage.close()


# -- bad input -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"beta": 0}, "beta=0"),
        ({"hidden": ()}, r"hidden=\[\]"),
        ({"hidden": (0,)}, "hidden=0"),
        ({"tau": 0}, "tau=0"),
        ({"batch": 0}, "batch=0"),
        ({"replay_size": 3}, "replay_size=3"),
        ({"explore_end": 1.5}, "explore_end=1.5"),
        ({"explore_hold": 0.5}, "explore_hold=0.5"),
        ({"on_termination": "stop"}, "on_termination=stop"),
        ({"path": "compiled", "hidden": (4,)}, "path=compiled"),
        ({"support_penalty": -1}, "support_penalty=-1"),
        ({"train_time_limit": -1}, "train_time_limit=-1"),
    ],
)
def test_settings_are_checked(settings, said):
    with pytest.raises(InputError, match=said):
        DeepS1(**settings)


def test_numbers_that_are_none_are_named():
    class Broken(Noisy):
        def step(self, action):
            observation, _, *rest = super().step(action)
            return observation, math.nan, *rest

    where = BoxProblem(lambda: Broken(), 2, 3, -1, name="broken")
    with pytest.raises(InputError, match="reward of broken=nan"):
        next(AverageSoftQ(**SMALL).run(where, Live(where, 0)))


def test_weights_that_run_away_are_told():
    where = BoxProblem(lambda: Noisy(), 2, 3)
    huge = replace(steps(), reward=np.full(300, 3e38, np.float32))
    with pytest.raises(NonFiniteError, match="left the finite numbers"):
        list(AverageSoftQ(**SMALL).run(where, huge))


def test_a_policy_is_saved_and_read(tmp_path):
    layout = mlp(4, (9, 7), 2)
    policy = NetworkPolicy(layout, torch.from_numpy(layout.start(np.random.default_rng(0))), 3.25)
    path = policy.save(tmp_path / "policy.safetensors")
    x = np.random.default_rng(1).normal(size=(30, 4)).astype(np.float32)
    again: Any = load_policy(path)
    assert np.array_equal(again(x), policy(x))
    from safetensors.torch import load_file

    layers, hidden = load_file(path), torch.from_numpy(x)  # as a user reads it, without the package
    for i in range(3):
        hidden = torch.nn.functional.linear(hidden, layers[f"layer{i}.weight"], layers[f"layer{i}.bias"])
        hidden = torch.relu(hidden) if i < 2 else hidden
    assert torch.softmax(3.25 * hidden.double(), 1).numpy() == pytest.approx(policy(x), abs=1e-6)
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(InputError, match="a policy that erl_torch saved"):
        load_policy(path)


def test_replay_of_recorded_tuples_keeps_all():
    data = steps(40)
    replay = Replay.of(data)
    assert (replay.n, replay.capacity) == (40, 40)
    with pytest.raises(InputError, match="reward"):
        Steps(np.zeros((3, 2)), np.zeros(3, int), np.zeros(2), np.zeros((3, 2)), np.zeros(3, bool))


@pytest.mark.slow
def test_a_policy_leaves_as_a_program_of_torch(tmp_path):
    """Three lines without the package: for any number of observations."""
    rng = np.random.default_rng(0)
    layout = mlp(4, (9, 7), 2)
    discrete = NetworkPolicy(layout, torch.from_numpy(layout.start(rng)), 3.25)
    actor = ActorPolicy(layout, torch.from_numpy(layout.start(rng)), (-2.0,), (4.0,))
    for name, policy, expected in (("q", discrete, discrete), ("actor", actor, actor.best)):
        path = export_policy(policy, tmp_path / f"{name}.pt2")
        program = torch.export.load(path).module()
        for n in (1, 2, 30):
            x = rng.normal(size=(n, 4)).astype(np.float32)
            assert program(torch.from_numpy(x)).detach().numpy() == pytest.approx(expected(x), abs=1e-5)
