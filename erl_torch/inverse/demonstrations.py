"""What was demonstrated, in the problem that it is to be explained in: counts, the expert's policy, its flow."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from erl_torch import checks
from erl_torch.checks import InputError
from erl_torch.empirical.counts import EmpiricalMDP, tally
from erl_torch.experience.experience import Experience, check_unweighted, permitted
from erl_torch.mdp.tabular import TabularMDP, check_prior
from erl_torch.notes import note
from erl_torch.solvers.chains import long_run
from erl_torch.solvers.problem import BellmanProblem

COUNTS: checks.Entries = (lambda x: (x >= 0) & (x <= 1e100), "0 to 1e100")  # sums and squares stay in double precision


class Setting(NamedTuple):
    """A problem without rewards, on the states and pairs that take part."""

    problem: BellmanProblem  # its reward is what comes on top of that to be found: 0, or the price of pairs never tried
    mdp: TabularMDP | EmpiricalMDP
    prior: np.ndarray  # [S, A], as given
    message: str  # what was left out, and why


@dataclass(frozen=True, eq=False)
class Demonstrated:
    """What was demonstrated, on the states of a problem."""

    counts: np.ndarray  # n(s,a), [n, A]
    policy: np.ndarray  # pi_E, [n, A]
    flow: np.ndarray  # d_E, the long-run share of pairs under pi_E, [n, A]
    pseudo_count: float
    exact: bool

    @property
    def n_steps(self) -> float:
        return float(self.counts.sum())

    @property
    def weight(self) -> np.ndarray:
        """Shares of pairs in the likelihood, [n, A]: of the steps, with pi_E in each state; d_E where it is exact."""
        if self.exact:
            return self.flow
        return np.asarray(self.policy * (self.counts.sum(1) / self.n_steps)[:, None])

    @property
    def unseen(self) -> float:
        """Share of the flow in states without a step, where the prior stands for the expert."""
        return float(self.flow[self.counts.sum(1) == 0].sum())


def setting(mdp: TabularMDP | EmpiricalMDP, beta: float, prior_policy: ArrayLike | None, optimism: float) -> Setting:
    """The problem of ``mdp`` without its rewards. Raises InputError as ``BellmanProblem.of``."""
    checks.instance("mdp", mdp, (TabularMDP, EmpiricalMDP), "a TabularMDP, or counts as of empirical_mdp")
    if isinstance(mdp, TabularMDP):
        prior = check_prior("prior_policy", prior_policy, mdp.n_states, mdp.n_actions, mdp.allowed)
        problem = BellmanProblem.of(mdp, beta, prior, optimism)
        left = mdp.n_states - problem.n_states
        message = f"{left} states that the start does not lead to take no part" if left else ""
        return Setting(replace(problem, reward=np.zeros_like(problem.reward)), mdp, prior, message)
    prior = check_prior("prior_policy", prior_policy, mdp.n_states, mdp.n_actions)
    empirical = mdp.problem(beta, prior)
    price = np.log(empirical.tried)[:, None] / beta + np.zeros_like(empirical.problem.reward)
    price = np.where(empirical.problem.prior > 0, price, 0.0)
    optimism = checks.optimism("optimism", optimism, empirical.problem.beta)
    return Setting(replace(empirical.problem, reward=price, optimism=optimism), mdp, prior, empirical.message)


def demonstrated(
    demonstrations: Experience | ArrayLike, given: Setting, pseudo_count: float, exact: bool
) -> Demonstrated:
    """Counts, policy and flow of ``demonstrations`` in a setting.

    Raises InputError where no step is left in it, or ``exact`` goes with tuples.
    """
    problem, prior = given.problem, given.prior
    if isinstance(demonstrations, Experience):
        if exact:
            raise InputError("exact", True, "False for tuples: a finite number of steps is not a policy")
        check_unweighted("demonstrations", demonstrations, "only actions are explained here, and weights are of s'")
        kept = permitted(demonstrations, prior, next_actions=False, told=note)
        counts = tally(kept, *prior.shape).visits.reshape(prior.shape).astype(np.float64)
    else:
        counts = checks.array("demonstrations", demonstrations, prior.shape, COUNTS)
        if not exact and counts.sum() < len(counts) + 0.5 and (counts != np.floor(counts)).any():
            note("demonstrations are taken as counts of less than a step a state: a policy, or shares, need exact=True")
    total = counts.sum()
    counts = np.where(problem.prior > 0, counts[problem.states], 0.0)
    if not counts.any():
        raise InputError("demonstrations", "no step in a pair of the problem", "steps of pairs that take part")
    if (lost := total - counts.sum()) > 1e-9 * total:
        note(f"{lost / total:.3g} of the demonstrations are left out: their pairs take no part in the problem")
    c = 0.0 if exact else pseudo_count
    visits = counts.sum(1, keepdims=True)
    known = visits + c > 0
    policy = np.where(known, (counts + c * problem.prior) / np.where(known, visits + c, 1.0), problem.prior)
    share = long_run(problem.chain(policy), problem.start).of_state
    return Demonstrated(counts, policy, share[:, None] * policy, c, exact)
