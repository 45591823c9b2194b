"""Algorithm S1 for many replicas in one compiled loop, one lane per replica (the engine of ``Replicas``).

Between the streams the tables have a leading axis [R]; in the u phase blocks of replicas are interleaved, so that one
fills the time in which another waits for its division. Lines, gauge and open points: ``algorithm_s1``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields, replace
from functools import cached_property
from types import FunctionType
from typing import Any

import numpy as np
import torch

from erl_torch import checks
from erl_torch.checks import InputError
from erl_torch.experience.sampling import Sampler
from erl_torch.experience.simulation import TUPLE_BYTES, ReplicaExperience, Simulation, fits, tuples_of
from erl_torch.experience.transitions import Transitions
from erl_torch.learners.learner import NonFiniteError, StreamLearner
from erl_torch.learners.s1 import device as s1_torch
from erl_torch.learners.s1 import kernels
from erl_torch.learners.s1.algorithm import (
    AlgorithmS1,
    S1State,
    S1Stream,
    gains,
    gauge,
    line_12,
    positive,
    reward_biases,
)
from erl_torch.learners.together import Together
from erl_torch.rng import streams

COMMON = (
    "n_epochs",
    "n_bias",
    "psi_tol",
    "max_psi_epochs",
    "rho_init",
    "self_loop",
    "clip_rho",
    "rescale_every",
    "unvisited",
    "implementation",
    "device",
)  # arguments that interleaved learners share
Array = np.ndarray
Rates = tuple[Array, Array, Array]  # lr_u, lr_rho, smallest 1/rho, [lanes] each
METHODS = [
    name
    for kind in (AlgorithmS1, StreamLearner)
    for name, value in vars(kind).items()
    if isinstance(value, (FunctionType, property)) and not name.startswith("__")
]
LANES = 32  # a block, while its tables fit the cache beside the core
SMALL_TABLES = 1 << 17  # entries of z of a block that do
ROWS = 256  # sampled at a time
NOISY_ROWS = 8192  # of exp(beta r) at a time


def can_interleave(replicas: Together, experience: ReplicaExperience) -> bool:
    """Whether ``replicas`` are published Algorithm S1 with the same loop for all, on streams of one length."""
    learners = replicas.learners
    if not isinstance(learners[0], AlgorithmS1) or learners[0].implementation != "fast":
        return False
    if any(getattr(type(learners[0]), name) is not getattr(AlgorithmS1, name) for name in METHODS):
        return False  # a class derived from it that does something another way
    if any(getattr(learner, name) != getattr(learners[0], name) for learner in learners for name in COMMON):
        return False
    return isinstance(experience, (Transitions, Simulation)) or len({len(data) for data in experience}) == 1


@dataclass(frozen=True, eq=False)
class LanesState:
    """What S1's replicas know after an epoch; tables as in ``S1State``, with a leading axis."""

    bias_iteration: int
    epoch: int
    n_tuples: int
    beta: np.ndarray  # [R]
    prior_policy: torch.Tensor  # [S, A]
    rho: np.ndarray  # [R]
    u: np.ndarray  # [R, S, A]
    psi: np.ndarray  # [R, S]
    psi_in_use: np.ndarray  # [R, S]
    mean_psi: np.ndarray  # [R, S, A]
    mean_log_psi: np.ndarray  # [R, S, A]
    reward_bias: np.ndarray  # [R, S, A]
    psi_error: np.ndarray  # [R]
    psi_epochs: np.ndarray  # [R]
    psi_converged: np.ndarray  # [R] bool
    ended: Mapping[int, tuple[S1State, NonFiniteError]]  # replicas that left the finite numbers

    @property
    def work(self) -> int:
        ended = [last.n_tuples for last, _ in self.ended.values()]
        return self.n_tuples * (len(self.beta) - len(ended)) + sum(ended)

    def milestone(self, learners: Sequence[StreamLearner[Any, Any]]) -> str:
        alive = next((r for r in range(len(self.beta)) if r not in self.ended), None)
        return "" if alive is None else learners[alive].milestone(self.replica(alive))

    def epochs(self, r: int, n: int) -> int:
        return round(n * self.ended[r][0].n_tuples / max(self.n_tuples, 1)) if r in self.ended else n  # all of a length

    @property
    def failures(self) -> Mapping[int, NonFiniteError]:
        return {r: error for r, (_, error) in self.ended.items()}

    @property
    def policy(self) -> torch.Tensor:
        """[R, S, A], lines 13-14."""
        weight = self.prior_policy * torch.from_numpy(self.u)
        return weight / weight.sum(2, keepdim=True)

    def replica(self, r: int) -> S1State:
        if r in self.ended:
            return self.ended[r][0]
        own = {f.name: getattr(self, f.name) for f in fields(S1State)}
        for name, value in own.items():
            if isinstance(value, np.ndarray):
                own[name] = torch.from_numpy(value[r].copy()) if value.ndim > 1 else value[r].item()
        return S1State(**own)

    def metrics(self) -> dict[str, np.ndarray]:
        ones = np.ones(len(self.beta), np.int64)
        largest = self.reward_bias.max((1, 2))
        # math.log: NumPy's differs in the last bit.
        log_rho = np.array([math.log(rho) for rho in self.rho])
        found = {
            "rho": self.rho,
            "theta": -log_rho / self.beta - largest,
            "delta_max": largest,
            "delta_mean": self.reward_bias.reshape(len(ones), -1).mean(1),
            "psi_error": self.psi_error,
            "psi_epochs": self.psi_epochs,
            "bias_iteration": self.bias_iteration * ones,
            "epoch": self.epoch * ones,
            "n_tuples": self.n_tuples * ones,
        }
        if self.ended:
            found = {name: values.copy() for name, values in found.items()}
            for r, (last, _) in self.ended.items():
                for name, value in last.metrics().items():
                    found[name][r] = value
        return found


def interleave(
    replicas: Together, experience: ReplicaExperience, n_states: int, n_actions: int, state: LanesState | None = None
) -> Iterator[LanesState]:
    """``Replicas.iterate`` of published Algorithm S1."""
    engine = Engine(replicas, experience, n_states, n_actions)
    with ThreadPoolExecutor(replicas.workers) as pool:
        lanes = engine.prepare(pool)
        state = engine.init() if state is None else state
        while not replicas.learners[0].finished(state) and len(state.ended) < len(replicas):
            state = engine.step(state, lanes, pool)
            yield state


@dataclass(frozen=True, eq=False)
class Lanes:
    """The streams of all replicas, ready for the loops."""

    n_tuples: int  # of each
    reward: np.ndarray  # [R or 1, S, A]; 0 where a stream's rewards vary
    visited: np.ndarray  # [R or 1, S, A]
    decay: np.ndarray  # [R, S*A]
    psi_maps: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]]  # a CSR matrix [S*A, S] a replica
    rho_max: np.ndarray  # [R]
    blocks: Sequence[Block]


@dataclass(frozen=True, eq=False)
class Block:
    """Together that are interleaved, and how their tuples come."""

    part: slice
    run: Callable[..., None]  # (begin, end, g, z, q, rates, failed) over tuples of the lanes, tables in place
    lanes_side_by_side: bool


@dataclass(frozen=True, eq=False)
class Engine:
    """S1's replicas on one experience: ``init``, ``prepare``, ``step``, as of a single learner."""

    replicas: Together
    experience: ReplicaExperience
    n_states: int
    n_actions: int

    @cached_property
    def learner(self) -> AlgorithmS1:
        """One of them, for what is common."""
        return self.learners[0]

    @cached_property
    def learners(self) -> tuple[AlgorithmS1, ...]:
        return tuple(learner for learner in self.replicas.learners if isinstance(learner, AlgorithmS1))

    @cached_property
    def prior(self) -> np.ndarray:
        return self.replicas.prior_policy(self.n_states, self.n_actions)

    @cached_property
    def beta(self) -> np.ndarray:
        return np.array([learner.beta for learner in self.learners])

    @cached_property
    def optimism(self) -> np.ndarray:
        return np.array([learner.optimism for learner in self.learners])

    @cached_property
    def n_pairs(self) -> int:
        return self.n_states * self.n_actions

    def init(self) -> LanesState:
        """The state of all replicas before any tuple."""
        starts = [learner.init(self.n_states, self.n_actions) for learner in self.learners]
        n = len(starts)
        table = np.zeros((n, self.n_states, self.n_actions))
        return LanesState(
            bias_iteration=0,
            epoch=0,
            n_tuples=0,
            beta=self.beta,
            prior_policy=starts[0].prior_policy.cpu(),
            rho=np.array([start.rho for start in starts]),
            u=table + (self.prior > 0),
            psi=np.ones((n, self.n_states)),
            psi_in_use=np.ones((n, self.n_states)),
            mean_psi=table + 1,
            mean_log_psi=table,
            reward_bias=table,
            psi_error=np.zeros(n),
            psi_epochs=np.zeros(n, np.int64),
            psi_converged=np.ones(n, bool),
            ended={},
        )

    # -- streams --------------------------------------------------------------------------------------

    def prepare(self, pool: ThreadPoolExecutor) -> Lanes:
        """Validate the streams and compute what is the same in every epoch."""
        if self.n_pairs * LANES > np.iinfo(np.int32).max:
            raise InputError("n_states * n_actions", self.n_pairs, f"below 2**31 / {LANES}")
        if isinstance(self.experience, Simulation):
            return self._sampled(self.experience, pool)
        return self._recorded(pool)

    def _blocks(self) -> list[slice]:
        n, block = len(self.replicas), self.replicas.block
        if self._on_torch:
            return [slice(0, n)]
        if block is None:
            most = max(8, min(LANES, SMALL_TABLES // self.n_pairs))
            # As even as can be, and as many as there are threads to work on them.
            count = max(-(-n // most), min(self.replicas.workers, n // 8))
            count = -(-count // self.replicas.workers) * self.replicas.workers if count > 1 else 1
            block = -(-n // count)
        return [slice(first, min(first + block, n)) for first in range(0, n, block)]

    def _side_by_side(self, part: slice) -> bool:
        if self.replicas.layout == "auto":
            return bool((part.stop - part.start) * self.n_pairs <= SMALL_TABLES)
        return self.replicas.layout == "lanes"

    def _steps(self, part: slice, side_by_side: bool) -> tuple[int, int]:
        """Strides of a block's flat tables: from pair to pair, from lane to lane."""
        return (part.stop - part.start, 1) if side_by_side else (1, self.n_pairs)

    @cached_property
    def _on_torch(self) -> bool:
        backend = self.replicas.backend
        return backend == "torch" or (backend == "auto" and str(torch.device(self.learner.device).type) != "cpu")

    def _sampled(self, simulation: Simulation, pool: ThreadPoolExecutor) -> Lanes:
        mdp, n_tuples = simulation.mdp, simulation.n_tuples
        behaviour = self.prior if simulation.behaviour_policy is None else simulation.behaviour_policy
        keep = fits(simulation, len(self.replicas), TUPLE_BYTES)
        lr_psi = np.array([learner.lr_psi for learner in self.learners])
        n, nnz = len(self.replicas), mdp.transition.nnz
        visits = np.zeros((n, self.n_pairs), np.int64)
        weight, scale = np.zeros((n, nnz)), np.ones((n, self.n_pairs))

        def sampler(part: slice) -> Sampler:
            rngs = [streams(int(seed)) for seed in simulation.seeds[part]]
            on_prior = simulation.behaviour_policy is None
            return Sampler(mdp, rngs, simulation.episode_length, np.asarray(behaviour), self.prior, on_prior)

        def survey(part: slice) -> Block:
            source = sampler(part)
            kept = np.empty((2, n_tuples if keep else 0, part.stop - part.start), np.int32)
            for begin in range(0, n_tuples, ROWS):
                rows = min(ROWS, n_tuples - begin)
                pair, entry, pair_next = source.take(rows)
                kernels.survey(
                    mdp.transition.indptr, pair, entry, 1.0 - lr_psi[part], lr_psi[part], visits[part], weight[part],
                    scale[part],
                )  # fmt: skip
                if keep:
                    kept[0, begin : begin + rows], kept[1, begin : begin + rows] = pair, pair_next
            if keep:
                return self._lanes_block(part, kept[0], kept[1], None)
            return self._sampled_block(part, lambda: sampler(part))

        blocks = list(pool.map(survey, self._blocks()))
        weight *= np.repeat(scale, np.diff(mdp.transition.indptr), axis=1)
        visited = (visits > 0).reshape(n, self.n_states, self.n_actions)
        largest = np.where(visited, mdp.reward, -np.inf).max((1, 2))
        csr = mdp.transition.indptr.astype(np.int64), mdp.transition.indices.astype(np.int32)
        return Lanes(
            n_tuples=n_tuples,
            reward=np.where(visited, mdp.reward, 0.0),
            visited=visited,
            decay=(1 - lr_psi)[:, None] ** visits.astype(np.float64),
            psi_maps=[(*csr, row) for row in weight],
            rho_max=self._rho_max(largest),
            blocks=blocks,
        )

    def _rho_max(self, largest: np.ndarray) -> np.ndarray:
        bounds = []
        for learner, reward in zip(self.learners, largest, strict=True):
            try:
                bounds.append(learner.largest_rho(float(reward)))
            except NonFiniteError:
                bounds.append(math.nan)  # it fails in its first epoch, by name
        return np.array(bounds)

    def _recorded(self, pool: ThreadPoolExecutor) -> Lanes:
        learners, shared = self.learners, isinstance(self.experience, Transitions)
        n = len(learners)

        def prepared(r: int) -> S1Stream:
            # Streams are the same at any beta and optimism, but for what is made of beta below; here nothing overflows.
            learner: AlgorithmS1 = replace(learners[r], beta=checks.SMALLEST_BETA, optimism=0.0)
            return learner.prepare(tuples_of(self.experience, r, self.prior), self.n_states, self.n_actions)

        if shared:
            by_step = {learner.lr_psi: r for r, learner in enumerate(learners)}
            made = dict(zip(by_step, pool.map(prepared, by_step.values()), strict=True))
            each = [made[learner.lr_psi] for learner in learners]
        else:
            each = list(pool.map(prepared, range(n)))
        tables = each[:1] if shared else each
        shape = (len(tables), self.n_states, self.n_actions)
        blocks = []
        for part in self._blocks():
            inside = each[part]
            noisy = any(stream.noisy for stream in inside)
            if shared:
                blocks.append(self._shared_block(part, each[0]))
                continue
            columns = [np.stack([getattr(s, name) for s in inside], axis=1) for name in ("pair", "pair_next")]
            rewards = np.stack([s.r for s in inside], axis=1) if noisy else None
            if rewards is not None:
                rewards[:, [not s.noisy for s in inside]] = 0.0  # in their tables
            blocks.append(self._lanes_block(part, columns[0], columns[1], rewards))
        return Lanes(
            n_tuples=len(each[0].data),
            reward=np.stack([stream.reward for stream in tables]).reshape(shape),
            visited=np.stack([stream.visited for stream in tables]),
            decay=np.stack([stream.decay for stream in each]),
            psi_maps=[stream.psi_map for stream in each],
            rho_max=self._rho_max(np.array([stream.r.max() for stream in each])),
            blocks=blocks,
        )

    # -- blocks: how tuples meet the tables -----------------------------------------------------------

    def _lanes_block(self, part: slice, pair: np.ndarray, pair_next: np.ndarray, r: np.ndarray | None) -> Block:
        """A recorded stream a lane; columns [N, lanes], rewards only where they vary."""
        if self._on_torch:
            return self._torch_block(part, lambda i, j: (pair[i:j], pair_next[i:j]), r)
        side_by_side = self._side_by_side(part)

        def run(begin: int, end: int, g: Array, z: Array, q: Array, rates: Rates, failed: Array) -> None:
            for first, stop, factor in self._factors(part, r, begin, end):
                kernels.lanes_epoch(
                    pair[first:stop], pair_next[first:stop], factor, r is not None, g, z, q, *rates, self._new,
                    *self._steps(part, side_by_side), self._rescale, failed, first, stop,
                )  # fmt: skip

        return Block(part, run, side_by_side)

    def _shared_block(self, part: slice, stream: S1Stream) -> Block:
        """One recorded stream for all lanes."""
        r = stream.r[:, None] if stream.noisy else None
        if self._on_torch:
            return self._torch_block(part, lambda i, j: (stream.pair[i:j, None], stream.pair_next[i:j, None]), r)

        def run(begin: int, end: int, g: Array, z: Array, q: Array, rates: Rates, failed: Array) -> None:
            for first, stop, factor in self._factors(part, r, begin, end):
                kernels.shared_epoch(
                    stream.pair[first:stop], stream.pair_next[first:stop], factor, r is not None, g, z, q, *rates,
                    self._new, self._rescale, failed, first, stop,
                )  # fmt: skip

        return Block(part, run, True)

    def _sampled_block(self, part: slice, sampler: Callable[[], Sampler]) -> Block:
        """Lanes that are sampled again in every pass."""
        side_by_side = self._side_by_side(part)
        buffers = tuple(np.empty((ROWS, part.stop - part.start), np.int32) for _ in range(3))
        source: list[Sampler] = []

        def rows(first: int, stop: int) -> tuple[np.ndarray, np.ndarray]:
            if first == 0:
                source[:] = [sampler()]
            pair, _, pair_next = source[0].take(stop - first)
            return pair, pair_next

        def run(begin: int, end: int, g: Array, z: Array, q: Array, rates: Rates, failed: Array) -> None:
            s = sampler()
            kernels.sampled_epoch(
                s.tables, s.environment, s.behaviour, s.now, buffers, g, z, q, *rates, self._new,
                *self._steps(part, side_by_side), self._rescale, failed, begin, end,
            )  # fmt: skip

        return self._torch_block(part, rows, None) if self._on_torch else Block(part, run, side_by_side)

    def _torch_block(
        self, part: slice, pairs: Callable[[int, int], tuple[np.ndarray, np.ndarray]], r: np.ndarray | None
    ) -> Block:
        """Any of the above, in torch operations."""

        def rows(first: int, stop: int) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
            factor = None if r is None else np.exp(self.beta[part] * r[first:stop])
            return *pairs(first, stop), factor

        def run(begin: int, end: int, g: Array, z: Array, q: Array, rates: Rates, failed: Array) -> None:
            device = self.learner.device
            s1_torch.u_phase(rows, begin, end, g, z, q, rates, self._new, self._rescale, failed, device)

        return Block(part, run, True)

    def _factors(
        self, part: slice, r: np.ndarray | None, begin: int, end: int
    ) -> Iterator[tuple[int, int, np.ndarray]]:
        """Cuts of begin..end with exp(beta r) of their tuples, [rows, lanes]; one cut where rewards do not vary."""
        if r is None:
            yield begin, end, np.ones((1, 1))
            return
        for first in range(begin, end, NOISY_ROWS):
            stop = min(end, first + NOISY_ROWS)
            yield first, stop, np.exp(self.beta[part] * r[first:stop])

    @cached_property
    def _new(self) -> bool:
        return self.learner.self_loop == "new"

    @cached_property
    def _rescale(self) -> int:
        return self.learner.rescale(self.n_pairs)

    # -- lines ----------------------------------------------------------------------------------------

    def step(self, before: LanesState, lanes: Lanes, pool: ThreadPoolExecutor) -> LanesState:
        """One epoch of lines 9-12 for all replicas, and before the first of a biasing iteration lines 2-8."""
        with np.errstate(all="ignore"):
            state = before
            if state.epoch == self.learner.n_epochs:
                state = replace(state, bias_iteration=state.bias_iteration + 1, epoch=0)
            good = np.isfinite(lanes.rho_max) | (not self.learner.clip_rho)
            good[list(state.ended)] = False
            if state.epoch == 0:
                state = self._new_biases(state, lanes, pool)
                good &= positive(state.mean_psi).all((1, 2)) & np.isfinite(state.reward_bias).all((1, 2))
            u, rho, whole = self._u_phase(state, lanes, pool)
            u, psi = line_12(u, self.prior, lanes.visited if self.learner.unvisited == "prior" else None)
            good &= whole & (positive(u) | (self.prior == 0)).all((1, 2)) & positive(psi).all(1)
            after = replace(
                state, epoch=state.epoch + 1, n_tuples=state.n_tuples + lanes.n_tuples, rho=rho, u=u, psi=psi
            )
            return after if good.all() else self._without(before, after, good)

    def _without(self, before: LanesState, after: LanesState, good: np.ndarray) -> LanesState:
        """``after``, with the replicas that are not good where they were ``before``."""
        ended = dict(before.ended)
        for r in map(int, np.flatnonzero(~good)):
            if r not in ended:
                ended[r] = (before.replica(r), self._failure(before, r))
        kept: dict[str, Any] = {}
        for f in fields(LanesState):
            old, new = getattr(before, f.name), getattr(after, f.name)
            if isinstance(new, np.ndarray):
                kept[f.name] = np.where(good.reshape(-1, *[1] * (new.ndim - 1)), new, old)
        return replace(after, **kept, ended=ended)

    def _failure(self, before: LanesState, r: int) -> NonFiniteError:
        """What replica ``r`` says of it when it runs alone: the same numbers, tuple by tuple."""
        learner = self.learners[r]
        try:
            stream = learner.prepare(tuples_of(self.experience, r, self.prior), self.n_states, self.n_actions)
            learner.step(before.replica(r), stream)
        except NonFiniteError as error:
            return error
        raise AssertionError(f"replica {r} fails beside others, not alone")

    def _new_biases(self, state: LanesState, lanes: Lanes, pool: ThreadPoolExecutor) -> LanesState:
        """Lines 2-8."""
        mean_psi, mean_log_psi = state.mean_psi.copy(), state.mean_log_psi.copy()

        def psi_phase(r: int) -> tuple[int, float]:
            return self.learners[r].psi_phase(
                lanes.psi_maps[r], lanes.decay[r], state.psi[r], mean_psi[r].reshape(-1), mean_log_psi[r].reshape(-1)
            )

        beta, optimism = self.beta[:, None, None], self.optimism[:, None, None]
        epochs, error = map(np.array, zip(*pool.map(psi_phase, range(len(self.replicas))), strict=True))
        reset = self.learner.rho_init == "reset" or state.bias_iteration == 0
        return replace(
            state,
            psi_in_use=state.psi,
            mean_psi=mean_psi,
            mean_log_psi=mean_log_psi,
            reward_bias=reward_biases(mean_psi, mean_log_psi, beta, optimism),
            psi_epochs=epochs,
            psi_error=error,
            psi_converged=state.psi_converged & (error < self.learner.psi_tol),
            u=np.zeros_like(state.u) + (self.prior > 0),  # line 7
            rho=np.array([math.exp(-beta) for beta in self.beta]) if reset else state.rho,  # line 8
        )

    def _u_phase(
        self, state: LanesState, lanes: Lanes, pool: ThreadPoolExecutor
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(u [R, S, A], rho [R], whether all numbers stayed positive and finite [R]) after lines 9-11."""
        beta, optimism = self.beta[:, None, None], self.optimism[:, None, None]
        psi = state.psi_in_use
        g = gains(lanes.reward, state.reward_bias, state.mean_log_psi, psi, beta, self.prior, optimism)
        of_psi = psi
        if optimism.any():
            of_psi = np.stack([gauge(*one) for one in zip(psi, self.optimism.tolist(), strict=True)])
        scale = of_psi[:, :, None]
        z = state.u * scale
        g, z = (x.reshape(len(self.replicas), self.n_pairs) for x in (g, z))
        q = 1 / state.rho
        learners = self.learners
        rates = (
            np.array([learner.lr_u for learner in learners]),
            np.array([learner.rate_of_rho(self.n_states) for learner in learners]),
            1 / lanes.rho_max,
        )
        failed = np.full(len(learners), -1)

        def run(block: Block) -> None:
            part = block.part
            # Flat tables of this block, in its layout.
            turn = np.transpose if block.lanes_side_by_side else np.asarray
            table = np.ascontiguousarray(turn(z[part]))
            gain = np.ascontiguousarray(turn(g[part])).reshape(-1)
            own = tuple(rate[part].copy() for rate in rates)
            block.run(0, lanes.n_tuples, gain, table.reshape(-1), q[part], own, failed[part])
            z[part] = turn(table)

        list(pool.map(run, lanes.blocks))
        u = z.reshape(state.u.shape) / scale
        rho = np.where(q > 0, 1 / q, math.inf)
        return u, rho, failed < 0
