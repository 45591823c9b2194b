"""Policies, evaluated on a known model (``erl_torch.solvers.policy``) or by playing episodes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike

from erl_torch import checks
from erl_torch.checks import InputError
from erl_torch.envs.encoded import encoded
from erl_torch.experience import kernels as experience_kernels
from erl_torch.experience.collect import batched
from erl_torch.experience.play import Draws, Plan, episode, reset
from erl_torch.experience.sampling import policy_cdf, sampling_tables
from erl_torch.mdp.ends import EndRule
from erl_torch.mdp.from_gymnasium import ending_states, known_mdp, sizes
from erl_torch.mdp.tabular import TabularMDP, check_policy, check_prior
from erl_torch.rng import Streams
from erl_torch.solvers import kernels as solvers_kernels
from erl_torch.solvers.certificates import one_step_worth, policy_gains
from erl_torch.solvers.chains import GTH_STATES, classes
from erl_torch.solvers.policy import kl_per_state, objective, reward_per_step


class Evaluation(NamedTuple):
    """Figures of one policy in one environment."""

    mean_return: float  # undiscounted return of an episode, mean over sampled episodes
    reward_per_step: float  # exact over the horizon where the model is known, else sampled
    objective: float  # stationary reward rate - KL/beta, as ``objective``, where the model is known; else sampled
    success_rate: float = np.nan  # of episodes within the horizon; NaN where it is not known what a success is
    objective_real: float = np.nan  # the objective at optimism 0, in the real world, where that of the run is another


def evaluate(
    source: TabularMDP | gym.Env[Any, Any],
    policy: ArrayLike,
    beta: float,
    rng: np.random.Generator,
    n_episodes: int = 20,
    horizon: int = 1000,
    prior_policy: ArrayLike | None = None,
    mdp: TabularMDP | None = None,
    mean_return: Callable[[np.ndarray], float] | None = None,
    success_rate: Callable[[np.ndarray], float] | None = None,
    ends: EndRule | None = None,
    *,
    optimism: float = 0.0,
) -> Evaluation:
    """Evaluate ``policy`` [S, A]: on the model where it is known, by playing episodes otherwise.

    On the model, reward per step and objective are exact up to rounding, with the exceptions that ``objective`` names.

    Args:
        source: where the episodes are played; they end after ``horizon`` steps, or where the environment ends them.
        policy: [S, A]; 0 where the model's state does not have the action. In an environment that masks actions, those
            that are left are played, with their shares; but as it is where there is a model that has all actions.
        beta: inverse temperature, 1/reward.
        rng: draws the episodes.
        n_episodes: whole number >= 1, episodes behind ``mean_return``.
        horizon: whole number >= 1, steps of an episode, and of the exact reward per step.
        prior_policy: [S, A], 0 where an action is not to be taken; None is uniform over the actions of each state.
        mdp: the model behind reward per step and objective; None is ``known_mdp(source)``.
        mean_return: computes the mean return of a policy [S, A]; no episodes are played then.
        success_rate: computes the success rate of a policy [S, A]; None counts episodes played.
        ends: which ends of episodes played are failures. What it adds to their rewards counts in reward per step and
            objective, not in the return. None: it is not known.
        optimism: 1 optimistic (control as inference), 0 right, negative robust, as in ``solve_soft_bellman``; it
            counts in the objective alone, which is NaN at any other than 0 where no model is known.

    Raises:
        InputError: an argument out of range, a policy or prior that is not [S, A], or a model of other sizes.
    """
    beta = checks.temperature("beta", beta)
    optimism = checks.optimism("optimism", optimism, beta)
    n_episodes, horizon = checks.at_least("n_episodes", n_episodes, 1), checks.at_least("horizon", horizon, 1)
    checks.memory("n_episodes", n_episodes, 8 * n_episodes, "the returns of all episodes")
    checks.instance("rng", rng, np.random.Generator, "a generator, as numpy.random.default_rng(0)")
    source = encoded(source)
    n_states, n_actions = sizes(source)
    if mdp is not None:
        checks.instance("mdp", mdp, TabularMDP, "a TabularMDP")
        if mdp.reward.shape != (n_states, n_actions):
            raise InputError("mdp", f"MDP of shape {mdp.reward.shape}", f"of shape [{n_states}, {n_actions}]")
    own_mdp = known_mdp(source)
    model = own_mdp if mdp is None else mdp
    allowed = None if model is None else model.allowed
    table = check_policy("policy", policy, n_states, n_actions, allowed)
    prior = check_prior("prior_policy", prior_policy, n_states, n_actions, allowed)
    succeeded = np.nan
    endless = isinstance(source, TabularMDP) or not ending_states(source, n_states).any()
    if model is not None and mean_return is not None:
        played = mean_return(table)
    elif own_mdp is not None and endless:
        returns = np.empty(n_episodes)
        experience_kernels.simulate_returns(*sampling_tables(own_mdp), policy_cdf(table), horizon, rng, returns)
        played = float(returns.mean())
    else:
        assert not isinstance(source, TabularMDP)
        masked = model is None or not model.allowed.all()
        sampled = _evaluate_by_playing(source, table, prior, beta, rng, n_episodes, horizon, ends, masked)
        played, succeeded = sampled.mean_return, sampled.success_rate
    if model is None:
        return sampled if optimism == 0.0 else sampled._replace(objective=np.nan)
    if success_rate is not None:
        succeeded = success_rate(table)
    figures = reward_per_step(model, table, horizon), objective(model, table, prior, beta, optimism=optimism)
    return Evaluation(played, *figures, succeeded)


class Judge:
    """Exact figures of many policies of one model, in compiled code that does not hold other threads up.

    Args:
        mdp: the model.
        prior: [S, A].
        horizon: steps behind ``reward_per_step``.
    """

    def __init__(self, mdp: TabularMDP, prior: np.ndarray, horizon: int) -> None:
        self.mdp, self.prior, self.horizon = mdp, prior, horizon
        n_states, n_actions = prior.shape
        p = mdp.transition
        n = p.nnz
        # The place of each transition in the chain of a policy is the same for all policies.
        marked = sp.csr_array((np.ones(n), p.indices.copy(), p.indptr[::n_actions].copy()), shape=(n_states, n_states))
        marked.sum_duplicates()
        self._rows, self._columns = marked.indptr, marked.indices
        marked.data = np.arange(marked.nnz, dtype=np.float64)
        s = np.repeat(np.arange(n_states), np.diff(p.indptr[::n_actions]))
        self._place = np.asarray(marked[s, p.indices]).astype(np.int64).ravel()
        label, closed = classes(marked)
        # With one closed class of moderate size the stationary distribution takes no factorisation.
        self._inside = np.flatnonzero(closed[label])
        self._small = closed.sum() == 1 and len(self._inside) <= GTH_STATES

    def reward_per_step(self, policy: np.ndarray) -> float:
        """``reward_per_step`` of a policy [S, A] over the horizon."""
        reward = (policy * self.mdp.reward).sum(1)
        chain = self._chain(policy)
        total = solvers_kernels.finite_horizon_return(
            self._rows, self._columns, chain, reward, self.mdp.start, self.horizon
        )
        return float(total) / self.horizon

    def objective(self, policy: np.ndarray, beta: float, *, optimism: float = 0.0) -> float:
        """``objective`` of a policy [S, A]; 1 optimistic (control as inference), 0 right, negative robust."""
        if optimism == 0.0 and self._small and ((policy > 0) | ~self.mdp.allowed).all():
            chain = sp.csr_array((self._chain(policy), self._columns, self._rows))
            share, sound = solvers_kernels.gth(chain[self._inside][:, self._inside].toarray())
            parts = (self.mdp.transition, self.mdp.reward, self.prior, beta, policy)
            gains = policy_gains(*parts, np.zeros(len(policy)))
            if sound and np.isfinite(gains).all() and np.abs(policy.sum(1) - 1).max() <= 2e-15:
                return float(share @ one_step_worth(*gains)[self._inside])
        return objective(self.mdp, policy, self.prior, beta, optimism=optimism)

    def _chain(self, policy: np.ndarray) -> np.ndarray:
        chain = np.empty(len(self._columns))
        p = self.mdp.transition
        solvers_kernels.chain_of(p.data, self._place, policy.reshape(-1), p.indptr, chain)
        return chain


def _kl_among(policy: np.ndarray, prior: np.ndarray, mask: np.ndarray) -> float:
    """KL(policy || prior) in one state, of their shares of the actions in ``mask``, as they are played."""
    p, q = np.where(mask, policy, 0.0), np.where(mask, prior, 0.0)
    return float(kl_per_state((p / p.sum())[None], (q / max(q.sum(), np.finfo(float).tiny))[None])[0])


def _evaluate_by_playing(
    env: gym.Env[Any, Any],
    policy: np.ndarray,
    prior: np.ndarray,
    beta: float,
    rng: np.random.Generator,
    n_episodes: int,
    horizon: int,
    ends: EndRule | None,
    masked: bool,
) -> Evaluation:
    kl = kl_per_state(policy, prior)
    of_masks: dict[int, float] = {}  # KL of what is played, in states whose actions are masked
    batch = batched(env)
    if batch is not None:
        uniform = np.full(policy.shape, 1 / policy.shape[1])  # a' is drawn, and not looked at
        data = batch(Plan(n_episodes, horizon, Streams(rng, rng, rng), policy, uniform, False), "original")
        return Evaluation(data.r.sum() / n_episodes, data.r.mean(), float((data.r - kl[data.s] / beta).mean()))
    choose = Draws(policy, rng, masked=masked)
    total = total_kl = charged = 0.0
    n_steps = n_successes = 0
    for _ in range(n_episodes):
        first = reset(env, rng)
        mask = first.mask
        for step in episode(env, first, choose, horizon):
            total += step.r
            if masked and mask is not None and step.s not in of_masks:
                of_masks[step.s] = _kl_among(policy[step.s], prior[step.s], mask)
            total_kl += of_masks.get(step.s, kl[step.s])
            mask = step.mask
            n_steps += 1
            if step.terminated and ends is not None:
                failed, more = ends.of(step.r, step.s_next)
                charged += more
                n_successes += not failed
        n_successes += ends is not None and ends.failures.every and not step.terminated
    succeeded = np.nan if ends is None else n_successes / n_episodes
    paid = total + charged
    return Evaluation(total / n_episodes, paid / n_steps, float(paid - total_kl / beta) / n_steps, succeeded)
