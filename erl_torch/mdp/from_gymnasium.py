"""What an environment tells of itself: its sizes and, where it has one, its model as a TabularMDP.

The model is read from ``env.unwrapped.mdp`` (this package's environments) or ``env.unwrapped.P``, the table
``P[s][a] = [(probability, s', reward, terminated), ...]`` of Gymnasium's toy_text and many others.

Ends of episodes. The solvers' process is endless, but P has terminal states. There are two readings:

    restart  a step that ends the episode leads straight to the start distribution. Long-run averages are then those
             of playing episode after episode. Terminal states are left, but never entered.
    absorb   it leads to the terminal state s', which is never left. Rows of s' that stay in s' are kept
             (FrozenLake's do); all others become a self-loop with reward 0 (CliffWalking, Taxi). The average
             reward is then that of the terminal states; where there are several, the solvers call it reducible.

A reward that depends on s' enters as its mean r(s,a). The objective is linear in the reward, so the optimum is the
same. Entries of P with the same s' are summed. Time limits are not part of a model.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import scipy.sparse as sp
import scipy.sparse.csgraph as csgraph
from gymnasium import wrappers
from numpy.typing import ArrayLike

from erl_torch import checks
from erl_torch.checks import InputError
from erl_torch.mdp.ends import Failures, Rule, with_end_reward
from erl_torch.mdp.tabular import TabularMDP, normalise_rows

Table = Mapping[int, Mapping[int, Sequence[tuple[float, int, float, bool]]]]  # P, as it should be

# Wrappers that leave states, actions, rewards and dynamics as they are.
NEUTRAL = (
    wrappers.TimeLimit,
    wrappers.OrderEnforcing,
    wrappers.PassiveEnvChecker,
    wrappers.Autoreset,
    wrappers.RecordEpisodeStatistics,
    wrappers.RecordVideo,
    wrappers.RenderCollection,
    wrappers.HumanRendering,
)


class MeanRewardWarning(UserWarning):
    """Rewards of the environment vary for the same (s,a); the model has their mean."""


def sizes(source: TabularMDP | gym.Env[Any, Any] | gym.vector.VectorEnv[Any, Any, Any]) -> tuple[int, int]:
    """(n_states, n_actions). Raises InputError unless both spaces are Discrete and start at 0."""
    if isinstance(source, TabularMDP):
        return source.n_states, source.n_actions
    allowed = "a TabularMDP, or an environment of Gymnasium's"
    checks.instance("source", source, (gym.Env, gym.vector.VectorEnv), allowed)
    if isinstance(source, gym.vector.VectorEnv):
        spaces = source.single_observation_space, source.single_action_space
    else:
        spaces = source.observation_space, source.action_space
    return _size("observation_space", spaces[0]), _size("action_space", spaces[1])


def _size(key: str, space: gym.Space[Any]) -> int:
    if isinstance(space, gym.spaces.Discrete) and space.start == 0:
        return int(space.n)
    raise InputError(key, space, "Discrete, starting at 0 (a Box can be cut: env.bins, or erl_torch.envs.Discretise)")


# -- questions to an environment that Gymnasium's interface does not answer ---------------------------------


def known_mdp(source: object) -> TabularMDP | None:
    """The MDP that ``source`` follows exactly: itself, or that of one of this package's environments."""
    if isinstance(source, TabularMDP):
        return source
    if not isinstance(source, gym.Env) or changed_by(source) is not None:
        return None
    mdp = getattr(source.unwrapped, "mdp", None)
    return mdp if isinstance(mdp, TabularMDP) else None


def ending_states(env: gym.Env[Any, Any], n_states: int) -> np.ndarray:
    """[S] bool: states of this package's environments in which every step ends the episode; none of others."""
    return np.asarray(getattr(env.unwrapped, "ends", np.zeros(n_states, bool)))


def has_table(env: gym.Env[Any, Any]) -> bool:
    """Whether the environment tells its model as ``P``."""
    return hasattr(env.unwrapped, "P")


def _table(env: gym.Env[Any, Any]) -> Table:
    """``P``, as it is. Raises InputError where there is none, or where it leaves out part of the process (Taxi)."""
    base = env.unwrapped
    if getattr(base, "fickle_passenger", False):
        raise InputError("fickle_passenger", True, "False: P does not tell of it (learn from env.step instead)")
    table: Table | None = getattr(base, "P", None)
    if table is None:
        raise InputError("env", base, "one that has its model as P or mdp (learn from env.step instead)")
    return table


def _own_start(env: gym.Env[Any, Any]) -> ArrayLike | None:
    """The distribution of the first state, under either of the names that Gymnasium's environments give it."""
    base = env.unwrapped
    start: ArrayLike | None = getattr(base, "initial_state_distrib", getattr(base, "isd", None))
    return start


# -- the model ----------------------------------------------------------------------------------------------


class Ends(NamedTuple):
    """How the steps of a model end episodes; all [S, A]."""

    ended: np.ndarray  # the probability that the step ends the episode
    failed: np.ndarray  # that it ends it in failure


def tabular_mdp(
    env: gym.Env[Any, Any],
    on_end: str = "restart",
    start: ArrayLike | None = None,
    end_reward: float = 0.0,
    failures: Rule = "default",
) -> TabularMDP:
    """The model of an environment that has one; see the module's docstring.

    Args:
        env: with Discrete spaces, and ``P`` or ``mdp``, without a wrapper that changes the process.
        on_end: "restart" or "absorb".
        start: [S], the start distribution; None is the environment's own.
        end_reward: added to the reward of the steps that end an episode: a charge, < 0, of those that fail, or a bonus,
            > 0, of the others.
        failures: the rule that says which ends are failures (``erl_torch.mdp.ends``).

    Raises:
        InputError: no model, a table that is not as above, a model that leaves out part of the process, or an
            end_reward that no end gets.

    Warns:
        MeanRewardWarning: rewards depend on s'.
    """
    checks.one_of("on_end", on_end, ("restart", "absorb"))
    _check_known(env)
    mdp = known_mdp(env)
    if mdp is not None:
        reward = mdp.reward
        if end_reward:
            ends = model_ends(env, failures)
            reward = with_end_reward(reward, ends.ended, ends.failed, end_reward)
        mdp = TabularMDP(mdp.transition, reward, mdp.start if start is None else start)  # type: ignore[arg-type]
        last = np.flatnonzero(ending_states(env, mdp.n_states))
        return mdp if on_end == "restart" else absorbed(mdp, last, mdp.reward[last])
    n_states, n_actions = sizes(env)
    row, to, p, r, end = _entries(_table(env), n_states, n_actions)
    if end_reward:
        failed = _failures(failures, r, end, n_states).among(r, to) & end
        r = with_end_reward(r, end, failed, end_reward)
    n_rows = n_states * n_actions
    first = _start(_own_start(env) if start is None else start, n_states)
    mean = np.bincount(row, p * r, n_rows)
    deviation = np.sqrt(np.bincount(row, p * (r - mean[row]) ** 2, n_rows))
    varies = deviation > 1e-9 * max(1.0, np.abs(r).max())
    if varies.any():
        warnings.warn(
            f"the reward depends on s' for {varies.sum()} of {n_rows} pairs (s, a), with standard deviations up to "
            f"{deviation.max():.3g}: the model has its mean r(s,a)",
            MeanRewardWarning,
            stacklevel=2,
        )
    shape = (n_rows, n_states)
    on = sp.coo_array((p[~end], (row[~end], to[~end])), shape=shape)
    if on_end == "restart":
        ending = np.bincount(row[end], p[end], n_rows)
        transition = on + sp.csr_array(ending[:, None]) @ sp.csr_array(first[None, :])
        return TabularMDP(transition, mean.reshape(n_states, n_actions), first)
    mdp = TabularMDP(
        on + sp.coo_array((p[end], (row[end], to[end])), shape=shape), mean.reshape(n_states, n_actions), first
    )
    # States that no episode comes to do not count: Taxi's table has rows for them too.
    seen = _come_to(row[~end] // n_actions, to[~end], first)
    terminal = np.setdiff1d(to[end], np.flatnonzero(seen))
    both = np.intersect1d(to[end & seen[row // n_actions]], np.flatnonzero(seen))
    if both.size:
        raise InputError("on_end", on_end, f"restart: state {both[0]} is entered with and without an episode's end")
    return absorbed(mdp, terminal, np.where(absorbing(mdp)[terminal, None], mdp.reward[terminal], 0.0))


def model_ends(env: gym.Env[Any, Any], failures: Rule = "default") -> Ends:
    """How the steps of an environment that has a model end episodes.

    Raises:
        InputError: no model, or a rule that cannot be used.
    """
    _check_known(env)
    mdp = known_mdp(env)
    if mdp is not None:
        ends = ending_states(env, mdp.n_states)
        over = np.repeat(ends[:, None], mdp.n_actions, 1)
        rule = _failures(failures, mdp.reward, over, mdp.n_states)
        state = np.repeat(np.arange(mdp.n_states)[:, None], mdp.n_actions, 1)
        return Ends(over.astype(np.float64), (over & rule.among(mdp.reward, state)).astype(np.float64))
    n_states, n_actions = sizes(env)
    row, to, p, r, end = _entries(_table(env), n_states, n_actions)
    failed = _failures(failures, r, end, n_states).among(r, to) & end
    chances = (np.bincount(row[x], p[x], n_states * n_actions).reshape(n_states, n_actions) for x in (end, failed))
    return Ends(*chances)


def best_end(env: gym.Env[Any, Any]) -> float | None:
    """The largest reward of a step that ends an episode, where the environment tells; -infinite if none ends one."""
    if changed_by(env) is None:
        mdp = known_mdp(env)
        if mdp is not None:
            return float(mdp.reward[ending_states(env, mdp.n_states)].max(initial=-np.inf))
        if has_table(env):
            _, _, _, r, end = _entries(_table(env), *sizes(env))
            return float(r[end].max(initial=-np.inf))
    return None


def _failures(rule: Rule, reward: np.ndarray, end: np.ndarray, n_states: int) -> Failures:
    return Failures.of(rule, float(reward[end].max(initial=-np.inf)), n_states)


def _check_known(env: gym.Env[Any, Any]) -> None:
    checks.instance("env", env, gym.Env, "an environment of Gymnasium's")
    changed = changed_by(env)
    if changed is not None:
        raise InputError("env", env, f"without {changed}, under which the model is not known")


def absorbing(mdp: TabularMDP) -> np.ndarray:
    """[S] bool: states that no action leaves."""
    rows = np.arange(mdp.n_states * mdp.n_actions)
    stays = np.asarray(mdp.transition[rows, rows // mdp.n_actions]).reshape(mdp.n_states, mdp.n_actions)
    return np.asarray((stays > 1 - 1e-12).all(1))


def changed_by(env: gym.Env[Any, Any]) -> str | None:
    """The outermost wrapper of ``env`` that may change the process, or None."""
    while isinstance(env, gym.Wrapper):
        if not isinstance(env, NEUTRAL):
            return type(env).__name__
        env = env.env
    return None


def _entries(table: Table, n_states: int, n_actions: int) -> tuple[np.ndarray, ...]:
    """(pair, s', probability, reward, terminated) of every entry. Raises InputError for a table of another form."""
    try:
        entries = [
            (s * n_actions + a, to, p, r, bool(end))
            for s in range(n_states)
            for a in range(n_actions)
            for p, to, r, end in table[s][a]
        ]
        columns = [np.array(column) for column in zip(*entries, strict=True)]
        row, to, p, r, end = columns
        p, r = p.astype(np.float64), r.astype(np.float64)
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise InputError(
            "P", type(table).__name__, f"P[s][a] = [(p, s', reward, terminated), ...] ({error})"
        ) from error
    if to.dtype.kind not in "iu" or to.min() < 0 or to.max() >= n_states:
        raise InputError("P", f"s' in [{to.min()}, {to.max()}]", f"states in [0, {n_states})")
    return row, to, p, r, end


def _start(start: ArrayLike | None, n_states: int) -> np.ndarray:
    if start is None:
        raise InputError("start", None, "given: the environment does not tell its start distribution")
    distribution = checks.array("start", start, (n_states,), checks.NOT_NEGATIVE)
    normalise_rows(lambda row: "start", np.array([0, n_states]), distribution, np.inf)
    return distribution


def _come_to(origin: np.ndarray, to: np.ndarray, start: np.ndarray) -> np.ndarray:
    """[S] bool: states that moves from ``origin`` to ``to``, [n] each, lead to from the support of ``start`` [S]."""
    n, sources = len(start), np.flatnonzero(start > 0)
    # One search from one more state, with a move to every source.
    rows, columns = np.append(origin, np.full(len(sources), n)), np.append(to, sources)
    graph = sp.csr_array((np.ones(len(rows), np.int8), (rows, columns)), shape=(n + 1, n + 1))
    seen = np.zeros(n + 1, bool)
    seen[csgraph.breadth_first_order(graph, n, return_predecessors=False)] = True
    return seen[:n]


def absorbed(mdp: TabularMDP, states: np.ndarray, reward: np.ndarray | float) -> TabularMDP:
    """``mdp`` with ``states`` never left and the given rewards, [n] or [n, A], there."""
    among = np.zeros(mdp.n_states, bool)
    among[states] = True
    per_row = np.repeat(among, mdp.n_actions).astype(np.float64)
    state = np.repeat(np.arange(mdp.n_states), mdp.n_actions)
    loops = sp.coo_array((per_row, (np.arange(per_row.size), state)), shape=mdp.transition.shape)
    table = mdp.reward.copy()
    table[states] = reward
    return TabularMDP(sp.diags_array(1 - per_row) @ mdp.transition + loops, table, mdp.start)
