"""Actions that a state does not have: the problem is the one on the others, and nothing at the missing ones is read.

The oracle is a lazy relative soft value iteration over each state's list of actions. Two identities hold for all
learners and solvers: a column of actions that no state has can be left out, and a missing action can be made a copy of
one that there is, among which the share of the prior is divided.
"""

import warnings
from dataclasses import fields, replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from helpers import composed, random_policy
from oracle import counted, soft_rate

import erl_torch
from erl_torch import (
    ActionMasks,
    AlgorithmS1,
    CertaintyEquivalence,
    EfficientS1,
    InputError,
    ListedS1,
    Problem,
    Replicas,
    Simulation,
    Status,
    TabularMDP,
    Transitions,
    certify,
    collect,
    empirical_mdp,
    evaluate,
    iterate_biasing,
    solve_biasing,
    solve_soft_bellman,
    theta_uncertainty,
)
from erl_torch.envs import TabularEnv
from erl_torch.learners.action_value.q_learning import (
    DifferentialSoftQ,
    QLearning,
    RVISoftQ,
    Sarsa,
    SoftQ,
    ULearning,
)
from erl_torch.learners.action_value.z_learning import ZLearning
from erl_torch.learners.exact import Exact
from erl_torch.run.training import train
from erl_torch.solvers.policy import objective

SOLVERS = (solve_soft_bellman, solve_biasing)


def optimum(rows, beta):
    """(smallest and largest TV - V, policies) of V = 0.5 (V + TV) iterated, state by state, action by action.

    rows[s] lists (action, prior, reward, p [S]) of the actions of s.
    """
    value = np.zeros(len(rows))
    for _ in range(400_000):
        new, policies = np.empty(len(rows)), []
        for s, actions in enumerate(rows):
            q = np.array([r + p @ value for _, _, r, p in actions])
            weight = np.array([w for _, w, _, _ in actions]) * np.exp(beta * (q - q.max()))
            new[s] = q.max() + np.log(weight.sum()) / beta
            policies.append(weight / weight.sum())
        gain = new - value
        if np.ptp(gain) < 1e-12:
            break
        value = value + 0.5 * (gain - gain[0])
    return gain.min(), gain.max(), policies


def listed(p, r, prior):
    """The actions with a prior above 0 of p [S, A, S], r and prior [S, A], as ``optimum`` takes them."""
    return [[(a, prior[s, a], r[s, a], p[s, a]) for a in range(r.shape[1]) if prior[s, a] > 0] for s in range(len(r))]


def random_masked(rng, n_states=None, n_actions=None):
    """(p [S, A, S], r, prior): some pairs missing (prior 0), every state left with one at least; one class."""
    n_states, n_actions = n_states or int(rng.integers(1, 6)), n_actions or int(rng.integers(2, 5))
    p = rng.dirichlet(np.full(n_states, 0.5), size=(n_states, n_actions)) + 1e-3
    p /= p.sum(-1, keepdims=True)
    allowed = rng.random((n_states, n_actions)) < 0.6
    allowed[np.arange(n_states), rng.integers(n_actions, size=n_states)] = True
    prior = np.where(allowed, random_policy(rng, n_states, n_actions), 0.0)
    return p, rng.normal(size=allowed.shape), prior / prior.sum(1, keepdims=True)


def masked(p, r, prior):
    return TabularMDP(p, np.where(prior > 0, r, -np.inf))


@pytest.mark.parametrize("seed", range(150))
def test_bounds_hold_and_the_policy_is_that_of_the_actions_there_are(seed):
    rng = np.random.default_rng(seed)
    p, r, prior = random_masked(rng)
    beta = float(10 ** rng.uniform(-1, 1))
    low, high, policies = optimum(listed(p, r, prior), beta)
    for solve in SOLVERS:
        found = solve(masked(p, r, prior), beta, prior)
        assert found.status is Status.CONVERGED
        assert found.theta_bounds[0] <= -low
        assert found.theta_bounds[1] >= -high
        assert found.theta == pytest.approx(-low, abs=1e-9)
        for s, policy in enumerate(policies):
            np.testing.assert_allclose(found.policy[s][prior[s] > 0], policy, rtol=1e-6, atol=1e-9)
        missing = prior == 0
        assert not found.policy[missing].any()
        assert not found.u[missing].any()
        assert not found.reward_bias[missing].any()
        assert (found.action_value[missing] == -torch.inf).all()
        assert torch.isfinite(found.action_value[~missing]).all()
        # 0 in the prior of a model that has the pairs says the same, bit for bit, whatever the pairs hold.
        poison = np.where(missing, rng.choice([-1e90, 1e90], r.shape), r)
        other = solve(TabularMDP(p, poison), beta, prior)
        assert other.theta_bounds == found.theta_bounds
        assert torch.equal(other.policy, found.policy)


@pytest.mark.parametrize("seed", range(40))
def test_a_missing_action_is_a_copy_among_which_the_prior_is_divided(seed):
    rng = np.random.default_rng(1000 + seed)
    p, r, prior = random_masked(rng)
    whole_p, whole_r, whole_prior = p.copy(), r.copy(), prior.copy()
    for s in range(len(r)):
        first, missing = np.flatnonzero(prior[s])[0], np.flatnonzero(prior[s] == 0)
        whole_p[s, missing], whole_r[s, missing] = p[s, first], r[s, first]
        whole_prior[s, [first, *missing]] = prior[s, first] / (1 + len(missing))
    for solve in SOLVERS:
        found, whole = (
            solve(masked(p, r, prior), 2.0, prior, tol=1e-12),
            solve(TabularMDP(whole_p, whole_r), 2.0, whole_prior, tol=1e-12),
        )
        assert found.theta == pytest.approx(whole.theta, abs=1e-9)
        assert found.reward_bias_max == pytest.approx(whole.reward_bias_max, abs=1e-6)
        for s in range(len(r)):
            first, missing = np.flatnonzero(prior[s])[0], np.flatnonzero(prior[s] == 0)
            together = whole.policy[s].clone()
            together[first] += together[missing].sum()
            together[missing] = 0
            np.testing.assert_allclose(found.policy[s], together, atol=1e-7)


def test_states_with_one_action_each_are_a_chain():
    """No choice, no KL: -theta is the chain's average reward, (2 r0 + r1)/3 where 0 and 1 are left with 1/4 and 1/2."""
    p = np.zeros((2, 3, 2))
    p[0, 2], p[1, 0] = [0.75, 0.25], [0.5, 0.5]
    r = np.full((2, 3), -np.inf)
    r[0, 2], r[1, 0] = 5.0, -1.0
    for solve in SOLVERS:
        for beta in (1e-3, 1.0, 1e3):
            found = solve(TabularMDP(p, r), beta)
            assert found.theta_bounds[0] <= -3.0 <= found.theta_bounds[1]
            assert found.theta == pytest.approx(-3.0, abs=1e-9)
            assert found.policy.tolist() == [[0, 0, 1], [1, 0, 0]]


def puterman_3_1():
    """State 0 pays 5 and is left with 1/2, or pays 10 and is left; state 1 pays -1 for ever, its one action."""
    p = np.array([[[0.5, 0.5], [0.0, 1.0]], [[0.0, 1.0], [0.0, 0.0]]])
    return TabularMDP(p, [[5.0, 10.0], [-1.0, -np.inf]])


def inventory():
    """Puterman 3.2.1: to stock s order a <= 3 - s at 4 + 2a, hold s + a, sell at 8 what there is of the demand 0..2."""
    p, r = np.zeros((4, 4, 4)), np.full((4, 4), -np.inf)
    for s in range(4):
        for a in range(4 - s):
            r[s, a] = -(4 + 2 * a) * (a > 0) - (s + a)
            for demand, chance in ((0, 0.25), (1, 0.5), (2, 0.25)):
                r[s, a] += 8 * chance * min(demand, s + a)
                p[s, a, max(s + a - demand, 0)] += chance
    return TabularMDP(p, r)


def harvest():
    """Of s in 0..9 leave a <= s: sqrt(s - a) is earned, and 0 to 4 grow on what is left, to 9 at most."""
    p, r = np.zeros((10, 10, 10)), np.full((10, 10), -np.inf)
    for s in range(10):
        for a in range(s + 1):
            r[s, a] = np.sqrt(s - a)
            for grown in range(5):
                p[s, a, min(a + grown, 9)] += 0.2
    return TabularMDP(p, r)


@pytest.mark.parametrize(
    ("make", "theta_1", "theta_10"),
    [
        (inventory, -1.4981619060, -2.1083586110),
        (harvest, -1.1717884570, -1.2953074960),
    ],
)
def test_textbook_problems(make, theta_1, theta_10):
    mdp = make()
    for solve in SOLVERS:
        assert solve(mdp, 1.0).theta == pytest.approx(theta_1, abs=1e-9)
        assert solve(mdp, 10.0).theta == pytest.approx(theta_10, abs=1e-9)


def test_textbook_problems_at_large_beta_are_their_best_rates():
    """g of Puterman's inventory is 97/44; the KL term of a policy is at most log(4)/beta a step."""
    theta = solve_soft_bellman(inventory(), 1e6).theta
    assert -97 / 44 <= theta <= -97 / 44 + np.log(4) / 1e6
    # State 1 has one action and is never left: its rate is that of the chain.
    ended = solve_soft_bellman(puterman_3_1(), 10.0)
    assert ended.status is Status.CONVERGED
    assert ended.theta == pytest.approx(1.0, abs=1e-9)


# -- the model ------------------------------------------------------------------------------------------------


P = np.array([[[0.5, 0.5], [0.0, 1.0]], [[0.1, 0.9], [0.0, 0.0]]])
R = np.array([[5.0, 10.0], [-2.0, 0.0]])
ALLOWED = np.array([[True, True], [True, False]])
UNIFORM = np.array([[0.5, 0.5], [1.0, 0.0]])


def test_three_ways_to_say_it_are_one(tmp_path):
    said = {
        "mask": TabularMDP(P, R, allowed=ALLOWED),
        "numbers": TabularMDP(P, R, allowed=[[1, 1], [1, 0]]),
        "reward": TabularMDP(P, np.where(ALLOWED, R, -np.inf)),
        "poison": TabularMDP(
            np.where(ALLOWED[..., None], P, [np.nan, -7.0]), np.where(ALLOWED, R, np.nan), allowed=ALLOWED
        ),
    }
    said["file"] = TabularMDP.load(said["mask"].save(tmp_path / "a.npz"))
    np.savez(tmp_path / "b.npz", transition=P, reward=np.where(ALLOWED, R, -np.inf))
    said["own file"] = TabularMDP.load(tmp_path / "b.npz")
    for mdp in said.values():
        assert np.array_equal(mdp.allowed, ALLOWED)
        assert not mdp.allowed.flags.writeable
        assert np.array_equal(mdp.reward, R)
        assert np.array_equal(mdp.transition.toarray(), P.reshape(4, 2))
        assert np.array_equal(mdp.uniform_policy, UNIFORM)
        assert mdp.reward_range == (-2.0, 10.0)
        assert repr(mdp) == "TabularMDP(2 states, 2 actions (3 of 4 pairs), 5 transitions, rewards in [-2, 10])"


def test_a_model_with_all_actions_is_as_ever(tmp_path):
    mdp = TabularMDP(np.full((2, 2, 2), 0.5), R)
    assert mdp.allowed.all()
    assert "pairs" not in repr(mdp)
    with np.load(mdp.save(tmp_path / "a.npz")) as arrays:
        assert "allowed" not in arrays
    assert mdp.restricted(np.ones((2, 2), bool)) is mdp
    fewer = mdp.restricted(ALLOWED)
    assert np.array_equal(fewer.allowed, ALLOWED)
    assert fewer.transition.nnz == 6
    assert fewer.restricted(np.ones((2, 2), bool)) is fewer


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((P, R), r"transition row 3 \(state 1, action 1\)=sum 0: must be a distribution \(.*reward -inf, or false in"),
        ((P, np.where(ALLOWED, R, -np.inf), None, False, np.ones((2, 2))), r"reward\[1, 1\]=-inf: must be finite"),
        ((P, np.full((2, 2), -np.inf)), r"allowed\[0\]=no action: must be at least one action in every state"),
        ((P, R, None, False, [[1, 1], [0, 0]]), r"allowed\[1\]=no action"),
        ((P, R, None, False, [[1, 1], [1, 2]]), r"allowed\[1, 1\]=2.0: must be true or false"),
        ((P, R, None, False, [1, 0]), r"allowed=array of shape \(2,\)"),
        ((P, np.where(ALLOWED, R, np.nan)), r"reward\[1, 1\]=nan: must be finite"),
    ],
)
def test_bad_masks_are_named(arguments, message):
    with pytest.raises(InputError, match=f"^{message}"):
        TabularMDP(*arguments)


MDP = TabularMDP(P, R, allowed=ALLOWED)
OFF = np.full((2, 2), 0.5)  # takes the action that state 1 does not have


@pytest.mark.parametrize(
    ("what", "key"),
    [
        (lambda: solve_soft_bellman(MDP, 1.0, OFF), "prior_policy"),
        (lambda: solve_biasing(MDP, 1.0, OFF), "prior_policy"),
        (lambda: evaluate(MDP, OFF, 1.0, np.random.default_rng(0)), "policy"),
        (lambda: evaluate(MDP, UNIFORM, 1.0, np.random.default_rng(0), prior_policy=OFF), "prior_policy"),
        (lambda: collect(MDP, 1, 9, behaviour_policy=OFF), "behaviour_policy"),
        (lambda: collect(MDP, 1, 9, prior_policy=OFF), "prior_policy"),
        (lambda: Simulation(MDP, 1, 9, [0], OFF), "behaviour_policy"),
        (lambda: Replicas.of(AlgorithmS1(prior_policy=OFF), 1).fit(Simulation(MDP, 1, 9, [0]), 2, 2), "prior_policy"),
    ],
)
def test_policies_that_take_a_missing_action_are_refused(what, key):
    with pytest.raises(InputError, match=rf"^{key}\[1, 1\]=0.5: must be 0: state 1 does not have action 1$"):
        what()


def test_policies_are_evaluated_on_the_actions_there_are():
    found = solve_soft_bellman(MDP, 1.0)
    policy = found.policy.numpy()
    j, _ = soft_rate(P, R, np.where(UNIFORM > 0, UNIFORM, 1.0), 1.0, policy)
    figures = evaluate(MDP, policy, 1.0, np.random.default_rng(0))
    assert figures.objective == pytest.approx(j, abs=1e-12)
    assert j == pytest.approx(-found.theta, abs=1e-9)
    assert objective(MDP, OFF, UNIFORM, 1.0) == -np.inf
    loss = j - soft_rate(P, R, np.where(UNIFORM > 0, UNIFORM, 1.0), 1.0, UNIFORM)[0]
    assert certify(replace(found, policy=torch.from_numpy(UNIFORM)), MDP, 1.0).gap == pytest.approx(loss, abs=1e-9)
    for state in iterate_biasing(MDP, 1.0):
        assert not state.policy[1, 1]
        assert not state.reward_bias[1, 1]
        assert np.isfinite(state.kl).all()


def test_another_target_has_the_same_actions():
    p = P.copy()
    p[1, 0] = [0.6, 0.4]
    target = TabularMDP(p, R, allowed=ALLOWED)
    found = solve_biasing(MDP, 1.0, target=target)
    assert found.theta == pytest.approx(solve_soft_bellman(target, 1.0).theta, abs=1e-9)
    with pytest.raises(InputError, match="target=MDP: must be one whose states have the same actions"):
        solve_biasing(MDP, 1.0, target=TabularMDP(np.full((2, 2, 2), 0.5), R))


# -- streams --------------------------------------------------------------------------------------------------


class Told(gym.Env):
    """Steps through an MDP and tells its masks in ``info``, but no model; every episode ends by chance 1/8."""

    def __init__(self, mdp, changing=None):
        self._inside, self._changing, self.taken = TabularEnv(mdp), changing, []
        self.observation_space, self.action_space = self._inside.observation_space, self._inside.action_space

    def itself(self):
        return self

    def _info(self, s):
        mask = self._inside.mdp.allowed[s].astype(np.int8)
        if self._changing is not None and s == 0 and len(self.taken) > self._changing:
            mask = np.ones_like(mask)
        return {"action_mask": mask}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        s, _ = self._inside.reset(seed=seed)
        return s, self._info(s)

    def step(self, action):
        self.taken.append((self._inside.state, int(action)))
        s, r, *_ = self._inside.step(action)
        return s, r, bool(self.np_random.random() < 0.125), False, self._info(s)


def problem_of(seed, n_states=4, n_actions=3):
    p, r, prior = random_masked(np.random.default_rng(seed), n_states, n_actions)
    return masked(p, r, prior), np.asarray((prior > 0) / (prior > 0).sum(1, keepdims=True))


def missing_in(mdp):
    """[S, A], as a tensor."""
    return torch.tensor(~mdp.allowed)


def takes_no_missing_pair(data, allowed):
    return allowed[data.s, data.a].all() and allowed[data.s_next, data.a_next].all()


@pytest.mark.parametrize("seed", range(4))
def test_streams_of_a_model_hold_no_missing_pair(seed):
    mdp, uniform = problem_of(seed)
    data = collect(mdp, 20, 100, seed)
    assert takes_no_missing_pair(data, mdp.allowed)
    counts = np.zeros(uniform.shape)
    np.add.at(counts, (data.s, data.a), 1)
    share = counts / counts.sum(1, keepdims=True)
    np.testing.assert_allclose(share, uniform, atol=6 / np.sqrt(counts.sum(1).min()))
    behaviour = np.where(mdp.allowed, np.random.default_rng(seed).random(uniform.shape), 0)
    behaviour /= behaviour.sum(1, keepdims=True)
    assert takes_no_missing_pair(collect(mdp, 20, 100, seed, behaviour), mdp.allowed)
    # The environment that follows the model is sampled like the model.
    again = collect(TabularEnv(mdp), 20, 100, seed)
    assert all(np.array_equal(getattr(data, f.name), getattr(again, f.name)) for f in fields(data))


@pytest.mark.parametrize("seed", range(3))
def test_environments_that_mask_are_stepped_with_the_actions_that_are_left(seed):
    mdp, uniform = problem_of(seed)
    env, masks = Told(mdp), ActionMasks(mdp.n_states, mdp.n_actions)
    data = collect(env, 40, 50, seed, masks=masks)
    assert masks.told.all()
    assert np.array_equal(masks.allowed, mdp.allowed)
    np.testing.assert_allclose(masks.uniform_policy, uniform, atol=1e-15)
    assert takes_no_missing_pair(data, mdp.allowed)
    assert all(mdp.allowed[pair] for pair in env.taken)
    # A prior keeps the shares of what is left.
    prior = random_policy(np.random.default_rng(seed), *uniform.shape)
    data = collect(Told(mdp), 200, 50, seed, prior_policy=prior)
    assert takes_no_missing_pair(data, mdp.allowed)
    counts = np.zeros(prior.shape)
    np.add.at(counts, (data.s, data.a), 1)
    due = prior * mdp.allowed / (prior * mdp.allowed).sum(1, keepdims=True)
    np.testing.assert_allclose(counts / counts.sum(1, keepdims=True), due, atol=6 / np.sqrt(counts.sum(1).min()))


class Dressed(gym.Wrapper):
    """The same, with the mask in the observation."""

    def __init__(self, env):
        super().__init__(env)
        masks = gym.spaces.MultiBinary(int(env.action_space.n))
        self.observation_space = gym.spaces.Dict({"observation": env.observation_space, "action_mask": masks})

    def reset(self, **options):
        s, info = self.env.reset(**options)
        return {"observation": s, **info}, {}

    def step(self, action):
        s, r, terminated, truncated, info = self.env.step(action)
        return {"observation": s, **info}, r, terminated, truncated, {}


def test_masks_in_observations_are_those_in_info():
    mdp, _ = problem_of(5)
    masks = ActionMasks(mdp.n_states, mdp.n_actions)
    plain, dressed = collect(Told(mdp), 40, 50, 3), collect(Dressed(Told(mdp)), 40, 50, 3, masks=masks)
    assert all(np.array_equal(getattr(plain, f.name), getattr(dressed, f.name)) for f in fields(plain))
    assert np.array_equal(masks.allowed, mdp.allowed)


@pytest.mark.parametrize("mode", list(gym.vector.AutoresetMode))
def test_vectors_of_environments_are_stepped_with_the_actions_that_are_left(mode):
    mdp, _ = problem_of(5)
    envs = [Told(mdp) for _ in range(3)]
    vector = gym.vector.SyncVectorEnv([envs[0].itself, envs[1].itself, envs[2].itself], autoreset_mode=mode)
    masks = ActionMasks(mdp.n_states, mdp.n_actions)
    data = collect(vector, 10, 60, 1, masks=masks)
    assert len(data) == 600
    assert takes_no_missing_pair(data, mdp.allowed)
    assert np.array_equal(masks.allowed, mdp.allowed)
    assert all(mdp.allowed[pair] for env in envs for pair in env.taken)


def test_masks_that_cannot_be_used_are_named():
    mdp = MDP
    with pytest.raises(InputError, match=r"^action_mask of state 0=.*an earlier visit of state 0") as error:
        collect(Told(TabularMDP(np.full((2, 2, 2), 0.5), R, allowed=ALLOWED[::-1]), changing=20), 50, 50)
    assert "\n" not in str(error.value)
    with pytest.raises(InputError, match=r"^behaviour_policy\[1, 1\]=0.5: must be 0: the environment says"):
        collect(Told(mdp), 50, 50, behaviour_policy=OFF)
    other = [[0.5, 0.5], [0.0, 1.0]]
    with pytest.raises(InputError, match=r"^policy\[1, 1\]=1.0: must be 0: the environment says"):
        collect(Told(mdp), 50, 50, prior_policy=other)
    env = Told(mdp)
    env._info = lambda s: {"action_mask": [1, 1, 1]}
    with pytest.raises(InputError, match=r"info\['action_mask'\]=\[1, 1, 1\]: must be of shape \[2\]"):
        collect(env, 1, 1)


def test_policies_are_played_on_the_actions_that_are_left():
    """A policy that takes missing actions too is played with the shares of the others: worth those of that policy."""
    env = Told(MDP)
    evaluate(env, OFF, 1.0, np.random.default_rng(0), n_episodes=50, horizon=20)
    assert set(env.taken) == {(0, 0), (0, 1), (1, 0)}
    from erl_torch.run.playing import episodes

    env = Told(MDP)
    episodes(env, OFF, 50, 20, 0)
    assert set(env.taken) == {(0, 0), (0, 1), (1, 0)}


def test_the_environment_of_a_model_tells_its_masks_and_refuses_others():
    env = TabularEnv(MDP)
    s, info = env.reset(seed=0)
    while s != 1:
        assert info["action_mask"].tolist() == [1, 1]
        s, _, _, _, info = env.step(1)
    assert info["action_mask"].tolist() == [1, 0]
    with pytest.raises(InputError, match=r"^action=1: must be one of \[0\], as state 1 has no other$"):
        env.step(1)
    assert TabularEnv(TabularMDP(np.full((2, 2, 2), 0.5), R)).reset(seed=0)[1] == {}


# -- learners -------------------------------------------------------------------------------------------------


LEARNERS: dict[str, Any] = {
    "s1": AlgorithmS1(beta=2.0, lr_u=0.05, n_epochs=2, n_bias=3),
    "s1, unvisited prior": AlgorithmS1(beta=2.0, lr_u=0.05, n_epochs=2, n_bias=3, unvisited="prior"),
    "s1, literal": AlgorithmS1(beta=2.0, lr_u=0.05, n_epochs=2, n_bias=2, implementation="literal"),
    "listed": ListedS1(beta=2.0, lr_u=0.05, n_epochs=2, n_bias=3),
    "efficient": EfficientS1(beta=2.0),
    "efficient, logs": EfficientS1(beta=2.0, log_domain="on", n_bias=4),
    "efficient, published": EfficientS1.published(2.0, n_epochs=2, n_bias=3, lr_u=0.05),
    "certainty equivalence": CertaintyEquivalence(beta=2.0),
    "differential": DifferentialSoftQ(beta=2.0, lr_rate=0.1),
    "rvi": RVISoftQ(beta=2.0),
    "u": ULearning(beta=2.0, lr_rate=0.1),
    "z": ZLearning(beta=2.0, lr_rate=0.1),
    "soft q": SoftQ(beta=2.0),
    "q": QLearning(beta=2.0),
    "sarsa": Sarsa(beta=2.0),
}
each = pytest.mark.parametrize("name", LEARNERS)


@each
def test_a_column_that_no_state_has_can_be_left_out(name):
    mdp, uniform = problem_of(11)
    p = mdp.transition.toarray().reshape(4, 3, 4)
    wide_p = np.concatenate([p, np.zeros((4, 1, 4))], axis=1)
    wide = TabularMDP(wide_p, np.concatenate([mdp.reward, np.zeros((4, 1))], 1), mdp.start,
                      allowed=np.concatenate([mdp.allowed, np.zeros((4, 1), bool)], 1))  # fmt: skip
    data = collect(mdp, 30, 100, 3)
    again = collect(wide, 30, 100, 3)
    assert all(np.array_equal(getattr(data, f.name), getattr(again, f.name)) for f in fields(data))
    learner = LEARNERS[name]
    narrow = replace(learner, prior_policy=uniform).fit(data, 4, 3)
    found = replace(learner, prior_policy=wide.uniform_policy).fit(data, 4, 4)
    assert not found.policy[:, 3].any()
    assert not found.policy[:, :3][missing_in(mdp)].any()
    np.testing.assert_allclose(found.policy[:, :3], narrow.policy, rtol=1e-9, atol=1e-12)
    assert found.status is narrow.status
    if narrow.theta is not None:
        assert found.theta == pytest.approx(narrow.theta, rel=1e-9, abs=1e-9)
    assert found.reward_bias_max == pytest.approx(narrow.reward_bias_max, rel=1e-9, abs=1e-12)
    assert not found.u[missing_in(wide)].any()
    assert (found.log_u[missing_in(wide)] == -torch.inf).all()
    q, v = found.value_functions()
    assert (q[missing_in(wide)] == -torch.inf).all()
    assert not v.isnan().any()


@each
def test_tuples_of_actions_with_prior_zero_are_left_out(name, tmp_path):
    """... whatever they hold; so that a log of all actions answers what is best without some of them."""
    rng = np.random.default_rng(17)
    p, r, prior = random_masked(rng, 4, 3)
    r = np.where(prior > 0, r, 1e3)  # would be the best, and change every maximum
    data = collect(TabularMDP(p, r), 30, 100, 3)
    learner = replace(LEARNERS[name], prior_policy=prior)
    kept = prior[data.s, data.a] > 0
    if learner.drawn_from_prior == "a_next":
        kept &= prior[data.s_next, data.a_next] > 0
    assert not kept.all()
    found, alone = learner.fit(data, 4, 3), learner.fit(data.where(kept), 4, 3)
    assert torch.equal(found.policy, alone.policy)
    assert torch.equal(found.u, alone.u)
    assert found.theta == alone.theta
    assert found.reward_bias_max == alone.reward_bias_max
    assert found.n_steps == alone.n_steps
    assert not found.policy[prior == 0].any()
    assert found.reward_bias_max < 100
    if name != "s1, literal":  # of files too, in any chunks
        erl_torch.write_experience(data, tmp_path / "tuples")
        filed = erl_torch.read_experience(tmp_path / "tuples", 4, 3, chunk=700)
        assert torch.equal(learner.fit(filed, 4, 3).policy, found.policy)
    nothing = data.where(prior[data.s, data.a] == 0)
    with pytest.raises(InputError, match="must be some of actions whose prior is above 0"):
        learner.fit(nothing, 4, 3)


@pytest.mark.parametrize("seed", range(12))
def test_certainty_equivalence_is_the_optimum_of_the_counts(seed):
    mdp, uniform = problem_of(100 + seed)
    data = collect(mdp, 20, 200, seed)
    p, r, visits = counted(data, mdp.n_states, mdp.n_actions)
    assert (visits[~mdp.allowed] == 0).all()
    assert (visits[mdp.allowed] > 0).all()
    low, _, policies = optimum(listed(p, r, uniform), 2.0)
    found = CertaintyEquivalence(2.0, prior_policy=uniform).fit(data, mdp.n_states, mdp.n_actions)
    assert found.status is Status.CONVERGED
    assert found.message == ""
    assert found.theta == pytest.approx(-low, abs=1e-9)
    for s, policy in enumerate(policies):
        np.testing.assert_allclose(found.policy[s].numpy()[mdp.allowed[s]], policy, atol=1e-7)


@pytest.mark.parametrize("seed", range(5))
def test_learners_come_to_certainty_equivalence(seed):
    mdp, uniform = problem_of(200 + seed)
    data, shape = collect(mdp, 40, 500, seed), (mdp.n_states, mdp.n_actions)
    limit = CertaintyEquivalence(2.0, prior_policy=uniform).fit(data, *shape)
    efficient = EfficientS1(2.0, prior_policy=uniform).fit(data, *shape)
    assert efficient.status is Status.CONVERGED
    *_, online = EfficientS1(2.0, prior_policy=uniform).online(
        [data.where(slice(i, i + 1700)) for i in range(0, len(data), 1700)], *shape
    )
    rvi = RVISoftQ(2.0, prior_policy=uniform, n_epochs=40, power=0.8).fit(data, *shape)
    for found, near in ((efficient, 1e-3), (online, 0.02), (rvi, 0.05)):
        np.testing.assert_allclose(found.policy, limit.policy, atol=near)
        assert found.theta == pytest.approx(limit.theta, abs=near)
        assert not found.policy[missing_in(mdp)].any()
    steps = {"lr_u": 5e-4, "lr_psi": 5e-4, "psi_tol": 1e-6, "n_epochs": 60}
    s1 = AlgorithmS1(2.0, n_bias=5, prior_policy=uniform, **steps).fit(data, *shape)
    assert s1.theta == pytest.approx(limit.theta, abs=0.02)
    # Its backup takes the a' of the stream, whose shares are off the prior's by about .007 (5,000 visits a state).
    np.testing.assert_allclose(s1.policy, limit.policy, atol=0.03)
    assert not s1.u[missing_in(mdp)].any()


def test_online_leaves_tuples_of_missing_actions_out():
    rng = np.random.default_rng(23)
    p, r, prior = random_masked(rng, 3, 3)
    data = collect(TabularMDP(p, np.where(prior > 0, r, 1e3)), 10, 300, 3)
    learner = EfficientS1(2.0, prior_policy=prior)
    kept = data.where(prior[data.s, data.a] > 0)
    cuts = [data.where(slice(i, i + 500)) for i in range(0, 3000, 500)]
    *_, found = learner.online([data.where(prior[data.s, data.a] == 0), *cuts], 3, 3)
    *_, alone = learner.online([kept], 3, 3)
    assert torch.equal(found.policy, alone.policy)
    assert found.n_tuples == len(kept)
    assert found.theta == alone.theta


@pytest.mark.parametrize("layout", ["lanes", "tables"])
@pytest.mark.parametrize("keep", [True, False])
def test_replicas_are_what_they_are_alone(layout, keep):
    mdp, uniform = problem_of(31)
    learner = AlgorithmS1(beta=2.0, lr_u=0.05, n_epochs=2, n_bias=3)
    simulation = Simulation(mdp, 20, 100, range(5), keep=keep)
    together = Replicas.of(learner, 5, layout=layout, block=3).fit(simulation, 4, 3)  # the prior is the model's
    for seed in range(5):
        data = collect(mdp, 20, 100, seed)
        alone = replace(learner, prior_policy=uniform).fit(data, 4, 3)
        assert torch.equal(together[seed].policy, alone.policy)
        assert torch.equal(together[seed].u, alone.u)
        assert together[seed].theta == alone.theta
        assert not alone.policy[missing_in(mdp)].any()


def test_replicas_on_tuples_and_on_torch():
    rng = np.random.default_rng(17)
    p, r, prior = random_masked(rng, 4, 3)
    mdp = TabularMDP(p, np.where(prior > 0, r, 1e3))
    learner = AlgorithmS1(beta=2.0, lr_u=0.05, n_epochs=2, n_bias=3, prior_policy=prior)
    streams = [collect(mdp, 20, 50, seed) for seed in range(3)]
    alone = [learner.fit(data, 4, 3) for data in streams]
    counts = Replicas.of(CertaintyEquivalence(2.0, prior_policy=prior), 3).fit(streams, 4, 3)
    assert not counts.policy[:, prior == 0].any()
    for one, other in zip(Replicas.of(learner, 3).fit(streams, 4, 3).solutions, alone, strict=True):
        assert torch.equal(one.policy, other.policy)
    shared = Replicas.of(learner, 2, lr_u=[0.05, 0.02]).fit(streams[0], 4, 3)
    assert torch.equal(shared[0].policy, alone[0].policy)
    on_torch = Replicas.of(learner, 2, backend="torch").fit(streams[0], 4, 3)
    np.testing.assert_allclose(on_torch[0].policy, alone[0].policy, rtol=1e-9)
    assert not on_torch.failures


def test_a_number_that_leaves_double_precision_is_still_found():
    """The mark of missing pairs hides no underflow of others."""
    prior = np.array([[0.5, 0.5, 0.0]])
    s = np.zeros(4000, int)
    a = np.arange(4000) % 2
    data = Transitions(s, a, np.where(a == 0, 0.0, -690.0), s, np.zeros(4000, int))
    learner = AlgorithmS1(beta=1.0, lr_u=1.0, lr_rho=1.0, n_epochs=1, n_bias=1, prior_policy=prior, rescale_every=1)
    narrow = replace(learner, prior_policy=prior[:, :2]).fit(data, 1, 2)
    found = learner.fit(data, 1, 3)
    assert found.status is narrow.status
    assert found.message == narrow.message


# -- intervals ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(4))
def test_intervals_are_those_without_the_column(seed):
    mdp, uniform = problem_of(300 + seed)
    data = collect(mdp, 20, 300, seed)
    narrow = theta_uncertainty(empirical_mdp(data, 4, 3), 2.0, uniform)
    wide = theta_uncertainty(empirical_mdp(data, 4, 4), 2.0, np.concatenate([uniform, np.zeros((4, 1))], 1))
    assert wide.withheld == narrow.withheld == ""
    assert wide.value == pytest.approx(narrow.value, abs=1e-9)
    assert wide.standard_error == pytest.approx(narrow.standard_error, rel=1e-6)
    np.testing.assert_allclose(wide.interval(), narrow.interval(), atol=1e-6)
    assert wide.untried == narrow.untried == (0.0, 0.0)
    # Visited, with prior 0: no draw of such a pair counts.
    full = TabularMDP(np.where(mdp.allowed[..., None], mdp.transition.toarray().reshape(4, 3, 4), 0.25), mdp.reward)
    logged = collect(full, 20, 300, seed)
    kept = logged.where(mdp.allowed[logged.s, logged.a])
    whole, part = (theta_uncertainty(empirical_mdp(one, 4, 3), 2.0, uniform) for one in (logged, kept))
    assert whole.value == pytest.approx(part.value, abs=1e-12)
    assert whole.standard_error == pytest.approx(part.standard_error, rel=1e-9)


# -- runs -----------------------------------------------------------------------------------------------------


def run(learner, problem, experience, directory):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        solution = erl_torch.train(learner, problem, experience, directory=directory)
    return solution, [str(warning.message) for warning in caught]


def test_runs_on_a_model(tmp_path):
    mdp, uniform = problem_of(41)
    data = collect(mdp, 20, 500, 0)
    for name, learner in {"exact": Exact(2.0), "efficient": EfficientS1(2.0), "s1": AlgorithmS1(2.0)}.items():
        experience = None if name == "exact" else data
        solution, notes = run(learner, mdp, experience, tmp_path / name)
        assert not solution.policy[missing_in(mdp)].any()
        assert notes == []  # a missing pair is no pair that was never visited
        assert solution.theta_bounds[0] <= -optimum(listed_of(mdp, uniform), 2.0)[0]
        assert erl_torch.Solution.load(tmp_path / name / "solution.npz").policy.equal(solution.policy)
    many, notes = run(Replicas.of(EfficientS1(2.0), 2), mdp, Simulation(mdp, 20, 500, [0, 1]), tmp_path / "many")
    assert not many.policy[:, missing_in(mdp)].any()
    assert notes == []
    with pytest.raises(InputError, match=r"learner.prior_policy\[\d, \d\]=0.3333333333333333: must be 0: state"):
        run(EfficientS1(2.0, prior_policy=np.full((4, 3), 1 / 3)), mdp, data, tmp_path / "refused")


def listed_of(mdp, prior):
    return listed(mdp.transition.toarray().reshape(*mdp.reward.shape, -1), mdp.reward, prior)


def test_runs_on_an_environment_that_tells_its_masks(tmp_path):
    from erl_torch.experience.sources import Simulate

    mdp, uniform = problem_of(43)
    env = Told(mdp)
    found, _ = run(CertaintyEquivalence(2.0), env, Simulate(40, 50), tmp_path / "default")
    data = collect(Told(mdp), 40, 50, 0)
    expected = CertaintyEquivalence(2.0, prior_policy=uniform).fit(data, 4, 3)
    np.testing.assert_allclose(found.policy, expected.policy, atol=1e-12)
    assert found.theta == pytest.approx(expected.theta, abs=1e-12)
    assert all(mdp.allowed[pair] for pair in env.taken)  # those of its evaluation too
    prior = random_policy(np.random.default_rng(0), 4, 3)
    found, _ = run(CertaintyEquivalence(2.0, prior_policy=prior), Told(mdp), Simulate(40, 50), tmp_path / "own")
    due = prior * mdp.allowed / (prior * mdp.allowed).sum(1, keepdims=True)
    data = collect(Told(mdp), 40, 50, 0, prior_policy=prior)
    expected = CertaintyEquivalence(2.0, prior_policy=due).fit(data, 4, 3)
    np.testing.assert_allclose(found.policy, expected.policy, atol=1e-12)
    many, _ = run(Replicas.of(AlgorithmS1(2.0), 2), Told(mdp), Simulate(20, 50), tmp_path / "many")
    assert not many.policy[:, missing_in(mdp)].any()


def test_a_log_with_actions_that_are_not_to_be_taken_is_noted(tmp_path):
    rng = np.random.default_rng(17)
    p, r, prior = random_masked(rng, 4, 3)
    mdp = TabularMDP(p, r)
    data = collect(mdp, 20, 100, 3)
    n = int((prior[data.s, data.a] == 0).sum())
    solution, notes = run(EfficientS1(2.0, prior_policy=prior), mdp, data, tmp_path)
    assert not solution.policy[prior == 0].any()
    assert notes == [f"{n:,} of 2,000 tuples are left out: the prior of their action is 0"]
    low, high, _ = optimum(listed(p, r, prior), 2.0)
    assert solution.theta_bounds[0] <= -low
    assert solution.theta_bounds[1] >= -high


def test_the_command_line_reads_a_model_with_missing_actions(tmp_path):
    mdp = harvest()
    mdp.save(tmp_path / "harvest.npz")
    np.save(tmp_path / "off.npy", np.full((10, 10), 0.1))
    keys = ["env=mdp", f"env.path={tmp_path}/harvest.npz", "learner.beta=1.0", "evaluation.pictures=false"]
    result = train(composed(*keys, "learner=exact"), tmp_path / "exact")
    assert result["theta"] == pytest.approx(-1.1717884570, abs=1e-9)
    few = ["learner=s1_efficient", "experience.n_episodes=20"]
    result = train(composed(*keys, *few), tmp_path / "learnt")
    assert result["status"] == "converged"
    assert not erl_torch.Solution.load(tmp_path / "learnt" / "solution.npz").policy[missing_in(mdp)].any()
    result = train(composed(*keys, *few, "n_replicas=2", "learner=s1"), tmp_path / "many")
    assert not erl_torch.ReplicaSolution.load(tmp_path / "many" / "replicas.npz").policy[:, missing_in(mdp)].any()
    with pytest.raises(InputError, match=r"behaviour_policy\[0, 1\]=0.1: must be 0: state 0 does not have action 1"):
        train(composed(*keys, *few, f"experience.behaviour_policy={tmp_path}/off.npy"), tmp_path / "refused")
    with pytest.raises(InputError, match=r"^env.use_action_mask=True: must be false: the environment has no method"):
        train(composed("env=cliff_walking", "env.use_action_mask=true"), tmp_path / "refused")


def test_taxi_has_fewer_actions_on_request(tmp_path):
    """The optimum is that of an iteration over each state's list, a sweep at a time."""
    from erl_torch import tabular_mdp

    env: Any = gym.make("Taxi-v4").unwrapped
    allowed = np.array([env.action_mask(s) for s in range(500)], bool)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        mdp = tabular_mdp(env, allowed=allowed)
    assert np.array_equal(mdp.allowed, allowed)
    p, r, value = mdp.transition, np.where(allowed, mdp.reward, -np.inf), np.zeros(500)
    follows = (p.toarray() > 0).reshape(500, 6, 500).any(1)
    reached = np.asarray(mdp.start > 0)
    for _ in range(100):
        reached = reached | follows[reached].any(0)
    for _ in range(20_000):
        q = r + (p @ value).reshape(500, 6)
        top = q.max(1)
        gain = top + np.log(np.exp(q - top[:, None]).sum(1) / allowed.sum(1)) - value
        if np.ptp(gain[reached]) < 1e-9:
            break
        value = value + 0.5 * (gain - gain[np.argmax(mdp.start)])
    keys = ["env=taxi", "learner=exact", "learner.beta=1.0", "evaluation.pictures=false"]
    result = train(composed(*keys, "env.use_action_mask=true"), tmp_path / "masked")
    assert result["theta"] == pytest.approx(-gain[reached].mean(), abs=1e-8)
    assert not erl_torch.Solution.load(tmp_path / "masked" / "solution.npz").policy[torch.tensor(~allowed)].any()
    with pytest.raises(InputError, match=r"^env.use_action_mask=True: must be false: there is no model \(P\) to read"):
        train(composed(*keys, "env.use_action_mask=true", "env.use_model=false"), tmp_path / "refused")


def test_a_problem_hands_its_mask_on():
    mdp, uniform = problem_of(47)
    env = TabularEnv(mdp)
    problem = Problem(env, mdp, uniform, mdp)
    assert np.array_equal(problem.allowed, mdp.allowed)
    learner = EfficientS1(2.0)
    np.testing.assert_allclose(learner.start(problem).policy, uniform, atol=1e-15)
    data = collect(mdp, 10, 100, 0)
    *_, state = learner.run(problem, data)
    assert not state.policy[missing_in(mdp)].any()
    exact = Exact(2.0)
    *_, state = exact.run(Problem(env, mdp, uniform, TabularMDP(np.full((4, 3, 4), 0.25), mdp.reward)))
    assert not state.policy[missing_in(mdp)].any()
    assert not exact.solution(state).policy[missing_in(mdp)].any()
    *_, states = Replicas.of(AlgorithmS1(2.0, n_bias=1, n_epochs=1), 2).run(problem, data)
    assert not states.policy[:, missing_in(mdp)].any()


def test_a_comparison_on_a_model():
    from erl_torch.run.compare import compare

    mdp, _ = problem_of(53)
    found = compare(mdp, {"ce": CertaintyEquivalence(2.0), "s1": AlgorithmS1(2.0, lr_u=0.05)}, 10, 200, seeds=2)
    assert np.isfinite(found.measures["gap"]).all()
    assert found.theta == pytest.approx(solve_soft_bellman(mdp, 2.0).theta, abs=1e-9)


def test_an_episode_takes_no_action_that_a_state_lacks():
    """A policy that did lost probability: bounds on a return that was too small."""
    transition = np.zeros((2, 2, 2))
    transition[0, 0, 1] = transition[1, :, 1] = 1.0
    mdp = TabularMDP(transition, [[1.0, -np.inf], [0.0, 0.0]], [1.0, 0.0])
    whole = erl_torch.evaluate_episodes(mdp, [[1.0, 0.0], [0.5, 0.5]], ends=np.array([False, True]))
    assert whole.mean_return.low <= 1.0 <= whole.mean_return.high
    with pytest.raises(InputError, match=r"policy\[0, 1\]"):
        erl_torch.evaluate_episodes(mdp, [[0.5, 0.5], [0.5, 0.5]], ends=np.array([False, True]))


@pytest.mark.parametrize("mask", [[True, False], np.ones((3, 4)), np.full((16, 4), 0.5), "all"])
def test_a_mask_of_another_shape_is_refused(mask):
    with pytest.raises(InputError, match="allowed"):
        erl_torch.tabular_mdp(gym.make("FrozenLake-v1"), allowed=mask)
    with pytest.raises(InputError, match="allowed"):
        erl_torch.tabular_mdp(gym.make("erl_torch/WindyCliff-v0"), allowed=mask)


class Masked(gym.Env):
    """One state, three actions, of which the mask leaves two; every step pays 0."""

    observation_space, action_space = gym.spaces.Discrete(1), gym.spaces.Discrete(3)
    info = {"action_mask": np.array([1, 1, 0], np.int8)}  # noqa: RUF012

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return 0, self.info

    def step(self, action):
        assert action < 2
        return 0, 0.0, False, False, self.info


@pytest.mark.parametrize(
    ("policy", "prior", "kl"),
    [
        ([0.5, 0.5, 0], None, 0.0),
        ([1 / 3] * 3, None, 0.0),
        ([1 / 3] * 3, [0.5, 0.5, 0], 0.0),
        ([0.9, 0.1, 0], None, 0.9 * np.log(1.8) + 0.1 * np.log(0.2)),
        ([0.45, 0.05, 0.5], [0.5, 0.5, 0], 0.9 * np.log(1.8) + 0.1 * np.log(0.2)),
    ],
)
def test_what_is_played_is_judged(policy, prior, kl):
    """The KL was that of the table, masked actions and all."""
    rng = np.random.default_rng(0)
    given = None if prior is None else np.array([prior])
    found = erl_torch.evaluate(Masked(), np.array([policy]), 2.0, rng, 3, 10, given)
    assert found.objective == pytest.approx(-kl / 2.0, abs=1e-12)


def test_the_bias_of_a_missing_action_is_none():
    transition = np.random.default_rng(0).dirichlet(np.ones(3), (3, 3))
    allowed = np.array([[True, True, False], [True, False, True], [True, True, True]])
    mdp = TabularMDP(transition, np.random.default_rng(1).random((3, 3)), allowed=allowed)
    data = erl_torch.collect(mdp, 10, 500)
    learnt = erl_torch.CertaintyEquivalence(beta=3.0, prior_policy=mdp.uniform_policy).fit(data, 3, 3)
    assert (learnt.reward_bias.numpy()[~allowed] == 0).all()
    assert (learnt.reward_bias.numpy()[allowed] > 0).all()
