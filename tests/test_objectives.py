"""Neighbours of the average reward (discounted, finite horizon, first exit): closed forms, an oracle of 40 digits."""

import re

import gymnasium as gym
import numpy as np
import pytest
from mpmath import mp, mpf

from erl_torch import (
    InputError,
    Status,
    TabularMDP,
    evaluate_episodes,
    solve_discounted,
    solve_finite_horizon,
    solve_first_exit,
    solve_soft_bellman,
    tabular_mdp,
)
from erl_torch.envs.windy_cliff import WindyCliffEnv
from erl_torch.solvers.discounted import _over
from erl_torch.solvers.first_exit import _certificate, _Inside
from erl_torch.solvers.problem import BellmanProblem

pytestmark = pytest.mark.filterwarnings("ignore::erl_torch.MeanRewardWarning")

CLIFF = WindyCliffEnv().mdp
DIGITS = 40


def random_mdp(rng, n, n_actions, ends=0):
    """A problem whose last ``ends`` states stay for ever without reward; the others may leave to anywhere."""
    p = rng.dirichlet(np.full(n, 10.0 ** rng.uniform(-1, 0.5)), (n, n_actions))
    p[rng.random(p.shape) < rng.uniform(0, 0.7)] = 0.0
    p[np.arange(n), :, (np.arange(n) + 1) % n] += 0.02
    if rng.random() < 0.3:  # differences of many orders
        p *= 10.0 ** rng.uniform(-6, 0, p.shape)
    r = rng.normal(size=(n, n_actions)) * 10.0 ** rng.uniform(-2, 2)
    if ends:
        r = -np.abs(r)
        p[-ends:] = np.eye(n)[-ends:, None]
        r[-ends:] = 0.0
    start = rng.dirichlet(np.ones(n))
    if ends:
        start[-ends:] = 0.0
    return TabularMDP(p / p.sum(2, keepdims=True), r, start / start.sum())


def random_prior(rng, n, n_actions):
    prior = rng.dirichlet(np.ones(n_actions), n) + 1e-6
    return prior / prior.sum(1, keepdims=True)


# -- an oracle of many digits, from the definitions -------------------------------------------------------------------


def digits(table):
    return [[mpf(float(x)) for x in row] for row in table]


def normalised(row):
    total = mp.fsum(row)
    return [x / total for x in row]


class Exact:
    """The stored problem, rows divided by their exact sums, in 40 digits. A discount is part of the rows."""

    def __init__(self, mdp, prior, beta, discount=1.0, ends=()):
        mp.dps = DIGITS
        dense = mdp.transition.toarray()
        self.n, self.n_actions = mdp.n_states, mdp.n_actions
        self.p = [[mpf(discount) * x for x in normalised(row)] for row in digits(dense)]
        self.r, self.prior, self.beta = digits(mdp.reward), [normalised(row) for row in digits(prior)], mpf(beta)
        self.live = [s for s in range(self.n) if s not in ends]

    def q(self, value, s):
        rows = range(s * self.n_actions, (s + 1) * self.n_actions)
        return [self.r[s][a] + mp.fdot(self.p[k], value) for a, k in enumerate(rows)]

    def backup(self, value):
        backed, policy = list(value), {}
        for s in self.live:
            q = self.q(value, s)
            top = max(q)
            weight = [w * mp.exp(self.beta * (x - top)) for w, x in zip(self.prior[s], q, strict=True)]
            total = mp.fsum(weight)
            backed[s], policy[s] = top + mp.log(total) / self.beta, [w / total for w in weight]
        return backed, policy

    def worth(self, policy, kl=True, table=None):
        """Solve x = c + K x for a policy {state: row}."""
        table = self.r if table is None else table
        k = len(self.live)
        system, right = mp.matrix(k, k), mp.matrix(k, 1)
        for i, s in enumerate(self.live):
            row = normalised(policy[s])
            for a, share in enumerate(row):
                if share:
                    right[i] += share * table[s][a]
                    if kl:
                        right[i] -= share * mp.log(share / self.prior[s][a]) / self.beta
            for j, t in enumerate(self.live):
                into = mp.fsum(share * self.p[s * self.n_actions + a][t] for a, share in enumerate(row))
                system[i, j] = (1 if i == j else 0) - into
        x = mp.lu_solve(system, right)
        value = [mpf(0)] * self.n
        for i, s in enumerate(self.live):
            value[s] = x[i]
        return value

    def optimum(self):
        policy = {s: self.prior[s] for s in self.live}
        value = self.worth(policy)
        for _ in range(200):
            new = self.worth(self.backup(value)[1])
            change = max(abs(x - y) for x, y in zip(new, value, strict=True))
            value = new
            if change < mpf(10) ** -28 * (1 + max(map(abs, value))):
                return value
        raise ArithmeticError("no optimum")


def within(low, exact, high):
    return all(mpf(float(a)) <= x <= mpf(float(b)) for a, x, b in zip(low, exact, high, strict=True))


def table_of(policy):
    return dict(enumerate(digits(policy)))


# -- discounted -------------------------------------------------------------------------------------------------------


def test_discounted_value_of_one_state_is_a_geometric_series():
    """Every step is worth log(mean exp(r)) at beta 1, and later ones less."""
    mdp = TabularMDP([[[1.0], [1.0]]], [[1.0, 3.0]])
    for discount in (0.0, 0.3, 0.9, 0.999999):
        found = solve_discounted(mdp, 1.0, discount)
        exact = np.log(0.5 * (np.e + np.e**3)) / (1 - discount)
        assert found.value.item() == pytest.approx(exact, rel=1e-14)
        assert found.status is Status.CONVERGED


def test_discounted_value_of_a_chain():
    """0 -> 1 -> 2, which stays, each step paying its number: V(0) = 0 + d (1 + d 2/(1 - d))."""
    p = np.zeros((3, 1, 3))
    p[0, 0, 1] = p[1, 0, 2] = p[2, 0, 2] = 1
    found = solve_discounted(TabularMDP(p, [[0.0], [1.0], [2.0]]), 5.0, 0.75)
    assert found.value.tolist() == pytest.approx([0.75 * (1 + 0.75 * 8), 7.0, 8.0], rel=1e-14)


@pytest.mark.parametrize("beta", [1.0, 10.0])
def test_discounted_nears_the_average_reward(beta):
    best = solve_soft_bellman(CLIFF, beta)
    for left in (1e-3, 1e-6, 1e-9, 1e-12):
        found = solve_discounted(CLIFF, beta, 1 - left)
        assert found.status is Status.CONVERGED
        left = 1 - (1 - left)  # as a double has it
        # Blackwell: (1 - discount) V = g + (1 - discount) h + ..., h at most the span of the relative value
        span = float(best.value.max() - best.value.min())
        assert np.abs(left * found.value.numpy() + best.theta).max() < 2 * left * span + 1e-9
        assert np.allclose(found.policy, best.policy, atol=1e-6 + 100 * left)


def test_discounted_bounds_hold_in_forty_digits():
    rng = np.random.default_rng(1)
    for _ in range(150):
        n, n_actions = int(rng.integers(1, 5)), int(rng.integers(1, 4))
        mdp, prior = random_mdp(rng, n, n_actions), random_prior(rng, n, n_actions)
        beta, discount = 10.0 ** rng.uniform(-2, 3), 1 - 10.0 ** -rng.uniform(0.05, 9)
        found = solve_discounted(mdp, beta, discount, prior)
        assert found.status is Status.CONVERGED
        oracle = Exact(mdp, prior, beta, discount)
        exact = oracle.optimum()
        assert within(found.value_low, exact, found.value_high)
        own = oracle.worth(table_of(found.policy.numpy()))
        assert max(a - b for a, b in zip(exact, own, strict=True)) <= mpf(found.gap)
        size = np.abs(found.value.numpy()).max()
        q = np.array([[float(x) for x in oracle.q(exact, s)] for s in range(n)])
        assert np.abs(found.action_value.numpy() - q).max() <= 1e-9 * max(size, np.abs(q).max())
        assert found.gap <= 2.5 * float((found.value_high - found.value_low).max())
        assert found.gap <= 1e-9 * size
        assert float((found.value_high - found.value_low).max()) <= 1e-10 * size * (1 + 1e-6)


def test_quotients_are_rounded_outwards():
    mp.dps = DIGITS
    for x in np.random.default_rng(2).normal(size=200):
        for discount in (0.1, 0.7, 1 - 1e-9):
            low, high = _over(x, x, discount)
            assert mpf(low) < mpf(float(x)) / (1 - mpf(discount)) < mpf(high)


@pytest.mark.parametrize("order", [[0, 1, 2], [2, 1, 0], [1, 0, 2]])
def test_a_state_that_is_hardly_ever_met_costs_no_digits(order):
    """0 is left at once, and met with share 1e-12. Wherever it stands."""
    p = np.array([[[0, 1, 0]] * 2, [[1e-12, 0.5, 0.5 - 1e-12]] * 2, [[0, 0.3, 0.7]] * 2])
    r = np.array([[5.0, 1.0], [1.0, 2.0], [3.0, -1.0]])
    mdp = TabularMDP(p[order][:, :, order], r[order], np.full(3, 1 / 3))
    found = solve_discounted(mdp, 1.0, 1 - 1e-8)
    assert found.status is Status.CONVERGED
    assert float((found.value_high - found.value_low).max()) < 1e-9 * found.value.abs().max()


@pytest.mark.parametrize("discount", [1.0, -0.1, np.nan, "0.9"])
def test_discounts_out_of_range_are_named(discount):
    with pytest.raises(InputError, match=r"discount=.*: must be a number in \[0, 1\)"):
        solve_discounted(CLIFF, 1.0, discount)


# -- finite horizon ---------------------------------------------------------------------------------------------------


def test_finite_horizon_of_one_state_is_a_sum():
    mdp = TabularMDP([[[1.0], [1.0]]], [[1.0, 3.0]])
    found = solve_finite_horizon(mdp, 1.0, 50)
    one = np.log(0.5 * (np.e + np.e**3))
    assert found.value[:, 0].numpy() == pytest.approx(one * np.arange(50, -1, -1), rel=1e-13)


def test_finite_horizon_nears_the_average_reward():
    """Soft values without a prior, as imitation's partition function has them, are larger by log 4 a step (beta 1)."""
    found = solve_finite_horizon(CLIFF, 1.0, 200)
    theta = solve_soft_bellman(CLIFF, 1.0).theta
    step = found.value[0] - found.value[1]
    assert np.allclose(step, -theta, rtol=0, atol=1e-12)
    assert np.allclose(step + np.log(4), 0.166953258741, rtol=0, atol=1e-11)


def test_finite_horizon_bounds_hold_in_forty_digits():
    rng = np.random.default_rng(2)
    for _ in range(100):
        n, n_actions, horizon = int(rng.integers(1, 5)), int(rng.integers(1, 4)), int(rng.integers(1, 30))
        mdp, prior, beta = random_mdp(rng, n, n_actions), random_prior(rng, n, n_actions), 10.0 ** rng.uniform(-2, 3)
        last = rng.normal(size=n)
        found = solve_finite_horizon(mdp, beta, horizon, prior, last)
        oracle = Exact(mdp, prior, beta)
        exact = [mpf(float(x)) for x in last]
        own = list(exact)
        for t in range(horizon - 1, -1, -1):
            exact, _ = oracle.backup(exact)
            assert within(found.value_low[t], exact, found.value_high[t])
            rows = table_of(found.policy[t].numpy())
            new = []
            for s in range(n):
                row, q = normalised(rows[s]), oracle.q(own, s)
                new.append(
                    mp.fsum(w * (q[a] - mp.log(w / oracle.prior[s][a]) / oracle.beta) for a, w in enumerate(row) if w)
                )
            own = new
        assert max(a - b for a, b in zip(exact, own, strict=True)) <= mpf(found.gap)
        size = max(np.abs(found.value.numpy()).max(), np.abs(mdp.reward).max())
        assert found.gap <= 1e-11 * size


def test_the_gap_of_a_finite_horizon_is_of_all_states():
    """State 0 is worth 0 for ever, without rounding; the policy of state 1 has an error of beta eps |V|."""
    p = np.zeros((4, 2, 4))
    p[0, :, 0] = p[2, :, 2] = p[3, :, 3] = 1
    p[1, 0, 2] = p[1, 1, 3] = 1
    mdp = TabularMDP(p, [[0.0, 0.0], [1 / 3, 0.1], [0.0, 0.0], [0.0, 0.0]], [0.25] * 4)
    last = [0.0, 0.0, 1e6, 1e6 + 0.2333333]
    beta = 1e6
    found = solve_finite_horizon(mdp, beta, 1, last_value=last)
    oracle = Exact(mdp, np.full((4, 2), 0.5), beta)
    value = [mpf(x) for x in last]
    exact, row, q = oracle.backup(value)[0], normalised(digits(found.policy[0].numpy())[1]), oracle.q(value, 1)
    worth = mp.fsum(w * (q[a] - mp.log(2 * w) / mpf(beta)) for a, w in enumerate(row) if w)
    assert 0 < exact[1] - worth <= mpf(found.gap)


# -- first exit -------------------------------------------------------------------------------------------------------


def loop(reward, leave=0.0):
    """State 0: action 0 stays, but for ``leave``, and pays ``reward``; action 1 ends, in state 1, and pays 0."""
    p = [[[1 - leave, leave], [0.0, 1.0]], [[0.0, 1.0], [0.0, 1.0]]]
    return TabularMDP(p, [[reward, 0.0], [0.0, 0.0]], [1.0, 0.0])


@pytest.mark.parametrize("beta", [0.1, 1.0, 30.0])
@pytest.mark.parametrize("reward", [-2.0, -0.01, 0.0])
def test_a_way_round_that_costs(beta, reward):
    """e^(bV) = (e^(br) e^(bV) + 1)/2: V = -log(2 - e^(br))/b."""
    found = solve_first_exit(loop(reward), beta)
    assert found.status is Status.CONVERGED
    assert found.value[0].item() == pytest.approx(-np.log(2 - np.exp(beta * reward)) / beta, rel=1e-11, abs=1e-300)
    assert [c.states.tolist() for c in found.avoiding] == [[0]]
    assert found.avoiding[0].actions.tolist() == [[True, False]]
    stay = np.exp(beta * reward) / 2  # pi(stay) = e^(br) prior
    assert found.policy[0, 0].item() == pytest.approx(stay, rel=1e-9)
    assert found.steps[0].item() == pytest.approx(1 / (1 - stay), rel=1e-9)
    assert 1 / (1 - stay) <= found.steps_bound[0].item() < 1.1 / (1 - stay)


@pytest.mark.parametrize("margin", [1e-3, -1e-3, -0.3, -5.0])
def test_a_way_round_that_pays_has_no_value(margin):
    """It pays from r = log(2)/beta on, where e^(br) = 2."""
    found = solve_first_exit(loop(np.log(2) - margin), 1.0)
    if margin > 0:
        assert found.status is Status.CONVERGED
        assert found.value[0].item() == pytest.approx(-np.log(2 - 2 * np.exp(-margin)), rel=1e-8)
    else:
        assert found.status is Status.ILL_POSED
        assert found.value[0].item() == np.inf
        assert found.start_bounds == (np.inf, np.inf)
        assert "in [0] actions [0] never lead to an end, at a regularised rate of" in found.message
        assert not found.solved.any()
        assert found.policy[0].tolist() == [0.5, 0.5]


def test_a_pole_that_need_not_fall_is_ill_posed():
    """+1 a step, and a policy that never ends: as CartPole's true game. Where every action may end, it has a value."""
    assert solve_first_exit(loop(1.0), 10.0).status is Status.ILL_POSED
    found = solve_first_exit(loop(1.0, leave=0.5), 10.0)  # pays up to 1 + 1/2 + 1/4 + ... for staying
    assert found.status is Status.CONVERGED
    assert not found.avoiding
    assert 1.8 < found.value[0].item() < 2.0


def test_a_critical_way_round_is_not_called_ill_posed():
    """The lap loses a little, about 1e-16: the value is finite, and rounding cannot tell."""
    for stay, beta, lap in ((0.75, 4.818, -1e-16), (0.5, 1.0, -1e-15), (0.9, 20.0, -3e-17)):
        p = np.zeros((2, 2, 2))
        p[0, 0, 0] = p[0, 1, 1] = p[1, :, 1] = 1.0
        mdp = TabularMDP(p, [[lap - np.log(stay) / beta, 0.0], [0.0, 0.0]], [1.0, 0.0])
        prior = np.array([[stay, 1 - stay], [0.5, 0.5]])
        assert solve_first_exit(mdp, beta, prior).status is not Status.ILL_POSED


def test_a_break_even_way_round_is_not_solved():
    """r = log(2)/beta but for rounding: neither finite nor infinite can be said."""
    found = solve_first_exit(loop(np.log(2)), 1.0)
    assert found.status is Status.STAGNATED
    assert "which rounding hides" in found.message
    assert not found.solved.any()  # so that the policy is the prior
    assert found.value[0].isnan()
    assert found.value_high[0].item() == np.inf


def test_states_that_cannot_end_are_named_and_never_entered():
    """0 may go to 1 (ends) or to 2, which never ends: the action that may lead there is never taken."""
    p = np.zeros((4, 2, 4))
    p[0, 0] = [0.5, 0.5, 0, 0]
    p[0, 1] = [0, 0.5, 0.5, 0]
    p[1, :, 3] = p[2, :, 2] = p[3, :, 3] = 1
    mdp = TabularMDP(p, [[-1.0, 5.0], [-1, -1], [-1, -1], [0, 0]], [1.0, 0, 0, 0])
    found = solve_first_exit(mdp, 2.0, ends=[False, False, False, True])
    # V(0) = -1 - log(2)/2 + (V(0) + V(1))/2, V(1) = -1
    assert found.value[0].item() == pytest.approx(2 * (-1.5 - np.log(2) / 2), rel=1e-12)
    assert found.value.tolist()[1:] == [-1.0, -np.inf, 0.0]
    assert found.policy[0].tolist() == [1.0, 0.0]
    assert found.action_value[0, 1].item() == -np.inf
    assert found.solved.tolist() == [True, True, False, False]
    assert found.status is Status.CONVERGED
    assert "no end can be reached from states [2]" in found.message


def test_a_model_without_an_end_is_refused():
    with pytest.raises(InputError, match=r"ends=None: must be given.*absorb.*terminated"):
        solve_first_exit(CLIFF, 1.0)
    with pytest.raises(InputError, match="ends=false everywhere"):
        solve_first_exit(CLIFF, 1.0, ends=np.zeros(CLIFF.n_states, bool))
    p = np.eye(2)[:, None]  # an end that is never met
    with pytest.raises(InputError, match=r"ends=\[\]: must be reached, for certain"):
        solve_first_exit(TabularMDP(p, [[-1.0], [0.0]], [1.0, 0.0]), 1.0)


def test_rewards_that_carry_the_prior_left_out_are_between_their_bounds():
    """r + log(1 - p_out)/beta, p_out the prior of the pairs that may lead to where no end can be reached."""
    rng = np.random.default_rng(12)
    mp.dps = DIGITS
    p = np.zeros((3, 4, 3))
    p[0, :3, 1] = p[0, 3, 2] = p[1, :, 1] = p[2, :, 2] = 1
    for _ in range(200):
        prior = np.full((3, 4), 0.25)
        prior[0] = rng.dirichlet(10.0 ** rng.uniform(-1, 1, 4)) + 1e-12
        prior[0] /= prior[0].sum()
        beta, r = 10.0 ** rng.uniform(-2, 3), rng.normal(size=4) * 10.0 ** rng.uniform(-3, 1)
        mdp = TabularMDP(p, np.vstack([r, np.zeros((2, 4))]), [1.0, 0, 0])
        problem = BellmanProblem.of(mdp, beta, prior)
        inside = _Inside.of(problem, problem.states == 1)
        assert inside.names.tolist() == [0]
        row = [mpf(float(x)) for x in problem.prior[0]]
        left = mp.log(mp.fsum(row[:3]) / mp.fsum(row)) / mpf(beta)
        for a in range(3):
            assert mpf(inside.low[0, a]) < mpf(float(r[a])) + left < mpf(inside.high[0, a])


def test_bounds_hold_whatever_value_and_steps_they_are_made_from():
    mdp = random_mdp(np.random.default_rng(13), 5, 2, 1)
    problem = BellmanProblem.of(mdp, 2.0)
    inside = _Inside.of(problem, problem.states == 4)
    found = solve_first_exit(mdp, 2.0)
    exact, steps = np.append(found.value[:4], 0.0), np.append(found.steps[:4], 0.0)
    for shift in (1.0, -1.0):
        for share in (1.0, 0.1):
            below, above, bound = _certificate(inside, exact + shift * (steps > 0), share * steps)
            assert (below <= exact[:4] + 1e-9).all()
            assert (above >= exact[:4] - 1e-9).all()
            assert (bound >= steps[:4] - 1e-9).all()


def test_the_rate_of_a_way_round_is_told():
    """Staying alone: r + log(1/2)/beta."""
    for beta, reward in ((1.0, 2.0), (5.0, 0.3), (0.5, 3.0)):
        low, high = map(
            float, re.search("rate of (.+) to ([^:]+): ", solve_first_exit(loop(reward), beta).message).groups()
        )
        rate = reward - np.log(2) / beta
        assert low == pytest.approx(rate, rel=1e-5)
        assert high == pytest.approx(rate, rel=1e-5)


def test_an_end_at_the_start_is_worth_nothing():
    found = solve_first_exit(TabularMDP([[[1.0]]], [[0.0]]), 1.0)
    assert (found.status, found.start_bounds) == (Status.CONVERGED, (0.0, 0.0)) or max(
        map(abs, found.start_bounds)
    ) < 1e-300


def test_first_exit_bounds_hold_in_forty_digits():
    rng = np.random.default_rng(3)
    counted = {}
    for _ in range(250):
        n, n_actions, ends = int(rng.integers(2, 6)), int(rng.integers(1, 4)), 1
        mdp, prior = random_mdp(rng, n, n_actions, ends), random_prior(rng, n, n_actions)
        if n_actions > 1 and rng.random() < 0.5:  # an action that stays, at a loss or a gain
            p = mdp.transition.toarray().reshape(n, n_actions, n)
            p[0, 0] = np.eye(n)[0]
            r = mdp.reward.copy()
            r[0, 0] *= rng.choice([1.0, 1e-3, -1e-2, -1.0])
            mdp = TabularMDP(p, r, mdp.start)
        beta = 10.0 ** rng.uniform(-2, 3)
        found = solve_first_exit(mdp, beta, prior)
        counted[found.status] = counted.get(found.status, 0) + 1
        if found.status is Status.ILL_POSED:
            # The loop's own rate, r + log(prior)/beta, is what pays.
            assert any(
                mdp.reward[s, a] + np.log(prior[s, a]) / beta >= -1e-12
                for c in found.avoiding
                for s, row in zip(c.states, c.actions, strict=True)
                for a in np.flatnonzero(row)
            )
            continue
        if n_actions == 1 and not found.solved.all() and "no end can be reached" in found.message:
            continue
        assert found.status in (Status.CONVERGED, Status.STAGNATED)
        live = np.flatnonzero(found.solved.numpy())
        oracle = Exact(mdp, prior, beta, ends=set(range(n)) - set(live.tolist()))
        exact = oracle.optimum()
        assert within(found.value_low[live], [exact[s] for s in live], found.value_high[live])
        own = oracle.worth(table_of(found.policy.numpy()))
        assert max(exact[s] - own[s] for s in live) <= mpf(found.gap)
        best = oracle.backup(exact)[1]
        ones = [[mpf(1)] * n_actions for _ in range(n)]
        steps = oracle.worth(best, kl=False, table=ones)
        assert all(steps[s] <= mpf(found.steps_bound[s].item()) for s in live)
        assert all(abs(steps[s] - found.steps[s].item()) <= 1e-6 * steps[s] for s in live)
    assert counted[Status.CONVERGED] > 150
    assert counted[Status.ILL_POSED] > 5


@pytest.mark.parametrize(
    ("env_id", "beta", "value", "mean_return"),
    [
        ("CliffWalking-v1", 1, -29.80865227, -15.171879),
        ("CliffWalking-v1", 10, -14.80217813, -13.000045),
        ("CliffWalking-v1", 100, -13.18021827, -13.0),
        ("Taxi-v4", 1, -12.35389850, 6.606134),
        ("Taxi-v4", 10, 5.79306741, 7.929891),
        ("Taxi-v4", 100, 7.71630566, 7.930000),
    ],
)
def test_first_exit_of_toy_text(env_id, beta, value, mean_return):
    mdp = tabular_mdp(gym.make(env_id), "absorb")
    found = solve_first_exit(mdp, beta)
    assert found.status is Status.CONVERGED
    assert found.start_bounds == pytest.approx((value, value), abs=6e-9)
    assert evaluate_episodes(mdp, found.policy).mean_return.value == pytest.approx(mean_return, abs=6e-7)


@pytest.mark.parametrize(
    ("size", "beta", "success"),
    [
        ("4x4", 5, 0.021903),
        ("4x4", 20, 0.049830),
        ("4x4", 100, 0.631710),
        ("4x4", 300, 0.823529),
        ("4x4", 3000, 14 / 17),
        ("8x8", 100, 0.617768),
        ("8x8", 300, 0.930631),
        ("8x8", 1000, 0.986744),
        ("8x8", 3000, 1.0),
    ],
)
def test_first_exit_of_the_lake(size, beta, success):
    env = gym.make("FrozenLake-v1", map_name=size)
    mdp = tabular_mdp(env, "absorb")
    found = solve_first_exit(mdp, beta)
    goal = np.arange(mdp.n_states) == mdp.n_states - 1
    figures = evaluate_episodes(mdp, found.policy, successes=goal)
    assert figures.success_rate.value == pytest.approx(success, abs=6e-7)
    assert figures.mean_return.value == pytest.approx(figures.success_rate.value, abs=1e-12)
    if (size, beta) == ("4x4", 100):
        assert found.start_bounds == pytest.approx((0.24049896, 0.24049896), abs=6e-9)
        assert found.avoiding[0].states.tolist() == [0, 1, 2, 3]  # the top row, going up
        assert np.argwhere(found.avoiding[0].actions).tolist() == [[s, 3] for s in range(4)]


def test_the_prior_of_the_cliff_walk():
    """-65,375 in 6,453 steps."""
    mdp = tabular_mdp(gym.make("CliffWalking-v1"), "absorb")
    figures = evaluate_episodes(mdp, np.full((48, 4), 0.25))
    assert figures.mean_return.value == pytest.approx(-65375.13, abs=0.01)
    assert figures.steps.value == pytest.approx(6453.12, abs=0.01)
    taxi = tabular_mdp(gym.make("Taxi-v4"), "absorb")
    assert evaluate_episodes(taxi, np.full((500, 6), 1 / 6)).mean_return.value == pytest.approx(-9681.79, abs=0.01)


# -- episodes of a policy ---------------------------------------------------------------------------------------------


def test_the_gambler_is_ruined():
    """A walk on 0..n, up with probability p: known chances, known lengths."""
    n, up = 10, 0.6
    p = np.zeros((n + 1, 1, n + 1))
    for s in range(1, n):
        p[s, 0, s + 1], p[s, 0, s - 1] = up, 1 - up
    p[0, 0, 0] = p[n, 0, n] = 1
    mdp = TabularMDP(p, [[0.0], *[[-1.0]] * (n - 1), [0.0]], np.eye(n + 1)[3])
    figures = evaluate_episodes(mdp, np.ones((n + 1, 1)), successes=np.arange(n + 1) == n)
    odds = (1 - up) / up
    chance = (1 - odds**3) / (1 - odds**n)
    length = 3 / (1 - 2 * up) - n / (1 - 2 * up) * chance
    for figure, exact in zip(figures, (-length, chance, length), strict=True):
        assert figure.value == pytest.approx(exact, rel=1e-12)
        assert figure.low <= figure.value <= figure.high
        assert figure.high - figure.low < 1e-11 * length


def test_figures_of_episodes_hold_in_forty_digits():
    rng = np.random.default_rng(4)
    for _ in range(150):
        n, n_actions = int(rng.integers(3, 6)), int(rng.integers(1, 4))
        mdp = random_mdp(rng, n, n_actions, 2)
        policy = random_prior(rng, n, n_actions)
        horizon = None if rng.random() < 0.7 else int(rng.integers(1, 20))
        successes = np.arange(n) == n - 1
        figures = evaluate_episodes(mdp, policy, successes=successes, horizon=horizon)
        oracle = Exact(mdp, policy, 1.0, ends={n - 2, n - 1})
        chance = [[oracle.p[s * n_actions + a][n - 1] for a in range(n_actions)] for s in range(n)]
        ones = [[mpf(1)] * n_actions for _ in range(n)]
        start = normalised([mpf(float(x)) for x in mdp.start])
        for figure, table in zip(figures, (oracle.r, chance, ones), strict=True):
            if horizon is None:
                x = oracle.worth(table_of(policy), kl=False, table=table)
            else:
                x = [mpf(0)] * n
                for _ in range(horizon):
                    new = list(x)
                    for s in oracle.live:
                        new[s] = mp.fsum(
                            w * (table[s][a] + mp.fdot(oracle.p[s * n_actions + a], x))
                            for a, w in enumerate(oracle.prior[s])
                        )
                    x = new
            exact = mp.fdot(start, x)
            assert mpf(figure.low) <= exact <= mpf(figure.high)
            assert figure.high - figure.low <= 1e-9 * max(abs(figure.value), figures.steps.value)


def test_episodes_that_never_end():
    """Up and down the lake's top row for ever: no return, no success, no end."""
    mdp = tabular_mdp(gym.make("FrozenLake-v1", is_slippery=False), "absorb")
    figures = evaluate_episodes(mdp, np.eye(4)[np.full(16, 3)])
    assert figures.steps.value == np.inf
    assert figures.success_rate.value == 0
    assert figures.mean_return.value == 0
    cliff = tabular_mdp(gym.make("CliffWalking-v1"), "absorb")
    assert (figures := evaluate_episodes(cliff, np.eye(4)[np.zeros(48, int)])).steps.low == np.inf
    assert (figures.mean_return.low, figures.mean_return.high) == (-np.inf, np.inf)


def test_only_ends_are_successes_and_only_what_is_done_pays():
    """0 goes to the end 1, or, with chance 1/2, to 2, which stays for ever; there another action would pay."""
    p = np.zeros((3, 2, 3))
    p[0, :, 1] = p[0, :, 2] = 0.5
    p[1, :, 1] = p[2, :, 2] = 1
    mdp = TabularMDP(p, [[-1.0, -1.0], [0, 0], [0, 7.0]], [1.0, 0, 0])
    policy = [[1.0, 0.0]] * 3
    ends = [False, True, False]
    figures = evaluate_episodes(mdp, policy, ends, successes=[True, True, True])
    assert figures == evaluate_episodes(mdp, policy, ends, successes=ends) == evaluate_episodes(mdp, policy, ends)
    assert figures.mean_return.value == pytest.approx(-1.0)
    assert figures.success_rate.value == pytest.approx(0.5)
    assert figures.steps.value == np.inf
    assert np.isnan(evaluate_episodes(mdp, [[0.5, 0.5]] * 3, ends).mean_return.value)


def test_what_is_beyond_double_precision_is_no_number():
    """60 steps forward in a row, with chance 1e-6 each, else back: 1e360 steps."""
    n = 61
    p = np.zeros((n, 1, n))
    p[np.arange(n - 1), 0, np.arange(1, n)] = 1e-6
    p[: n - 1, 0, 0] += 1 - 1e-6
    p[-1, 0, -1] = 1
    mdp = TabularMDP(p, np.append(-np.ones(n - 1), 0.0)[:, None], np.eye(n)[0])
    figures = evaluate_episodes(mdp, np.ones((n, 1)))
    for figure, low in zip(figures, (-np.inf, 0.0, 0.0), strict=True):
        assert np.isnan(figure.value)
        assert figure.low == low
    assert (figures.mean_return.high, figures.success_rate.high, figures.steps.high) == (np.inf, 1.0, np.inf)
    found = solve_first_exit(mdp, 1.0)
    assert found.status is Status.STAGNATED
    assert not found.solved.any()
    assert found.value[:-1].isnan().all()
    assert found.steps[:-1].isnan().all()
    assert found.action_value[:-1].isnan().all()
    assert (found.value_low[:-1] == -np.inf).all()
    assert (found.value_high[:-1] == np.inf).all()


# -- missing actions --------------------------------------------------------------------------------------------------


def test_a_missing_action_is_as_if_another_had_its_prior():
    """An action that does not exist, against one that is the copy of an existing one, whose prior the two share."""
    rng = np.random.default_rng(9)
    for _ in range(20):
        p, r = rng.dirichlet(np.ones(4), (4, 3)), -rng.random((4, 3))
        p[3], r[3] = np.eye(4)[3], 0.0
        start = [0.5, 0.3, 0.2, 0.0]
        missing = rng.random((4, 3)) < 0.4
        missing[np.arange(4), rng.integers(0, 3, 4)] = False
        copied, paid, prior = p.copy(), r.copy(), np.zeros((4, 3))
        for s in range(4):
            there, gone = np.flatnonzero(~missing[s]), np.flatnonzero(missing[s])
            prior[s, there] = 1 / len(there)
            copied[s, gone], paid[s, gone] = p[s, there[0]], r[s, there[0]]
            prior[s, [there[0], *gone]] /= 1 + len(gone)
            prior[s, gone] = prior[s, there[0]]
        mdp, twin = TabularMDP(p, np.where(missing, -np.inf, r), start), TabularMDP(copied, paid, start)
        for solve in (
            lambda m, prior: solve_discounted(m, 3.0, 0.9, prior),
            lambda m, prior: solve_finite_horizon(m, 3.0, 7, prior),
            lambda m, prior: solve_first_exit(m, 3.0, prior),
        ):
            found, other = solve(mdp, None), solve(twin, prior)
            assert found.status is Status.CONVERGED
            assert np.allclose(found.value, other.value, rtol=0, atol=1e-11)
            assert not found.policy.numpy()[..., missing].any()
            assert np.isneginf(found.action_value.numpy()[..., :3, :][..., missing[:3]]).all()
            assert found.gap < 1e-10


def test_figures_between_infinite_bounds_are_no_numbers():
    """40 states uphill, up by .05: about 1e50 steps to the end; the value was a number outside its bounds."""
    n, up = 40, 0.05
    p = np.zeros((n + 1, 1, n + 1))
    for s in range(n):
        p[s, 0, s + 1] += up
        p[s, 0, max(s - 1, 0)] += 1 - up
    p[n, 0, n] = 1
    mdp = TabularMDP(p, np.where(np.arange(n + 1) < n, -1.0, 0.0)[:, None], np.eye(n + 1)[0])
    found = evaluate_episodes(mdp, np.ones((n + 1, 1)), np.arange(n + 1) == n)
    for figure in (found.mean_return, found.steps):
        assert np.isnan(figure.value) or figure.low <= figure.value <= figure.high
        assert np.isnan(figure.value) or np.isfinite([figure.low, figure.high]).all()
