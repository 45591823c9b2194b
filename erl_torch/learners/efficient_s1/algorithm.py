r"""Algorithm S1 taken to the limit of its data: every table at the accuracy that the stream allows.

Symbols, shapes and equation numbers as in ``erl_torch.learners.s1.algorithm``. With psi = exp(-beta V) and the gauge
z = psi u, one biasing iteration streams

    w = g(s,a) y(s'),    z(s,a) += a_n (w/rho - z(s,a)),    rho += lr_rho (w/z(s,a) - rho)            lines 9-11
    log g(s,a) = beta (r(s,a) + <V>(s,a) - V(s) - Delta),    y(s) = sum_a pi0(a|s) z(s,a)

and ends with V += log(y)/beta (line 12). Where the iterations end, y = 1 in every state, so w = g(s,a) whatever s':
the noise of the backup is gone, and a step that need not fall finds z = g/rho exactly. That is

    V(s) - theta = (1/beta) log sum_a pi0(a|s) exp(beta (r(s,a) + <V>(s,a)))

on the empirical model: the fixed point is certainty equivalence, and its loss g* - J is what the data allow.
The published steps stay about a hundred times further away: their <psi> remembers the last ten visits, and their
backup is noisy also at the end.

Options, each alone (published: all off, ``unvisited="initial"``; then this *is* ``ListedS1``, tested)

    1. ``sample_mean_psi``  <psi> and <log psi> are means over all visits (step 1/n), from counts: no passes, and with
                            them lr_psi, psi_tol and max_psi_epochs go. Off: lines 2-3.
    2. ``expected_backup``  y(s') above in place of u(s',a') psi(s'). a' is not used, so any behaviour policy with
                            support will do; off, a' must be a draw from the prior at s'.
    3. ``clocks``           a_n = max(clock_floor, h/(h + n)), n earlier visits of (s,a) in this biasing iteration,
                            h = ``clock_horizon``: what n visits leave of the start is (n/h)^-h, and a pair that is
                            seen once a pass is at its value after a few. lr_rho falls as lr_rho/(epoch of the
                            iteration). The floor lets z fall by any number of decades, and far states mix; the noise
                            it would leave vanishes with that of the backup. Off: a_n = lr_u, lr_rho.
    4. ``mean_reward``      r(s,a) is the mean over all visits. Off: each tuple's own r, that is an average of
                            exp(beta r), optimistic about noise in r.
    5. ``warm_start``       u and theta are carried over to the next biasing iteration (rho = exp(-beta (theta +
                            Delta)) with its Delta). Off: u = 1, rho = exp(-beta), lines 7-8, and with clocks a larger
                            lr_rho is needed: rho may have to fall by exp(-beta Delta) in every iteration.
    6. ``polyak``           line 12 and the policy take the mean of z over the visits of the second half of an
                            iteration's epochs. Off: the last z.
    7. ``log_domain``       "on": z and rho as logarithms, for any beta; "off": as numbers; "auto": as numbers where
                            the tables span less than 10^80, and again in logarithms should a number leave the range.
    8. ``certificate``      stop once max(TV - V) - min(T_pi V - V) <= tol * (range of r) on the empirical model, where
                            V and pi are the state's own: its policy's loss there is not above that. Off: all passes.
    9. ``unvisited``        "exclude": the problem is that of ``erl_torch.empirical.counts``: pairs never visited have
                            probability 0, states outside keep the prior. "initial": u = 1 of line 7.
                            Pairs with prior 0 take no part either way, nor do tuples that have them.
The self-loop and the clip of rho are those of ``ListedS1`` (``self_loop="new"``, ``clip_rho``).

**Optimism.** 1 optimistic (control as inference), 0 right, negative robust: with lam = ``optimism``, kappa = lam beta,
E V gives way to C V = (1/kappa) log E exp(kappa V(s')) on the empirical rows, and what is streamed is

    w = g(s,a) e y(s'),    log g = beta (r + C V - V(s) - Delta),    e = exp(kappa (V(s') - C V)) of mean 1.

``sample_mean_psi`` counts for <psi^-lam> = exp(kappa C V) as for <log psi>. With it, ``mean_reward`` and
``expected_backup``, c + e (y(s') - c) is backed up in place of e y(s'), c the least y: of the same mean over the
visits, as that of e is known from the counts, and again without noise where y = 1. No step is then above 1/<e^2> of
its pair, beyond which noise would grow. Otherwise e is streamed as it comes,
and at constant steps that never goes away. The fixed point is certainty equivalence at that optimism, whose C is itself
too small by about CV^2 / (2 kappa n), CV^2 the relative variance of exp(kappa V(s')): rows need n far above that.

``reward_noise="joint"``: r and s' of a tuple count together, (1/kappa) log <exp(kappa (r + V(s')))>, as in
``erl_torch.empirical.counts.joint``; "mean": r is the mean over the visits.

Tuples with weights w (docs/other-dynamics.md): <.> are means with weights, and lines 10-11 take the steps a_n w/w_bar
and lr_rho w/w_bar, w_bar the mean weight of the pair, so that z, rho change on average as under the other dynamics; a_n
is at most w_bar/max(w), so that every update is a convex combination still. Not online, and not without
``sample_mean_psi``.

Online (``online``): one pass over a stream without end, no tuple kept: tables of S*A numbers, and the counts
n(s,a,s') that occur. The stream is cut into phases that end at S A tuples times powers of ``phase_growth``; V is fixed
in a phase, while <V> and r are means over all visits and z, rho run as above on fresh tuples; at its end
V += log(y)/beta, and the counts give <V> anew. Delta is left out there (it cancels): theta = -log(rho)/beta, and delta
is not estimated.

Alone, that goes astray on some streams: rho stays at its clip, and V with it far off. So V is certified at the end of
every phase, on the empirical model of all tuples so far. Where TV - V spans more than is due (``OnlineState.goal``), V
is taken from the counts, by damped value iteration from where it is, and z with it; rho is set to the nearest value
that the certificate allows. A state that is yielded has a certificate of its own: the policy is that of z or, where
that is wider than is due, the one that up to 32 sweeps from V make, if narrower. ``certified`` says whether the width
is within what is due, ``status`` and ``message`` what is amiss if not; either way it bounds the loss in the counts'
model. Where chains mix slowly, states between two ends of phases may have a wide certificate and a good policy.

Cost. A phase that ends at n tuples may read 8 n entries (s,a,s') of the counts, or make one sweep, beside checking its
V once: with f = ``phase_growth``, about 8 f/(f - 1) entries a tuple on the whole, at most; in practice far fewer. A
state that is yielded costs O(S A + distinct (s,a,s')), with up to 33 sweeps; what they find is not carried on, so that
the cut of the stream changes nothing.

Why nothing overflows: each update is a convex combination, of logarithms where they are large; w/z <= rho/a_n since
z contains a_n w/rho, so rho rises by at most 1/a_n a tuple; z is rescaled, which changes nothing, as the updates are
homogeneous in it.

Sources: 1, 5, 8, gauge and fixed point derived; 2 as expected SARSA; 3 as the asynchronous clocks of average-reward
Q-learning (Abounadi, Bertsekas, Borkar 2001), 6 Polyak and Juditsky (1992).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, ClassVar

import numpy as np
import scipy.sparse as sp
import torch
from scipy.special import logsumexp, softmax

from erl_torch import checks
from erl_torch.checks import InputError
from erl_torch.empirical.counts import NOISE, EmpiricalMDP, EmpiricalProblem, empirical_mdp, joint, tally
from erl_torch.experience.experience import Experience, Parts, Selection, check_unweighted, is_weighted, weighing
from erl_torch.experience.transitions import Transitions
from erl_torch.learners.efficient_s1 import kernels
from erl_torch.learners.learner import NonFiniteError, StreamLearner, columns, message
from erl_torch.learners.s1.algorithm import BLOCK, LOG_PSI_EPSILON
from erl_torch.mdp.tabular import check_prior
from erl_torch.solution import Solution, Status, proven
from erl_torch.solvers import kernels as solvers_kernels
from erl_torch.solvers.certificates import gains, policy_gains, soft_backup
from erl_torch.solvers.problem import BellmanProblem

LAST_STEP = 100_000  # visits of a pair in one biasing iteration after which its step stays
SAFE_RANGE = 180.0  # of logarithms, for plain numbers: products of four such stay in range
DAMPING = 0.9  # step of value iteration on the counts
SWEPT_PER_TUPLE = 8  # entries of the counts that it may read at a phase's end, for each tuple so far
WIDE = 0.003  # width of a certificate, relative to what its policy meets, beyond which a run is no success
LEAST_OPTIMISM = 1e-8  # in size, but for 0
LEAST_EVERY = 1024  # tuples of the online mode between looks for the least y, and at least one a state
STATE_SWEEPS = 32  # its sweeps at most for the policy of a state that is yielded


@dataclass(frozen=True, eq=False)
class EfficientState:
    """Everything known after an epoch; a value, never changed in place. Tables are logarithms."""

    bias_iteration: int  # 0 is the unbiased iteration
    epoch: int  # epochs done in this biasing iteration
    n_tuples: int  # tuples streamed through lines 9-11 since the start
    beta: float
    log_rho: float
    prior_policy: torch.Tensor  # [S, A]
    weight: torch.Tensor  # prior where the pair takes part, else 0, [S, A]
    log_z: torch.Tensor  # [S, A], gauge of log_psi_in_use
    log_total: torch.Tensor  # sum of z over the visits of the averaging window, [S, A]
    log_average: torch.Tensor  # the z that policy and psi are made of, [S, A]
    log_psi: torch.Tensor  # [S], line 12
    log_psi_in_use: torch.Tensor  # [S], behind the present biases
    log_mean_psi: torch.Tensor  # log <psi^(1-optimism)>, [S, A]
    mean_log_psi: torch.Tensor  # -beta C V, [S, A]: <log psi> at optimism 0
    empirical_width: float = math.inf  # bound on the policy's loss in the empirical model, reward a step
    psi_converged: bool = True
    certified: bool = False
    status: Status | None = None  # how a run ends that ends here; None: by the passes that are made
    message: str = ""  # what is left out, and how wide the certificate is if too wide
    optimism: float = 0.0

    @property
    def rho(self) -> float:
        """0 or infinite beyond double precision: ``theta`` is made of its logarithm."""
        with np.errstate(over="ignore", under="ignore"):
            return float(np.exp(self.log_rho))

    @property
    def reward_bias(self) -> torch.Tensor:
        """delta of line 5, [S, A], reward, >= 0 up to optimism 1 and <= 0 from there on; 0 where there is no visit."""
        power = 1.0 - self.optimism
        delta = (self.log_mean_psi - power * self.mean_log_psi) / self.beta
        return delta.clamp(min=0.0) if power > 0 else delta.clamp(max=0.0)

    @property
    def reward_bias_max(self) -> float:
        """Delta, line 6; reward."""
        return float(self.reward_bias.max())

    @property
    def theta(self) -> float:
        """-log(rho)/beta - Delta, reward a step."""
        return -self.log_rho / self.beta - self.reward_bias_max

    def with_theta_in(self, bounds: tuple[float, float]) -> EfficientState:
        """With rho such that theta is within bounds that are known to hold; unchanged where it is."""
        if bounds[0] <= self.theta <= bounds[1]:
            return self
        theta = min(max(self.theta, bounds[0]), bounds[1])
        return replace(self, log_rho=-self.beta * (theta + self.reward_bias_max))

    @property
    def u(self) -> torch.Tensor:
        """[S, A], mean 1; 0 on pairs that take no part, or below double precision."""
        log_u = torch.where(self.weight > 0, self.log_average - self.log_psi_in_use[:, None], -torch.inf)
        u = (log_u - log_u.max()).exp()  # the largest of those that take part: one outside could be beyond all of them
        return u / u.mean()

    @property
    def psi(self) -> torch.Tensor:
        """[S], 1 / sum_a pi0 u; within double precision."""
        return self.log_psi.clamp(-700.0, 700.0).exp()

    @property
    def policy(self) -> torch.Tensor:
        """[S, A], lines 13-14."""
        return (self.weight.log() + self.log_average).softmax(1)

    def metrics(self) -> dict[str, float]:
        """The scalars that are logged, by their documented names (docs/logging.md)."""
        return {
            "rho": self.rho,
            "theta": self.theta,
            "delta_max": self.reward_bias_max,
            "delta_mean": float(self.reward_bias.mean()),
            "empirical_width": self.empirical_width,
            "bias_iteration": self.bias_iteration,
            "epoch": self.epoch,
            "n_tuples": self.n_tuples,
        }


@dataclass(frozen=True, eq=False, kw_only=True)
class OnlineState(EfficientState):
    """A state of the online mode: a policy with its certificate, and all that the next tuple needs.

    ``bias_iteration`` counts the phases that have ended, ``epoch`` the chunks. ``log_z`` is that of lines 9-11,
    ``log_average`` what the policy is made of.
    """

    visits: np.ndarray  # n(s,a), [S*A] int64
    fresh: np.ndarray  # of them in this phase, [S*A] int64
    reward: np.ndarray  # mean, [S*A]
    reward_squares: np.ndarray  # sum of squares about the mean, [S*A]
    mean_value: np.ndarray  # <V>, [S*A]
    keys: np.ndarray  # (s A + a) S + s' of what has occurred, ascending, [nnz] int64
    counts: np.ndarray  # n(s,a,s'), [nnz]
    reward_sums: np.ndarray  # of (s,a,s'), [nnz]
    log_rho_in_use: float  # line 11; log_rho is the nearest to it within the certificate
    log_rho_max: float
    phase_end: int  # tuples
    log_least: float = -math.inf  # of the least y, as far as it is known; above optimism 0 and below
    n_replaced: int = 0  # phases at whose end V was taken from the counts
    status: Status | None = Status.UNCERTIFIED  # CONVERGED where certified, REDUCIBLE as in CertaintyEquivalence
    message: str = "no state has been returned to yet"

    @property
    def value(self) -> np.ndarray:
        """V, fixed in a phase, [S]."""
        return self.log_psi_in_use.numpy() / -self.beta

    @property
    def model(self) -> EmpiricalMDP:
        """The empirical model of all tuples so far."""
        n_states, n_actions = self.log_z.shape
        pair, s_next = np.divmod(self.keys, n_states)
        indptr = np.searchsorted(pair, np.arange(len(self.visits) + 1))
        rows = (self.counts / self.visits[pair], s_next.astype(np.int32), indptr)
        return EmpiricalMDP(
            visits=self.visits.reshape(n_states, n_actions),
            transition=sp.csr_array(rows, shape=(len(self.visits), n_states)),
            reward=self.reward.reshape(n_states, n_actions),
            reward_variance=(self.reward_squares / np.maximum(self.visits - 1, 1)).reshape(n_states, n_actions),
            reward_given_next=self.reward_sums / self.counts,
        )

    def part(self) -> EmpiricalProblem | None:
        """The problem of the counts; None while no state has been returned to."""
        try:
            return self.model.problem(self.beta, self.prior_policy, optimism=self.optimism)
        except InputError as error:
            if error.key != "transitions":
                raise
            return None

    def backed_up(self, part: EmpiricalProblem, value: np.ndarray) -> np.ndarray:
        """beta (r + C V) of V [n] on the problem of the counts, less what ``part`` adds to r for unvisited actions."""
        missing = np.where(part.used, 0.0, self.prior_policy.numpy())[part.problem.states].sum(1)
        return np.asarray(self.beta * part.problem.action_value(value) - np.log1p(-missing)[:, None])

    def goal(self, tol: float, policy: np.ndarray) -> float:
        """What the certificate is to be within: .3% of the range of the mean rewards, or of ten times what ``policy``
        [S, A] meets of them in the states as visited, if less; from 1000 tuples a visited pair on, a share that falls
        as 1/tuples, like the loss of certainty equivalence, down to ``tol``."""
        reward = self.reward[self.visits > 0]
        span = float(np.ptp(reward)) or float(np.abs(reward).max()) or 1.0
        share = self.visits.reshape(policy.shape).sum(1) / self.visits.sum()
        met = float(share @ (policy * np.abs(self.reward.reshape(policy.shape))).sum(1))
        span = min(span, 10 * met) if met > 0 else span
        return span * max(tol, min(0.003, 3 * len(reward) / self.n_tuples))

    def metrics(self) -> dict[str, float]:
        """The scalars that are logged, by their documented names (docs/logging.md)."""
        return super().metrics() | {"n_replaced": self.n_replaced}


def _weights(data: Experience, model: EmpiricalMDP) -> tuple[np.ndarray, np.ndarray]:
    """(mean weight of each pair, its largest weight over that), [S*A] each; 1 where there is no visit."""
    n = model.visits.size
    total, largest = np.zeros(n), np.zeros(n)
    for chunk in data.chunks():
        assert chunk.weight is not None
        pair = chunk.s * np.int32(model.n_actions) + chunk.a
        np.add.at(total, pair, chunk.weight)
        np.maximum.at(largest, pair, chunk.weight)
    met = total > 0
    mean = np.where(met, total / np.maximum(model.visits.ravel(), 1), 1.0)
    return mean, np.where(met, largest / mean, 1.0)


@dataclass(frozen=True, eq=False)
class EfficientStream:
    """A stream made ready for the compiled loops: done once a fit."""

    n_tuples: int  # of the whole stream, those that take no part included
    parts: Parts[tuple[np.ndarray, np.ndarray, np.ndarray]]  # a chunk each, int32, int32, float64:
    #   s * A + a; s', or s' * A + a'; beta r where `noisy`, else [0]
    #   (kappa r where rewards count jointly with s')
    weights: Parts[np.ndarray | None]  # a chunk each: w over the mean of the pair, None without weights
    largest_weight: np.ndarray  # of each pair, [S*A]; empty without weights
    noisy: bool  # each tuple's own r is in the third column
    own_reward: bool  # ... as exp(beta r), in place of the mean reward
    log_factor_max: float  # of the third column
    squares: EmpiricalMDP  # ... at 2 kappa
    model: EmpiricalMDP  # where rewards count jointly with s', their ``joint``
    part: EmpiricalProblem
    weight: torch.Tensor  # [S, A]
    inside: np.ndarray  # [S, A] bool: pairs of the problem; u = 1 elsewhere
    visited: np.ndarray  # [n_visited], pairs in the stream
    members: np.ndarray  # states with a pair inside
    psi_rows: tuple[np.ndarray, np.ndarray, np.ndarray]  # CSR, rows of the visited pairs that sum to 1
    log_keep: np.ndarray  # [n_visited], log of what an epoch of lines 2-3 leaves of the old value; -inf: nothing
    log_rho_max: float
    theta_bounds: tuple[float, float]  # of V = 0, where the problem is the one that z solves; else infinite


@dataclass(frozen=True, eq=False)
class EfficientS1(StreamLearner[EfficientState, EfficientStream]):
    """Algorithm S1 with options that reach certainty equivalence; see the module's docstring.

    Args:
        beta: inverse temperature, 1/reward, > 0.
        optimism: 1 optimistic (control as inference), 0 right (the paper), negative robust; any number but those
            within 1e-8 of 0, where streamed numbers lose their digits.
        reward_noise: "mean", or "joint": rewards that vary for the same (s,a) count together with s'.
        lr_u, lr_rho: step sizes in (0, 1]; lr_rho None is lr_u / n_states. With ``clocks``, lr_u counts for nothing
            else.
        n_epochs: passes over the stream a biasing iteration. Short ones serve best where u is carried over.
        n_bias: biasing iterations at most, the unbiased first included.
        prior_policy: [S, A], 0 where a state does not have the action; None is uniform.
        tol: width at which the certificate ends the run, relative to the range of the rewards.
        clock_horizon, clock_floor: of the clocks; h >= 1, floor in (0, 1].
        phase_growth: of the online mode, > 1.
        lr_psi, psi_tol, max_psi_epochs: of lines 2-3, without ``sample_mean_psi``.
        sample_mean_psi, expected_backup, clocks, mean_reward, warm_start, polyak, log_domain, certificate, unvisited:
            the options.

    Raises:
        InputError: an argument out of its range.
    """

    states: ClassVar[tuple[type, ...]] = (EfficientState,)
    stream_bytes: ClassVar[int] = 8  # pairs
    takes_weights: ClassVar[bool] = True

    beta: float = 10.0
    optimism: float = field(default=0.0, kw_only=True)
    lr_u: float = 0.005
    lr_rho: float | None = None
    n_epochs: int = 3
    n_bias: int = 30
    prior_policy: torch.Tensor | np.ndarray | None = None
    tol: float = 1e-7
    clock_horizon: float = 10.0
    clock_floor: float = 0.05
    phase_growth: float = 2.0
    lr_psi: float = 0.1
    psi_tol: float = 1e-4
    max_psi_epochs: int = 10_000
    sample_mean_psi: bool = True
    expected_backup: bool = True
    clocks: bool = True
    mean_reward: bool = True
    warm_start: bool = True
    polyak: bool = True
    log_domain: str = "auto"
    certificate: bool = True
    unvisited: str = "exclude"
    reward_noise: str = "mean"

    def __post_init__(self) -> None:
        checks.plain(self)
        checks.temperature("beta", self.beta)
        checks.optimism("optimism", self.optimism, self.beta)
        if 0 < abs(self.optimism) < LEAST_OPTIMISM:  # what is streamed is divided by it
            allowed = f"0, or at least {LEAST_OPTIMISM:g} in size (CertaintyEquivalence takes smaller ones)"
            raise InputError("optimism", self.optimism, allowed)
        checks.step_size("lr_u", self.lr_u)
        if self.lr_rho is not None:
            checks.step_size("lr_rho", self.lr_rho)
        checks.at_least("n_epochs", self.n_epochs, 1)
        checks.at_least("n_bias", self.n_bias, 1)
        checks.positive("tol", self.tol)
        if not (checks.is_number(self.clock_horizon) and 1 <= self.clock_horizon < math.inf):
            raise InputError("clock_horizon", self.clock_horizon, "a finite number >= 1")
        checks.step_size("clock_floor", self.clock_floor)
        if not (checks.is_number(self.phase_growth) and 1 < self.phase_growth < math.inf):
            raise InputError("phase_growth", self.phase_growth, "a finite number > 1")
        checks.step_size("lr_psi", self.lr_psi)
        checks.positive("psi_tol", self.psi_tol)
        checks.at_least("max_psi_epochs", self.max_psi_epochs, 1)
        checks.one_of("log_domain", self.log_domain, ("auto", "on", "off"))
        checks.one_of("unvisited", self.unvisited, ("exclude", "initial"))
        checks.one_of("reward_noise", self.reward_noise, NOISE)
        if self.reward_noise == "joint" and not (self.sample_mean_psi and self.mean_reward):
            raise InputError("reward_noise", "joint", "mean where sample_mean_psi or mean_reward is off")

    @classmethod
    def published(cls, beta: float = 10.0, **options: object) -> EfficientS1:
        """Every option at the paper's value, unless given: Algorithm S1 itself."""
        off: dict[str, object] = dict.fromkeys(SWITCHES, False)
        paper: dict[str, object] = {"log_domain": "off", "unvisited": "initial", "n_epochs": 15, "n_bias": 6}
        return cls(beta, **(off | paper | options))  # type: ignore[arg-type]

    @property
    def kappa(self) -> float:
        """optimism * beta, 1/reward."""
        return self.optimism * self.beta

    @property
    def averages_exp_reward(self) -> bool:
        return not self.mean_reward

    @property
    def drawn_from_prior(self) -> str:
        return "" if self.expected_backup else "a_next"

    def fit(self, transitions: Experience, n_states: int, n_actions: int) -> Solution:
        """Run to the end and return the solution.

        Status CONVERGED once certified, COMPLETED after n_bias iterations, UNCERTIFIED where the certificate is then
        wider than .3% of what the policy meets, REDUCIBLE as in CertaintyEquivalence (these two with ``certificate``,
        ``unvisited="exclude"`` and mean rewards only); NON_FINITE only with ``log_domain="off"``, with the tables of
        the last good epoch.

        Raises:
            InputError: a state or action out of range, a prior policy of the wrong shape, or a stream that never
                returns to any state.
        """
        return super().fit(transitions, n_states, n_actions)

    def finished(self, state: EfficientState) -> bool:
        """Certified, or after the last epoch of the last biasing iteration."""
        return state.certified or (state.bias_iteration, state.epoch) == (self.n_bias - 1, self.n_epochs)

    @property
    def passes(self) -> int:
        """n_bias * n_epochs."""
        return self.n_bias * self.n_epochs

    def milestone(self, state: EfficientState) -> str:
        """The end of a biasing iteration."""
        return "" if state.epoch < self.n_epochs else f"biasing iteration {state.bias_iteration}"

    def progress(self, state: EfficientState) -> str:
        """Biasing iteration, epoch and theta."""
        return f"bias {state.bias_iteration}/{self.n_bias - 1} {super().progress(state)}"

    def solution(
        self,
        state: EfficientState,
        history: Sequence[Mapping[str, float]] = (),
        failure: BaseException | None = None,
    ) -> Solution:
        """The solution that ``state`` stands for; its status as ``fit`` says."""
        status = self.ended(state, failure)
        if status is Status.NON_FINITE:
            pass
        elif state.status is not None and (isinstance(state, OnlineState) or self.finished(state)):
            status = state.status
        elif state.certified:
            status = Status.CONVERGED
        elif status is Status.COMPLETED and not state.psi_converged:
            status = Status.PSI_LIMIT
        return Solution(
            policy=state.policy,
            u=state.u,
            psi=state.psi,
            rho=state.rho,
            theta=state.theta,
            reward_bias=state.reward_bias,
            reward_bias_max=state.reward_bias_max,
            n_steps=state.n_tuples,
            status=status,
            message=message(failure) or state.message,
            beta=self.beta,
            optimism=self.optimism,
            history=columns(history),
        )

    def online(
        self, chunks: Iterable[Transitions], n_states: int, n_actions: int, state: OnlineState | None = None
    ) -> Iterator[OnlineState]:
        """Learn from a stream that comes in chunks of any size, each seen once; yield the state after each.

        Of the options only beta, prior, tol, clock_horizon, phase_growth and the step sizes count (the clocks' floor
        is the smaller of lr_u and clock_floor: no later pass takes its noise away); the rest are as if on.
        How the stream is cut changes no bit of a state but its ``epoch``, which counts the chunks. Memory:
        O(S A + distinct (s,a,s')), beside the chunk.

        Args:
            chunks: the stream.
            n_states, n_actions: sizes of the tables.
            state: the last one of an earlier call, to go on from; None is the beginning.

        Raises:
            InputError: chunks that are no Transitions, a state or action out of range, or rewards whose squares are not
                finite.
        """
        checks.instance("chunks", chunks, Iterable, "an iterable of Transitions, as of recording.chunks()")
        state = self.init_online(n_states, n_actions) if state is None else state
        for chunk in chunks:
            state = self.learn(state, chunk)
            yield state

    def init(self, n_states: int, n_actions: int) -> EfficientState:
        """The state before any tuple: the prior policy, rho = exp(-beta), no bias."""
        prior = torch.from_numpy(check_prior("prior_policy", self.prior_policy, n_states, n_actions))
        zero, none = torch.zeros_like(prior), torch.zeros(n_states, dtype=torch.float64)
        return EfficientState(
            bias_iteration=0,
            epoch=0,
            n_tuples=0,
            beta=self.beta,
            log_rho=-self.beta,
            prior_policy=prior,
            weight=prior,
            log_z=zero,
            log_total=zero - math.inf,
            log_average=zero,
            log_psi=none,
            log_psi_in_use=none,
            log_mean_psi=zero,
            mean_log_psi=zero,
            optimism=self.optimism,
        )

    def prepare(self, transitions: Experience, n_states: int, n_actions: int) -> EfficientStream:
        """Validate the stream against the sizes and compute what is the same in every epoch: one pass, or a few."""
        data, lr_psi = weighing(transitions, n_states, n_actions), 0.0 if self.sample_mean_psi else self.lr_psi
        weighted = is_weighted(data)
        if weighted and not self.sample_mean_psi:
            raise InputError("sample_mean_psi", False, "true where tuples have weights")
        found = tally(data, n_states, n_actions, lr_psi)
        model = empirical_mdp(data, n_states, n_actions, found)
        part = model.problem(self.beta, self.prior_policy, optimism=self.optimism)
        prior = check_prior("prior_policy", self.prior_policy, n_states, n_actions)
        weight = prior
        if self.unvisited == "exclude":
            taken = np.asarray(part.used.any(1))
            met = np.repeat(part.used.ravel(), np.diff(found.indptr)) & taken[found.indices]
            if not met.all():

                def takes_part(chunk: Transitions) -> np.ndarray:
                    return np.asarray(part.used[chunk.s, chunk.a] & taken[chunk.s_next])

                if isinstance(data, Transitions):
                    data = data.where(takes_part(data))
                else:
                    data = Selection(data, takes_part, int(found.counts[met].sum()))
                found = tally(data, n_states, n_actions, lr_psi)
                model = empirical_mdp(data, n_states, n_actions, found)
            weight = prior * (part.used | ~taken[:, None])
        together = self.reward_noise == "joint" and self.optimism != 0 and found.varied
        squares = joint(model, data, 2 * self.kappa) if together else model
        if together:
            model = joint(model, data, self.kappa)
            part = replace(part, problem=model.problem(self.beta, self.prior_policy, optimism=self.optimism).problem)
        visits = model.visits.ravel()
        visited = np.flatnonzero(visits)
        indptr, indices, values = model.transition.indptr, model.transition.indices, model.transition.data
        log_keep = np.full(len(visited), -np.inf)
        if not self.sample_mean_psi:
            indptr, indices, values = found.psi_map
            values = values / np.repeat(np.add.reduceat(values, indptr[visited]), np.diff(indptr)[visited])
            with np.errstate(divide="ignore"):
                log_keep = visits[visited] * np.log1p(-self.lr_psi)
        own_reward = not self.mean_reward and found.varied
        solved = self.unvisited == "exclude" and not own_reward
        noisy = own_reward or together
        unit = self.kappa if together else self.beta

        inside = part.used if self.unvisited == "exclude" else prior > 0
        mean_weight, largest_weight = _weights(data, model) if weighted else (np.empty(0), np.empty(0))

        def relative_weights(chunk: Transitions) -> np.ndarray | None:
            if chunk.weight is None:
                return None
            return np.asarray(chunk.weight / mean_weight[chunk.s * np.int32(n_actions) + chunk.a])

        def columns(chunk: Transitions) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            after = chunk.s_next if self.expected_backup else chunk.s_next * np.int32(n_actions) + chunk.a_next
            return chunk.s * np.int32(n_actions) + chunk.a, after, unit * chunk.r if noisy else np.zeros(1)

        return EfficientStream(
            n_tuples=len(transitions),
            parts=Parts(data, columns, self._rescale_every(n_states * n_actions)),
            weights=Parts(data, relative_weights, self._rescale_every(n_states * n_actions)),
            largest_weight=largest_weight,
            noisy=noisy,
            own_reward=own_reward,
            log_factor_max=max(abs(unit * r) for r in found.reward_range) if noisy else 0.0,
            squares=squares,
            model=model,
            part=part,
            weight=torch.from_numpy(weight),
            inside=inside,
            members=np.flatnonzero(inside.any(1)),
            visited=visited,
            psi_rows=(np.append(indptr[visited], len(values)), indices, values),
            log_keep=log_keep,
            log_rho_max=max(0.0, self.beta * found.reward_range[1]),
            theta_bounds=part.problem.gains(np.zeros(part.problem.n_states)).theta_bounds
            if solved
            else (-np.inf, np.inf),
        )

    def step(self, state: EfficientState, stream: EfficientStream) -> EfficientState:
        """One epoch of lines 9-12, and before the first of a biasing iteration lines 2-8.

        Pure: ``state`` is left as it is. Raises NonFiniteError, with ``log_domain="off"`` only.
        """
        if state.epoch == self.n_epochs:
            state = replace(state, bias_iteration=state.bias_iteration + 1, epoch=0)
        if state.epoch == 0:
            state = self._new_biases(replace(state, weight=stream.weight), stream)
            state = state.with_theta_in(stream.theta_bounds)
        log_z, log_total, log_rho = self._u_epoch(state, stream)
        log_average = log_z
        inside, log_psi = stream.inside, state.log_psi_in_use.numpy()[:, None]
        window = state.epoch + 1 - self.n_epochs // 2  # epochs in the mean
        if self.polyak and window > 0:
            n = stream.model.visits * window
            log_average = np.where(n > 0, log_total - np.log(np.maximum(n, 1)), log_z)
        with np.errstate(divide="ignore"):
            log_weight = np.log(state.weight.numpy())
        log_u = log_average - log_psi
        log_u -= logsumexp(log_u[inside]) - math.log(inside.sum())
        log_u = np.where(inside, log_u, 0.0)
        log_average = log_u + log_psi
        after = replace(
            state,
            epoch=state.epoch + 1,
            n_tuples=state.n_tuples + stream.n_tuples,
            log_rho=log_rho,
            log_z=torch.from_numpy(log_z),
            log_total=torch.from_numpy(log_total),
            log_average=torch.from_numpy(log_average),
            log_psi=torch.from_numpy(-logsumexp(log_weight + log_u, axis=1)),  # line 12
        )
        return self._certified(after, stream.part, solved=np.isfinite(stream.theta_bounds[0]))

    def init_online(self, n_states: int, n_actions: int) -> OnlineState:
        """The state of the online mode before any tuple."""
        start = self.init(n_states, n_actions)
        zero, none = np.zeros(n_states * n_actions), np.zeros(n_states * n_actions, np.int64)
        return OnlineState(
            **{f.name: getattr(start, f.name) for f in fields(start) if f.name not in ("status", "message")},
            visits=none,
            fresh=none,
            reward=zero,
            reward_squares=zero,
            mean_value=zero,
            keys=np.empty(0, np.int64),
            counts=np.empty(0),
            reward_sums=np.empty(0),
            log_rho_in_use=start.log_rho,
            log_rho_max=0.0,
            phase_end=n_states * n_actions,
        )

    def learn(self, state: OnlineState, chunk: Transitions) -> OnlineState:
        """The state after one more chunk of the online mode.

        Pure: ``state`` is left as it is. Raises InputError as ``online`` does.
        """
        checks.instance("chunk", chunk, Transitions, "Transitions")
        check_unweighted("chunk", chunk, "the online mode of EfficientS1 has no weights, but its fit has")
        if self.reward_noise == "joint" and self.optimism:
            raise InputError("reward_noise", "joint", "mean in the online mode, which keeps mean rewards only")
        chunk.check_range(*state.log_z.shape)
        there = state.prior_policy.numpy() > 0
        if not there.all():
            taken = there[chunk.s, chunk.a]
            if not taken.any():
                return replace(state, epoch=state.epoch + 1)
            chunk = chunk if taken.all() else chunk.where(taken)
        done = 0
        while done < len(chunk):
            stop = min(len(chunk), done + state.phase_end - state.n_tuples)
            state = self._observe(state, chunk.where(slice(done, stop)))
            if state.n_tuples == state.phase_end:
                state = self._end_phase(state)
            done = stop
        return self._judged(replace(state, epoch=state.epoch + 1))

    # -- lines --------------------------------------------------------------------------------------

    def _new_biases(self, state: EfficientState, stream: EfficientStream) -> EfficientState:
        """Lines 2-8."""
        log_mean_psi, mean_log_psi = state.log_mean_psi.numpy().copy(), state.mean_log_psi.numpy().copy()
        x, y = log_mean_psi.reshape(-1), mean_log_psi.reshape(-1)  # views
        log_psi = state.log_psi.numpy()
        visited, (indptr, indices, values) = stream.visited, stream.psi_rows
        lam = self.optimism

        def log_means(h: np.ndarray) -> np.ndarray:
            """log <exp h> of the visited pairs."""
            found, scratch, tilted = np.empty(len(visited)), np.empty(len(visited)), np.empty(len(values))
            solvers_kernels.tilt_rows(indptr, indices, values, h, found, scratch, tilted)
            return found

        new_x = log_means((1.0 - lam) * log_psi)
        new_y = log_means(-lam * log_psi) if lam else np.add.reduceat(values * log_psi[indices], indptr[:-1])
        # One epoch of lines 2-3 is x <- keep x + (1 - keep) new: convex, whatever the numbers.
        with np.errstate(divide="ignore", under="ignore", over="ignore"):
            keep = np.exp(stream.log_keep)
            log_fresh = np.log(-np.expm1(stream.log_keep))
            converged = self.sample_mean_psi
            for _ in range(1 if self.sample_mean_psi else self.max_psi_epochs):
                before_x, before_y = x[visited], y[visited]
                x[visited] = np.logaddexp(stream.log_keep + before_x, log_fresh + new_x)
                if lam:  # y is -log <psi^-lam> / lam
                    y[visited] = np.logaddexp(stream.log_keep - lam * before_y, log_fresh + new_y) / -lam
                else:
                    y[visited] = keep * before_y + (1 - keep) * new_y
                change = np.maximum(
                    np.abs(np.expm1((x[visited] - before_x) / (1.0 - lam or 1.0))),
                    np.abs(y[visited] - before_y) / (np.abs(before_y) + LOG_PSI_EPSILON),
                )
                if self.sample_mean_psi or change.max() < self.psi_tol:
                    converged = True
                    break
        after = replace(
            state,
            log_psi_in_use=state.log_psi,
            log_mean_psi=torch.from_numpy(log_mean_psi),
            mean_log_psi=torch.from_numpy(mean_log_psi),
            psi_converged=state.psi_converged and converged,
            log_total=torch.full_like(state.log_total, -math.inf),
        )
        if self.warm_start and state.bias_iteration > 0:
            theta = -state.log_rho / self.beta - state.reward_bias_max
            log_z = state.log_average + (state.log_psi - state.log_psi_in_use)[:, None]
            return replace(after, log_z=log_z, log_rho=-self.beta * (theta + after.reward_bias_max))
        log_z = state.log_psi[:, None].expand_as(state.log_z).clone()  # lines 7, 8
        return replace(after, log_z=log_z, log_rho=-self.beta)

    def steps(self) -> np.ndarray:
        """The step of a pair's n-th visit in a biasing iteration, n = 0, 1, ...; the last entry stays."""
        if not self.clocks:
            return np.array([self.lr_u])
        n = np.arange(math.ceil(min(self.clock_horizon * (1 / self.clock_floor - 1), LAST_STEP)) + 1)
        return np.asarray(np.maximum(self.clock_floor, self.clock_horizon / (self.clock_horizon + n)))

    def _certified(self, state: EfficientState, part: EmpiricalProblem, solved: bool) -> EfficientState:
        """With the certificate, and what it says where the run ends; ``solved``: it is of the problem that z solves."""
        policy = state.policy.numpy()
        low, high = certificate(part, state.log_psi.numpy(), policy)
        certified = self.certificate and is_narrow(part, (-high, -low), self.tol, policy)
        state = replace(state, empirical_width=high - low, certified=certified)
        if not (self.certificate and solved):
            return state
        status = Status.REDUCIBLE if part.reducible else None
        message = [part.message] if part.reducible else []
        if not self.finished(state):
            return replace(state, status=status, message="; ".join(message))
        if not is_narrow(part, (-high, -low), max(WIDE, self.tol), policy):
            status = status or Status.UNCERTIFIED
            message.append(
                f"certificate {high - low:.2g} wide after all passes; in the data, {proven((-high, -low), None)}"
            )
        return replace(state, status=status, message="; ".join(message)).with_theta_in((-high, -low))

    def _u_epoch(self, state: EfficientState, stream: EfficientStream) -> tuple[np.ndarray, np.ndarray, float]:
        """(log z, log total, log rho) after an epoch of lines 9-11."""
        lam, log_psi, mean_log_psi = self.optimism, state.log_psi_in_use.numpy(), state.mean_log_psi.numpy()
        reward = 0.0 if stream.own_reward else stream.model.reward
        tilts = bool(lam) and self.sample_mean_psi and self.expected_backup and self.mean_reward
        # Where e is streamed as it comes, the gauge psi^(1-lam) u takes it in, and z is that of it.
        power = 1.0 if tilts else 1.0 - lam
        gauge = (1.0 - power) * log_psi[:, None]
        log_g = self.beta * (reward - state.reward_bias_max) - power * mean_log_psi
        log_g += power * log_psi[:, None]
        log_share = lam * mean_log_psi  # 1 / exp(kappa C V)
        if stream.noisy and not stream.own_reward:
            log_share = log_share - self.kappa * reward
            log_g = log_g if tilts else log_g - self.kappa * reward
        log_z = state.log_z.numpy() - gauge
        top = log_z[stream.inside].max()
        log_z, log_total = np.where(stream.inside, log_z - top, 0.0), state.log_total.numpy() - gauge - top
        log_g = np.where(stream.inside, log_g, 0.0)
        middle = -lam * float(log_psi[stream.members].mean())
        log_tilt = np.where(stream.inside.any(1), -lam * log_psi - middle, 0.0)
        log_share = np.where(stream.inside, log_share + middle, 0.0)
        tilt = (log_tilt, log_share) if tilts else ()
        sizes = [np.abs(x).max() for x in (log_g, *tilt)]
        span = max(*sizes, stream.log_factor_max, -log_z.min(), abs(state.log_rho))
        with np.errstate(all="ignore"):
            if self.log_domain == "off" or (self.log_domain == "auto" and span < SAFE_RANGE):
                g, z, total = np.exp(log_g), np.exp(log_z), np.exp(log_total)
                rho, healthy = self._stream(np.exp, state, stream, g, z, total, tuple(map(np.exp, tilt)))
                if healthy:
                    return np.log(z) + gauge, np.log(total) + gauge, math.log(rho)
                if self.log_domain == "off":
                    raise NonFiniteError(
                        state.n_tuples,
                        f"u or rho is no longer a positive finite number in biasing iteration {state.bias_iteration}, "
                        f"epoch {state.epoch + 1}, at beta={self.beta:g}: set log_domain to auto",
                    )
            log_rho, _ = self._stream(np.asarray, state, stream, log_g, log_z, log_total, tilt)
        return log_z + gauge, log_total + gauge, log_rho

    def _largest_steps(self, state: EfficientState, stream: EfficientStream) -> np.ndarray:
        """1 / <e^2> of each pair, [S*A]: larger steps would let noise grow."""
        model, h = stream.squares, -2.0 * self.optimism * state.log_psi_in_use.numpy()
        p, found = model.transition, np.empty(state.log_z.numel())
        solvers_kernels.tilt_rows(p.indptr, p.indices, p.data, h, found, np.empty(len(found)), np.empty(p.nnz))
        found += 2.0 * self.optimism * state.mean_log_psi.numpy().ravel()
        found += 2.0 * self.kappa * (model.reward - stream.model.reward).ravel()
        return np.exp(-np.maximum(found, 0.0))

    def _stream(
        self,
        number: Callable[[Any], Any],
        state: EfficientState,
        stream: EfficientStream,
        g: np.ndarray,
        z: np.ndarray,
        total: np.ndarray,
        tilt: tuple[np.ndarray, ...],
    ) -> tuple[float, bool]:
        """Run a kernel over the stream, a block at a time; ``number`` makes of a logarithm what it computes with.

        ``tilt``: of s' and of pairs, where e is backed up by its mean; else empty.
        """
        n_states, n_actions = z.shape
        lr_rho = self.lr_u / n_states if self.lr_rho is None else self.lr_rho
        lr_rho = lr_rho / (state.epoch + 1) if self.clocks else lr_rho
        visits = (stream.model.visits * state.epoch).ravel()
        rho, rho_max = number(state.log_rho), number(stream.log_rho_max)
        weight = number(state.weight.log().numpy().ravel())
        average = self.polyak and state.epoch >= self.n_epochs // 2
        plain = number is np.exp
        if tilt:
            kernel = kernels.tilted_gauge_epoch if plain else kernels.log_tilted_gauge_epoch
        else:
            kernel = kernels.gauge_epoch if plain else kernels.log_gauge_epoch
        largest = self._largest_steps(state, stream) if tilt else np.ones(z.size)
        if len(stream.largest_weight):
            largest = largest / np.maximum(stream.largest_weight, 1.0)
            lr_rho = min(lr_rho, 1 / float(stream.largest_weight.max()))
        of_tilt = (tilt[0], tilt[1].ravel(), largest, stream.members) if tilt else ()
        which = () if tilt else (self.expected_backup,)
        t = 0
        for (pair, after, log_factor), weights in zip(stream.parts, stream.weights, strict=True):
            of_weights = () if weights is None else (weights,) if tilt else (weights, largest)
            first, last, factor = t, t + len(pair), number(log_factor)
            while t < last:
                stop = min(last, t - t % BLOCK + BLOCK)
                rho, healthy = kernel(
                    pair,
                    after,
                    factor,
                    stream.noisy,
                    g.ravel(),
                    *of_tilt,
                    z.reshape(-1),
                    total.reshape(-1),
                    average,
                    weight,
                    n_actions,
                    self.steps(),
                    visits,
                    float(rho),
                    lr_rho,
                    float(rho_max),
                    *which,
                    self._rescale_every(z.size),
                    t,
                    stop,
                    first,
                    *of_weights,
                )
                if not healthy:
                    return rho, False
                t = stop
        return rho, True

    # -- the online mode ----------------------------------------------------------------------------

    def _observe(self, state: OnlineState, data: Transitions) -> OnlineState:
        """Lines 9-11, and the counts, over tuples of one phase."""
        n_states, n_actions = state.log_z.shape
        pair = data.s * np.int32(n_actions) + data.a
        names = ("visits", "fresh", "reward", "reward_squares", "mean_value")
        tables = {name: getattr(state, name).copy() for name in names}
        log_z = state.log_z.numpy().copy()
        lr_rho = self.lr_u / n_states if self.lr_rho is None else self.lr_rho
        kernel = kernels.tilted_online_phase if self.optimism else kernels.online_phase
        kappa = (self.kappa,) if self.optimism else ()
        of_least = (state.log_least, state.n_tuples, max(LEAST_EVERY, n_states)) if self.optimism else ()
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            log_rho, log_rho_max, *log_least = kernel(
                pair,
                data.s_next,
                data.r,
                self.beta,
                *kappa,
                state.value,
                *tables.values(),
                log_z.reshape(-1),
                np.log(state.prior_policy.numpy().ravel()),
                n_actions,
                replace(self, clocks=True, clock_floor=min(self.clock_floor, self.lr_u)).steps(),
                state.log_rho_in_use,
                lr_rho / (state.bias_iteration + 1),
                state.log_rho_max,
                *of_least,
            )
        if not np.isfinite(tables["reward_squares"]).all():
            raise InputError(
                "r", f"between {data.r.min():g} and {data.r.max():g}", "of a size whose squares are finite"
            )
        key = pair * np.int64(n_states) + data.s_next
        keys = np.union1d(state.keys, key)
        entry = np.searchsorted(keys, np.append(state.keys, key))
        return replace(
            state,
            **tables,
            n_tuples=state.n_tuples + len(data),
            log_z=torch.from_numpy(log_z),
            log_rho_in_use=log_rho,
            log_rho_max=log_rho_max,
            log_least=log_least[0] if log_least else state.log_least,
            keys=keys,
            counts=np.bincount(entry, np.append(state.counts, np.ones(len(data)))),
            reward_sums=np.bincount(entry, np.append(state.reward_sums, data.r)),
        )

    def _end_phase(self, state: OnlineState) -> OnlineState:
        """Line 12, or V and z of the counts where its certificate is wide; rho within the certificate."""
        n_states, n_actions = state.log_z.shape
        visits = state.visits.reshape(n_states, n_actions)
        weight = state.prior_policy.numpy() * ((visits > 0) | ~visits.any(1, keepdims=True))
        log_z = state.log_z.numpy().copy()
        with np.errstate(divide="ignore"):
            h = logsumexp(np.log(weight) + log_z, axis=1)
        h -= np.average(h, weights=visits.sum(1))
        log_z -= h[:, None]
        value, log_rho, n_replaced = state.value + h / self.beta, state.log_rho_in_use, state.n_replaced
        part = state.part()
        if part is not None:
            problem, inside = part.problem, part.problem.states
            sweeps = math.ceil(SWEPT_PER_TUPLE * state.n_tuples / problem.transition.nnz)
            with np.errstate(divide="ignore"):
                policy = softmax(np.log(weight) + log_z, axis=1)
            found, gain, needed = swept(problem, value[inside], state.goal(self.tol, policy), sweeps)
            low, high = float(gain.min()), float(gain.max())
            log_rho = float(np.clip(log_rho, self.beta * low, self.beta * high))
            if needed:
                found += np.average(value[inside] - found, weights=visits[inside].sum(1))
                value[inside], n_replaced = found, n_replaced + 1
                z = state.backed_up(part, found) - self.beta * (found[:, None] + (low + high) / 2)
                log_z[inside] = np.where(part.used[inside], z, log_z[inside])
        return replace(
            state,
            bias_iteration=state.bias_iteration + 1,
            phase_end=math.ceil(self.phase_growth * state.phase_end),
            n_replaced=n_replaced,
            fresh=np.zeros_like(state.fresh),
            mean_value=self._certain(state, value),
            log_least=-math.inf,
            log_z=torch.from_numpy(log_z),
            log_rho_in_use=log_rho,
            log_psi_in_use=torch.from_numpy(-self.beta * value),
        )

    def _certain(self, state: OnlineState, value: np.ndarray) -> np.ndarray:
        """C V of ``value`` [S] on the counts, [S*A]; 0 without visits."""
        n_states, visits = len(value), np.maximum(state.visits, 1)
        pair, s_next = np.divmod(state.keys, n_states)
        if not self.optimism:
            return np.asarray(np.bincount(pair, state.counts * value[s_next], visits.size) / visits)
        met, first = np.unique(pair, return_index=True)
        found = np.zeros(visits.size)
        log_sums = np.logaddexp.reduceat(np.log(state.counts) + self.kappa * value[s_next], first)
        found[met] = (log_sums - np.log(visits[met])) / self.kappa
        return found

    def _judged(self, state: OnlineState) -> OnlineState:
        """With a policy and its certificate on the counts: that of z, or of V swept, if narrower, where z's is wide."""
        part = state.part()
        if part is None:
            return state
        problem, inside = part.problem, part.problem.states
        weight = state.prior_policy.numpy() * (part.used | ~part.used.any(1, keepdims=True))
        log_psi = state.log_psi_in_use.numpy()

        def judged(log_z: np.ndarray) -> tuple[float, float, np.ndarray, np.ndarray]:
            """(the certificate's two ends, z, log psi of line 12)."""
            with np.errstate(divide="ignore"):
                log_policy = np.log(weight) + log_z
            log_y = logsumexp(log_policy, axis=1)
            low, high = certificate(part, log_psi - log_y, np.exp(log_policy - log_y[:, None]))
            return low, high, log_z, log_psi - log_y

        log_z = np.zeros_like(weight)
        log_z[inside] = state.log_z.numpy()[inside]
        low, high, log_average, line_12 = judged(log_z)
        with np.errstate(divide="ignore"):
            goal = state.goal(self.tol, softmax(np.log(weight) + log_average, axis=1))
        if not high - low <= goal:
            value, *_ = swept(problem, state.value[inside], goal, STATE_SWEEPS)
            log_z[inside] = state.backed_up(part, value) - self.beta * state.value[inside, None]
            other = judged(np.where(part.used, log_z, 0.0))
            if other[1] - other[0] < high - low:
                low, high, log_average, line_12 = other
        certified = high - low <= goal
        message = [part.message] if part.message else []
        if not certified:
            message.append(f"certificate {high - low:.2g} wide after {state.n_tuples} tuples, not {goal:.2g}")
        mean_log_psi = torch.from_numpy(-self.beta * state.mean_value.reshape(weight.shape))
        status = Status.CONVERGED if certified else Status.UNCERTIFIED
        return replace(
            state,
            log_rho=float(np.clip(state.log_rho_in_use, self.beta * low, self.beta * high)),
            weight=torch.from_numpy(weight),
            log_average=torch.from_numpy(log_average),
            log_psi=torch.from_numpy(line_12),
            log_mean_psi=(1.0 - self.optimism) * mean_log_psi,  # so that delta is 0
            mean_log_psi=mean_log_psi,
            empirical_width=high - low,
            certified=certified,
            status=Status.REDUCIBLE if part.reducible else status,
            message="; ".join(message),
        )

    def _rescale_every(self, n_pairs: int) -> int:
        """Tuples between rescalings of z."""
        return max(5000, n_pairs)


SWITCHES = (
    "sample_mean_psi",
    "expected_backup",
    "clocks",
    "mean_reward",
    "warm_start",
    "polyak",
    "certificate",
)


def certificate(part: EmpiricalProblem, log_psi: np.ndarray, policy: np.ndarray) -> tuple[float, float]:
    """(min(T_pi V - V), max(TV - V)) on the empirical problem, V = -log(psi)/beta: J(pi) and g* there lie between.

    Bounds with their rounding (``erl_torch.solvers.certificates``), for the problem as its numbers stand. What
    ``policy`` [S, A] does in pairs that take no part is left out, and the rest normalised.
    """
    problem = part.problem
    value = -log_psi[problem.states] / problem.beta
    parts = (problem.transition, problem.reward, problem.prior, problem.beta)
    low, _ = policy_gains(*parts, within(part, policy), value, problem.kappa)
    return float(low.min()), float(gains(*parts, value, problem.kappa).high.max())


def is_narrow(part: EmpiricalProblem, bounds: tuple[float, float], tol: float, policy: np.ndarray) -> bool:
    """``BellmanProblem.is_narrow`` for a policy [S, A] on all states."""
    return part.problem.is_narrow(bounds, tol, within(part, policy))


def within(part: EmpiricalProblem, policy: np.ndarray) -> np.ndarray:
    """``policy`` [S, A] on the pairs that take part, [n, A], normalised."""
    inside = np.where(part.used, policy, 0.0)[part.problem.states]
    return np.asarray(inside / inside.sum(1, keepdims=True))


def swept(problem: BellmanProblem, value: np.ndarray, goal: float, sweeps: int) -> tuple[np.ndarray, np.ndarray, int]:
    """(V, TV - V, sweeps made) of relative value iteration from ``value`` [n], until TV - V spans at most ``goal``.

    V <- V + DAMPING (TV - V - c). With a step below 1 it converges on periodic chains too, and the span never rises:
    each sweep averages TV - V over successors.
    """
    made = 0
    while True:
        gain = soft_backup(problem.action_value(value), problem.prior, problem.beta)[0] - value
        if not np.ptp(gain) > goal or made == sweeps:
            return value, gain, made
        value = value + DAMPING * (gain - (gain.min() + gain.max()) / 2)
        made += 1
