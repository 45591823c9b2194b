"""What one episode of a policy comes to, in a known model: its return, its chance of success, its steps.

Each figure is the expected sum of a table over the steps of an episode: of rewards; of the chances that the step ends
it in success; of 1. So it solves x = c + K x on the states that do not end, K the chain of the policy, and

    x + h min(c + K x - x) <= true <= x + h max(c + K x - x)

with h the expected steps to the end, which the same bound gives for c = 1. Rounding is in the bounds
(``certificate_kernels.policy_gain_rows``; docs/theory.md, 6).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike

from erl_torch import checks
from erl_torch.checks import InputError
from erl_torch.mdp.from_gymnasium import absorbed
from erl_torch.mdp.tabular import TabularMDP, check_policy
from erl_torch.solvers.certificates import policy_gains
from erl_torch.solvers.chains import RegenerativeLU, SingularChainError, classes, policy_chain, reachable_from
from erl_torch.solvers.first_exit import ending
from erl_torch.solvers.values import chance_of, down, start_bounds, up, with_end


class Bounded(NamedTuple):
    """A figure with bounds that hold in exact arithmetic."""

    value: float
    low: float
    high: float


class EpisodeFigures(NamedTuple):
    """Of an episode of one policy, from the start distribution."""

    mean_return: Bounded  # expected undiscounted sum of rewards; no KL
    success_rate: Bounded  # probability that the episode ends in success
    steps: Bounded  # expected number


def evaluate_episodes(
    mdp: TabularMDP,
    policy: ArrayLike,
    ends: ArrayLike | None = None,
    successes: ArrayLike | None = None,
    horizon: int | None = None,
) -> EpisodeFigures:
    """Return, success rate and steps of an episode of ``policy``, exact but for the bounds that are given.

    Args:
        mdp: the model of one episode: ``tabular_mdp(env, on_end="absorb")``.
        policy: [S, A].
        ends: [S] bool, as of ``solve_first_exit``.
        successes: [S] bool, the ends that count as a success; None is all of them.
        horizon: steps after which an episode is cut off, without success; None is never.

    Returns:
        The figures. Without a horizon, where the policy may never come to an end: infinite steps, and a return that is
        that of the steps before where all that follows pays 0; otherwise it is NaN, between infinite bounds. Where
        an end is so far that double precision does not reach it, figures are NaN between bounds that hold.

    Raises:
        InputError: a policy that is not [S, A], no end, or a horizon below 1.
    """
    checks.instance("mdp", mdp, TabularMDP, "a TabularMDP")
    table = check_policy("policy", policy, mdp.n_states, mdp.n_actions, mdp.allowed)
    ended = ending(mdp, ends)
    succeeds = ended if successes is None else _mask("successes", successes, ended)
    model = absorbed(mdp, np.flatnonzero(ended), 0.0)
    chance = chance_of(model.transition, succeeds).reshape(model.reward.shape)
    chance[ended] = 0.0
    once = np.where(ended[:, None], 0.0, np.ones_like(chance))
    tables = (model.reward, chance, once)
    if horizon is not None:
        horizon = checks.at_least("horizon", horizon, 1)
        figures = [_over(model, table, c, horizon) for c in tables]
    else:
        figures = _until_the_end(model, table, tables, ended)
    mean_return, success, steps = (_from(model.start, *figure) for figure in figures)
    # Sums of probabilities of their rows: by rounding alone they leave [0, 1].
    success = Bounded(*(min(max(x, 0.0), 1.0) for x in success))
    return EpisodeFigures(mean_return, success, Bounded(steps.value, max(steps.low, 0.0), steps.high))


def _mask(key: str, value: ArrayLike, ended: np.ndarray) -> np.ndarray:
    mask = np.asarray(value)
    if mask.shape != ended.shape or mask.dtype != bool:
        raise InputError(key, f"{mask.dtype} of shape {mask.shape}", f"true or false for each of {len(ended)} states")
    return np.asarray(mask & ended)


def _from(start: np.ndarray, value: np.ndarray, low: np.ndarray, high: np.ndarray) -> Bounded:
    least, most = start_bounds(start, low, high)
    at = start > 0
    mean = (
        float(start[at] @ value[at]) if np.isfinite(value[at]).all() else float(value[at][~np.isfinite(value[at])][0])
    )
    return Bounded(min(max(mean, least), most), least, most)


def _over(
    model: TabularMDP, policy: np.ndarray, table: np.ndarray, horizon: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(value, low, high) [S] of the expected sum of ``table`` [S, A] over ``horizon`` steps."""
    low = high = np.zeros(model.n_states)
    for _ in range(horizon):
        low = down(low + policy_gains(model.transition, table, policy, 1.0, policy, low)[0])
        high = up(high + policy_gains(model.transition, table, policy, 1.0, policy, high)[1])
    return 0.5 * (low + high), low, high


def _until_the_end(
    model: TabularMDP, policy: np.ndarray, tables: tuple[np.ndarray, ...], ended: np.ndarray
) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """(value, low, high) [S] of the expected sum of each table [S, A]; the last one is of ones."""
    chain = policy_chain(model.transition, policy)
    label, closed = classes(chain)
    reached = reachable_from(chain, model.start)
    stays = closed[label] & ~ended & reached  # for ever, and no end
    # One state more, in place of all in which nothing more happens; unreached states are put there too.
    over = ended | stays | ~reached
    on = np.flatnonzero(~over)
    k, n_actions = len(on), model.n_actions
    rows = (on[:, None] * n_actions + np.arange(n_actions)).ravel()
    p = model.transition[rows]
    transition = with_end(sp.csr_array(p[:, on]), chance_of(p, over), n_actions)
    own = np.vstack([policy[on], np.full(n_actions, 1 / n_actions)])
    try:
        lu = RegenerativeLU(policy_chain(transition, own), k)
    except SingularChainError:
        lu = None

    def solved(table: np.ndarray, steps: np.ndarray | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        c = np.vstack([table[on], np.zeros(n_actions)])
        x = np.full(k + 1, np.nan) if lu is None else lu.poisson((own * c).sum(1))[1]
        if not np.isfinite(x).all():  # beyond double precision
            return np.full(k, np.nan), np.full(k, 0.0 if steps is None else -np.inf), np.full(k, np.inf)
        low, high = (g[:k] for g in policy_gains(transition, c, own, 1.0, own, x))
        least, most = float(low.min(initial=0.0)), float(high.max(initial=0.0))
        x = x[:k]
        if steps is None:  # c = 1: x + least h <= h <= x + most h
            steps = up(up(x / (1 - most))) if most < 0.5 else np.full(k, np.inf)
            return np.where(np.isfinite(steps), x, np.nan), down(down(x / (1 - least))), steps
        known = np.where(np.isfinite(steps), x, np.nan)  # else nothing is known of it
        return known, down(down(x + down(least * steps))), up(up(x + up(most * steps)))

    of_steps = solved(tables[-1], None)
    figures = [*(solved(table, of_steps[2]) for table in tables[:-1]), of_steps]
    never = reachable_from(sp.csr_array(chain.T), stays.astype(np.float64)) if stays.any() else stays
    spread = []
    for i, figure in enumerate(figures):
        full = [np.zeros(model.n_states) for _ in range(3)]
        for whole, part in zip(full, figure, strict=True):
            whole[on] = part
        pays = stays & ((policy > 0) & (tables[i] != 0)).any(1)
        lost = reachable_from(sp.csr_array(chain.T), pays.astype(np.float64)) if pays.any() else pays
        if i == len(figures) - 1:
            full = [np.where(never, np.inf, x) for x in full]
        else:
            full = [np.where(lost, way, x) for way, x in zip((np.nan, -np.inf, np.inf), full, strict=True)]
        spread.append((full[0], full[1], full[2]))
    return spread
