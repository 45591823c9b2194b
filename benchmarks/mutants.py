"""Mistakes that somebody could have made, one at a time, each with the tests that must notice it.

    python benchmarks/mutants.py [--processes 1|2] [part of a name ...]      about half an hour of one core

A mutant is a patch (a text that stands once in a file, and another for it) and the tests that must fail on it. All
those tests pass first, without any patch. Then the tree is copied, a patch applied, its tests are run, and the file is
put back, mutant by mutant. What is found of a mutant:

    killed     a test failed, ran past its time (a loop that does not end), or crashed (memory out of bounds)
    SURVIVED   all tests passed: none looks at what the patch spoils
    BROKEN     the patched code does not compile or import, which any test would notice
    STALE      the text of the patch does not stand exactly once in the file: it wants rewriting

The exit code is 0 if every mutant is killed.

Numba's cache looks at the time and size of kernels.py alone, so a mutant of that file gets an empty cache; the others
share one, and the file put back keeps its time.
"""

from __future__ import annotations

import argparse
import collections
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import Queue
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
TREE = (
    "erl_torch",
    "tests",
    "benchmarks",
    "conf",
    "docs",
    "examples",
    "pyproject.toml",
    "README.md",
    "train.py",
    "compare.py",
    "play.py",
    "reproduce.py",
)
LIMIT = 240.0  # seconds of a mutant's tests
UNCOMPILED = re.compile(r"numba\.core\.errors|NameError|SyntaxError|ImportError|UnboundLocalError")


class Mutant(NamedTuple):
    """``old`` stands once in ``file``; ``tests``, by file and name, fail where ``new`` stands in its place."""

    name: str
    file: str  # below erl_torch
    old: str
    new: str
    tests: str  # "file::test file::test", below tests

    @property
    def nodes(self) -> list[str]:
        return [f"tests/{node}" for node in self.tests.split()]


MUTANTS = [
    # -- kernels: counting a stream
    Mutant(
        "weights of visits decay by the step itself",
        "kernels.py",
        "factor = pairs[k, 2] * (1.0 - lr_psi)",
        "factor = pairs[k, 2] * lr_psi",
        "test_algorithm_s1.py::test_psi_map_sorts_its_columns_and_forgets_old_visits",
    ),
    Mutant(
        "a new visit's weight misses the row's factor",
        "kernels.py",
        "entries[e, 2] += lr_psi / factor",
        "entries[e, 2] += lr_psi",
        "test_streams.py::test_the_tally_counts",
    ),
    Mutant(
        "a row's factor is reset, its weights are not",
        "kernels.py",
        "                    entries[m, 2] *= factor\n",
        "                    pass\n",
        "test_algorithm_s1.py::test_psi_map_sorts_its_columns_and_forgets_old_visits",
    ),
    Mutant(
        "tally never sees that rewards vary",
        "kernels.py",
        "            varied = True\n",
        "            varied = False\n",
        "test_certainty_equivalence.py::test_statistics_are_those_of_the_tuples",
    ),
    Mutant(
        "rewards vary only if the first visit's is met again",
        "kernels.py",
        "        pairs[k, 1] = r[t]\n",
        "        pairs[k, 1] = r[t] if pairs[k, 0] == 1.0 else pairs[k, 1]\n",
        "test_kernels.py::test_the_tally_keeps_the_last_reward_and_the_range",
    ),
    Mutant(
        "keys of (s,a,s') collide",
        "kernels.py",
        "key = k * n_states + s_next[t]",
        "key = k * (n_states - 1) + s_next[t]",
        "test_streams.py::test_the_tally_counts",
    ),
    # -- kernels: the psi phase
    Mutant(
        "the psi phase looks at <psi> alone",
        "kernels.py",
        "            change = max(change, abs(mean_log_psi[k] - y) / (abs(y) + epsilon))\n",
        "",
        "test_algorithm_s1.py::test_the_psi_phase_ends_by_the_larger_relative_error",
    ),
    Mutant(
        "the psi phase ends on an absolute error",
        "kernels.py",
        "change = max(change, abs(mean_psi[k] - x) / x)",
        "change = max(change, abs(mean_psi[k] - x))",
        "test_algorithm_s1.py::test_the_psi_phase_ends_by_the_larger_relative_error",
    ),
    Mutant(
        "<log psi> decays by W alone",
        "kernels.py",
        "mean_log_psi[k] = decay[k] * y + add_log_psi[k]",
        "mean_log_psi[k] = (1.0 - decay[k]) * y + add_log_psi[k]",
        "test_algorithm_s1.py::test_affine_psi_phase_is_the_sequential_one",
    ),
    # -- kernels: lines 10 and 11
    Mutant(
        "line 11 without its own step in the new u",
        "kernels.py",
        "_fma(keep_rho, lr_u, lr_rho) * w",
        "keep_rho * lr_u * w",
        "test_algorithm_s1.py::test_one_action_cycle_is_solved_exactly",
    ),
    Mutant(
        "the listing's self-loop in the script's reading",
        "kernels.py",
        "z[k], q = _lines_10_and_11(gain, z[k], z[j], q, lr_u, lr_rho, inv_rho_min, new and k == j)",
        "z[k], q = _lines_10_and_11(gain, z[k], z[j], q, lr_u, lr_rho, inv_rho_min, k == j)",
        "test_algorithm_s1.py::test_gives_what_the_authors_script_gives",
    ),
    Mutant(
        "clip of rho removed from the compiled line 11",
        "kernels.py",
        "return z_new, inv_rho_min if q_new < inv_rho_min else q_new",
        "return z_new, q_new",
        "test_algorithm_s1.py::test_rho_is_clipped_at_its_bound",
    ),
    Mutant(
        "rescaling goes away from 1",
        "kernels.py",
        "                scale = math.ldexp(1.0, -exponent)\n                for k in range(z.size):",
        "                scale = math.ldexp(1.0, exponent)\n                for k in range(z.size):",
        "test_algorithm_s1.py::test_million_tuple_drift_stays_in_range",
    ),
    Mutant(
        "a failure's tuple is counted within its chunk",
        "kernels.py",
        "return q, bad + first",
        "return q, bad",
        "test_streams.py::test_a_failure_names_its_tuple_wherever_it_is_read_from",
    ),
    Mutant(
        "a failing stretch is not done again from its start",
        "kernels.py",
        "            z[:] = backup\n            q = q_before\n",
        "            q = q_before\n",
        "test_algorithm_s1.py::test_leaving_the_finite_numbers_stops_with_step_and_cause",
    ),
    # -- kernels: lanes
    Mutant(
        "all lanes have the first one's step",
        "kernels.py",
        "z[k], q[i] = _lines_10_and_11(gain, z[k], z[j], q[i], lr_u[i], lr_rho[i], inv_rho_min[i], new and k == j)",
        "z[k], q[i] = _lines_10_and_11(gain, z[k], z[j], q[i], lr_u[0], lr_rho[i], inv_rho_min[i], new and k == j)",
        "test_replicas.py::test_bits_of_any_mixture",
    ),
    Mutant(
        "a lane at 0 counts as healthy",
        "kernels.py",
        "healthy = healthy and np.isfinite(x) and x > 0.0",
        "healthy = healthy and np.isfinite(x)",
        "test_replicas.py::test_a_replica_that_fails_leaves_the_others_alone",
    ),
    Mutant(
        "the shared loop takes another tuple's factor",
        "kernels.py",
        "gain[i] * factor[t, i], here[i]",
        "gain[i] * factor[0, i], here[i]",
        "test_replicas.py::test_bits_on_a_shared_stream",
    ),
    Mutant(
        "a piece of the lanes is cut out twice",
        "kernels.py",
        "_lanes_rows(\n            pair, pair_next, factor, noisy,",
        "_lanes_rows(\n            pair[begin:], pair_next[begin:], factor, noisy,",
        "test_replicas.py::test_rewards_that_vary_are_cut_without_a_trace",
    ),
    # -- kernels: EfficientS1
    Mutant(
        "clip of rho removed from gauge_epoch",
        "kernels.py",
        "            if rho > rho_max:\n                rho = rho_max\n",
        "",
        "test_efficient_s1.py::test_rho_is_clipped_at_its_bound",
    ),
    Mutant(
        "clip of rho removed from log_gauge_epoch",
        "kernels.py",
        "log_rho = min(_log_blend(log_rho, w - z_new, lr_rho), log_rho_max)",
        "log_rho = _log_blend(log_rho, w - z_new, lr_rho)",
        "test_efficient_s1.py::test_rho_is_clipped_at_its_bound",
    ),
    Mutant(
        "a visit's step is the next one's",
        "kernels.py",
        "            step = steps[min(visits[k], last)]\n            visits[k] += 1\n            z_new = (1.0 - step)",
        "            visits[k] += 1\n            step = steps[min(visits[k], last)]\n            z_new = (1.0 - step)",
        "test_efficient_s1.py::test_kernels_agree_with_the_direct_form",
    ),
    Mutant(
        "sums over visits are not rescaled",
        "kernels.py",
        "            z[k] *= scale\n            total[k] *= scale\n",
        "            z[k] *= scale\n",
        "test_efficient_s1.py::test_kernels_agree_with_the_direct_form",
    ),
    Mutant(
        "the expected backup keeps y(s) of the stretch before",
        "kernels.py",
        "                y[s] = row\n",
        "                pass\n",
        "test_efficient_s1.py::test_kernels_agree_with_the_direct_form",
    ),
    Mutant(
        "a blend at step 1 goes through log 0",
        "kernels.py",
        "return log_new if step >= 1.0 else log_x + math.log1p(step * math.expm1(d))",
        "return log_x + math.log1p(step * math.expm1(d))",
        "test_kernels.py::test_log_blend",
    ),
    # -- kernels: sampling
    Mutant(
        "a draw at the edge belongs to the entry before",
        "kernels.py",
        "        if x < cdf[middle]:\n",
        "        if x <= cdf[middle]:\n",
        "test_kernels.py::test_draws_are_of_half_open_intervals",
    ),
    Mutant(
        "a draw at the edge belongs to the entry before, in lanes",
        "kernels.py",
        "<= x[i] else none",
        "< x[i] else none",
        "test_kernels.py::test_draws_are_of_half_open_intervals",
    ),
    Mutant(
        "entries of probability 0 close a row",
        "kernels.py",
        "            if data[m] > 0.0:\n                last = m\n",
        "            last = m\n",
        "test_kernels.py::test_rounding_reaches_no_entry_of_probability_0",
    ),
    Mutant(
        "the start is drawn from the behaviour's stream",
        "kernels.py",
        "s = _draw(start_cdf, 0, start_cdf.size, x[x_row, i])",
        "s = _draw(start_cdf, 0, start_cdf.size, y[y_row, i])",
        "test_replicas.py::test_a_lane_draws_what_numpy_draws",
    ),
    Mutant(
        "a' comes from the behaviour policy",
        "kernels.py",
        "_draw_lanes(prior_cdf, low, length, action_levels, y[y_row])",
        "_draw_lanes(behaviour_cdf, low, length, action_levels, y[y_row])",
        "test_experience.py::test_law_of_the_stream",
    ),
    Mutant(
        "uniforms of 52 bits",
        "kernels.py",
        "np.int64(word >> np.uint64(11))) * (1.0 / 9007199254740992.0)",
        "np.int64(word >> np.uint64(12))) * (1.0 / 4503599627370496.0)",
        "test_replicas.py::test_a_lane_draws_what_numpy_draws",
    ),
    Mutant(
        "a restart's number is left out of the count",
        "kernels.py",
        "restarts = (done + n + episode_length - 1) // episode_length - (done + episode_length - 1) // episode_length",
        "restarts = (done + n) // episode_length - done // episode_length + 1",
        "test_replicas.py::test_a_lane_draws_what_numpy_draws",
    ),
    Mutant(
        "what a survey forgets it remembers",
        "kernels.py",
        "            weight[m] *= scale\n        scale = 1.0\n    return scale",
        "            weight[m] *= 1.0\n        scale = 1.0\n    return scale",
        "test_replicas.py::test_survey_is_the_map_of_the_recorded_stream",
    ),
    # -- kernels: returns and chains
    Mutant(
        "an episode is a step too short",
        "kernels.py",
        "        for _ in range(episode_length):\n",
        "        for _ in range(episode_length - 1):\n",
        "test_kernels.py::test_returns_on_a_cycle_are_counted",
    ),
    Mutant(
        "a reward is that of the state reached",
        "kernels.py",
        "            total += reward[s, k - s * n_actions]\n"
        "            s = indices[_draw(cdf, indptr[k], indptr[k + 1], rng.random())]\n",
        "            a = k - s * n_actions\n"
        "            s = indices[_draw(cdf, indptr[k], indptr[k + 1], rng.random())]\n"
        "            total += reward[s, a]\n",
        "test_kernels.py::test_returns_on_a_cycle_are_counted",
    ),
    Mutant(
        "a horizon is a step too short",
        "kernels.py",
        "    for _ in range(horizon):\n",
        "    for _ in range(horizon - 1):\n",
        "test_evaluation.py::test_finite_horizon_is_the_sum_of_powers",
    ),
    Mutant(
        "rows for columns in the back substitution",
        "kernels.py",
        "x[k] += x[i] * p[i, k]",
        "x[k] += x[i] * p[k, i]",
        "test_action_value.py::test_gth_and_lu_are_the_stationary_distribution",
    ),
    # -- kernels: mazes, counts
    Mutant(
        "a mean of five over four",
        "kernels.py",
        "field[i, j] = (field[i, j] + around) / 5",
        "field[i, j] = (field[i, j] + around) / 4",
        "test_mazes.py::test_smoothing_is_the_raster_sweep",
    ),
    Mutant(
        "counts of the row before are kept",
        "kernels.py",
        "            seen[indices[m]] = 0\n",
        "            pass\n",
        "test_kernels.py::test_cells_are_counted_row_by_row",
    ),
    # -- kernels: action values
    Mutant(
        "the prior of visited actions is not normalised",
        "kernels.py",
        "return top + math.log(total / mass) / beta",
        "return top + math.log(total) / beta",
        "test_action_value.py::test_compiled_is_the_slow_twin",
    ),
    Mutant(
        "a maximum over actions never tried",
        "kernels.py",
        "if visits[k] > 0 and q[k] > top:",
        "if q[k] > top:",
        "test_action_value.py::test_compiled_is_the_slow_twin",
    ),
    Mutant(
        "the reference is a pair, not a state",
        "kernels.py",
        "if reference >= 0 and k // n_actions == reference:",
        "if reference >= 0 and k == reference:",
        "test_action_value.py::test_compiled_is_the_slow_twin",
    ),
    Mutant(
        "a large error overflows",
        "kernels.py",
        "    if x > 0.0:\n        return x + math.log1p((1.0 - step) * math.expm1(-x))\n",
        "",
        "test_action_value.py::test_log_mix",
    ),
    # -- Algorithm S1
    Mutant(
        "clip_rho counts for nothing",
        "learners/algorithm_s1.py",
        "return max(1.0, math.exp(exponent)) if self.clip_rho else math.inf",
        "return math.inf",
        "test_algorithm_s1.py::test_rho_is_clipped_at_its_bound",
    ),
    Mutant(
        "rho is clipped at 1 whatever the rewards",
        "learners/algorithm_s1.py",
        "return max(1.0, math.exp(exponent)) if self.clip_rho else math.inf",
        "return 1.0 if self.clip_rho else math.inf",
        "test_algorithm_s1.py::test_rho_is_clipped_at_its_bound",
    ),
    Mutant(
        "the smallest reward bounds rho",
        "learners/algorithm_s1.py",
        "self.largest_rho(found.reward_range[1])",
        "self.largest_rho(found.reward_range[0])",
        "test_algorithm_s1.py::test_rho_is_clipped_at_its_bound",
    ),
    Mutant(
        "a psi phase cut short is forgotten",
        "learners/algorithm_s1.py",
        "psi_converged=state.psi_converged and error < self.psi_tol",
        "psi_converged=error < self.psi_tol",
        "test_algorithm_s1.py::test_a_psi_phase_cut_short_is_remembered",
    ),
    Mutant(
        "the psi phase is never said to be cut short",
        "learners/algorithm_s1.py",
        "status = Status.COMPLETED if state.psi_converged else Status.PSI_LIMIT",
        "status = Status.COMPLETED",
        "test_algorithm_s1.py::test_psi_limit_is_reported",
    ),
    Mutant(
        "the biases' psi is that of the iteration before",
        "learners/algorithm_s1.py",
        "psi_in_use=state.psi,",
        "psi_in_use=state.psi_in_use,",
        "test_algorithm_s1.py::test_gives_what_the_authors_script_gives",
    ),
    Mutant(
        "delta falls below 0 by rounding",
        "learners/algorithm_s1.py",
        "return np.maximum((np.log(mean_psi) - mean_log_psi) / beta, 0.0)  # type: ignore[no-any-return]",
        "return (np.log(mean_psi) - mean_log_psi) / beta  # type: ignore[no-any-return]",
        "test_algorithm_s1.py::test_deterministic_dynamics_need_no_bias",
    ),
    Mutant(
        "Delta is added where it is to be taken off",
        "learners/algorithm_s1.py",
        "return -math.log(self.rho) / self.beta - self.reward_bias_max",
        "return -math.log(self.rho) / self.beta + self.reward_bias_max",
        "test_algorithm_s1.py::test_gives_what_the_authors_script_gives",
    ),
    Mutant(
        "line 12 without the prior",
        "learners/algorithm_s1.py",
        "return u, 1 / (prior * u).sum(-1)",
        "return u, u.shape[-1] / u.sum(-1)",
        "test_algorithm_s1.py::test_psi_and_policy_are_equations_7_and_12",
    ),
    Mutant(
        "pairs without visits get the mean without its mass",
        "learners/algorithm_s1.py",
        "(weight * u).sum(-1, keepdims=True) / mass, 1.0)",
        "(weight * u).sum(-1, keepdims=True), 1.0)",
        "test_algorithm_s1.py::test_visited_states_only",
    ),
    Mutant(
        "rho's step is that of u",
        "learners/algorithm_s1.py",
        "return self.lr_u / n_states if self.lr_rho is None else self.lr_rho",
        "return self.lr_u if self.lr_rho is None else self.lr_rho",
        "test_algorithm_s1.py::test_default_step_size_of_rho_is_the_scripts",
    ),
    Mutant(
        "the listing does not clip rho",
        "learners/listing.py",
        "        rho = min(rho, rho_max)\n",
        "",
        "test_algorithm_s1.py::test_rho_is_clipped_at_its_bound",
    ),
    Mutant(
        "the listing's line 11 with the old u",
        "learners/listing.py",
        '        if self_loop == "new":\n            u_next = float(u[s_next, a_next])\n',
        "",
        "test_algorithm_s1.py::test_fast_is_the_listing",
    ),
    # -- replicas
    Mutant(
        "lanes forget a psi phase cut short",
        "learners/s1_lanes.py",
        "psi_converged=state.psi_converged & (error < self.learner.psi_tol)",
        "psi_converged=error < self.learner.psi_tol",
        "test_replicas.py::test_a_psi_phase_cut_short_is_remembered",
    ),
    Mutant(
        "rho begins at the first replica's temperature",
        "learners/s1_lanes.py",
        "rho=np.array([math.exp(-beta) for beta in self.beta]) if reset",
        "rho=np.array([math.exp(-self.beta[0]) for beta in self.beta]) if reset",
        "test_replicas.py::test_bits_on_a_shared_stream",
    ),
    Mutant(
        "every block samples the first seeds",
        "learners/s1_lanes.py",
        "for seed in simulation.seeds[part]]",
        "for seed in simulation.seeds[: part.stop - part.start]]",
        "test_replicas.py::test_bits_of_replicas_are_those_of_single_runs",
    ),
    Mutant(
        "factors of a later cut are those of the first",
        "learners/s1_lanes.py",
        "yield first, stop, np.exp(self.beta[part] * r[first:stop])",
        "yield first, stop, np.exp(self.beta[part] * r[: stop - first])",
        "test_replicas.py::test_rewards_that_vary_are_cut_without_a_trace",
    ),
    Mutant(
        "a lane's rewards stay in the table where its tuples have them",
        "learners/s1_lanes.py",
        "rewards[:, [not s.noisy for s in inside]] = 0.0",
        "pass",
        "test_replicas.py::test_bits_of_replicas_are_those_of_single_runs",
    ),
    Mutant(
        "a lane that failed keeps its spoilt tables",
        "learners/s1_lanes.py",
        "ended[r] = (before.replica(r), self._failure(before, r))",
        "ended[r] = (after.replica(r), self._failure(before, r))",
        "test_replicas.py::test_a_failure_later_on_keeps_the_last_good_epoch",
    ),
    Mutant(
        "torch's line 11 without its own step",
        "learners/s1_torch.py",
        "both = keep_rho * lr_u + lr_rho",
        "both = keep_rho * lr_u",
        "test_replicas.py::test_torch_operations_are_the_compiled_loop",
    ),
    Mutant(
        "torch keeps 1/rho below its bound",
        "learners/s1_torch.py",
        "q_now = torch.maximum(q_new, q_min)",
        "q_now = torch.minimum(q_new, q_min)",
        "test_replicas.py::test_torch_operations_are_the_compiled_loop",
    ),
    Mutant(
        "torch does not clip rho",
        "learners/s1_torch.py",
        "q_now = torch.maximum(q_new, q_min)",
        "q_now = q_new",
        "test_replicas.py::test_replicas_clip_rho",
    ),
    Mutant(
        "a failed replica's history goes on",
        "learners/replicas.py",
        "                    break  # it had stopped before\n",
        "                    pass\n",
        "test_replicas.py::test_a_failure_later_on_keeps_the_last_good_epoch",
    ),
    # -- action values
    Mutant(
        "an action never tried is worth nothing",
        "learners/action_value.py",
        "return torch.where(seen, self.q, value[:, None])",
        "return torch.where(seen, self.q, 0.0)",
        "test_action_value.py::test_actions_never_taken_keep_their_prior_share",
    ),
    Mutant(
        "the soft value misses the mass of what was tried",
        "learners/action_value.py",
        "(logits.logsumexp(1) - mass) / self.beta",
        "logits.logsumexp(1) / self.beta",
        "test_action_value.py::test_actions_never_taken_keep_their_prior_share",
    ),
    Mutant(
        "the reference is the rarest state",
        "learners/action_value.py",
        "int(np.argmax(visits))",
        "int(np.argmin(visits))",
        "test_action_value.py::test_the_reference_is_the_state_visited_most",
    ),
    Mutant(
        "the rate's step is that of q",
        "learners/action_value.py",
        "return (1 / n_pairs if self.lr_rate is None else self.lr_rate), -1",
        "return (1.0 if self.lr_rate is None else self.lr_rate), -1",
        "test_action_value.py::test_compiled_is_the_slow_twin",
    ),
    Mutant(
        "the read-out averages over all tuples",
        "learners/z_learning.py",
        "mean = np.divide(total, counts, out=",
        "mean = np.divide(total, counts.sum(), out=",
        "test_action_value.py::test_read_out_of_z_learning_is_the_mean_over_visits",
    ),
    # -- EfficientS1
    Mutant(
        "options forget a psi phase cut short",
        "learners/efficient_s1.py",
        "psi_converged=state.psi_converged and converged,",
        "psi_converged=converged,",
        "test_efficient_s1.py::test_a_psi_phase_cut_short_is_remembered",
    ),
    Mutant(
        "KL is left out of the certificate",
        "learners/efficient_s1.py",
        "followed = (inside * q).sum(1) - kl_per_state(inside, prior) / problem.beta",
        "followed = (inside * q).sum(1)",
        "test_efficient_s1.py::test_the_width_bounds_the_loss_of_any_policy",
    ),
    Mutant(
        "rho is carried over with the Delta of before",
        "learners/efficient_s1.py",
        "log_rho=-self.beta * (theta + after.reward_bias_max))",
        "log_rho=-self.beta * (theta + state.reward_bias_max))",
        "test_efficient_s1.py::test_theta_is_carried_over_whatever_delta_becomes",
    ),
    Mutant(
        "sums over visits go on from iteration to iteration",
        "learners/efficient_s1.py",
        "            log_total=torch.full_like(state.log_total, -math.inf),\n        )\n        if self.warm_start",
        "        )\n        if self.warm_start",
        "test_efficient_s1.py::test_line_12_takes_the_mean_of_z_over_this_iterations_visits",
    ),
    Mutant(
        "the clocks' step is one visit ahead",
        "learners/efficient_s1.py",
        "self.clock_horizon / (self.clock_horizon + n)))",
        "self.clock_horizon / (self.clock_horizon + n + 1)))",
        "test_efficient_s1.py::test_steps_of_the_clocks",
    ),
    Mutant(
        "pairs never visited keep their prior",
        "learners/efficient_s1.py",
        "weight = prior * (part.used | ~inside[:, None])",
        "weight = prior",
        "test_efficient_s1.py::test_pairs_never_visited_have_probability_zero_and_unseen_states_the_prior",
    ),
    Mutant(
        "the smallest reward bounds rho, with options",
        "learners/efficient_s1.py",
        "log_rho_max=max(0.0, self.beta * found.reward_range[1])",
        "log_rho_max=max(0.0, self.beta * found.reward_range[0])",
        "test_efficient_s1.py::test_rho_is_clipped_at_its_bound",
    ),
    # -- certainty equivalence and the empirical model
    Mutant(
        "the prior's mass on visited actions has the wrong sign",
        "empirical.py",
        "axis=1) + np.log(np.minimum(mass, 1.0)) / beta",
        "axis=1) - np.log(np.minimum(mass, 1.0)) / beta",
        "test_certainty_equivalence.py::test_states_that_lead_nowhere_are_left_out_and_keep_the_prior",
    ),
    Mutant(
        "states that lead to lost states are kept",
        "empirical.py",
        "                break\n            alive = np.asarray(used.any(1))\n",
        "                break\n            alive = np.asarray(used.any(1))\n            break\n",
        "test_certainty_equivalence.py::test_states_that_lead_nowhere_are_left_out_and_keep_the_prior",
    ),
    Mutant(
        "the class of most states, not of most tuples",
        "empirical.py",
        "tuples = np.bincount(label, self.visits.sum(1)) * closed",
        "tuples = np.bincount(label) * closed",
        "test_certainty_equivalence.py::test_of_two_closed_sets_the_one_with_more_tuples_counts",
    ),
    Mutant(
        "variance of rewards over n",
        "empirical.py",
        "reward_variance=(squares / np.maximum(visits - 1, 1))",
        "reward_variance=(squares / np.maximum(visits, 1))",
        "test_certainty_equivalence.py::test_statistics_are_those_of_the_tuples",
    ),
    Mutant(
        "a pair never visited has u = 1",
        "learners/certainty_equivalence.py",
        "            u=answer.u * known,",
        "            u=answer.u,",
        "test_certainty_equivalence.py::test_a_pair_never_visited_is_an_action_that_is_not_there",
    ),
    # -- streams
    Mutant(
        "one stream for every purpose",
        "rng.py",
        "return Streams(*(np.random.default_rng(child) for child in children))",
        "return Streams(*(np.random.default_rng(children[0]) for child in children))",
        "test_experience.py::test_streams_are_independent_by_name",
    ),
    Mutant(
        "streams of a sum with the seed",
        "rng.py",
        "children = np.random.SeedSequence(seed).spawn(len(Streams._fields))",
        "children = [np.random.SeedSequence(seed + i) for i in range(len(Streams._fields))]",
        "test_experience.py::test_streams_are_independent_by_name",
    ),
    Mutant(
        "generators stay where they were",
        "sampling.py",
        "            for generator, words in ((rng.environment, self.environment), (rng.behaviour, self.behaviour)):",
        "            for generator, words in ((rng.environment, self.environment),):",
        "test_replicas.py::test_generators_go_on_where_the_stream_ends",
    ),
    Mutant(
        "halvings for rows half as long",
        "sampling.py",
        "return (longest - 1).bit_length()",
        "return (longest // 2).bit_length()",
        "test_kernels.py::test_lanes_draw_from_rows_of_any_length",
    ),
    Mutant(
        "a state equal to the size passes",
        "transitions.py",
        "            if column.max() >= bound:",
        "            if column.max() > bound:",
        "test_algorithm_s1.py::test_bad_stream_is_named",
    ),
    Mutant(
        "the checksum is of the last chunk",
        "transitions.py",
        "zlib.crc32(memoryview(getattr(chunk, name)), found)",
        "zlib.crc32(memoryview(getattr(chunk, name)))",
        "test_streams.py::test_files_are_the_stream_in_memory",
    ),
    # -- environments
    Mutant(
        "wind blows up where it should blow down",
        "envs/grid_world.py",
        "np.maximum([-h, v, h, -v], 0).T ** 2",
        "np.maximum([-h, -v, h, v], 0).T ** 2",
        "test_envs.py::test_cliff_is_the_authors test_envs.py::test_wind_at_three_quarters_pi",
    ),
    Mutant(
        "wind's probability is not squared",
        "envs/grid_world.py",
        "np.maximum([-h, v, h, -v], 0).T ** 2",
        "np.maximum([-h, v, h, -v], 0).T",
        "test_envs.py::test_wind_at_three_quarters_pi",
    ),
    Mutant(
        "the action moves before the wind",
        "envs/grid_world.py",
        "np.broadcast_to(blown[:, None], moved.shape)",
        "np.broadcast_to(free[:, None, None], moved.shape)",
        "test_envs.py::test_success_is_of_the_action_alone",
    ),
    Mutant(
        "diagonals cost what straight moves cost",
        "envs/grid_world.py",
        "        cost[cost == 0] = 1.0\n",
        "        cost[:] = 1.0\n",
        "test_envs.py::test_nine_actions",
    ),
    Mutant(
        "walls do not stand in the way",
        "envs/grid_world.py",
        'return np.where(self.tiles[target] == "W", state, target)',
        "return target",
        "test_envs.py::test_walls_borders_and_success",
    ),
    Mutant(
        "a step's draw is not of the row's own sum",
        "envs/tabular.py",
        "row = self.state * self.mdp.n_actions + int(action)",
        "row = int(action) * self.mdp.n_states + self.state",
        "test_envs.py::test_steps_follow_the_model_with_every_rule",
    ),
    Mutant(
        "an end leads to the next state, not to the start",
        "models.py",
        "on = sp.coo_array((p[~end], (row[~end], to[~end])), shape=shape)",
        "on = sp.coo_array((p, (row, to)), shape=shape)",
        "test_models.py::test_restart_against_a_loop_over_P",
    ),
    Mutant(
        "a reward that depends on s' is the last one's",
        "models.py",
        "mean = np.bincount(row, p * r, n_rows)",
        "mean = np.zeros(n_rows)\n    mean[row] = r",
        "test_models.py::test_rewards_that_depend_on_s_next_are_reported",
    ),
    # -- checkpoints
    Mutant(
        "one checkpoint is kept",
        "checkpoint.py",
        "KEPT = 2\n",
        "KEPT = 1\n",
        "test_checkpoint.py::test_the_last_two_are_kept",
    ),
    Mutant(
        "the oldest checkpoint is read",
        "checkpoint.py",
        'for path in sorted(self._folder.glob("*.ckpt"), reverse=True):',
        'for path in sorted(self._folder.glob("*.ckpt")):',
        "test_checkpoint.py::test_the_newest_checkpoint_is_read",
    ),
    Mutant(
        "checksums are not looked at",
        "checkpoint.py",
        "    if hashlib.sha256(body).hexdigest().encode() != line:\n"
        '        raise ValueError("its checksum does not match")\n',
        "",
        "test_checkpoint.py::test_a_bit_flipped_in_a_table_is_seen",
    ),
    Mutant(
        "the clock of checkpoints is never set",
        "checkpoint.py",
        "            path.unlink(missing_ok=True)\n        self._last = time.monotonic()\n",
        "            path.unlink(missing_ok=True)\n",
        "test_checkpoint.py::test_interval",
    ),
    Mutant(
        "a stop waits for the clock",
        "checkpoint.py",
        "if not now and (self.every is None",
        "if (self.every is None",
        "test_checkpoint.py::test_interval",
    ),
    Mutant(
        "only settings given before are compared",
        "checkpoint.py",
        "sorted(key for key in {**before, **self._settings} if",
        "sorted(key for key in before if",
        "test_checkpoint.py::test_settings_that_are_new_or_gone_are_refused",
    ),
    # -- exact solvers, chains, evaluation
    Mutant(
        "the chain stays cut at a rare state",
        "kernels.py",
        "                    ref = order[np.argmax(x)]\n",
        "                    break\n",
        "test_solver_claims.py::test_the_cut_is_moved_off_a_state_that_is_hardly_ever_met",
    ),
    Mutant(
        "way back to the cut is lost in elimination",
        "kernels.py",
        "absorbed = row[ref]",
        "absorbed = 0.0",
        "test_solver_claims.py::test_the_cut_is_moved_off_a_state_that_is_hardly_ever_met",
    ),
    Mutant(
        "KL of the tilted dynamics without its mean",
        "kernels.py",
        "kl[row] = max(average - log_total, 0.0)",
        "kl[row] = max(average, 0.0)",
        "test_solver_claims.py::test_a_tilted_row_is_as_defined",
    ),
    Mutant(
        "power iteration ends when u alone has",
        "kernels.py",
        "if moving_v < 0 and _moving(u, new_u, 0, bound) < 0:",
        "if True:",
        "test_maze_counts.py::test_power_iteration_is_the_plain_one",
    ),
    Mutant(
        "delta in nats, not in reward",
        "solvers/result.py",
        "problem.transition @ log_psi, 0.0) / problem.beta",
        "problem.transition @ log_psi, 0.0)",
        "test_solvers.py::test_biasing_iterations_are_the_dense_ones",
    ),
    Mutant(
        "k counts from 1",
        "solvers/biasing.py",
        "            k = state.k\n",
        "            k = state.k + 1\n",
        "test_solvers.py::test_authors_mazes",
    ),
    Mutant(
        "KL is to the old dynamics, not to the target",
        "solvers/biasing.py",
        "            kl = _kl_to(problem, at, tilted)\n",
        "            pass\n",
        "test_solvers.py::test_target_dynamics_are_what_is_solved",
    ),
    Mutant(
        "states that the start never leads to count",
        "solvers/problem.py",
        "mask = reachable_from(state_graph(p, n_actions), mdp.start)",
        "mask = np.ones(mdp.n_states, bool)",
        "test_solvers.py::test_unreachable_states_keep_the_prior",
    ),
    Mutant(
        "a class is open where something leads to it",
        "chains.py",
        "closed[label[origin[leaves]]] = False",
        "closed[label[chain.indices[leaves]]] = False",
        "test_solvers.py::test_regeneration_needs_a_state_that_is_reached",
    ),
    Mutant(
        "Poisson's gain misses the way back",
        "chains.py",
        "gain = (c[self.ref] + self._row @ x) / (1.0 + self._row @ self.hitting_time)",
        "gain = (c[self.ref] + self._row @ x) / (self._row @ self.hitting_time)",
        "test_solvers.py::test_regeneration_solves_the_poisson_equation",
    ),
    Mutant(
        "KL the other way round",
        "evaluation.py",
        "policy * np.log(policy / prior)",
        "policy * np.log(prior / policy)",
        "test_evaluation.py::test_kl",
    ),
    Mutant(
        "a distribution over a horizon begins a step late",
        "evaluation.py",
        "share, now = share + now, backward @ now",
        "share, now = share + backward @ now, backward @ now",
        "test_solvers.py::test_finite_horizon_distribution",
    ),
    # -- certificates, rows, intervals
    Mutant(
        "shares are of jumps instead of time",
        "kernels.py",
        "        x[k] *= least / rate[k]\n",
        "        x[k] *= 1.0\n",
        "test_rounding.py::test_shares_of_time_are_as_accurate_as_said",
    ),
    Mutant(
        "lost digits of an elimination are trusted",
        "kernels.py",
        "        sound = sound and x[k] >= tiny\n",
        "        sound = True\n",
        "test_rounding.py::test_digits_lost_below_the_range_of_numbers_are_known",
    ),
    Mutant(
        "a gain's error has no drift",
        "kernels.py",
        "error[a] = 10.0 * epsilon * size + epsilon * abs(q[a])",
        "error[a] = epsilon * abs(q[a])",
        "test_rounding.py::test_gains_lie_between_their_ends",
    ),
    Mutant(
        "a gain's error has no rounding of the logarithm",
        "kernels.py",
        "    return found, rounding\n",
        "    return found, 0.0\n",
        "test_rounding.py::test_gains_lie_between_their_ends",
    ),
    Mutant(
        "the state itself takes part in a drift",
        "kernels.py",
        "            x = data[m] * (value[indices[m]] - value[s])\n            size",
        "            x = data[m] * (value[indices[m]] - value[0])\n            size",
        "test_rounding.py::test_gains_lie_between_their_ends",
    ),
    Mutant(
        "the logarithm cancels where the best action has little prior",
        "kernels.py",
        "    if below >= -0.5:\n        logarithm",
        "    if below >= -1.0:\n        logarithm",
        "test_rounding.py::test_bounds_where_the_best_action_has_little_prior",
    ),
    Mutant(
        "the prior's own sum is left in the logarithm",
        "kernels.py",
        "    below /= total\n",
        "    below /= 1.0 + 1e-12\n",
        "test_rounding.py::test_gains_lie_between_their_ends",
    ),
    Mutant(
        "divergence without its lower end",
        "kernels.py",
        "    rounding = (n + 40) * epsilon * found + 8.0 * epsilon * size + n * 1e-322",
        "    rounding = 0.0",
        "test_rounding.py::test_policy_gains_lie_between_their_ends",
    ),
    Mutant(
        "divergence by logarithms alone",
        "kernels.py",
        "        if abs(x) < 0.1:\n",
        "        if abs(x) < 0.0:\n",
        "test_rounding.py::test_policies_close_to_the_prior_have_narrow_gains",
    ),
    Mutant(
        "a drift of a policy without its error",
        "kernels.py",
        "    error = 2.0 * error + (n_actions + 12) * epsilon * size",
        "    error = 0.0",
        "test_rounding.py::test_policy_gains_lie_between_their_ends",
    ),
    Mutant(
        "the probability of ending in a class is left out",
        "chains.py",
        "share[inside] = mass * part.of_state",
        "share[inside] = part.of_state / len(ends)",
        "test_rounding.py::test_endings_of_a_chain_with_several_classes",
    ),
    Mutant(
        "a state that is never left reaches SuperLU",
        "chains.py",
        "if not (diagonal > 0).all():",
        "if False:",
        "test_rounding.py::test_states_that_are_never_left_do_not_reach_superlu",
    ),
    Mutant(
        "indices of sparse matrices are trusted",
        "mdp.py",
        "            value.check_format(full_check=True)\n",
        "            pass\n",
        "test_rounding.py::test_indices_out_of_range_are_named",
    ),
    Mutant(
        "rows of single precision stay as they are",
        "mdp.py",
        "        data /= np.repeat(factor, np.diff(indptr))\n",
        "        pass\n",
        "test_rounding.py::test_rows_of_single_precision_are_welcome_and_named",
    ),
    Mutant(
        "a correction of rows is not said",
        "mdp.py",
        "    if largest > WORTH_A_NOTE:\n",
        "    if largest > 1:\n",
        "test_rounding.py::test_rows_of_single_precision_are_welcome_and_named",
    ),
    Mutant(
        "tolerance relative to rewards never met",
        "solvers/problem.py",
        "        return seen\n",
        "        return self.reward_range\n",
        "test_rounding.py::test_a_penalty_that_is_never_paid_loosens_nothing",
    ),
    Mutant(
        "the gap is the width of the bounds",
        "solvers/result.py",
        "    gap = policy_gap(problem, policy, bounds, value)",
        "    gap = bounds[1] - bounds[0]",
        "test_solver_claims.py::test_the_gap_is_of_the_policy_whatever_proved_the_bounds",
    ),
    Mutant(
        "a policy's gap counts from the wrong bound",
        "solvers/result.py",
        "max(float(np.nextafter(-bounds[0] - worth, np.inf)), 0.0)",
        "max(float(np.nextafter(-bounds[1] - worth, np.inf)), 0.0)",
        "test_solver_claims.py::test_a_certified_gap_counts_from_the_end_that_no_policy_passes",
    ),
    Mutant(
        "biasing has the bounds of its last value",
        "solvers/biasing.py",
        "        lower, upper = max(lower, proven.theta_bounds[0]), min(upper, proven.theta_bounds[1])\n",
        "        lower, upper = proven.theta_bounds\n",
        "test_solver_claims.py::test_bounds_of_biasing_iterations_are_the_best_so_far",
    ),
    Mutant(
        "rho without Delta",
        "solvers/result.py",
        "float(np.exp(-beta * (theta + delta)))",
        "float(np.exp(-beta * theta))",
        "test_solvers.py::test_three_routes_agree",
    ),
    Mutant(
        "theta beside REDUCIBLE",
        "solvers/result.py",
        "        theta=None if status is Status.REDUCIBLE else theta,\n",
        "        theta=theta,\n",
        "test_rounding.py::test_biasing_says_where_it_has_no_eigenvector",
    ),
    Mutant(
        "rho beside REDUCIBLE",
        "solvers/result.py",
        "        rho = None if status is Status.REDUCIBLE else float(",
        "        rho = float(",
        "test_solver_claims.py::test_the_model_known_before_needs_one_class_as_the_target_does",
    ),
    Mutant(
        "a gap by rounding to nearest",
        "solvers/result.py",
        "float(np.nextafter(-bounds[0] - worth, np.inf))",
        "float(-bounds[0] - worth)",
        "test_solver_claims.py::test_a_gap_is_not_below_the_loss_where_the_difference_rounds_down",
    ),
    Mutant(
        "a poor value's gains are all there is of a gap",
        "solvers/result.py",
        "    if value is None or -worth - bounds[0] > 2 * (bounds[1] - bounds[0]):\n",
        "    if value is None:\n",
        "test_solver_claims.py::test_a_poor_value_does_not_spoil_the_gap_of_its_policy",
    ),
    Mutant(
        "STOPPED whatever the bounds",
        "solvers/biasing.py",
        "        if found.status is not Status.CONVERGED:\n",
        "        if True:\n",
        "test_solver_claims.py::test_at_the_first_iteration_with_small_kl_the_bounds_say_whether_it_has_converged",
    ),
    Mutant(
        "a target on other states passes",
        "solvers/biasing.py",
        "    if not np.array_equal(problem.states, known.states):\n",
        "    if False:\n",
        "test_solver_claims.py::test_a_target_on_other_states_is_refused",
    ),
    Mutant(
        "the model known before may fall apart",
        "solvers/biasing.py",
        "    if known is not None and len(known.classes[1]) > 1:\n",
        "    if False:\n",
        "test_solver_claims.py::test_the_model_known_before_needs_one_class_as_the_target_does",
    ),
    Mutant(
        "a lost eigenvector goes on",
        "solvers/biasing.py",
        "        if lost == PATIENCE:\n",
        "        if False:\n",
        "test_solver_claims.py::test_an_eigenvector_beyond_doubles_ends_the_iteration",
    ),
    Mutant(
        "the last state counts, not the best",
        "solvers/soft_bellman.py",
        "        if best is None or state.width < best.width:\n",
        "        if True:\n",
        "test_solver_claims.py::test_the_state_with_the_narrowest_bounds_is_kept",
    ),
    Mutant(
        "polishing keeps its last state",
        "solvers/soft_bellman.py",
        "        best = new if new.width < best.width else best\n    return",
        "        best = new\n    return",
        "test_solver_claims.py::test_the_state_with_the_narrowest_bounds_is_kept",
    ),
    Mutant(
        "a divergence below range has no error",
        "kernels.py",
        "8.0 * epsilon * size + n * 1e-322  #",
        "8.0 * epsilon * size  #",
        "test_rounding.py::test_divergences_below_range_are_in_the_bounds",
    ),
    Mutant(
        "KL times beta",
        "kernels.py",
        "        low[s] = mean - most / beta\n        high[s] = mean - least / beta\n",
        "        low[s] = mean - most * beta\n        high[s] = mean - least * beta\n",
        "test_evaluation.py::test_cliff_oracles",
    ),
    Mutant(
        "a log that grew is not cut",
        "event_file.py",
        "                os.truncate(path, kept)\n",
        "                pass\n",
        "test_checkpoint.py::test_event_file_is_cut_and_gone_on_with",
    ),
    Mutant(
        "percentile instead of basic bootstrap",
        "uncertainty.py",
        "return 2 * self.value - float(high), 2 * self.value - float(low)",
        "return float(low), float(high)",
        "test_uncertainty.py::test_bootstrap_interval_is_the_basic_one",
    ),
    Mutant(
        "multinomial draws without the running mass",
        "uncertainty.py",
        "        mass[row] -= p.data[entry]\n",
        "",
        "test_uncertainty.py::test_resampled_counts_are_multinomial",
    ),
    Mutant(
        "resamples that fall apart are kept",
        "uncertainty.py",
        "if solution.status is Status.CONVERGED and not problem.reducible and solution.theta is not None:",
        "if solution.theta is not None:",
        "test_uncertainty.py::test_resamples_that_fall_apart_are_left_out",
    ),
    Mutant(
        "a pair seen once has the mean variance",
        "uncertainty.py",
        "largest = variance[known].max(initial=0.0)",
        "largest = variance[known].mean()",
        "test_uncertainty.py::test_a_pair_seen_once_is_given_the_largest_variance",
    ),
    Mutant(
        "the interval is not skewed",
        "uncertainty.py",
        "shift = 0.5 * t**2 * self.third / variance if variance > 0 else 0.0",
        "shift = 0.0",
        "test_uncertainty.py::test_interval_is_wilsons_for_a_count",
    ),
    Mutant(
        "the skewness has theta's sign wrong",
        "uncertainty.py",
        "        third=-found.third,\n",
        "        third=found.third,\n",
        "test_uncertainty.py::test_interval_covers_where_it_rests_on_rare_events",
    ),
    Mutant(
        "the second order is put on, not off",
        "uncertainty.py",
        "        gain - bias,\n",
        "        gain + bias,\n",
        "test_uncertainty.py::test_variance_is_the_derivative_of_the_value_with_the_rows",
    ),
    Mutant(
        "the optimist's bias is left out",
        "uncertainty.py",
        "        found += 0.5 * problem.beta * float(d @ (direct + through + both))\n",
        "        found += 0.0\n",
        "test_uncertainty.py::test_bias_is_the_second_derivative_with_the_rows",
    ),
    Mutant(
        "covariance of p and V is left out",
        "uncertainty.py",
        "    found = float((d[:, None] * policy**2 * np.where(known, together, 0.0)).sum())",
        "    found = 0.0",
        "test_uncertainty.py::test_bias_is_the_second_derivative_with_the_rows",
    ),
    Mutant(
        "pairs never tried count for nothing",
        "uncertainty.py",
        "    untried = _untried(model, part, d) if optimal else 0.0",
        "    untried = 0.0",
        "test_uncertainty.py::test_pairs_never_tried_widen_one_side",
    ),
    Mutant(
        "no variance is an interval",
        "uncertainty.py",
        '        return "no pair shows any variance"',
        '        return ""',
        "test_uncertainty.py::test_interval_is_withheld_where_it_says_nothing",
    ),
    # -- constants of the bounds, and what is done where digits are lost
    Mutant(
        "a lost eigenvector cannot come back",
        "solvers/biasing.py",
        " or moved or upper - lower",
        " or upper - lower",
        "test_solver_claims.py::test_a_lost_eigenvector_may_come_back_while_the_dynamics_change",
    ),
    Mutant(
        "a coarse value is not polished",
        "solvers/biasing.py",
        "        value, bounds = polish(problem, value, bounds, tol)\n",
        "        pass\n",
        "test_solver_claims.py::test_where_an_eigenvector_is_too_coarse_the_value_is_polished",
    ),
    Mutant(
        "the Judge trusts every elimination",
        "evaluation.py",
        "            if sound and np.isfinite(gains)",
        "            if np.isfinite(gains)",
        "test_rounding.py::test_the_judge_knows_rates_below_range",
    ),
    Mutant(
        "entries that lost digits pass",
        "kernels.py",
        "sound = sound and (p[i, j] >= tiny or i == j)",
        "sound = sound",
        "test_rounding.py::test_digits_lost_in_the_elimination_are_known",
    ),
    Mutant(
        "a quarter of a drift's error in the gains",
        "kernels.py",
        "error[a] = 10.0 * epsilon * size",
        "error[a] = 2.5 * epsilon * size",
        "test_rounding.py::test_rounding_of_a_drift_is_in_the_bounds",
    ),
    Mutant(
        "a quarter of a drift's error in a policy's gains",
        "kernels.py",
        "policy[s, a] * (10.0 * epsilon * moved",
        "policy[s, a] * (2.5 * epsilon * moved",
        "test_rounding.py::test_rounding_of_a_drift_is_in_the_bounds",
    ),
    Mutant(
        "a quarter of the logarithm's error",
        "kernels.py",
        "(2 * n + 20) * epsilon * abs(size)",
        "(0.5 * n + 5) * epsilon * abs(size)",
        "test_rounding.py::test_rounding_of_many_small_priors_is_in_the_bounds",
    ),
    Mutant(
        "a quarter of the error of a sum of divergences",
        "kernels.py",
        "rounding = (n + 40) * epsilon * found",
        "rounding = (0.25 * n + 10) * epsilon * found",
        "test_rounding.py::test_rounding_of_a_sum_of_divergences_is_in_the_bounds",
    ),
    Mutant(
        "a divergence's terms have no error",
        "kernels.py",
        " + 8.0 * epsilon * size + n",
        " + n",
        "test_rounding.py::test_rounding_of_a_divergence_where_its_terms_cancel_is_in_the_bounds",
    ),
    Mutant(
        "a sum over actions has no error",
        "kernels.py",
        "error = 2.0 * error + (n_actions + 12) * epsilon * size",
        "error = 2.0 * error",
        "test_rounding.py::test_rounding_of_a_sum_over_actions_is_in_the_bounds",
    ),
]


class Workplace:
    """A copy of the tree, in which one mutant at a time is tried."""

    def __init__(self, folder: Path) -> None:
        self.tree, self.clean, self.spoilt = folder / "tree", folder / "cache", folder / "cache of a mutant"
        for name in TREE:
            source = ROOT / name
            if source.is_dir():
                shutil.copytree(source, self.tree / name, ignore=shutil.ignore_patterns("__pycache__"))
            else:
                shutil.copy2(source, self.tree / name)

    def test(self, nodes: list[str], cache: Path, limit: float) -> tuple[int | None, str]:
        """(exit code of pytest, or None past the limit; its output)."""
        options = ["-x", "-p", "no:cacheprovider", "--hypothesis-profile=unshrunk", "--tb=short"]
        command = [sys.executable, "-B", "-m", "pytest", *options, *nodes]
        paths = {"PYTHONPATH": str(self.tree), "NUMBA_CACHE_DIR": str(cache)}
        process = subprocess.Popen(
            command, cwd=self.tree, env={**os.environ, **paths}, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
            text=True, start_new_session=True,
        )  # fmt: skip
        try:
            said, _ = process.communicate(timeout=limit)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            said, _ = process.communicate()
            return None, said
        return process.returncode, said

    def verdict(self, mutant: Mutant) -> str:
        path = self.tree / "erl_torch" / mutant.file
        text = path.read_text()
        if text.count(mutant.old) != 1 or mutant.old == mutant.new:
            return f"STALE: its text stands {text.count(mutant.old)} times in {mutant.file}"
        cache = self.clean
        if mutant.file == "kernels.py":
            cache = self.spoilt
            shutil.rmtree(cache, ignore_errors=True)
        times = path.stat()
        path.write_text(text.replace(mutant.old, mutant.new))
        try:
            code, said = self.test(mutant.nodes, cache, LIMIT)
        finally:
            path.write_text(text)
            os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))
        failed = re.findall(r"^(?:FAILED|ERROR) tests/(\S+)", said, re.M)
        if code is None:
            return "killed by time"
        if code < 0:
            return f"killed by signal {-code}"
        if code == 0:
            return "SURVIVED"
        if code != 1 or UNCOMPILED.search(said):
            return f"BROKEN: {said.strip().splitlines()[-1]}"
        return f"killed by {failed[0]}"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", help="parts of the names of the mutants to try; none: all")
    parser.add_argument("--processes", type=int, default=1, choices=(1, 2))
    arguments = parser.parse_args()
    double = [name for name, n in collections.Counter(m.name for m in MUTANTS).items() if n > 1]
    assert not double, double
    chosen = [m for m in MUTANTS if not arguments.names or any(part in m.name for part in arguments.names)]
    if not chosen:
        parser.error(f"no mutant is named {' or '.join(arguments.names)}")
    began = time.monotonic()
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(arguments.processes) as pool:
        places: Queue[Workplace] = Queue()
        for i in range(arguments.processes):
            places.put(Workplace(Path(folder) / str(i)))
        first = places.queue[0]
        code, said = first.test(sorted({node for m in chosen for node in m.nodes}), first.clean, 10 * LIMIT)
        if code != 0:
            print(said, "The tests fail without any mutant.", sep="\n")
            return 1
        print(f"without a mutant: {said.strip().splitlines()[-1]}", flush=True)

        def tried(mutant: Mutant) -> str:
            place, start = places.get(), time.monotonic()
            try:
                found = place.verdict(mutant)
            finally:
                places.put(place)
            print(f"{mutant.file:32} {mutant.name:52} {time.monotonic() - start:5.0f} s  {found}", flush=True)
            return found

        found = list(pool.map(tried, chosen))
    killed = sum(verdict.startswith("killed") for verdict in found)
    print(f"\n{killed} of {len(chosen)} killed in {(time.monotonic() - began) / 60:.1f} minutes")
    for mutant, verdict in zip(chosen, found, strict=True):
        if not verdict.startswith("killed"):
            print(f"{mutant.file}: {mutant.name}: {verdict}")
    return 0 if killed == len(chosen) else 1


if __name__ == "__main__":
    sys.exit(main())
