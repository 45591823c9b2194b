"""Classic control: batched dynamics, estimated models and rollouts, all against Gymnasium's env.step."""

import math
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from scipy import stats

import erl_torch
from erl_torch import InputError, collect_rollouts, estimate_mdp, rollout, solve_soft_bellman
from erl_torch.envs import CONTROL_ENTRY_POINTS, CONTROL_EPISODE_LENGTH, CONTROL_TASKS, estimate
from erl_torch.envs.control import control_task
from erl_torch.experience.rollouts import _Player

IDS = sorted(CONTROL_ENTRY_POINTS)
# The reward that the paper's model pays, of a step that Gymnasium made: (the original after it, its reward).
# MountainCar's flag stands where Gymnasium has it; CartPole's "sutton_barto" form pays -1 on failing, else 0.
INSTANT = {
    "pendulum": lambda env, reward: reward,
    "mountain_car": lambda env, reward: 0.0 if env.state[0] >= env.goal_position else reward,
    "cart_pole": lambda env, reward: reward + 1,
    "acrobot": lambda env, reward: reward,
}
INSTANT_FORM = {"cart_pole": {"sutton_barto_reward": True}}


@pytest.fixture(autouse=True)
def cache_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("ERL_TORCH_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


class Original:
    """Gymnasium's env.step from a state set by hand."""

    def __init__(self, task):
        self.task, self.env = task, gym.make(task.gymnasium_id).unwrapped
        self.paying = gym.make(task.gymnasium_id, **INSTANT_FORM.get(task.name, {})).unwrapped
        self.env.reset(seed=0)
        self.paying.reset(seed=0)

    def __call__(self, state, action):
        return self.stepped(self.env, state, action)

    def instant(self, state, action):
        """The reward of the paper's model."""
        _, reward, _ = self.stepped(self.paying, state, action)
        return INSTANT[self.task.name](self.paying, reward)

    def stepped(self, env, state, action):
        env.state = np.array(state)
        env.steps_beyond_terminated = None  # CartPole's own
        boxed = isinstance(env.action_space, gym.spaces.Box)
        _, reward, terminated, _, _ = env.step(np.array([self.task.actions[action]]) if boxed else action)
        return np.array(env.state, np.float64), reward, terminated


def cell_of(task, bins, state):
    """By np.digitize, angles wrapped where the task's are."""
    x = np.array(state)
    for i in {"pendulum": [0], "acrobot": [0, 1]}.get(task.name, []):
        x[i] = math.atan2(math.sin(x[i]), math.cos(x[i]))
    edges = [np.linspace(a, b, n + 1)[1:-1] for a, b, n in zip(bins.low, bins.high, bins.bins, strict=True)]
    return np.ravel_multi_index([np.digitize(v, e) for v, e in zip(x, edges, strict=True)], bins.bins, order="F")


@pytest.mark.slow
@pytest.mark.parametrize("name", CONTROL_TASKS)
def test_steps_are_gymnasiums(name):
    """10,000 states on and beyond the binned box."""
    task, rng, n = control_task(name), np.random.default_rng(1), 10_000
    original = Original(task)
    states = rng.uniform(np.array(task.low) * 1.25, np.array(task.high) * 1.25, (n, len(task.low)))
    actions = rng.integers(len(task.actions), size=n)
    batch = task.step(torch.from_numpy(states), torch.tensor(task.actions).double()[actions])
    after, reward, terminated = zip(*(original(*pair) for pair in zip(states, actions, strict=True)), strict=True)
    np.testing.assert_allclose(batch.state.numpy(), after, rtol=0, atol=1e-10)
    np.testing.assert_allclose(batch.reward.numpy(), reward, rtol=0, atol=1e-12)
    assert batch.terminated.tolist() == list(terminated)
    assert batch.state.dtype == batch.reward.dtype == torch.float64
    if name != "pendulum":
        assert 0 < sum(terminated) < n
    bins = task.uniform_bins()
    cells = bins.cells(task.variables(batch.state))
    assert cells.tolist() == [cell_of(task, bins, state) for state in after]
    expected = [original.instant(*pair) for pair in zip(states, actions, strict=True)]
    model_reward = task.instant_reward(torch.from_numpy(states), batch)
    np.testing.assert_allclose(model_reward.numpy(), expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", CONTROL_TASKS)
def test_first_states_are_gymnasiums(name):
    """Two-sample Kolmogorov-Smirnov on every coordinate, p > 1e-4; cells with the exact probabilities."""
    task = control_task(name)
    env: Any = gym.make(task.gymnasium_id).unwrapped
    theirs = []
    for seed in range(500):
        env.reset(seed=seed)
        theirs.append(env.state)
    ours = task.initial(4000, np.random.default_rng(0))
    for mine, other in zip(ours.numpy().T, np.array(theirs).T, strict=True):
        assert stats.ks_2samp(mine, other).pvalue > 1e-4
    bins = task.uniform_bins(8)
    p = bins.box_distribution(task.reset_low, task.reset_high)
    counts = np.bincount(bins.cells(task.variables(ours)).numpy(), minlength=bins.n_cells)
    assert counts[p == 0].sum() == 0
    if (p > 0).sum() > 1:
        assert stats.chisquare(counts[p > 0], p[p > 0] * 4000).pvalue > 1e-4


SMALL = {"pendulum": 6, "mountain_car": 6, "cart_pole": 4, "acrobot": 4}


@pytest.mark.parametrize("name", CONTROL_TASKS)
def test_model_against_fresh_steps(name):
    """Homogeneity of s' in random cells: counts of the estimate and of env.step come from one distribution."""
    task, rng, n, fresh = control_task(name), np.random.default_rng(3), 500, 300
    bins = task.uniform_bins(SMALL[name])
    model = estimate_mdp(task, SMALL[name], n_samples=n, seed=4)
    original, n_actions = Original(task), len(task.actions)
    statistic = freedom = 0
    for row in rng.choice(bins.n_cells * n_actions, 10, replace=False):
        cell, action = divmod(int(row), n_actions)
        place = np.array(np.unravel_index(cell, bins.bins, order="F"))
        width = np.subtract(bins.high, bins.low) / bins.bins
        counts, rewards = np.zeros((2, bins.n_cells)), []
        counts[0] = model.mdp.transition[[row]].toarray()[0] * n
        for state in bins.low + (place + rng.random((fresh, len(place)))) * width:
            after = original(state, action)[0]
            counts[1, cell_of(task, bins, after)] += 1
            rewards.append(original.instant(state, action))
        rare = counts.sum(0) < 20
        table = np.column_stack([counts[:, ~rare], counts[:, rare].sum(1)])
        table = table[:, table.sum(0) > 0]
        if table.shape[1] > 1:
            found = stats.chi2_contingency(table, correction=False)
            statistic, freedom = statistic + found.statistic, freedom + found.dof
        error = 5 * np.std(rewards) * math.sqrt(1 / n + 1 / fresh) + 0.03 * (np.std(rewards) == 0) + 1e-12
        assert abs(np.mean(rewards) - model.mdp.reward[cell, action] - model.reward_shift) < error
    assert stats.chi2.sf(statistic, freedom) > 1e-3


def equal(one, other):
    p, q = one.mdp.transition, other.mdp.transition
    pairs = [(p.indptr, q.indptr), (p.indices, q.indices), (p.data, q.data), (one.mdp.reward, other.mdp.reward)]
    return one.reward_shift == other.reward_shift and all(np.array_equal(a, b) for a, b in pairs)


@pytest.mark.slow
@pytest.mark.parametrize("name", CONTROL_TASKS)
def test_model_does_not_depend_on_the_workers(name):
    n_samples = 40_000 // SMALL[name] ** 2  # several chunks
    seen = []
    one = estimate_mdp(name, SMALL[name], n_samples=n_samples, workers=1, cache=False, report=seen.append)
    total = one.mdp.reward.size * n_samples
    assert seen == sorted(seen)
    assert seen[-1] == total > 3 * estimate.CHUNK
    for workers in (2, 5):
        assert equal(one, estimate_mdp(name, SMALL[name], n_samples=n_samples, workers=workers, cache=False))
    assert not equal(one, estimate_mdp(name, SMALL[name], n_samples=n_samples, seed=1, cache=False))


def test_rows_of_a_model_share_no_random_numbers(monkeypatch):
    """Where in its cell a sample lies, whatever chunk its row belongs to."""
    monkeypatch.setattr(estimate, "CHUNK", 100)
    task, seen = control_task("pendulum"), []

    def step(state, value):
        seen.append(state.numpy().reshape(-1, 10, 2))
        return task.step(state, value)

    estimate_mdp(replace(task, step=step), 6, n_samples=10, workers=1, cache=False)
    assert len(seen) == 11
    low, high = np.array(task.low), np.array(task.high)
    place = np.concatenate(seen) - low  # [rows, n, d]
    within = (place / ((high - low) / 6)) % 1
    assert len(np.unique(within.round(9).reshape(-1, 2), axis=0)) == 36 * len(task.actions) * 10


def test_model_of_other_settings():
    model = estimate_mdp("pendulum", [5, 3], [-1.0, -2.0], [1.0, 2.0], actions=[0.5], n_samples=50, start="uniform")
    assert model.mdp.reward.shape == (15, 1)
    assert model.mdp.reward.max() == 0
    assert np.array_equal(model.mdp.start, np.full(15, 1 / 15))
    counts = model.mdp.transition.data * 50
    np.testing.assert_allclose(counts, counts.round(), atol=1e-9)
    mid = 5 + 2  # the cell around upright, at rest
    cost = (0.2**2 / 3) + 0.1 * ((2 / 3) ** 2 / 3) + 0.001 * 0.25
    assert abs(model.mdp.reward[mid, 0] + model.reward_shift + cost) < 0.01


def test_cache(cache_folder, monkeypatch):
    settings = dict(task="mountain_car", bins=5, n_samples=20)
    made = estimate_mdp(**settings)
    (file,) = cache_folder.glob("mountain_car-*.npz")
    written = file.read_bytes()

    def refuse(*_):
        raise AssertionError("sampled again")

    with monkeypatch.context() as patch:
        patch.setattr(estimate._Job, "run", refuse)
        assert equal(made, estimate_mdp(**settings))
        assert estimate_mdp(**settings, start="uniform").mdp.start[0] == 1 / 25  # the start is no part of the key
        for other in (dict(bins=6), dict(n_samples=21), dict(seed=1), dict(low=[-1.2, -0.06]), dict(cache=False)):
            with pytest.raises(AssertionError, match="sampled again"):
                estimate_mdp(**settings | other)
    half = estimate_mdp(**settings | dict(seed=1))
    (foreign,) = set(cache_folder.glob("*.npz")) - {file}
    with np.load(file) as archive:
        arrays = dict(archive)
    short = {**arrays, "counts": arrays["counts"][:-1]}
    wrong = {**arrays, "indices": arrays["indices"] + 25}
    spoilt = {**arrays, "reward": arrays["reward"] * np.nan}
    damages = [written[:100], b"", written[:300] + b"\0\0\0\0" + written[304:], foreign.read_bytes()]
    for damage in [*damages, short, wrong, spoilt, {"key": arrays["key"]}]:
        if isinstance(damage, bytes):
            file.write_bytes(damage)
        else:
            np.savez(file, **damage)
        with pytest.warns(UserWarning, match="estimating mountain_car anew"):
            assert equal(made, estimate_mdp(**settings))
        assert file.read_bytes() == written
    assert not equal(made, half)


def test_a_cache_of_another_format_is_not_used(cache_folder, monkeypatch):
    """The format is in the file's name and in its key: even renamed, an old file is refused aloud."""
    settings = dict(task="mountain_car", bins=5, n_samples=20)
    with monkeypatch.context() as patch:
        patch.setattr(estimate, "FORMAT", estimate.FORMAT - 1)
        estimate_mdp(**settings)
    (old,) = cache_folder.glob("*.npz")
    made = estimate_mdp(**settings)
    (new,) = set(cache_folder.glob("*.npz")) - {old}
    old.rename(new)
    with pytest.warns(UserWarning, match="estimating mountain_car anew"):
        assert equal(made, estimate_mdp(**settings))


def test_works_without_a_cache_folder(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setenv("ERL_TORCH_CACHE", str(tmp_path / "file" / "cache"))
    with pytest.warns(UserWarning, match="is not kept on disk"):
        first = estimate_mdp("pendulum", 3, n_samples=5)
    assert equal(first, estimate_mdp("pendulum", 3, n_samples=5, cache=False))
    monkeypatch.delenv("ERL_TORCH_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert estimate.cache_folder() == tmp_path / "erl_torch"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "theta", "deviation", "seeds"),
    [("pendulum", 3.338, 0.095, 20), ("mountain_car", 0.0400, 0.0067, 20), ("cart_pole", 0.1660, 0.0017, 3)],
)
def test_theta_of_table_s2(name, theta, deviation, seeds):
    """The mean over seeds meets a mean measured independently, within three of its own standard errors.

    ``deviation`` is that from one sample of the model to another, measured likewise. CartPole's samples take seconds
    each: three of them, with the error of three.
    """
    task = control_task(name)
    found = []
    for seed in range(seeds):
        solution = solve_soft_bellman(estimate_mdp(task, seed=seed, start="uniform").mdp, task.beta)
        assert solution.status.name == "CONVERGED"
        found.append(solution.theta)
    assert abs(np.mean(found) - theta) < 3 * deviation / math.sqrt(seeds)
    # Of deviations as small or as large as ours, one in a thousand is.
    low, high = stats.chi2.ppf([5e-4, 1 - 5e-4], seeds - 1)
    assert low < (seeds - 1) * np.var(found, ddof=1) / deviation**2 < high


def some_policy(task, rng):
    """A deterministic policy [S, A]; the car's pumps, so that it arrives."""
    bins, n_actions = task.uniform_bins(), len(task.actions)
    acts = rng.integers(n_actions, size=bins.n_cells)
    if task.name == "mountain_car":
        acts = np.where(np.arange(bins.n_cells) // 12 >= 6, 2, 0)
    return np.eye(n_actions)[acts]


@pytest.mark.parametrize(
    ("name", "steps"), [("pendulum", 60), ("mountain_car", 200), ("cart_pole", 60), ("acrobot", 30)]
)
def test_deterministic_rollouts_are_gymnasiums_episodes(name, steps):
    """From the same first states; short, as the acrobot's rounding errors grow tenfold every ten steps."""
    task, n = control_task(name), 20
    policy = some_policy(task, np.random.default_rng(5))
    played = rollout(name, policy, n, steps, np.random.default_rng(6))
    env: Any = gym.make(next(i for i in IDS if CONTROL_TASKS[name] in i)).unwrapped
    first = task.initial(n, np.random.default_rng(6)).numpy()
    for i in range(n):
        cell, _ = env.reset(seed=0)
        env.env.unwrapped.state = first[i]
        cell = cell_of(task, env.bins, first[i])
        total = length = 0
        for _ in range(steps):
            cell, reward, terminated, truncated, _ = env.step(np.argmax(policy[cell]))
            assert not truncated
            assert cell == cell_of(task, env.bins, env.env.unwrapped.state)
            total, length = total + reward, length + 1
            if terminated:
                break
        assert played.lengths[i] == length
        assert abs(played.returns[i] - total) < 1e-6 * max(1, abs(total))
    if name in ("mountain_car", "cart_pole"):
        assert played.lengths.max() < steps or name == "cart_pole"
        assert played.lengths.min() < steps


@pytest.mark.parametrize("apart", [False, True])
def test_an_episode_does_not_depend_on_the_ends_of_others(apart):
    """Where no episode ends, each is the same up to where it would have ended."""
    task = control_task("cart_pole")

    def endless(state, value):
        step = task.step(state, value)
        return step._replace(terminated=torch.zeros_like(step.terminated))

    policy = np.tile([0.4, 0.6], (8**4, 1))
    prior = np.full((8**4, 2), 0.5) if apart else None
    ticks = []
    for played in (task, replace(task, step=endless)):
        player = _Player(played, None, None, "original")
        first = task.initial(40, np.random.default_rng(1))
        ticks.append(list(player.play(first, policy, prior, 40, np.random.default_rng(2))))
    assert len(ticks[0][-1].episode) < 30 < len(ticks[1][-1].episode)
    for one, other in zip(*ticks, strict=True):
        for name in ("s", "a", "s_next", "a_next"):
            assert np.array_equal(getattr(one, name), getattr(other, name)[one.episode])


def test_random_rollouts_have_gymnasiums_law():
    """Lengths of CartPole episodes under the uniform policy, against Gymnasium's own; p > 1e-3."""
    policy = np.full((8**4, 2), 0.5)
    ours = rollout("cart_pole", policy, 2000, 500, np.random.default_rng(0))
    assert np.array_equal(ours.returns, ours.lengths)
    cyclic = rollout("cart_pole", policy, 2000, 500, np.random.default_rng(0), reward="cyclic")
    assert (cyclic.returns == -1).all()
    env, rng, theirs = gym.make("CartPole-v1").unwrapped, np.random.default_rng(1), []
    for seed in range(400):
        env.reset(seed=seed)
        theirs.append(next(t for t in range(1, 1000) if env.step(rng.integers(2))[2]))
    assert stats.ks_2samp(ours.lengths, theirs).pvalue > 1e-3
    again = rollout("cart_pole", policy, 2000, 500, np.random.default_rng(0))
    assert np.array_equal(ours.returns, again.returns)
    cut = rollout("cart_pole", policy, 2000, 12, np.random.default_rng(0))
    assert np.array_equal(cut.lengths, np.minimum(ours.lengths, 12))


@pytest.mark.parametrize("on_prior", [True, False])
def test_collected_stream(on_prior):
    """Continuity, ends of episodes, and the laws of a and a'."""
    prior = np.tile([0.3, 0.7], (8**4, 1))
    behaviour = None if on_prior else np.tile([0.6, 0.4], (8**4, 1))
    settings = dict(behaviour_policy=behaviour, prior_policy=prior)
    data = collect_rollouts("cart_pole", 1500, 15, 3, **settings)
    ended = data.r == -1
    assert set(data.r.tolist()) == {-1.0, 0.0}
    begins, age, n_truncated = [0], 1, 0
    for t in range(len(data) - 1):
        over = ended[t] or age == 15
        n_truncated += age == 15 and not ended[t]
        if not over or ended[t]:
            assert data.s_next[t] == data.s[t + 1]
        if not over and on_prior:
            assert data.a_next[t] == data.a[t + 1]
        age = 1 if over else age + 1
        if over:
            begins.append(t + 1)
    assert len(begins) == 1500
    assert 100 < ended.sum() < 1400
    assert ended.sum() + n_truncated in (1499, 1500)
    centre = control_task("cart_pole").uniform_bins().box_distribution([-0.05] * 4, [0.05] * 4)
    assert (centre[data.s[begins]] > 0).all()
    assert (centre[data.s_next[ended]] > 0).all()
    truncated = np.array([b - 1 for b in begins[1:] if not ended[b - 1]])
    assert (centre[data.s_next[truncated]] == 0).any()
    for column, p in ((data.a, 0.7 if on_prior else 0.4), (data.a_next, 0.7)):
        assert abs(column.mean() - p) < 4 * math.sqrt(p * (1 - p) / len(data))
    again = collect_rollouts("cart_pole", 1500, 15, 3, **settings)
    other = collect_rollouts("cart_pole", 1500, 15, 4, **settings)
    for name in ("s", "a", "r", "s_next", "a_next"):
        assert np.array_equal(getattr(data, name), getattr(again, name))
    assert not np.array_equal(data.s[:500], other.s[:500])


def test_collected_stream_against_stepping():
    """The same law of (s, a, s') as ``collect`` through env.step: mean reward and length of episodes agree."""
    env = gym.make("erl_torch/DiscreteCartPole-v0", reward="cyclic")
    stepped = erl_torch.collect(gym.wrappers.TransformReward(env, float), 300, 500, 0)  # wrapped: env.step alone
    batched = erl_torch.collect(env, 3000, 500, 0)
    direct = collect_rollouts("cart_pole", 3000, 500, 0)
    assert all(np.array_equal(getattr(batched, name), getattr(direct, name)) for name in ("s", "a", "r", "s_next"))
    assert (stepped.r == -1).sum() == 300
    assert (batched.r == -1).sum() == 3000
    lengths = [np.diff(np.flatnonzero(data.r == -1), prepend=-1) for data in (stepped, batched)]
    assert stats.ks_2samp(*lengths).pvalue > 1e-3


@pytest.mark.parametrize("env_id", IDS)
def test_environments_pass_gymnasiums_check(env_id):
    check_env(gym.make(env_id).unwrapped, skip_render_check=True)
    env: Any = gym.make(env_id, render_mode="rgb_array")
    env.reset(seed=0)
    first = env.render()
    for t in range(10):
        env.step(t % env.action_space.n)
    assert first.dtype == np.uint8
    assert first.ndim == 3
    assert not np.array_equal(first, env.render())
    env.close()
    with pytest.raises(ValueError, match="render_mode=holo"):
        env.unwrapped.__class__(render_mode="holo")
    with pytest.raises(InputError, match="reward=instant: must be original or cyclic"):
        gym.make(env_id, reward="instant")


@pytest.mark.parametrize("env_id", IDS)
def test_same_seed_same_episode_to_the_time_limit(env_id):
    def episode():
        env: Any = gym.make(env_id)
        cells, ends = [env.reset(seed=7)[0]], (False, False)
        while not any(ends):
            cell, _, *ends, _ = env.step(len(cells) // 3 % env.action_space.n)
            cells.append(cell)
        return cells, ends

    cells, (terminated, truncated) = episode()
    assert episode()[0] == cells
    assert terminated or (truncated and len(cells) == CONTROL_EPISODE_LENGTH + 1)
    assert terminated == ("CartPole" in env_id)
    assert all(type(cell) is np.int64 for cell in cells)


def test_torques_reach_the_original():
    acrobot: Any = gym.make("erl_torch/DiscreteAcrobot-v0", torques=[-3, 4], bins=5).unwrapped
    pendulum: Any = gym.make("erl_torch/DiscretePendulum-v0", torques=[1.5], bins=[4, 3], low=[-1, -8]).unwrapped
    assert acrobot.observation_space.n == 625
    assert pendulum.observation_space.n == 12
    for env, action, torque in ((acrobot, 1, 4.0), (acrobot, 0, -3.0), (pendulum, 0, 1.5)):
        env.reset(seed=0)
        state = torch.tensor(np.array(env.env.unwrapped.state, np.float64)[None])
        cell, reward, *_ = env.step(action)
        batch = env.task.step(state, torch.tensor([torque]).double())
        np.testing.assert_allclose(env.env.unwrapped.state, batch.state[0], atol=1e-12)
        assert abs(reward - batch.reward.item()) < 1e-6
        assert cell == env.bins.cells(env.task.variables(batch.state)).item()


def test_a_policy_on_other_bins_is_played():
    """The policy of a finer model solves the original; bins as in estimate_mdp."""
    model = estimate_mdp("mountain_car", bins=16, n_samples=100, cache=False).mdp
    best = erl_torch.solve_soft_bellman(model, 2.0).policy
    played = [rollout("mountain_car", best, 64, 500, np.random.default_rng(0), bins=bins) for bins in (16, (16, 16))]
    assert np.array_equal(played[0].returns, played[1].returns)
    assert played[0].returns.mean() > -400  # the prior never gets there: -500


def test_evaluation_plays_the_original():
    """Batched figures of a policy against env.step: return, reward per step and objective agree (fixed seeds)."""
    env = gym.make("erl_torch/DiscretePendulum-v0")
    policy = np.random.default_rng(0).dirichlet(np.ones(3), 256)
    batched = erl_torch.evaluate(env, policy, 1.0, np.random.default_rng(1), 400, 100)
    plain = gym.wrappers.TransformReward(env, float)
    stepped = erl_torch.evaluate(plain, policy, 1.0, np.random.default_rng(2), 400, 100)
    assert batched.mean_return == pytest.approx(100 * batched.reward_per_step)
    np.testing.assert_allclose(batched, stepped, rtol=0.1)
    assert batched.objective < batched.reward_per_step


def test_cyclic_reward_of_the_environments():
    env = gym.make("erl_torch/DiscreteCartPole-v0", reward="cyclic")
    env.reset(seed=0)
    rewards = [env.step(0)]
    while not rewards[-1][2]:
        rewards.append(env.step(0))
    assert [r[1] for r in rewards] == [0.0] * (len(rewards) - 1) + [-1.0]


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: estimate_mdp("cartpole"), "task=cartpole: must be pendulum or mountain_car or cart_pole or acrobot"),
        (lambda: estimate_mdp("pendulum", [4, 4, 4]), r"bins=\[4, 4, 4\]: must be a whole number or 2 of them"),
        (lambda: estimate_mdp("pendulum", 4, low=[0.0]), r"low=array of shape \(1,\): must be of shape \[2\]"),
        (lambda: estimate_mdp("pendulum", 0), r"bins\[0\]=0"),
        (lambda: estimate_mdp("pendulum", actions=[3.0]), "actions=.* finite numbers of at most 2 in size"),
        (lambda: estimate_mdp("acrobot", actions=[np.inf]), "actions=.* finite numbers"),
        (lambda: estimate_mdp("acrobot", actions=[]), "actions="),
        (lambda: estimate_mdp("cart_pole", actions=[1.0]), "actions=.* left out: those of CartPole-v1 are fixed"),
        (lambda: estimate_mdp("pendulum", n_samples=0), "n_samples=0"),
        (lambda: estimate_mdp("pendulum", n_samples=10**7), "n_samples=10000000: must be at most 1000000"),
        (lambda: estimate_mdp("pendulum", seed=-1), "seed=-1"),
        (lambda: estimate_mdp("pendulum", start="best"), "start=best: must be reset or uniform"),
        (lambda: estimate_mdp("pendulum", workers=0), "workers=0"),
        (lambda: estimate_mdp("pendulum", device="abacus"), "device=abacus"),
        (lambda: rollout("pendulum", np.ones((3, 3)), 1, 1, np.random.default_rng()), "policy="),
        (lambda: rollout("pendulum", None, 0, 1, np.random.default_rng()), "n_episodes=0"),
        (lambda: rollout("pendulum", None, 1, 0, np.random.default_rng()), "max_steps=0"),
        (lambda: collect_rollouts("pendulum", 1, 1, reward="instant"), "reward=instant"),
    ],
)
def test_bad_settings_are_refused(call, message):
    with pytest.raises(InputError, match=message):
        call()
