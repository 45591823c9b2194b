"""Actions in a box: the actor's density and slopes, exact answers of one state, bits, runs."""

import math
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from helpers import composed
from scipy.integrate import cumulative_trapezoid

from erl_torch import InputError
from erl_torch.networks import kernels
from erl_torch.networks.actor_critic import ActorCriticS1, AverageActorCritic, suited
from erl_torch.networks.layout import mlp
from erl_torch.networks.learner import AverageSoftQ, DeepS1
from erl_torch.networks.live import Live
from erl_torch.networks.policy import ActorPolicy, Prior, load_policy
from erl_torch.networks.problem import BoxProblem
from erl_torch.networks.replay import COLUMNS, Replay, Steps
from erl_torch.networks.seeds import Seeds
from erl_torch.run.training import train

KINDS = [ActorCriticS1, AverageActorCritic]
LOW, HIGH = (-2.0, 1.0), (2.0, 4.0)
SMALL: dict[str, Any] = {"beta": 2.0, "batch": 16, "hidden": (10, 9), "n_steps": 900, "epoch_steps": 300, "lr": 3e-3}


class Pushed(gym.Env):
    """A point that is pushed along a line; pays for being near 0, and ends far away."""

    def __init__(self):
        self.observation_space = gym.spaces.Box(-9, 9, (1,), np.float32)
        self.action_space = gym.spaces.Box(np.array(LOW, np.float32), np.array(HIGH, np.float32))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x = self.np_random.normal()
        return np.array([self.x], np.float32), {}

    def step(self, action):
        assert self.action_space.contains(np.asarray(action, np.float32)), action
        self.x = self.x + 0.3 * action[0] + 0.1 * (action[1] - 2.5) + 0.1 * self.np_random.normal()
        return np.array([self.x], np.float32), float(-(self.x**2)), bool(abs(self.x) > 3), False, {}


def problem(**settings):
    return BoxProblem(lambda: Pushed(), 1, 0, 0, LOW, HIGH, time_limit=40, **settings)


def steps(n=200, seed=0):
    rng = np.random.default_rng(seed)
    action = rng.uniform(LOW, HIGH, (n, 2))
    return Steps(rng.normal(size=(n, 1)), action, rng.normal(size=n), rng.normal(size=(n, 1)), rng.random(n) < 0.1)


# -- the actor ----------------------------------------------------------------------------------------------------


def test_the_density_of_the_actor_is_one_on_the_box():
    """log pi/prior as it is drawn: its density integrates to 1, and is that of the actions that are drawn."""
    layout = mlp(1, (6, 5), 2)
    weights = torch.from_numpy(layout.start(np.random.default_rng(1)) * 2)
    policy = ActorPolicy(layout, weights, (-2.0,), (2.0,))
    x = np.array([[0.7]], np.float32)
    n = 200_000
    uniform = ((np.arange(n) + 0.5) / n)[:, None]
    action, surprise = policy.draw(np.repeat(x, n, 0), uniform)
    order = np.argsort(action[:, 0])
    assert np.trapezoid(np.exp(surprise[order]) / 4, action[order, 0]) == pytest.approx(1.0, abs=1e-3)
    below = cumulative_trapezoid(np.exp(surprise[order]) / 4, action[order, 0], initial=0)
    assert below[:: n // 50] == pytest.approx(np.linspace(0, 1, n)[:: n // 50], abs=2e-3)
    assert policy.best(x)[0, 0] == pytest.approx(np.median(action), abs=1e-3)


def literal(learner, where, state, data, n_updates):  # noqa: PLR0915 (as long as the update)
    """The updates with autograd, in the words of the equations; noise and minibatches as the kernel draws them."""
    separate, beta, k = learner.separate, learner.scaled_beta, 2
    q, v = learner.layouts(where)
    actor = learner.actor(where)
    w, lagged, m, s = (x.clone().double() for x in (state.weights, state.lagged, state.m, state.v))
    random, g = state.random.copy().view(np.uint64), 0.0
    low, high = np.array(LOW), np.array(HIGH)
    columns = [torch.from_numpy(getattr(data, name)) for name in COLUMNS]

    def bits():
        random[0] += np.uint64(0x9E3779B97F4A7C15)
        z = random[0]
        z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        return int((z ^ (z >> np.uint64(31))) >> np.uint64(11)) / 2**53

    def normals():
        found = np.zeros((learner.batch, k))
        for i in range(learner.batch):
            for j in range(k):
                u, angle = bits() + 2.0**-53, bits()
                found[i, j] = math.sqrt(-2 * math.log(u)) * math.cos(2 * math.pi * angle)
        return torch.from_numpy(found)

    def acted(vector, x, noise):
        mean, measure = actor.output(vector, x).reshape(-1, 2, k).unbind(1)
        log_sd = -5 + 3.5 * (torch.tanh(measure) + 1)
        before = mean + log_sd.exp() * noise
        density = torch.distributions.Normal(mean, log_sd.exp()).log_prob(before)
        squashed = torch.tanh(before)
        return squashed, (density - torch.log1p(-(squashed**2)) + math.log(2)).sum(1)

    def both(vector, x, a):
        pair = torch.cat([x, a], 1)
        return [q.output(vector[c * q.size : (c + 1) * q.size], pair)[:, 0] for c in range(2)]

    for t in range(1, n_updates + 1):
        with np.errstate(over="ignore"):
            chosen = [int(bits() * len(data)) for _ in range(learner.batch)]
            noise = normals()
            x, a, r, x2, ended = (column[chosen] for column in columns)
            x, x2, r = x.double(), x2.double(), r.double()
            a = (a.double() - torch.from_numpy((low + high) / 2)) / torch.from_numpy((high - low) / 2)
            noise2 = None if separate else normals()
        p = w.clone().requires_grad_()
        own = p[-actor.size :]
        with torch.no_grad():
            if separate:
                after = v.output(lagged, x2)[:, 0]
            else:
                a2, surprise2 = acted(own, x2, noise2)
                after = torch.minimum(*both(lagged, x2, a2)) - surprise2 / beta
            if learner.on_termination == "episodic":
                after = torch.where(ended, 0.0, after)
        drawn, surprise = acted(own, x, noise)
        worth = torch.minimum(*both(p.detach(), x, drawn)) - surprise / beta
        if separate and learner.on_termination == "restart":
            g += learner.g_rate * (float(worth.mean().detach()) - g)
        target = r + after - (0 if separate else g)
        loss = -worth.mean() + sum(0.5 * ((one - target) ** 2).mean() for one in both(p, x, a))
        if separate:
            value = v.output(p[2 * q.size : 2 * q.size + v.size], x)[:, 0]
            loss = loss + 0.5 * ((value - (worth.detach() - g)) ** 2).mean()
        elif learner.on_termination == "restart":
            g += learner.g_rate * (float(after.mean()) - g)
        (slope,) = torch.autograd.grad(loss, p)
        m += 0.1 * (slope - m)
        s += 0.001 * (slope**2 - s)
        lr_end = learner.lr * learner.lr_end_fraction
        rate = learner.lr + (lr_end - learner.lr) * (t - 1) / learner.n_steps
        w -= rate * (m / (1 - 0.9**t)) / ((s / (1 - 0.999**t)).sqrt() + 1e-8)
        begin = 2 * q.size if separate else 0
        lagged += learner.tau * (w[begin : begin + len(lagged)] - lagged)
    return w, lagged, m, g


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("ends", ["restart", "episodic"])
def test_compiled_updates_are_those_of_autograd(kind, ends):
    learner = kind(**SMALL | {"n_steps": 12, "epoch_steps": 12}, on_termination=ends, reward_scale=0.5)
    data = steps()
    state = learner.begin(problem(), data)
    done = learner.epoch(problem(), state, None)
    scaled = replace(data, reward=data.reward * np.float32(0.5))
    w, lagged, m, g = literal(learner, problem(), state, scaled, 12)
    assert done.weights.double().numpy() == pytest.approx(w.numpy(), abs=2e-5)
    assert done.lagged.double().numpy() == pytest.approx(lagged.numpy(), abs=2e-5)
    assert done.m.double().numpy() == pytest.approx(m.numpy(), abs=1e-4)
    assert done.numbers[kernels.G] == pytest.approx(g, abs=1e-5)
    assert (done.weights - state.weights).abs().max() > 0.01


# -- exact answers ------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_one_state_has_its_soft_optimum(kind):
    """r = -(a - .5)^2 in one state: the rate (1/beta) log of the mean of exp(beta r) over the box, by quadrature, less
    what a squashed normal cannot do."""
    rng = np.random.default_rng(0)
    n, beta = 4000, 6.0
    a = rng.uniform(-2, 2, (n, 1))
    one = np.ones((n, 1))
    data = Steps(one, a, -((a[:, 0] - 0.5) ** 2), one, np.zeros(n, bool))
    where = BoxProblem(lambda: Pushed(), 1, 0, 0, (-2.0,), (2.0,))
    learner = kind(beta=beta, n_steps=6000, epoch_steps=3000, hidden=(32, 32), lr=3e-3, tau=0.05)
    *_, state = learner.run(where, data)
    x, weight = np.polynomial.legendre.leggauss(200)
    exact = math.log(weight @ np.exp(-beta * (2 * x - 0.5) ** 2) / 2) / beta
    assert -state.theta == pytest.approx(exact, abs=0.02)
    policy = learner.policy(where, state)
    uniform = ((np.arange(20_000) + 0.5) / 20_000)[:, None]
    action, surprise = policy.draw(np.ones((20_000, 1), np.float32), uniform)
    rate = float((-((action[:, 0] - 0.5) ** 2) - surprise / beta).mean())
    assert exact - 0.02 < rate <= exact + 1e-3  # J of the policy: never above the optimum
    boltzmann = np.exp(-beta * (2 * x - 0.5) ** 2) * weight
    assert action.mean() == pytest.approx(2 * (boltzmann @ x) / boltzmann.sum(), abs=0.05)


# -- bits ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_a_run_that_goes_on_has_the_same_bits(kind):
    learner = kind(**SMALL, explore_hold=3.0)
    whole = list(learner.run(problem(), Live(problem(), 2)))
    *_, last = learner.run(problem(), Live(problem(), 2), whole[0])
    assert torch.equal(whole[-1].weights, last.weights)
    assert whole[-1].figures == pytest.approx(last.figures, nan_ok=True, abs=0)
    *_, together = Seeds(learner, (2, 7), 2).run(problem(), [Live(problem(), seed) for seed in (2, 7)])
    assert torch.equal(together.each[0].weights, last.weights)
    actions = last.replay.action[: last.replay.n]
    assert (actions >= np.float32(LOW)).all()
    assert (actions <= np.float32(HIGH)).all()
    assert actions.std(0).min() > 0.1


def test_a_shift_of_all_values_changes_neither_theta_nor_actor():
    learner = ActorCriticS1(**SMALL | {"n_steps": 300, "lr": 1e-12})
    where = problem()
    state = learner.begin(where, steps())
    q, v = learner.layouts(where)
    assert v is not None
    weights, lagged = state.weights.clone(), state.lagged.clone()
    for layout, vector in (
        (q, weights[: q.size]),
        (q, weights[q.size : 2 * q.size]),
        (v, weights[2 * q.size : 2 * q.size + v.size]),
        (v, lagged),
    ):
        layout.layers(vector)[-1][1].add_(5.0)
    moved = replace(state, weights=weights, lagged=lagged)
    one, other = (learner.epoch(where, each, None) for each in (state, moved))
    assert one.theta == pytest.approx(other.theta, abs=2e-5)


# -- policies, runs, bad input ------------------------------------------------------------------------------------


def test_an_actor_is_saved_and_read(tmp_path):
    learner = ActorCriticS1(**SMALL)
    policy = learner.policy(problem(), learner.start(problem()))
    again = load_policy(policy.save(tmp_path / "policy.safetensors"))
    x, uniform = np.random.default_rng(0).normal(size=(9, 1)), np.random.default_rng(1).random((9, 2))
    assert isinstance(again, ActorPolicy)
    for one, other in zip(policy.draw(x, uniform), again.draw(x, uniform), strict=True):
        assert np.array_equal(one, other)
    prior = Prior(0, LOW, HIGH)
    assert (prior.draw(x, uniform)[0] >= LOW).all()


def test_deep_s1_takes_an_actor_where_actions_are_in_a_box(tmp_path):
    assert isinstance(suited(DeepS1(beta=3.0), problem()), ActorCriticS1)
    assert suited(DeepS1(beta=3.0), problem()).beta == 3.0
    discrete = BoxProblem(lambda: Pushed(), 1, 3)
    assert type(suited(DeepS1(), discrete)) is DeepS1
    few = ("learner.n_steps=200", "learner.hidden=[8,8]", "evaluation.n_episodes=2", "evaluation.horizon=20")
    for name in ("deep_s1", "asac"):
        result = train(composed("env=pendulum_v1", f"learner={name}", *few), tmp_path / name)
        assert result["status"] == "completed"
        assert isinstance(load_policy(tmp_path / name / "policy.safetensors"), ActorPolicy)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: ActorCriticS1(optimism=1.0), "optimism=1.0: must be 0"),
        (lambda: ActorCriticS1(support_penalty=1.0), "support_penalty=1.0: must be 0"),
        (lambda: ActorCriticS1(hidden=(8,)), "hidden=.*two hidden layers"),
        (lambda: ActorCriticS1().check(BoxProblem(lambda: Pushed(), 1, 3)), "deep_s1 or asql"),
        (lambda: AverageSoftQ().check(problem()), "deep_s1 or asac"),
    ],
)
def test_what_cannot_be_is_named(make, said):
    with pytest.raises(InputError, match=said):
        make()


def test_replay_has_room_for_boxes():
    assert Replay.empty(3, 2, 100).action.shape == (100, 2)
