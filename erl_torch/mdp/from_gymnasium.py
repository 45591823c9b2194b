"""What an environment tells of itself: its sizes and, where it has one, its model as a TabularMDP.

The model is read from ``env.unwrapped.mdp`` (this package's environments) or ``env.unwrapped.P``, the table
``P[s][a] = [(probability, s', reward, terminated), ...]`` of Gymnasium's toy_text and many others.

Ends of episodes. The solvers' process is endless, but P has terminal states. There are two readings:

    restart  a step that ends the episode leads straight to the start distribution. Long-run averages are then those
             of playing episode after episode. Terminal states are left, but never entered.
    absorb   it leads to the terminal state s', which is never left. Rows of s' that stay in s' are kept
             (FrozenLake's do); all others become a self-loop with reward 0 (CliffWalking, Taxi). The average
             reward is then that of the terminal states; where there are several, the solvers call it reducible.

Tables. States and actions of P are those of the spaces (whole numbers, or tuples and dicts as labels, see
``erl_torch.Labels``); P may be dicts, lists, or an array of objects. An entry of three is (probability, s', reward). An
action without entries is one that the state does not have. A state without any is one where episodes end: entered, it
is the end; nothing is known of it, and no step is taken there. Entries of probability 0 are passed over. A reward of
-inf says as well that the state does not have the action.

Whether to believe it. A subclass that overrides ``step`` or ``reset`` of the environment that has the model, an object
whose ``step`` was replaced, or a wrapper, may change the process: the model is not used, unless the class (or the
object) says ``model_holds = True``.

A reward that depends on s' enters as its mean r(s,a). The objective is linear in the reward, so the optimum is the
same. Entries of P with the same s' are summed. Time limits are not part of a model.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import scipy.sparse as sp
import scipy.sparse.csgraph as csgraph
from gymnasium import wrappers
from numpy.typing import ArrayLike

from erl_torch import checks
from erl_torch.checks import InputError
from erl_torch.labels import Labels, SpaceLabels
from erl_torch.mdp.ends import Failures, Rule, with_end_reward
from erl_torch.mdp.tabular import TabularMDP, normalise_rows
from erl_torch.notes import note

MASKED = "observation", "action_mask"  # keys of an observation that is a state with the mask of its actions

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


STEPPING = ("step", "reset")  # the methods that a model describes
OWN_PACKAGES = ("gymnasium", "erl_torch")  # whose classes fit their own models
INSIST = "where it does, say model_holds = True in the class"


class MeanRewardWarning(UserWarning):
    """Rewards of the environment vary for the same (s,a); the model has their mean."""


def sizes(source: TabularMDP | gym.Env[Any, Any] | gym.vector.VectorEnv[Any, Any, Any]) -> tuple[int, int]:
    """(n_states, n_actions). Raises InputError unless both spaces are finite, with fewer than 2**31 members."""
    if isinstance(source, TabularMDP):
        return source.n_states, source.n_actions
    allowed = "a TabularMDP, or an environment of Gymnasium's"
    checks.instance("source", source, (gym.Env, gym.vector.VectorEnv), allowed)
    if isinstance(source, gym.vector.VectorEnv):
        spaces = source.single_observation_space, source.single_action_space
    else:
        spaces = source.observation_space, source.action_space
    return len(space_labels("observation_space", spaces[0])), len(space_labels("action_space", spaces[1]))


def space_labels(key: str, space: gym.Space[Any]) -> SpaceLabels:
    """The labels of a finite space, without the mask of an observation. Raises InputError under ``key`` for others."""
    if isinstance(space, gym.spaces.Dict) and set(space.spaces) == set(MASKED):
        space = space.spaces[MASKED[0]]
    try:
        return Labels.of_space(space)
    except InputError as error:
        ways = " (a Box can be cut: env.bins, or erl_torch.envs.Discretise; learner=deep_s1 takes it as it is)"
        hint = "" if key == "action_space" else ways
        raise InputError(key, error.value, f"{error.allowed}{hint}") from error


# -- questions to an environment that Gymnasium's interface does not answer ---------------------------------


def known_mdp(source: object) -> TabularMDP | None:
    """The MDP that ``source`` follows exactly: itself, or that of one of this package's environments.

    A note says where a model is not believed because a method was overridden.
    """
    if isinstance(source, TabularMDP):
        return source
    mdp = getattr(source.unwrapped, "mdp", None) if isinstance(source, gym.Env) else None
    if not isinstance(source, gym.Env) or not isinstance(mdp, TabularMDP):
        return None
    if (own := overridden(source)) is not None:
        note(f"learning from env.step, as {own}, and mdp may not describe that ({INSIST})")
        return None
    return mdp if changed_by(source) is None else None


def ending_states(env: gym.Env[Any, Any], n_states: int) -> np.ndarray:
    """[S] bool: states of this package's environments in which every step ends the episode; none of others."""
    return np.asarray(getattr(env.unwrapped, "ends", np.zeros(n_states, bool)))


def has_table(env: gym.Env[Any, Any]) -> bool:
    """Whether the environment tells its model as ``P``."""
    return hasattr(env.unwrapped, "P")


def _table(env: gym.Env[Any, Any]) -> object:
    """``P``, as it is. Raises InputError where there is none, or where it leaves out part of the process (Taxi)."""
    base = env.unwrapped
    if getattr(base, "fickle_passenger", False):
        raise InputError("fickle_passenger", True, "False: P does not tell of it (learn from env.step instead)")
    table: object = getattr(base, "P", None)
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
    allowed: ArrayLike | None = None,
    end_reward: float = 0.0,
    failures: Rule = "default",
) -> TabularMDP:
    """The model of an environment that has one; see the module's docstring.

    Args:
        env: with finite spaces, and ``P`` or ``mdp``, without a wrapper or a method that changes the process.
        on_end: "restart" or "absorb".
        start: [S], the start distribution; None is the environment's own.
        allowed: [S, A] bool, the actions that each state has; None is all that the model has.
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
        mask = mdp.allowed if allowed is None else mdp.allowed & _mask_of(allowed, mdp.reward.shape)
        first = mdp.start if start is None else start
        mdp = TabularMDP(mdp.transition, reward, first, allowed=mask)  # type: ignore[arg-type]
        last = np.flatnonzero(ending_states(env, mdp.n_states))
        return mdp if on_end == "restart" else absorbed(mdp, last, mdp.reward[last])
    n_states, n_actions = sizes(env)
    row, to, p, r, end = _entries(_table(env), env.unwrapped)
    if end_reward:
        failed = _failures(failures, r, end, n_states, p).among(r, to) & end
        r = with_end_reward(r, end, failed, end_reward)
    n_rows = n_states * n_actions
    first = _start(_own_start(env) if start is None else start, n_states)
    missing, silent = _missing(row, n_states, n_actions)
    if (lost := np.flatnonzero(first * silent[::n_actions])).size:
        raise InputError(f"start[{lost[0]}]", first[lost[0]], "0, as P has no entries for this state")
    mean = np.bincount(row, p * r, n_rows)
    deviation = np.sqrt(np.bincount(row, p * (r - mean[row]) ** 2, n_rows))
    mask = ~missing.reshape(n_states, n_actions)
    if allowed is not None:
        mask &= _mask_of(allowed, (n_states, n_actions))
        deviation *= mask.ravel()
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
    # A state without entries is never stepped from; its row has to lead somewhere.
    from_start = sp.csr_array(silent.astype(np.float64)[:, None]) @ sp.csr_array(first[None, :])
    if on_end == "restart":
        ending = np.bincount(row[end], p[end], n_rows)
        transition = on + sp.csr_array(ending[:, None]) @ sp.csr_array(first[None, :]) + from_start
        return TabularMDP(transition, mean.reshape(n_states, n_actions), first, allowed=mask)
    transition = on + sp.coo_array((p[end], (row[end], to[end])), shape=shape) + from_start
    mdp = TabularMDP(transition, mean.reshape(n_states, n_actions), first, allowed=mask)
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
        rule = _failures(failures, mdp.reward, over, mdp.n_states, mdp.allowed)
        state = np.repeat(np.arange(mdp.n_states)[:, None], mdp.n_actions, 1)
        return Ends(over.astype(np.float64), (over & rule.among(mdp.reward, state)).astype(np.float64))
    n_states, n_actions = sizes(env)
    row, to, p, r, end = _entries(_table(env), env.unwrapped)
    failed = _failures(failures, r, end, n_states, p).among(r, to) & end
    chances = (np.bincount(row[x], p[x], n_states * n_actions).reshape(n_states, n_actions) for x in (end, failed))
    return Ends(*chances)


class Pays(NamedTuple):
    """What the steps of an environment pay."""

    best_end: float  # the largest reward of a step that ends an episode; -infinite if none ends one
    going_on: float  # mean reward of the others, all pairs (s,a) alike; -infinite without any


def end_pays(env: gym.Env[Any, Any]) -> Pays | None:
    """What the ends of an environment pay, and its other steps; None where it does not tell."""
    if changed_by(env) is None and overridden(env) is None:
        mdp = known_mdp(env)
        if mdp is not None:
            over = np.repeat(ending_states(env, mdp.n_states)[:, None], mdp.n_actions, 1)
            return _pays(mdp.reward, over, mdp.allowed)
        if has_table(env):
            try:
                _, _, p, r, end = _entries(_table(env), env.unwrapped)
            except InputError:  # a table that cannot be read tells nothing
                return None
            return _pays(r, end, p)
    return None


def rule_of_ends(failures: Rule, env: gym.Env[Any, Any]) -> Failures:
    """``failures`` in ``env``. Raises InputError as ``Failures.of`` does."""
    pays = end_pays(env)
    best, going_on = (None, -np.inf) if pays is None else pays
    return Failures.of(failures, best, sizes(env)[0], going_on)


def _pays(reward: np.ndarray, end: np.ndarray, weight: np.ndarray) -> Pays:
    w = np.where(end, 0.0, weight)
    total = w.sum()
    return Pays(float(reward[end].max(initial=-np.inf)), float((w * reward).sum() / total) if total else -np.inf)


def _failures(rule: Rule, reward: np.ndarray, end: np.ndarray, n_states: int, weight: np.ndarray) -> Failures:
    best, going_on = _pays(reward, end, weight)
    return Failures.of(rule, best, n_states, going_on)


def name_of(env: gym.Env[Any, Any]) -> str:
    """What messages call an environment: its id, or its class."""
    return env.spec.id if env.spec is not None else type(env.unwrapped).__name__


def _check_known(env: gym.Env[Any, Any]) -> None:
    checks.instance("env", env, gym.Env, "an environment of Gymnasium's")
    if (own := overridden(env)) is not None:
        raise InputError("env", name_of(env), f"one whose model describes its steps: {own} ({INSIST})")
    changed = changed_by(env)
    if changed is not None:
        raise InputError("env", name_of(env), f"without {changed}, under which the model is not known")


def absorbing(mdp: TabularMDP) -> np.ndarray:
    """[S] bool: states that no action leaves."""
    rows = np.arange(mdp.n_states * mdp.n_actions)
    stays = np.asarray(mdp.transition[rows, rows // mdp.n_actions]).reshape(mdp.n_states, mdp.n_actions)
    return np.asarray(((stays > 1 - 1e-12) | ~mdp.allowed).all(1))


def changed_by(env: gym.Env[Any, Any]) -> str | None:
    """The outermost wrapper of ``env``, or the overridden method, that may change the process; None without any."""
    while isinstance(env, gym.Wrapper):
        neutral = next((kind for kind in NEUTRAL if isinstance(env, kind)), None)
        own = [m for m in STEPPING if m in vars(env) or getattr(type(env), m) is not getattr(neutral, m, None)]
        if not all(_said(env, method) for method in own):
            return type(env).__name__
        env = env.env
    return overridden(env)


def overridden(env: gym.Env[Any, Any]) -> str | None:
    """In words, which of the methods that the model of ``env`` describes was overridden; None where none was."""
    base = env.unwrapped
    name = type(base).__name__
    for method in STEPPING:
        if _said(base, method):
            continue
        if method in getattr(base, "__dict__", {}):
            return f"{method} of this {name} was replaced"
        owners = [
            kind
            for kind in type(base).__mro__
            if kind not in (gym.Env, object) and (one := vars(kind).get(method)) is not None and not _abstract(one)
        ]
        if owners and not _defined_in(owners[0], method):
            return f"{method} of {owners[0].__name__} was replaced"
        if len(owners) > 1 and not (_home(owners[0]) == _home(owners[1]) and _home(owners[0]) in OWN_PACKAGES):
            return f"{owners[0].__name__} overrides {method} of {owners[1].__name__}"
    return None


def _said(one: object, method: str) -> bool:
    """Whether ``model_holds`` is true of ``one``, or of the class that has its ``method`` or one derived from that."""
    if getattr(one, "__dict__", {}).get("model_holds", False):
        return True
    order = type(one).__mro__
    owner = next((i for i, kind in enumerate(order) if method in vars(kind)), len(order))
    return any(vars(kind).get("model_holds", False) for kind in order[: owner + 1])


def _defined_in(kind: type, method: str) -> bool:
    """Whether ``method`` is a function written in the body of ``kind``."""
    one = vars(kind)[method]
    one = getattr(one, "__wrapped__", one)
    return getattr(one, "__qualname__", "").split(".")[-2:-1] == [kind.__qualname__.split(".")[-1]]


def _abstract(method: object) -> bool:
    return bool(getattr(method, "__isabstractmethod__", False))


def _home(kind: type) -> str:
    return kind.__module__.split(".")[0]


def _entries(table: object, env: gym.Env[Any, Any]) -> tuple[np.ndarray, ...]:
    """(pair, s', probability, reward, terminated) of every entry of probability > 0. Raises InputError for a table of
    another form; it names the entry."""
    states = space_labels("observation_space", env.observation_space)
    actions = space_labels("action_space", env.action_space)
    rows: list[tuple[int, int, float, float, bool]] = []  # pair, s', probability, reward, terminated
    loose: list[int] = []  # entries of three, which do not say whether the episode ends
    for s, of_state in _items("P", table, states):
        for a, entries in _items(f"P[{states.text(s)}]", of_state, actions):
            key = _Key(states, s, actions, a)
            for entry in _listed(key, entries):
                probability, s_next, reward, terminated = _entry(key, entry, states)
                if probability != 0:
                    loose += [len(rows)] if terminated is None else []
                    rows.append((s * len(actions) + a, s_next, probability, reward, bool(terminated)))
    if not rows:
        raise InputError("P", type(table).__name__, "a table with entries")
    columns = [np.array(column) for column in zip(*rows, strict=True)]
    row, to, p, r, end = columns
    # -inf where the state does not have the action: its other entries say nothing.
    kept = ~np.isin(row, row[np.isneginf(r)])
    has_entries = np.zeros(len(states), bool)
    has_entries[row[kept] // len(actions)] = True
    into_nothing = ~has_entries[to]
    end[loose] = into_nothing[loose]
    wrong = np.flatnonzero(kept & into_nothing & ~end)
    if wrong.size:
        s, a = divmod(int(row[wrong[0]]), len(actions))
        allowed = "one with entries, or the end of the episode (terminated true)"
        raise InputError(f"{_Key(states, s, actions, a)}: s'", states.text(int(to[wrong[0]])), allowed)
    return row[kept], to[kept], p[kept], r[kept], end[kept]


class _Key(NamedTuple):
    """``P[s][a]``, written only where it is needed."""

    states: Labels
    s: int
    actions: Labels
    a: int

    def __str__(self) -> str:
        return f"P[{self.states.text(self.s)}][{self.actions.text(self.a)}]"


def _items(key: str, table: object, labels: Labels) -> Iterator[tuple[int, Any]]:
    """(number, what is there) of a dict, list or array with one place per label. Raises InputError."""
    if table is None:
        return
    if isinstance(table, Mapping):
        met: set[int] = set()
        for label, value in table.items():
            number = labels.encode(label, f"{key}: key")
            if number in met:
                raise InputError(f"{key}: key", label, "there once only")
            met.add(number)
            yield number, value
        return
    values = _listed(key, table)
    if len(values) not in (0, len(labels)):
        raise InputError(key, f"{len(values)} items", f"a dict, or a list of {len(labels)}")
    yield from enumerate(values)


def _listed(key: str | _Key, value: object) -> Sequence[Any]:
    if isinstance(value, (list, tuple)):
        return value
    if value is None:
        return []
    if isinstance(value, str) or not isinstance(value, (Sequence, np.ndarray, set, frozenset, Iterator)):
        raise InputError(
            f"{key}", f"{value!r} ({type(value).__name__})", "P[s][a] = [(p, s', reward, terminated), ...]"
        )
    return list(value) if not isinstance(value, np.ndarray) or value.ndim else [value.item()]


def _entry(key: _Key, entry: object, states: Labels) -> tuple[float, int, float, bool | None]:
    """(probability, s', reward, terminated); None where the entry does not say. Raises InputError."""
    values = entry
    if not isinstance(values, (tuple, list)):
        values = list(values) if isinstance(values, (Sequence, np.ndarray)) and not isinstance(values, str) else []
    if len(values) not in (3, 4):
        raise InputError(f"{key}", f"{entry!r}", "a list of (p, s', reward, terminated)")
    try:
        p, r = float(values[0]), float(values[2])
    except (TypeError, ValueError) as error:
        raise InputError(f"{key}", f"{entry!r}", "a list of (p, s', reward, terminated), of numbers") from error
    if not 0 <= p < math.inf:
        raise InputError(f"{key}: probability", p, "finite and >= 0")
    if p != 0 and not r < math.inf:
        raise InputError(f"{key}: reward", r, "finite, or -inf for an action that the state does not have")
    end = values[3] if len(values) == 4 else None
    if type(end) is not bool and not isinstance(end, (int, float, np.bool_, np.number, type(None))):
        raise InputError(f"{key}: terminated", f"{end!r}", "True or False")
    try:
        s_next = states.encode(values[1])
    except InputError as error:
        raise InputError(f"{key}: s'", error.value, error.allowed) from error
    return p, s_next, r, None if end is None else bool(end)


def _mask_of(allowed: ArrayLike, shape: tuple[int, ...]) -> np.ndarray:
    return np.asarray(checks.array("allowed", allowed, shape, (lambda x: (x == 0) | (x == 1), "true or false")) == 1)


def _missing(row: np.ndarray, n_states: int, n_actions: int) -> tuple[np.ndarray, np.ndarray]:
    """[S*A] bool each: pairs without entries in states that have some, and all pairs of states that have none."""
    empty = np.bincount(row, minlength=n_states * n_actions).reshape(n_states, n_actions) == 0
    silent = np.repeat(empty.all(1), n_actions)
    return empty.ravel() & ~silent, silent


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
    return TabularMDP(sp.diags_array(1 - per_row) @ mdp.transition + loops, table, mdp.start, allowed=mdp.allowed)
