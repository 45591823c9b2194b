r"""Algorithm S1: the optimal entropy-regularised policy of a stochastic MDP, from experience alone.

Source: Arriojas, Adamczyk, Tiomkin, Kulkarni, "Bayesian inference approach for entropy regularized
reinforcement learning with stochastic dynamics", UAI 2023, supplement B. Equation and line numbers are the
supplement's.

Symbols (S states, A actions; every expectation <.> is over s' ~ p(.|s,a))

    beta               inverse temperature, 1/reward
    prior_policy       pi0(a|s), [S, A]
    u                  left eigenvector of the tilted matrix, [S, A] > 0, up to scale           eq. (3)
    rho                its dominant eigenvalue                                                  eq. (3)
    psi                1 / sum_a pi0(a|s) u(s,a), [S]                                           eq. (7)
    mean_psi           <psi>(s,a), [S, A]                                                       eq. (10)
    mean_log_psi       <log psi>(s,a), [S, A]                                                   eq. (11)
    b                  dynamics bias psi(s') / <psi>(s,a)                                       eq. (8)
    reward_bias        delta(s,a) = (log <psi> - <log psi>) / beta >= 0, reward                 eq. (9)
    reward_bias_max    Delta = max delta, reward
    theta              -log(rho)/beta - Delta, reward a step; -theta is the reward rate minus KL/beta

One biasing iteration estimates <psi> and <log psi> from the stream (lines 2-3, the psi phase), then streams

    u(s,a) += lr_u * (exp(beta r_b) b(s'|s,a) u(s',a') / rho - u(s,a))          lines 9, 10; eq. (5)
    rho    += lr_rho * (exp(beta r_b) b(s'|s,a) u(s',a') / u(s,a) - rho)        line 11;     eq. (6)

with r_b = r + delta - Delta for n_epochs passes (the u phase), and sets psi anew (line 12). The policy is
pi0 u, normalised (lines 13-14). The first iteration has psi = 1, no bias: its policy is the optimistic one.

``optimism`` (lam; 1 optimistic (control as inference), 0 right, negative robust) is what the agent makes of the dice of
the dynamics. With V = -log(psi)/beta, C V = (1/kappa) log <exp(kappa V)> and kappa = lam beta (docs/theory.md, 9):

    line 2     <psi^(1-lam)> in place of <psi>; ``mean_psi`` is its power 1/(1-lam), a mean of psi
    line 3     <psi^(-lam)> in place of <log psi>; ``mean_log_psi`` is l = -log <psi^(-lam)> / lam, which is -beta C V
    line 4     b = psi(s')^(1-lam) / <psi^(1-lam)>
    line 5     delta = (log <psi^(1-lam)> - (1-lam) l) / beta: >= 0 for lam <= 1, <= 0 above

At 0 this is the listing. At 1 b = 1 and delta = 0: each biasing iteration is plain U-learning, and there is no psi
phase. Lines 6-14 are the listing's at every optimism, rho = exp(-beta) of line 8 with them. Only l counts in lines
9-11; <psi^(1-lam)> cancels but for Delta, a constant.

Exact rearrangements used by ``implementation="fast"`` (the literal twin is ``erl_torch.learners.s1.listing``)

    psi phase   psi is fixed during lines 2-3, so an epoch is the affine map x <- d x + W psi with
                d = (1-lr_psi)**n(s,a) and W found once a stream: further epochs cost O(S A), not O(N).
    gauge       exp(beta delta) b = psi(s') exp(-<log psi>), so with z = psi u one table
                g = exp(beta (r - Delta) - <log psi> + log psi(s)) holds all of lines 9-11. Likewise
                z = psi^(1-lam) u and g = exp(beta (r - Delta) + (1-lam) (log psi(s) - l)): the same loops.
    logarithms  where lam is not 0 the psi phase works in logarithms: no power of psi overflows.
    division    with q = 1/rho line 11 is q <- q z' / ((1-lr_rho) z' + lr_rho g z(s',a') q): one division.

What the listing leaves open, and what is done here. ``AlgorithmS1`` reads points 4 and 7 as the authors' script does,
which made the published Figure 5; ``ListedS1`` is the same class with the listing's readings for defaults.

1. lr_rho has no value in the listing: None is lr_u / n_states, as in the authors' script.
2. Rescaling u is not in the listing: neutral, since the updates are homogeneous in u. Every
   ``rescale_every`` tuples (fast: by powers of two, so no bit of rho or of the policy changes), and to
   mean 1 after each epoch.
3. ``clip_rho``: rho <= max(1, exp(beta max r)) after each update. The script clips at 1, which holds
   for r <= 0 only; the wider bound holds for any reward and optimism, because sum_s' p b = 1 and delta <= Delta,
   once the means of lines 2-3 have converged; before, the clip only keeps rho near where its limit lies
   (docs/theory.md, 5).
4. ``rho_init``: "reset" sets rho = exp(-beta) in every biasing iteration (line 8), "carry" only once
   (the script).
5. <psi> and <log psi> are carried over between biasing iterations (line 1 stands before the loop).
6. "Relative error" is the largest of |d<psi>|/<psi> and |d<log psi>|/(|<log psi>| + 1e-10) over all
   pairs, from one epoch to the next; at another optimism those of ``mean_psi`` and ``mean_log_psi``.
7. ``self_loop``: where (s',a') = (s,a), line 11 sees the u that line 10 has just written ("new", the
   listing read in order), or the one before ("old", the script).
8. n_bias counts all iterations, the unbiased first included: the script's n_bias_iter = 5 is 6 here.
9. ``unvisited``: a pair that never occurs keeps u = 1 of line 7, scaled along with the rest
   ("initial": the listing, the script), or has the value that gives it exactly its prior probability
   ("prior"). A state that never occurs keeps the prior policy either way.
10. Rewards that vary for the same (s,a) are used as they come: S1 averages exp(beta r), and is optimistic about that
   noise, whatever ``optimism``, which is about s' alone. At optimism 1 that is the joint convention, the mean of
   exp(beta (r + V(s'))); at any other it is neither that nor the mean reward.
11. Delta is the maximum over the pairs that occur; above optimism 1 those that do not, whose delta is 0, count, too (it
   is a constant that theta does not see).
12. A pair with prior 0 is an action that the state does not have: its u is 0, and it has no part in the scale of u.
    Tuples that take one, or lead to one as a', are left out.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np
import torch

from erl_torch import checks
from erl_torch.checks import InputError
from erl_torch.empirical.counts import tally
from erl_torch.experience.experience import Experience, Parts, tuple_at
from erl_torch.experience.transitions import Transitions
from erl_torch.learners.learner import NonFiniteError, StreamLearner, columns, message
from erl_torch.learners.s1 import kernels, listing
from erl_torch.mdp.tabular import check_prior
from erl_torch.solution import Solution, Status

LOG_PSI_EPSILON = 1e-10  # keeps the relative error of <log psi> finite where it is 0
BLOCK = 1 << 24  # tuples a compiled call, so that signals are served several times a second


@dataclass(frozen=True, eq=False)
class S1State:
    """Everything Algorithm S1 knows after an epoch of its u phase; a value, never changed in place."""

    bias_iteration: int  # 0 is the unbiased iteration
    epoch: int  # epochs of the u phase done in this biasing iteration
    n_tuples: int  # tuples streamed through lines 9-11 since the start
    beta: float
    rho: float
    prior_policy: torch.Tensor  # [S, A]
    u: torch.Tensor  # [S, A], mean 1; 0 where the prior is 0
    psi: torch.Tensor  # [S], line 12 of this u
    psi_in_use: torch.Tensor  # [S], behind the present biases
    mean_psi: torch.Tensor  # [S, A]; <psi^(1-optimism)>^(1/(1-optimism)); 1 at optimism 1, which has no psi phase
    mean_log_psi: torch.Tensor  # [S, A]; -log <psi^(-optimism)> / optimism, which is <log psi> at 0
    reward_bias: torch.Tensor  # [S, A], line 5; 0 where the stream has no visit
    psi_error: float  # relative error at which the psi phase stopped
    psi_epochs: int  # epochs it took
    psi_converged: bool = True  # false once a psi phase has met max_psi_epochs

    @property
    def reward_bias_max(self) -> float:
        """Delta, line 6; reward."""
        return float(self.reward_bias.max())

    @property
    def theta(self) -> float:
        """-log(rho)/beta - Delta, reward a step."""
        return -math.log(self.rho) / self.beta - self.reward_bias_max

    @property
    def policy(self) -> torch.Tensor:
        """[S, A], lines 13-14."""
        weight = self.prior_policy * self.u
        return weight / weight.sum(1, keepdim=True)

    def metrics(self) -> dict[str, float]:
        """The scalars that are logged, by their documented names (docs/logging.md)."""
        return {
            "rho": self.rho,
            "theta": self.theta,
            "delta_max": self.reward_bias_max,
            "delta_mean": float(self.reward_bias.cpu().numpy().mean()),
            "psi_error": self.psi_error,
            "psi_epochs": self.psi_epochs,
            "bias_iteration": self.bias_iteration,
            "epoch": self.epoch,
            "n_tuples": self.n_tuples,
        }


@dataclass(frozen=True, eq=False)
class S1Stream:
    """A stream made ready for the compiled loops: done once a fit."""

    data: Experience
    visited: np.ndarray  # [S, A] bool
    parts: Parts[tuple[np.ndarray, np.ndarray, np.ndarray]]  # pair, pair_next and factor below, a chunk each
    reward: np.ndarray  # [S*A]; all 0 where `noisy`
    noisy: bool  # rewards vary for the same (s, a)
    decay: np.ndarray  # [S*A], (1 - lr_psi) ** visits
    psi_map: tuple[np.ndarray, np.ndarray, np.ndarray]  # W, CSR [S*A, S]
    rho_max: float

    # Of a stream in memory:

    @property
    def r(self) -> np.ndarray:
        """[N]"""
        assert isinstance(self.data, Transitions)
        return self.data.r

    @property
    def pair(self) -> np.ndarray:
        """[N] int32, s * A + a."""
        return self.parts.whole[0]

    @property
    def pair_next(self) -> np.ndarray:
        """[N] int32, s' * A + a'."""
        return self.parts.whole[1]

    @property
    def factor(self) -> np.ndarray:
        """[N] exp(beta r) where ``noisy``, else [1]."""
        return self.parts.whole[2]


@dataclass(frozen=True, eq=False)
class AlgorithmS1(StreamLearner[S1State, S1Stream]):
    """Algorithm S1, every line of the listing; see the module's docstring for symbols and open points.

    Args:
        beta: inverse temperature, 1/reward, > 0.
        optimism: 1 optimistic (control as inference), 0 right, negative robust.
        lr_u, lr_rho, lr_psi: step sizes in (0, 1] of lines 10, 11 and 2-3; lr_rho None is lr_u / n_states.
        n_epochs: passes over the stream per u phase.
        n_bias: biasing iterations, the unbiased first included.
        psi_tol: relative error between epochs that ends a psi phase.
        max_psi_epochs: limit on the epochs of a psi phase.
        prior_policy: [S, A], rows sum to 1, 0 where a state does not have the action; None is uniform.
        rho_init: "carry" (line 8 only in the first biasing iteration: the script) or "reset" (in each: the listing).
        self_loop: which u(s',a') line 11 sees where (s',a') = (s,a): "old" (the script) or "new" (the listing).
        clip_rho: keep rho <= max(1, exp(beta max r)).
        rescale_every: tuples between rescalings of u; None is max(5000, S*A).
        unvisited: "initial" or "prior": what a pair without visits keeps.
        implementation: "fast" (compiled, on the CPU) or "literal" (the listing, a tuple at a time).
        device: where the tables live.

    Raises:
        InputError: an argument out of its range.
    """

    states: ClassVar[tuple[type, ...]] = (S1State,)
    stream_bytes: ClassVar[int] = 32  # columns, pairs
    averages_exp_reward: ClassVar[bool] = True
    drawn_from_prior: ClassVar[str] = "a_next"

    beta: float = 10.0
    optimism: float = field(default=0.0, kw_only=True)
    lr_u: float = 0.005
    lr_rho: float | None = None
    lr_psi: float = 0.1
    n_epochs: int = 15
    n_bias: int = 6
    psi_tol: float = 1e-4
    max_psi_epochs: int = 10_000
    prior_policy: torch.Tensor | np.ndarray | None = None
    rho_init: str = "carry"
    self_loop: str = "old"
    clip_rho: bool = True
    rescale_every: int | None = None
    unvisited: str = "initial"
    implementation: str = "fast"
    device: str = "cpu"

    def __post_init__(self) -> None:
        checks.plain(self)
        checks.temperature("beta", self.beta)
        checks.optimism("optimism", self.optimism, self.beta)
        checks.step_size("lr_u", self.lr_u)
        if self.lr_rho is not None:
            checks.step_size("lr_rho", self.lr_rho)
        checks.step_size("lr_psi", self.lr_psi)
        checks.at_least("n_epochs", self.n_epochs, 1)
        checks.at_least("n_bias", self.n_bias, 1)
        checks.positive("psi_tol", self.psi_tol)
        checks.at_least("max_psi_epochs", self.max_psi_epochs, 1)
        checks.one_of("rho_init", self.rho_init, ("reset", "carry"))
        checks.one_of("self_loop", self.self_loop, ("new", "old"))
        if self.rescale_every is not None:
            checks.at_least("rescale_every", self.rescale_every, 1)
        checks.one_of("unvisited", self.unvisited, ("initial", "prior"))
        checks.one_of("implementation", self.implementation, ("fast", "literal"))
        checks.device("device", self.device)

    def finished(self, state: S1State) -> bool:
        """After the last epoch of the last biasing iteration."""
        return (state.bias_iteration, state.epoch) == (self.n_bias - 1, self.n_epochs)

    @property
    def passes(self) -> int:
        """n_bias * n_epochs."""
        return self.n_bias * self.n_epochs

    def milestone(self, state: S1State) -> str:
        """The end of a biasing iteration."""
        return "" if state.epoch < self.n_epochs else f"biasing iteration {state.bias_iteration}"

    def progress(self, state: S1State) -> str:
        """Biasing iteration, epoch and theta."""
        return f"bias {state.bias_iteration}/{self.n_bias - 1} {super().progress(state)}"

    def solution(
        self,
        state: S1State,
        history: Sequence[Mapping[str, float]] = (),
        failure: BaseException | None = None,
    ) -> Solution:
        """The solution that ``state`` stands for; PSI_LIMIT where a psi phase met ``max_psi_epochs``."""
        status = self.ended(state, failure)
        if status is Status.COMPLETED and not state.psi_converged:
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
            message=message(failure),
            beta=self.beta,
            optimism=self.optimism,
            history=columns(history),
        )

    def init(self, n_states: int, n_actions: int) -> S1State:
        """The state before any tuple (line 1): the prior policy, rho = exp(-beta), no bias."""
        prior = check_prior("prior_policy", self.prior_policy, n_states, n_actions)
        rho = math.exp(-self.beta)
        if rho == 0.0:
            raise InputError("beta", self.beta, "below 745, where exp(-beta) leaves double precision")
        table = torch.zeros(n_states, n_actions, dtype=torch.float64, device=self.device)
        return S1State(
            bias_iteration=0,
            epoch=0,
            n_tuples=0,
            beta=self.beta,
            rho=rho,
            prior_policy=torch.from_numpy(prior).to(self.device),
            u=table + torch.from_numpy(prior > 0).to(self.device),
            psi=torch.ones(n_states, dtype=torch.float64, device=self.device),
            psi_in_use=torch.ones(n_states, dtype=torch.float64, device=self.device),
            mean_psi=table + 1,
            mean_log_psi=table,
            reward_bias=table,
            psi_error=0.0,
            psi_epochs=0,
        )

    def prepare(self, transitions: Experience, n_states: int, n_actions: int) -> S1Stream:
        """Validate the stream against the sizes and compute what is the same in every epoch: one pass."""
        if self.implementation == "literal" and not isinstance(transitions, Transitions):
            raise InputError("implementation", "literal", "fast, where the stream is not in memory")
        found = tally(transitions, n_states, n_actions, self.lr_psi)

        def part(chunk: Transitions) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            pair = chunk.s * np.int32(n_actions) + chunk.a
            pair_next = chunk.s_next * np.int32(n_actions) + chunk.a_next
            return pair, pair_next, np.exp(self.beta * chunk.r) if found.varied else np.ones(1)

        rho_max = self.largest_rho(found.reward_range[1])
        return S1Stream(
            data=transitions,
            visited=(found.visits > 0).reshape(n_states, n_actions),
            parts=Parts(transitions, part, self.rescale(n_states * n_actions)),
            reward=np.zeros(n_states * n_actions) if found.varied else found.last_reward,
            noisy=found.varied,
            decay=(1 - self.lr_psi) ** found.visits.astype(np.float64),
            psi_map=found.psi_map,
            rho_max=rho_max,
        )

    def step(self, state: S1State, stream: S1Stream) -> S1State:
        """One epoch of lines 9-12, and before the first of a biasing iteration lines 2-8.

        Pure: ``state`` is left as it is. Raises NonFiniteError.
        """
        with np.errstate(all="ignore"):  # what matters is caught by name, with its step
            if state.epoch == self.n_epochs:
                state = replace(state, bias_iteration=state.bias_iteration + 1, epoch=0)
            if state.epoch == 0:
                state = self._new_biases(state, stream)
            run = self._u_epoch_fast if self.implementation == "fast" else self._u_epoch_literal
            u, rho, done = run(state, stream)
            n_tuples = state.n_tuples + len(stream.data)
            if done < len(stream.data):
                raise self._failure(state, stream, done)
            visited = stream.visited if self.unvisited == "prior" else None
            prior = state.prior_policy.cpu().numpy()
            u, psi = line_12(u, prior, visited)
            if not (positive(u[prior > 0]).all() and positive(psi).all()):
                raise NonFiniteError(
                    n_tuples, f"u spans more than double precision holds at beta={self.beta:g}: lower beta"
                )
            return replace(
                state,
                epoch=state.epoch + 1,
                n_tuples=n_tuples,
                rho=rho,
                u=torch.from_numpy(u).to(self.device),
                psi=torch.from_numpy(psi).to(self.device),
            )

    # -- lines --------------------------------------------------------------------------------------

    def _new_biases(self, state: S1State, stream: S1Stream) -> S1State:
        """Lines 2-8."""
        run = self._psi_phase_fast if self.implementation == "fast" else self._psi_phase_literal
        mean_psi, mean_log_psi, epochs, error = run(state, stream)
        bias = reward_biases(mean_psi, mean_log_psi, self.beta, self.optimism)
        if not (positive(mean_psi).all() and np.isfinite(bias).all()):
            raise NonFiniteError(
                state.n_tuples,
                f"psi spans more than double precision holds in biasing iteration {state.bias_iteration} "
                f"at beta={self.beta:g}: lower beta",
            )
        reset = self.rho_init == "reset" or state.bias_iteration == 0
        return replace(
            state,
            psi_in_use=state.psi,
            mean_psi=torch.from_numpy(mean_psi).to(self.device),
            mean_log_psi=torch.from_numpy(mean_log_psi).to(self.device),
            reward_bias=torch.from_numpy(bias).to(self.device),
            psi_epochs=epochs,
            psi_error=error,
            psi_converged=state.psi_converged and error < self.psi_tol,
            u=(state.prior_policy > 0).double(),  # line 7
            rho=math.exp(-self.beta) if reset else state.rho,  # line 8
        )

    def _psi_phase_fast(self, state: S1State, stream: S1Stream) -> tuple[np.ndarray, np.ndarray, int, float]:
        mean_psi, mean_log_psi = (x.cpu().numpy().copy() for x in (state.mean_psi, state.mean_log_psi))
        epochs, error = self.psi_phase(
            stream.psi_map, stream.decay, state.psi.cpu().numpy(), mean_psi.reshape(-1), mean_log_psi.reshape(-1)
        )
        return mean_psi, mean_log_psi, epochs, error

    def psi_phase(
        self,
        psi_map: tuple[np.ndarray, np.ndarray, np.ndarray],
        decay: np.ndarray,
        psi: np.ndarray,
        mean_psi: np.ndarray,
        mean_log_psi: np.ndarray,
    ) -> tuple[int, float]:
        """Lines 2-3 from W and decay [S*A] of a stream and psi [S]; the means [S*A] change in place.

        Returns (epochs, relative error at the end); (0, 0) at optimism 1, which uses neither mean.
        """
        if self.optimism == 1.0:
            return 0, 0.0
        limits = self.psi_tol, LOG_PSI_EPSILON, self.max_psi_epochs
        if self.optimism:
            log_mean_psi = np.log(mean_psi)
            epochs, error = kernels.power_phase(
                *psi_map, decay, np.log(psi), self.optimism, log_mean_psi, mean_log_psi, *limits
            )
            mean_psi[:] = np.exp(log_mean_psi)
            return int(epochs), float(error)
        epochs, error = kernels.psi_phase(
            *psi_map,
            decay,
            psi,
            np.log(psi),
            mean_psi,
            mean_log_psi,
            *limits,
        )
        return int(epochs), float(error)

    def _psi_phase_literal(self, state: S1State, stream: S1Stream) -> tuple[np.ndarray, np.ndarray, int, float]:
        mean_psi, mean_log_psi = state.mean_psi.clone(), state.mean_log_psi.clone()
        error = 0.0 if self.optimism == 1.0 else math.inf
        epochs = 0
        of_psi = self._running(state.psi, state.psi.log())
        means = self._running(mean_psi, mean_log_psi)
        while epochs < self.max_psi_epochs and not error < self.psi_tol:
            epochs += 1
            before, log_before = mean_psi.clone(), mean_log_psi.clone()
            assert isinstance(stream.data, Transitions)
            tables = [_walkable(table) for table in (*of_psi, *means)]
            listing.psi_epoch(stream.data, tables[0], tables[1], tables[2], tables[3], self.lr_psi)
            mean_psi, mean_log_psi = self._of_running(*means)
            error = max(
                float(((mean_psi - before).abs() / before).max()),
                float(((mean_log_psi - log_before).abs() / (log_before.abs() + LOG_PSI_EPSILON)).max()),
            )
        return mean_psi.cpu().numpy(), mean_log_psi.cpu().numpy(), epochs, error

    def _running(self, psi: torch.Tensor, log_psi: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """What lines 2-3 average: psi^(1-optimism), and log psi or psi^(-optimism)."""
        if self.optimism == 0.0:
            return psi, log_psi
        return psi ** (1 - self.optimism), (-self.optimism * log_psi).exp()

    def _of_running(self, first: torch.Tensor, second: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """``_running`` undone: (mean_psi, mean_log_psi)."""
        if self.optimism == 0.0:
            return first.clone(), second.clone()
        return first ** (1 / (1 - self.optimism)), second.log() / -self.optimism

    def _u_epoch_fast(self, state: S1State, stream: S1Stream) -> tuple[np.ndarray, float, int]:
        n_states, n_actions = state.u.shape
        psi = state.psi_in_use.cpu().numpy()
        g = gains(
            stream.reward.reshape(n_states, n_actions),
            state.reward_bias.cpu().numpy(),
            state.mean_log_psi.cpu().numpy(),
            psi,
            self.beta,
            state.prior_policy.cpu().numpy(),
            self.optimism,
        )
        scale = gauge(psi, self.optimism)[:, None]
        z = state.u.cpu().numpy() * scale
        g, table = g.reshape(-1), z.reshape(-1)  # views: the kernel writes into z
        rescale_every = self.rescale(n_states * n_actions)
        inv_rho = 1 / state.rho
        t = 0
        for pair, pair_next, factor in stream.parts:
            first, last = t, t + len(pair)
            while t < last:
                stop = min(last, t - t % BLOCK + BLOCK)
                inv_rho, t = kernels.u_epoch(
                    pair,
                    pair_next,
                    factor,
                    stream.noisy,
                    g,
                    table,
                    inv_rho,
                    self.lr_u,
                    self.rate_of_rho(n_states),
                    1 / stream.rho_max,
                    self.self_loop == "new",
                    rescale_every,
                    t,
                    stop,
                    first,
                )
                if t < stop:
                    return z / scale, _inverse(inv_rho), t
        return z / scale, _inverse(inv_rho), t

    def _u_epoch_literal(self, state: S1State, stream: S1Stream) -> tuple[np.ndarray, float, int]:
        u = state.u.clone()
        assert isinstance(stream.data, Transitions)
        psi, mean_psi = state.psi_in_use, state.mean_psi
        if self.optimism:
            psi, mean_psi = psi ** (1 - self.optimism), mean_psi ** (1 - self.optimism)
        rho, t = listing.u_epoch(
            stream.data,
            _walkable(psi),
            _walkable(mean_psi),
            _walkable(state.reward_bias),
            state.reward_bias_max,
            _walkable(u),
            state.rho,
            beta=self.beta,
            lr_u=self.lr_u,
            lr_rho=self.rate_of_rho(len(u)),
            rho_max=stream.rho_max,
            self_loop=self.self_loop,
            rescale_every=self.rescale(u.numel()),
        )
        return u.cpu().numpy(), rho, t

    def rate_of_rho(self, n_states: int) -> float:
        """Step size of line 11."""
        return self.lr_u / n_states if self.lr_rho is None else self.lr_rho

    def rescale(self, n_pairs: int) -> int:
        """Tuples between rescalings of u."""
        return self.rescale_every or max(5000, n_pairs)

    def largest_rho(self, largest_reward: float) -> float:
        """The bound of ``clip_rho``. Raises NonFiniteError where exp(beta r) overflows."""
        exponent = self.beta * largest_reward
        if exponent > 700:
            raise NonFiniteError(0, f"exp(beta r) overflows at beta*max(r) = {exponent:.6g}: lower beta or shift r")
        return max(1.0, math.exp(exponent)) if self.clip_rho else math.inf

    def _failure(self, state: S1State, stream: S1Stream, t: int) -> NonFiniteError:
        s, a, r = tuple_at(stream.data, t)
        return NonFiniteError(
            state.n_tuples + t + 1,
            f"u or rho is no longer a positive finite number at tuple {t} "
            f"(s={s}, a={a}, r={r:g}) of biasing iteration {state.bias_iteration}, "
            f"epoch {state.epoch + 1}: beta*r = {self.beta * r:g}; lower beta or the step sizes",
        )


def _inverse(x: float) -> float:
    return 1 / x if x else math.inf


@dataclass(frozen=True, eq=False)
class ListedS1(AlgorithmS1):
    """``AlgorithmS1`` with the listing's readings for defaults: rho is reset in every biasing iteration (line 8), and
    line 11 sees the u that line 10 has written."""

    rho_init: str = "reset"
    self_loop: str = "new"


def _walkable(table: torch.Tensor) -> torch.Tensor | np.ndarray:
    return table.numpy() if table.device.type == "cpu" else table


# -- lines between the streams, for one replica or with a leading axis of several: the same bits ------


def positive(table: np.ndarray) -> np.ndarray:
    """Where ``table`` is a positive finite number."""
    return np.isfinite(table) & (table > 0)  # type: ignore[no-any-return]


def reward_biases(
    mean_psi: np.ndarray,
    mean_log_psi: np.ndarray,
    beta: float | np.ndarray,
    optimism: float | np.ndarray = 0.0,
) -> np.ndarray:
    """delta [..., S, A] of line 5, reward; beta and optimism numbers, or arrays that broadcast."""
    # <psi> >= exp(<log psi>) by Jensen; the two running means keep that up to rounding.
    found = (1 - optimism) * np.maximum((np.log(mean_psi) - mean_log_psi) / beta, 0.0)
    return found + 0.0  # type: ignore[no-any-return]  # no -0


def gauge(psi: np.ndarray, optimism: float) -> np.ndarray:
    """z / u [S], up to a constant factor: psi^(1-optimism), at most 1 where optimism is not 0."""
    if optimism == 0.0:
        return psi
    exponent = (1 - optimism) * np.log(psi)
    return np.exp(exponent - exponent.max())  # type: ignore[no-any-return]


def gains(
    reward: np.ndarray,
    reward_bias: np.ndarray,
    mean_log_psi: np.ndarray,
    psi: np.ndarray,
    beta: float | np.ndarray,
    prior: np.ndarray,
    optimism: float | np.ndarray = 0.0,
) -> np.ndarray:
    """g [..., S, A] of the gauge z = psi^(1-optimism) u; psi [..., S] is the one behind the biases. -1 marks pairs with
    prior 0, for the kernels: no tuple has them, and their z = 0 is no sign of an underflow."""
    largest = reward_bias.max((-2, -1), keepdims=True)  # line 6
    left = 1 - optimism
    g = np.exp(beta * (reward - largest) - left * mean_log_psi + left * np.log(psi)[..., None])
    g[..., prior == 0] = -1.0
    return g  # type: ignore[no-any-return]


def line_12(u: np.ndarray, prior: np.ndarray, visited: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """(u of mean 1 [..., S, A], psi [..., S]).

    ``visited`` [..., S, A]: pairs outside get the mean of u over their state's visited actions; where there are
    none, they keep their u.
    """
    if visited is not None:
        weight = prior * visited
        mass = weight.sum(-1, keepdims=True)
        mean = np.where(mass > 0, (weight * u).sum(-1, keepdims=True) / mass, u)
        u = np.where(visited | (prior == 0), u, mean)
    u = u / u.reshape(*u.shape[:-2], -1).mean(-1)[..., None, None]
    return u, 1 / (prior * u).sum(-1)
