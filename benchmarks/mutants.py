"""Mistakes that somebody could have made, one at a time, each with the tests that must notice it.

    python benchmarks/mutants.py [processes=1] [to=FILE.json] [part of a name ...]     about half an hour of one core

A mutant is a patch (a text that stands once in a file, and another for it) and the tests that must fail on it. All
those tests pass first, without any patch. Then the tree is copied, a patch applied, its tests are run, and the file is
put back, mutant by mutant. What is found of a mutant:

    killed     a test failed, ran past its time (a loop that does not end), or crashed (memory out of bounds)
    SURVIVED   all tests passed: none looks at what the patch spoils
    BROKEN     the patched code does not compile or import, which any test would notice
    STALE      the text of the patch does not stand exactly once in the file: it wants rewriting

``to`` keeps every verdict as it falls, and writes a table beside it (FILE.md) at the end. A mutant whose verdict is
there already is not tried again, unless its patch, the file that it spoils or its tests' files have changed since.

The exit code is 0 if every mutant is killed.

Numba's cache looks at the time and size of kernels.py; here (``ByFunction``) at what a kernel and all that it calls
say, so that a mutant compiles what it spoils and nothing else. NUMBA_CACHE_DIR, if set, keeps it from run to run.
"""

from __future__ import annotations

import ast
import collections
import functools
import hashlib
import inspect
import json
import multiprocessing
import os
import re
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import Queue
from threading import Lock
from typing import Any, NamedTuple

HERE = Path(__file__).parent
ROOT = HERE.parent
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
        "empirical/kernels.py",
        "factor = pairs[k, 2] * (1.0 - lr_psi)",
        "factor = pairs[k, 2] * lr_psi",
        "test_algorithm_s1.py::test_psi_map_sorts_its_columns_and_forgets_old_visits",
    ),
    Mutant(
        "a new visit's weight misses the row's factor",
        "empirical/kernels.py",
        "entries[e, 2] += lr_psi / factor",
        "entries[e, 2] += lr_psi",
        "test_streams.py::test_the_tally_counts",
    ),
    Mutant(
        "a row's factor is reset, its weights are not",
        "empirical/kernels.py",
        "                    entries[m, 2] *= factor\n",
        "                    pass\n",
        "test_algorithm_s1.py::test_psi_map_sorts_its_columns_and_forgets_old_visits",
    ),
    Mutant(
        "tally never sees that rewards vary",
        "empirical/kernels.py",
        "            varied = True\n",
        "            varied = False\n",
        "test_certainty_equivalence.py::test_statistics_are_those_of_the_tuples",
    ),
    Mutant(
        "rewards vary only if the first visit's is met again",
        "empirical/kernels.py",
        "        pairs[k, 1] = r[t]\n",
        "        pairs[k, 1] = r[t] if pairs[k, 0] == 1.0 else pairs[k, 1]\n",
        "test_kernels.py::test_the_tally_keeps_the_last_reward_and_the_range",
    ),
    Mutant(
        "keys of (s,a,s') collide",
        "empirical/kernels.py",
        "key = k * n_states + s_next[t]",
        "key = k * (n_states - 1) + s_next[t]",
        "test_streams.py::test_the_tally_counts",
    ),
    # -- kernels: the psi phase
    Mutant(
        "the psi phase looks at <psi> alone",
        "learners/s1/kernels.py",
        "            change = max(change, abs(mean_log_psi[k] - y) / (abs(y) + epsilon))\n",
        "",
        "test_algorithm_s1.py::test_the_psi_phase_ends_by_the_larger_relative_error",
    ),
    Mutant(
        "the psi phase ends on an absolute error",
        "learners/s1/kernels.py",
        "change = max(change, abs(mean_psi[k] - x) / x)",
        "change = max(change, abs(mean_psi[k] - x))",
        "test_algorithm_s1.py::test_the_psi_phase_ends_by_the_larger_relative_error",
    ),
    Mutant(
        "<log psi> decays by W alone",
        "learners/s1/kernels.py",
        "mean_log_psi[k] = decay[k] * y + add_log_psi[k]",
        "mean_log_psi[k] = (1.0 - decay[k]) * y + add_log_psi[k]",
        "test_algorithm_s1.py::test_affine_psi_phase_is_the_sequential_one",
    ),
    # -- kernels: lines 10 and 11
    Mutant(
        "line 11 without its own step in the new u",
        "learners/s1/kernels.py",
        "_fma(keep_rho, lr_u, lr_rho) * w",
        "keep_rho * lr_u * w",
        "test_algorithm_s1.py::test_one_action_cycle_is_solved_exactly",
    ),
    Mutant(
        "the listing's self-loop in the script's reading",
        "learners/s1/kernels.py",
        "z[k], q = _lines_10_and_11(gain, z[k], z[j], q, lr_u, lr_rho, inv_rho_min, new and k == j)",
        "z[k], q = _lines_10_and_11(gain, z[k], z[j], q, lr_u, lr_rho, inv_rho_min, k == j)",
        "test_algorithm_s1.py::test_gives_what_the_authors_script_gives",
    ),
    Mutant(
        "clip of rho removed from the compiled line 11",
        "learners/s1/kernels.py",
        "return z_new, inv_rho_min if q_new < inv_rho_min else q_new",
        "return z_new, q_new",
        "test_algorithm_s1.py::test_rho_is_clipped_at_its_bound",
    ),
    Mutant(
        "rescaling goes away from 1",
        "learners/s1/kernels.py",
        "                scale = math.ldexp(1.0, -exponent)\n                for k in range(z.size):",
        "                scale = math.ldexp(1.0, exponent)\n                for k in range(z.size):",
        "test_algorithm_s1.py::test_million_tuple_drift_stays_in_range",
    ),
    Mutant(
        "a failure's tuple is counted within its chunk",
        "learners/s1/kernels.py",
        "return q, bad + first",
        "return q, bad",
        "test_streams.py::test_a_failure_names_its_tuple_wherever_it_is_read_from",
    ),
    Mutant(
        "a failing stretch is not done again from its start",
        "learners/s1/kernels.py",
        "            z[:] = backup\n            q = q_before\n",
        "            q = q_before\n",
        "test_algorithm_s1.py::test_leaving_the_finite_numbers_stops_with_step_and_cause",
    ),
    # -- kernels: lanes
    Mutant(
        "all lanes have the first one's step",
        "learners/s1/kernels.py",
        "z[k], q[i] = _lines_10_and_11(gain, z[k], z[j], q[i], lr_u[i], lr_rho[i], inv_rho_min[i], new and k == j)",
        "z[k], q[i] = _lines_10_and_11(gain, z[k], z[j], q[i], lr_u[0], lr_rho[i], inv_rho_min[i], new and k == j)",
        "test_replicas.py::test_bits_of_any_mixture",
    ),
    Mutant(
        "a lane at 0 counts as healthy",
        "learners/s1/kernels.py",
        "healthy = healthy and ((np.isfinite(z[k]) and z[k] > 0.0) or g[k] < 0.0)",
        "healthy = healthy and np.isfinite(z[k])",
        "test_replicas.py::test_a_replica_that_was_at_0_has_failed",
    ),
    Mutant(
        "the shared loop takes another tuple's factor",
        "learners/s1/kernels.py",
        "gain[i] * factor[t, i], here[i]",
        "gain[i] * factor[0, i], here[i]",
        "test_replicas.py::test_bits_on_a_shared_stream",
    ),
    Mutant(
        "a piece of the lanes is cut out twice",
        "learners/s1/kernels.py",
        "_lanes_rows(\n            pair, pair_next, factor, noisy,",
        "_lanes_rows(\n            pair[begin:], pair_next[begin:], factor, noisy,",
        "test_replicas.py::test_rewards_that_vary_are_cut_without_a_trace",
    ),
    # -- kernels: EfficientS1
    Mutant(
        "clip of rho removed from gauge_epoch",
        "learners/efficient_s1/kernels.py",
        "            if rho > rho_max:\n                rho = rho_max\n",
        "",
        "test_efficient_s1.py::test_rho_is_clipped_at_its_bound",
    ),
    Mutant(
        "clip of rho removed from log_gauge_epoch",
        "learners/efficient_s1/kernels.py",
        "log_rho = min(_log_blend(log_rho, w - z_new, lr_rho), log_rho_max)",
        "log_rho = _log_blend(log_rho, w - z_new, lr_rho)",
        "test_efficient_s1.py::test_rho_is_clipped_at_its_bound",
    ),
    Mutant(
        "a visit's step is the next one's",
        "learners/efficient_s1/kernels.py",
        "            step = steps[min(visits[k], last)]\n            visits[k] += 1\n            z_new = (1.0 - step)",
        "            visits[k] += 1\n            step = steps[min(visits[k], last)]\n            z_new = (1.0 - step)",
        "test_efficient_s1.py::test_kernels_agree_with_the_direct_form",
    ),
    Mutant(
        "sums over visits are not rescaled",
        "learners/efficient_s1/kernels.py",
        "            z[k] *= scale\n            total[k] *= scale\n",
        "            z[k] *= scale\n",
        "test_efficient_s1.py::test_kernels_agree_with_the_direct_form",
    ),
    Mutant(
        "the expected backup keeps y(s) of the stretch before",
        "learners/efficient_s1/kernels.py",
        "                y[s] = row\n",
        "                pass\n",
        "test_efficient_s1.py::test_kernels_agree_with_the_direct_form",
    ),
    Mutant(
        "a blend at step 1 goes through log 0",
        "learners/efficient_s1/kernels.py",
        "return log_new if step >= 1.0 else log_x + math.log1p(step * math.expm1(d))",
        "return log_x + math.log1p(step * math.expm1(d))",
        "test_kernels.py::test_log_blend",
    ),
    # -- kernels: sampling
    Mutant(
        "a draw at the edge belongs to the entry before",
        "experience/kernels.py",
        "        if x < cdf[middle]:\n",
        "        if x <= cdf[middle]:\n",
        "test_kernels.py::test_draws_are_of_half_open_intervals",
    ),
    Mutant(
        "a draw at the edge belongs to the entry before, in lanes",
        "experience/kernels.py",
        "<= x[i] else none",
        "< x[i] else none",
        "test_kernels.py::test_draws_are_of_half_open_intervals",
    ),
    Mutant(
        "entries of probability 0 close a row",
        "experience/kernels.py",
        "            if data[m] > 0.0:\n                last = m\n",
        "            last = m\n",
        "test_kernels.py::test_rounding_reaches_no_entry_of_probability_0",
    ),
    Mutant(
        "the start is drawn from the behaviour's stream",
        "experience/kernels.py",
        "s = _draw(start_cdf, 0, start_cdf.size, x[x_row, i])",
        "s = _draw(start_cdf, 0, start_cdf.size, y[y_row, i])",
        "test_replicas.py::test_a_lane_draws_what_numpy_draws",
    ),
    Mutant(
        "a' comes from the behaviour policy",
        "experience/kernels.py",
        "_draw_lanes(prior_cdf, low, length, action_levels, y[y_row])",
        "_draw_lanes(behaviour_cdf, low, length, action_levels, y[y_row])",
        "test_experience.py::test_law_of_the_stream",
    ),
    Mutant(
        "uniforms of 52 bits",
        "experience/kernels.py",
        "np.int64(word >> np.uint64(11))) * (1.0 / 9007199254740992.0)",
        "np.int64(word >> np.uint64(12))) * (1.0 / 4503599627370496.0)",
        "test_kernels.py::test_uniforms_are_numpys_to_the_last_bit",
    ),
    Mutant(
        "a restart's number is left out of the count",
        "experience/kernels.py",
        "restarts = (done + n + episode_length - 1) // episode_length - (done + episode_length - 1) // episode_length",
        "restarts = (done + n) // episode_length - done // episode_length + 1",
        "test_replicas.py::test_a_lane_draws_what_numpy_draws",
    ),
    Mutant(
        "what a survey forgets it remembers",
        "learners/s1/kernels.py",
        "            weight[m] *= scale\n        scale = 1.0\n    return scale",
        "            weight[m] *= 1.0\n        scale = 1.0\n    return scale",
        "test_replicas.py::test_survey_is_the_map_of_the_recorded_stream",
    ),
    # -- kernels: returns and chains
    Mutant(
        "an episode is a step too short",
        "experience/kernels.py",
        "        for _ in range(episode_length):\n",
        "        for _ in range(episode_length - 1):\n",
        "test_kernels.py::test_returns_on_a_cycle_are_counted",
    ),
    Mutant(
        "a reward is that of the state reached",
        "experience/kernels.py",
        "            total += reward[s, k - s * n_actions]\n"
        "            s = indices[_draw(cdf, indptr[k], indptr[k + 1], rng.random())]\n",
        "            a = k - s * n_actions\n"
        "            s = indices[_draw(cdf, indptr[k], indptr[k + 1], rng.random())]\n"
        "            total += reward[s, a]\n",
        "test_kernels.py::test_returns_on_a_cycle_are_counted",
    ),
    Mutant(
        "a horizon is a step too short",
        "solvers/kernels.py",
        "    for _ in range(horizon):\n",
        "    for _ in range(horizon - 1):\n",
        "test_evaluation.py::test_finite_horizon_is_the_sum_of_powers",
    ),
    Mutant(
        "rows for columns in the back substitution",
        "solvers/kernels.py",
        "x[k] += x[i] * p[i, k]",
        "x[k] += x[i] * p[k, i]",
        "test_action_value.py::test_gth_and_lu_are_the_stationary_distribution",
    ),
    # -- kernels: mazes, counts
    Mutant(
        "a mean of five over four",
        "envs/kernels.py",
        "field[i, j] = (field[i, j] + around) / 5",
        "field[i, j] = (field[i, j] + around) / 4",
        "test_mazes.py::test_smoothing_is_the_raster_sweep",
    ),
    Mutant(
        "counts of the row before are kept",
        "envs/kernels.py",
        "            seen[indices[m]] = 0\n",
        "            pass\n",
        "test_kernels.py::test_cells_are_counted_row_by_row",
    ),
    # -- kernels: action values
    Mutant(
        "the prior of visited actions is not normalised",
        "learners/action_value/kernels.py",
        "return top + math.log(total / mass) / beta",
        "return top + math.log(total) / beta",
        "test_action_value.py::test_compiled_is_the_slow_twin",
    ),
    Mutant(
        "a maximum over actions never tried",
        "learners/action_value/kernels.py",
        "if visits[k] > 0 and q[k] > top:",
        "if q[k] > top:",
        "test_action_value.py::test_compiled_is_the_slow_twin",
    ),
    Mutant(
        "the reference is a pair, not a state",
        "learners/action_value/kernels.py",
        "if reference >= 0 and k // n_actions == reference:",
        "if reference >= 0 and k == reference:",
        "test_action_value.py::test_compiled_is_the_slow_twin",
    ),
    Mutant(
        "a large error overflows",
        "learners/action_value/kernels.py",
        "    if x > 0.0:\n        return x + math.log1p((1.0 - step) * math.expm1(-x))\n",
        "",
        "test_action_value.py::test_log_mix",
    ),
    # -- Algorithm S1
    Mutant(
        "clip_rho counts for nothing",
        "learners/s1/algorithm.py",
        "return max(1.0, math.exp(exponent)) if self.clip_rho else math.inf",
        "return math.inf",
        "test_algorithm_s1.py::test_rho_is_clipped_at_its_bound",
    ),
    Mutant(
        "rho is clipped at 1 whatever the rewards",
        "learners/s1/algorithm.py",
        "return max(1.0, math.exp(exponent)) if self.clip_rho else math.inf",
        "return 1.0 if self.clip_rho else math.inf",
        "test_algorithm_s1.py::test_rho_is_clipped_at_its_bound",
    ),
    Mutant(
        "the smallest reward bounds rho",
        "learners/s1/algorithm.py",
        "self.largest_rho(found.reward_range[1])",
        "self.largest_rho(found.reward_range[0])",
        "test_algorithm_s1.py::test_rho_is_clipped_at_its_bound",
    ),
    Mutant(
        "a psi phase cut short is forgotten",
        "learners/s1/algorithm.py",
        "psi_converged=state.psi_converged and error < self.psi_tol",
        "psi_converged=error < self.psi_tol",
        "test_algorithm_s1.py::test_a_psi_phase_cut_short_is_remembered",
    ),
    Mutant(
        "the psi phase is never said to be cut short",
        "learners/s1/algorithm.py",
        "if status is Status.COMPLETED and not state.psi_converged:",
        "if status is Status.COMPLETED and False:",
        "test_algorithm_s1.py::test_psi_limit_is_reported",
    ),
    Mutant(
        "the biases' psi is that of the iteration before",
        "learners/s1/algorithm.py",
        "psi_in_use=state.psi,",
        "psi_in_use=state.psi_in_use,",
        "test_algorithm_s1.py::test_gives_what_the_authors_script_gives",
    ),
    Mutant(
        "delta falls below 0 by rounding",
        "learners/s1/algorithm.py",
        "np.maximum((np.log(mean_psi) - mean_log_psi) / beta, 0.0)",
        "((np.log(mean_psi) - mean_log_psi) / beta)",
        "test_algorithm_s1.py::test_deterministic_dynamics_need_no_bias",
    ),
    Mutant(
        "Delta is added where it is to be taken off",
        "learners/s1/algorithm.py",
        "return -math.log(self.rho) / self.beta - self.reward_bias_max",
        "return -math.log(self.rho) / self.beta + self.reward_bias_max",
        "test_algorithm_s1.py::test_gives_what_the_authors_script_gives",
    ),
    Mutant(
        "line 12 without the prior",
        "learners/s1/algorithm.py",
        "return u, 1 / (prior * u).sum(-1)",
        "return u, u.shape[-1] / u.sum(-1)",
        "test_algorithm_s1.py::test_psi_and_policy_are_equations_7_and_12",
    ),
    Mutant(
        "pairs without visits get the mean without its mass",
        "learners/s1/algorithm.py",
        "(weight * u).sum(-1, keepdims=True) / mass, u)",
        "(weight * u).sum(-1, keepdims=True), u)",
        "test_algorithm_s1.py::test_visited_states_only",
    ),
    Mutant(
        "rho's step is that of u",
        "learners/s1/algorithm.py",
        "return self.lr_u / n_states if self.lr_rho is None else self.lr_rho",
        "return self.lr_u if self.lr_rho is None else self.lr_rho",
        "test_algorithm_s1.py::test_default_step_size_of_rho_is_the_scripts",
    ),
    Mutant(
        "the listing does not clip rho",
        "learners/s1/listing.py",
        "        rho = min(rho, rho_max)\n",
        "",
        "test_algorithm_s1.py::test_rho_is_clipped_at_its_bound",
    ),
    Mutant(
        "the listing's line 11 with the old u",
        "learners/s1/listing.py",
        '        if self_loop == "new":\n            u_next = float(u[s_next, a_next])\n',
        "",
        "test_algorithm_s1.py::test_fast_is_the_listing",
    ),
    Mutant(
        "psi is raised to the wrong power in the gauge",
        "learners/s1/algorithm.py",
        "exponent = (1 - optimism) * np.log(psi)",
        "exponent = (1 + optimism) * np.log(psi)",
        "test_dial_s1.py::test_expected_lines_reach_the_exact_solution",
    ),
    Mutant(
        "delta without its factor",
        "learners/s1/algorithm.py",
        "found = (1 - optimism) * np.maximum(",
        "found = np.maximum(",
        "test_dial_s1.py::test_expected_lines_reach_the_exact_solution",
    ),
    Mutant(
        "the mean behind delta takes the exponent of line 3",
        "learners/s1/kernels.py",
        "_mixed(x, own[0, k], decay[k], 1.0 - optimism)",
        "_mixed(x, own[0, k], decay[k], -optimism)",
        "test_dial_s1.py::test_the_psi_phase_is_the_sequential_one",
    ),
    # -- replicas
    Mutant(
        "replicas take the first one's optimism in lines 2-3",
        "learners/s1/lanes.py",
        "return self.learners[r].psi_phase(",
        "return self.learner.psi_phase(",
        "test_dial_s1.py::test_replicas_at_any_optimism_come_out_as_alone",
    ),
    Mutant(
        "lanes forget a psi phase cut short",
        "learners/s1/lanes.py",
        "psi_converged=state.psi_converged & (error < self.learner.psi_tol)",
        "psi_converged=error < self.learner.psi_tol",
        "test_replicas.py::test_a_psi_phase_cut_short_is_remembered",
    ),
    Mutant(
        "rho begins at the first replica's temperature",
        "learners/s1/lanes.py",
        "rho=np.array([math.exp(-beta) for beta in self.beta]) if reset",
        "rho=np.array([math.exp(-self.beta[0]) for beta in self.beta]) if reset",
        "test_replicas.py::test_bits_on_a_shared_stream",
    ),
    Mutant(
        "every block samples the first seeds",
        "learners/s1/lanes.py",
        "for seed in simulation.seeds[part]]",
        "for seed in simulation.seeds[: part.stop - part.start]]",
        "test_replicas.py::test_bits_of_replicas_are_those_of_single_runs",
    ),
    Mutant(
        "factors of a later cut are those of the first",
        "learners/s1/lanes.py",
        "yield first, stop, np.exp(self.beta[part] * r[first:stop])",
        "yield first, stop, np.exp(self.beta[part] * r[: stop - first])",
        "test_replicas.py::test_rewards_that_vary_are_cut_without_a_trace",
    ),
    Mutant(
        "a lane's rewards stay in the table where its tuples have them",
        "learners/s1/lanes.py",
        "rewards[:, [not s.noisy for s in inside]] = 0.0",
        "pass",
        "test_replicas.py::test_bits_of_replicas_are_those_of_single_runs",
    ),
    Mutant(
        "a lane that failed keeps its spoilt tables",
        "learners/s1/lanes.py",
        "ended[r] = (before.replica(r), self._failure(before, r))",
        "ended[r] = (after.replica(r), self._failure(before, r))",
        "test_replicas.py::test_a_failure_later_on_keeps_the_last_good_epoch",
    ),
    Mutant(
        "torch's line 11 without its own step",
        "learners/s1/device.py",
        "both = keep_rho * lr_u + lr_rho",
        "both = keep_rho * lr_u",
        "test_replicas.py::test_torch_operations_are_the_compiled_loop",
    ),
    Mutant(
        "torch keeps 1/rho below its bound",
        "learners/s1/device.py",
        "q_now = torch.maximum(q_new, q_min)",
        "q_now = torch.minimum(q_new, q_min)",
        "test_replicas.py::test_torch_operations_are_the_compiled_loop",
    ),
    Mutant(
        "torch does not clip rho",
        "learners/s1/device.py",
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
        "learners/action_value/q_learning.py",
        "torch.where(seen, self.q, value[:, None])",
        "torch.where(seen, self.q, 0.0)",
        "test_action_value.py::test_actions_never_taken_keep_their_prior_share",
    ),
    Mutant(
        "the soft value misses the mass of what was tried",
        "learners/action_value/q_learning.py",
        "(logits.logsumexp(1) - mass) / self.beta",
        "logits.logsumexp(1) / self.beta",
        "test_action_value.py::test_actions_never_taken_keep_their_prior_share",
    ),
    Mutant(
        "the reference is the rarest state",
        "learners/action_value/q_learning.py",
        "int(np.argmax(visits))",
        "int(np.argmin(visits))",
        "test_action_value.py::test_the_reference_is_the_state_visited_most",
    ),
    Mutant(
        "the rate's step is that of q",
        "learners/action_value/q_learning.py",
        "return (1 / n_pairs if self.lr_rate is None else self.lr_rate), -1",
        "return (1.0 if self.lr_rate is None else self.lr_rate), -1",
        "test_action_value.py::test_compiled_is_the_slow_twin",
    ),
    Mutant(
        "the read-out averages over all tuples",
        "learners/action_value/z_learning.py",
        "mean = np.divide(total, counts, out=",
        "mean = np.divide(total, counts.sum(), out=",
        "test_action_value.py::test_read_out_of_z_learning_is_the_mean_over_visits",
    ),
    # -- EfficientS1
    Mutant(
        "options forget a psi phase cut short",
        "learners/efficient_s1/algorithm.py",
        "psi_converged=state.psi_converged and converged,",
        "psi_converged=converged,",
        "test_efficient_s1.py::test_a_psi_phase_cut_short_is_remembered",
    ),
    Mutant(
        "the lower bound of the certificate is the largest gain",
        "learners/efficient_s1/algorithm.py",
        "return float(low.min()), float(gains",
        "return float(low.max()), float(gains",
        "test_efficient_s1.py::test_the_width_bounds_the_loss_of_any_policy",
    ),
    Mutant(
        "rho is carried over with the Delta of before",
        "learners/efficient_s1/algorithm.py",
        "log_rho=-self.beta * (theta + after.reward_bias_max))",
        "log_rho=-self.beta * (theta + state.reward_bias_max))",
        "test_efficient_s1.py::test_theta_is_carried_over_whatever_delta_becomes",
    ),
    Mutant(
        "sums over visits go on from iteration to iteration",
        "learners/efficient_s1/algorithm.py",
        "            log_total=torch.full_like(state.log_total, -math.inf),\n        )\n        if self.warm_start",
        "        )\n        if self.warm_start",
        "test_efficient_s1.py::test_line_12_takes_the_mean_of_z_over_this_iterations_visits",
    ),
    Mutant(
        "the clocks' step is one visit ahead",
        "learners/efficient_s1/algorithm.py",
        "self.clock_horizon / (self.clock_horizon + n)))",
        "self.clock_horizon / (self.clock_horizon + n + 1)))",
        "test_efficient_s1.py::test_steps_of_the_clocks",
    ),
    Mutant(
        "pairs never visited keep their prior",
        "learners/efficient_s1/algorithm.py",
        "weight = prior * (part.used | ~inside[:, None])",
        "weight = prior",
        "test_efficient_s1.py::test_pairs_never_visited_have_probability_zero_and_unseen_states_the_prior",
    ),
    Mutant(
        "the smallest reward bounds rho, with options",
        "learners/efficient_s1/algorithm.py",
        "log_rho_max=max(0.0, self.beta * found.reward_range[1])",
        "log_rho_max=max(0.0, self.beta * found.reward_range[0])",
        "test_efficient_s1.py::test_rho_is_clipped_at_its_bound",
    ),
    # -- certainty equivalence and the empirical model
    Mutant(
        "the prior's mass on visited actions has the wrong sign",
        "empirical/counts.py",
        "axis=1) + np.log(np.minimum(mass, 1.0)) / beta",
        "axis=1) - np.log(np.minimum(mass, 1.0)) / beta",
        "test_certainty_equivalence.py::test_states_that_lead_nowhere_are_left_out_and_keep_the_prior",
    ),
    Mutant(
        "states that lead to lost states are kept",
        "empirical/counts.py",
        "                break\n            alive = np.asarray(used.any(1))\n",
        "                break\n            alive = np.asarray(used.any(1))\n            break\n",
        "test_certainty_equivalence.py::test_states_that_lead_nowhere_are_left_out_and_keep_the_prior",
    ),
    Mutant(
        "the class of most states, not of most tuples",
        "empirical/counts.py",
        "tuples = np.bincount(label, visits.sum(1)) * closed",
        "tuples = np.bincount(label) * closed",
        "test_certainty_equivalence.py::test_of_two_closed_sets_the_one_with_more_tuples_counts",
    ),
    Mutant(
        "variance of rewards over n",
        "empirical/counts.py",
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
        'children = np.random.SeedSequence(checks.at_least("seed", seed, 0)).spawn(len(Streams._fields))',
        "children = [np.random.SeedSequence(seed + i) for i in range(len(Streams._fields))]",
        "test_experience.py::test_streams_are_independent_by_name",
    ),
    Mutant(
        "generators stay where they were",
        "experience/sampling.py",
        "            for generator, words in ((rng.environment, self.environment), (rng.behaviour, self.behaviour)):",
        "            for generator, words in ((rng.environment, self.environment),):",
        "test_replicas.py::test_generators_go_on_where_the_stream_ends",
    ),
    Mutant(
        "halvings for rows half as long",
        "experience/sampling.py",
        "return (longest - 1).bit_length()",
        "return (longest // 2).bit_length()",
        "test_kernels.py::test_lanes_draw_from_rows_of_any_length",
    ),
    Mutant(
        "a state equal to the size passes",
        "experience/transitions.py",
        "            if column.max() >= bound:",
        "            if column.max() > bound:",
        "test_algorithm_s1.py::test_bad_stream_is_named",
    ),
    Mutant(
        "the checksum is of the last chunk",
        "experience/transitions.py",
        "zlib.crc32(memoryview(getattr(chunk, name)), crc)",
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
        "mdp/from_gymnasium.py",
        "on = sp.coo_array((p[~end], (row[~end], to[~end])), shape=shape)",
        "on = sp.coo_array((p, (row, to)), shape=shape)",
        "test_models.py::test_restart_against_a_loop_over_P",
    ),
    Mutant(
        "a reward that depends on s' is the last one's",
        "mdp/from_gymnasium.py",
        "mean = np.bincount(row, p * r, n_rows)",
        "mean = np.zeros(n_rows)\n    mean[row] = r",
        "test_models.py::test_rewards_that_depend_on_s_next_are_reported",
    ),
    # -- checkpoints
    Mutant(
        "one checkpoint is kept",
        "run/checkpoint.py",
        "KEPT = 2\n",
        "KEPT = 1\n",
        "test_checkpoint.py::test_the_last_two_are_kept",
    ),
    Mutant(
        "the oldest checkpoint is read",
        "run/checkpoint.py",
        'for path in sorted(self._folder.glob("*.ckpt"), reverse=True):',
        'for path in sorted(self._folder.glob("*.ckpt")):',
        "test_checkpoint.py::test_the_newest_checkpoint_is_read",
    ),
    Mutant(
        "checksums are not looked at",
        "run/checkpoint.py",
        "    if hashlib.sha256(body).hexdigest().encode() != line:\n"
        '        raise ValueError("its checksum does not match")\n',
        "",
        "test_checkpoint.py::test_a_bit_flipped_in_a_table_is_seen",
    ),
    Mutant(
        "the clock of checkpoints is never set",
        "run/checkpoint.py",
        "            path.unlink(missing_ok=True)\n        self._last = time.monotonic()\n",
        "            path.unlink(missing_ok=True)\n",
        "test_checkpoint.py::test_interval",
    ),
    Mutant(
        "a stop waits for the clock",
        "run/checkpoint.py",
        "if not now and (self.every is None",
        "if (self.every is None",
        "test_checkpoint.py::test_interval",
    ),
    Mutant(
        "only settings given before are compared",
        "run/checkpoint.py",
        "sorted(key for key in {**before, **self._settings} if",
        "sorted(key for key in before if",
        "test_checkpoint.py::test_settings_that_are_new_or_gone_are_refused",
    ),
    # -- exact solvers, chains, evaluation
    Mutant(
        "the chain stays cut at a rare state",
        "solvers/kernels.py",
        "                    ref = order[np.argmax(x)]\n",
        "                    break\n",
        "test_solver_claims.py::test_the_cut_is_moved_off_a_state_that_is_hardly_ever_met",
    ),
    Mutant(
        "way back to the cut is lost in elimination",
        "solvers/kernels.py",
        "absorbed = row[ref]",
        "absorbed = 0.0",
        "test_solver_claims.py::test_the_cut_is_moved_off_a_state_that_is_hardly_ever_met",
    ),
    Mutant(
        "KL of the tilted dynamics without its mean",
        "solvers/kernels.py",
        "kl[row] = max(average - log_total, 0.0)",
        "kl[row] = max(average, 0.0)",
        "test_solver_claims.py::test_a_tilted_row_is_as_defined",
    ),
    Mutant(
        "power iteration ends when u alone has",
        "reproduction/kernels.py",
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
        "solvers/chains.py",
        "closed[label[origin[leaves]]] = False",
        "closed[label[chain.indices[leaves]]] = False",
        "test_solvers.py::test_regeneration_needs_a_state_that_is_reached",
    ),
    Mutant(
        "Poisson's gain misses the way back",
        "solvers/chains.py",
        "gain = (c[self.ref] + self._row @ x) / (1.0 + self._row @ self.hitting_time)",
        "gain = (c[self.ref] + self._row @ x) / (self._row @ self.hitting_time)",
        "test_solvers.py::test_regeneration_solves_the_poisson_equation",
    ),
    Mutant(
        "KL the other way round",
        "solvers/policy.py",
        "policy * np.log(policy / prior)",
        "policy * np.log(prior / policy)",
        "test_evaluation.py::test_kl",
    ),
    Mutant(
        "a distribution over a horizon begins a step late",
        "solvers/policy.py",
        "share, now = share + now, backward @ now",
        "share, now = share + backward @ now, backward @ now",
        "test_solvers.py::test_finite_horizon_distribution",
    ),
    # -- certificates, rows, intervals
    Mutant(
        "shares are of jumps instead of time",
        "solvers/kernels.py",
        "        x[k] *= least / rate[k]\n",
        "        x[k] *= 1.0\n",
        "test_rounding.py::test_shares_of_time_are_as_accurate_as_said",
    ),
    Mutant(
        "lost digits of an elimination are trusted",
        "solvers/kernels.py",
        "        sound = sound and x[k] >= tiny\n",
        "        sound = True\n",
        "test_rounding.py::test_digits_lost_below_the_range_of_numbers_are_known",
    ),
    Mutant(
        "a gain's error has no drift",
        "solvers/certificate_kernels.py",
        "error[a] = 10.0 * epsilon * size + epsilon * abs(q[a])",
        "error[a] = epsilon * abs(q[a])",
        "test_rounding.py::test_gains_lie_between_their_ends",
    ),
    Mutant(
        "a gain's error has no rounding of the logarithm",
        "solvers/certificate_kernels.py",
        "    return maximum, rounding\n",
        "    return maximum, 0.0\n",
        "test_rounding.py::test_gains_lie_between_their_ends",
    ),
    Mutant(
        "the state itself takes part in a drift",
        "solvers/certificate_kernels.py",
        "            x = data[m] * (value[indices[m]] - value[s])\n            size",
        "            x = data[m] * (value[indices[m]] - value[0])\n            size",
        "test_rounding.py::test_gains_lie_between_their_ends",
    ),
    Mutant(
        "the logarithm cancels where the best action has little prior",
        "solvers/certificate_kernels.py",
        "    if below >= -0.5:\n        logarithm",
        "    if below >= -1.0:\n        logarithm",
        "test_rounding.py::test_bounds_where_the_best_action_has_little_prior",
    ),
    Mutant(
        "the prior's own sum is left in the logarithm",
        "solvers/certificate_kernels.py",
        "    below /= total\n",
        "    below /= 1.0 + 1e-12\n",
        "test_rounding.py::test_gains_lie_between_their_ends",
    ),
    Mutant(
        "divergence without its lower end",
        "solvers/certificate_kernels.py",
        "    rounding = (n + 40) * epsilon * kl + 8.0 * epsilon * size + n * 1e-322",
        "    rounding = 0.0",
        "test_rounding.py::test_policy_gains_lie_between_their_ends",
    ),
    Mutant(
        "divergence by logarithms alone",
        "solvers/certificate_kernels.py",
        "        if abs(x) < 0.1:\n",
        "        if abs(x) < 0.0:\n",
        "test_rounding.py::test_policies_close_to_the_prior_have_narrow_gains",
    ),
    Mutant(
        "a drift of a policy without its error",
        "solvers/certificate_kernels.py",
        "    error = 2.0 * error + (n_actions + 12) * epsilon * size",
        "    error = 0.0",
        "test_rounding.py::test_policy_gains_lie_between_their_ends",
    ),
    Mutant(
        "the probability of ending in a class is left out",
        "solvers/chains.py",
        "share[members] = mass * own.of_state",
        "share[members] = own.of_state / len(ends)",
        "test_rounding.py::test_endings_of_a_chain_with_several_classes",
    ),
    Mutant(
        "a state that is never left reaches SuperLU",
        "solvers/chains.py",
        "if not (diagonal > 0).all():",
        "if False:",
        "test_rounding.py::test_states_that_are_never_left_do_not_reach_superlu",
    ),
    Mutant(
        "indices of sparse matrices are trusted",
        "checks.py",
        "            matrix.check_format(full_check=True)\n",
        "            pass\n",
        "test_rounding.py::test_indices_out_of_range_are_named",
    ),
    Mutant(
        "rows of single precision stay as they are",
        "mdp/tabular.py",
        "        data /= np.repeat(factor, np.diff(indptr))\n",
        "        pass\n",
        "test_rounding.py::test_rows_of_single_precision_are_welcome_and_named",
    ),
    Mutant(
        "a correction of rows is not said",
        "mdp/tabular.py",
        "    if largest > NOTED_CORRECTION:\n",
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
        "the dial: biasing forgets the dynamics in mind",
        "solvers/biasing.py",
        "    if problem.kappa == 0:\n        return np.asarray(log_p)\n",
        "    return np.asarray(log_p)\n",
        "test_dial_biasing.py::test_iterations_are_the_dense_ones",
    ),
    Mutant(
        "the dial: KL of biasing is to p",
        "solvers/biasing.py",
        "at.tilt(h) if at.kappa == 0 else _tilted_again(at, log_q, h)",
        "at.tilt(h)",
        "test_dial_biasing.py::test_iterations_are_the_dense_ones",
    ),
    Mutant(
        "the dial: its slope with beta leaves out the dynamics",
        "solvers/dial.py",
        " - problem.optimism * price)",
        ")",
        "test_dial_theory.py::test_slope",
    ),
    Mutant(
        "the dial: a factor of the price near optimism 0",
        "solvers/dial.py",
        "series += term / (k + 2)",
        "series += term / (k + 1)",
        "test_dial_theory.py::test_slope",
    ),
    Mutant(
        "biasing has the bounds of its last value",
        "solvers/biasing.py",
        "        lower, upper = max(lower, gains.theta_bounds[0]), min(upper, gains.theta_bounds[1])\n",
        "        lower, upper = gains.theta_bounds\n",
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
        "        if solution.status is not Status.CONVERGED:\n",
        "        if True:\n",
        "test_solver_claims.py::test_at_the_first_iteration_with_small_kl_the_bounds_say_whether_it_has_converged",
    ),
    Mutant(
        "a target on other states passes",
        "solvers/biasing.py",
        "    if not np.array_equal(problem.states, source.states):\n",
        "    if False:\n",
        "test_solver_claims.py::test_a_target_on_other_states_is_refused",
    ),
    Mutant(
        "the model known before may fall apart",
        "solvers/biasing.py",
        "    if source is not None and len(source.classes[1]) > 1:\n",
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
        "solvers/certificate_kernels.py",
        "8.0 * epsilon * size + n * 1e-322  #",
        "8.0 * epsilon * size  #",
        "test_rounding.py::test_divergences_below_range_are_in_the_bounds",
    ),
    Mutant(
        "KL times beta",
        "solvers/certificate_kernels.py",
        "        low[s] = mean - most / beta\n        high[s] = mean - least / beta\n",
        "        low[s] = mean - most * beta\n        high[s] = mean - least * beta\n",
        "test_evaluation.py::test_cliff_oracles",
    ),
    Mutant(
        "a log that grew is not cut",
        "log/event_file.py",
        "                os.truncate(path, kept)\n",
        "                pass\n",
        "test_checkpoint.py::test_event_file_is_cut_and_gone_on_with",
    ),
    Mutant(
        "percentile instead of basic bootstrap",
        "empirical/uncertainty.py",
        "return 2 * self.value - float(high), 2 * self.value - float(low)",
        "return float(low), float(high)",
        "test_uncertainty.py::test_bootstrap_interval_is_the_basic_one",
    ),
    Mutant(
        "multinomial draws without the running mass",
        "empirical/uncertainty.py",
        "        mass[row] -= p.data[entry]\n",
        "",
        "test_uncertainty.py::test_resampled_counts_are_multinomial",
    ),
    Mutant(
        "resamples that fall apart are kept",
        "empirical/uncertainty.py",
        "if solution.status is Status.CONVERGED and not problem.reducible and solution.theta is not None:",
        "if solution.theta is not None:",
        "test_uncertainty.py::test_resamples_that_fall_apart_are_left_out",
    ),
    Mutant(
        "a pair seen once has the mean variance",
        "empirical/uncertainty.py",
        "each[once] = each[used & ~once].max(initial=0.0)",
        "each[once] = each[used & ~once].mean()",
        "test_uncertainty.py::test_a_pair_seen_once_is_given_the_largest_variance",
    ),
    Mutant(
        "a row hides nothing",
        "empirical/kernels.py",
        "            moved[place] = max(left, 0.0)",
        "            moved[place] = 0.0",
        "test_uncertainty.py::test_rows_of_the_likelihood_meet_their_equations",
    ),
    Mutant(
        "theta's limits are those of J",
        "empirical/uncertainty.py",
        "(-limits(budget)[1], -limits(budget)[0])",
        "limits(budget)",
        "test_uncertainty.py::test_interval_covers_where_it_rests_on_rare_events",
    ),
    Mutant(
        "the adjoint takes p for q",
        "inverse/derivatives.py",
        "self.tilted.T @ by_log_policy.ravel()",
        "self.problem.transition.T @ by_log_policy.ravel()",
        "test_inverse.py::test_gradients_of_dense_problems",
    ),
    Mutant(
        "the adjoint forgets what log pi* gives to the rate",
        "inverse/derivatives.py",
        "total = by_rate - beta * float(by_log_policy.sum())",
        "total = by_rate",
        "test_inverse.py::test_gradients_of_dense_problems",
    ),
    Mutant(
        "gradients by dynamics as at optimism 0",
        "inverse/derivatives.py",
        "return np.asarray(np.expm1(kappa * off) / kappa)",
        "return np.asarray(off)",
        "test_inverse.py::test_gradients_of_dense_problems",
    ),
    Mutant(
        "beta moves no certainty equivalent",
        "inverse/derivatives.py",
        "        if problem.optimism:\n",
        "        if False:\n",
        "test_inverse.py::test_gradients_of_dense_problems",
    ),
    Mutant(
        "gradients by a row that is not divided by its sum",
        "inverse/soft_bellman.py",
        "by_log = found.log_prior - prior * found.log_prior.sum(1, keepdims=True)",
        "by_log = found.log_prior",
        "test_inverse.py::test_rows_stand_for_the_rows_divided_by_their_sums",
    ),
    Mutant(
        "the gauge of a state in the place of the mean",
        "inverse/soft_bellman.py",
        "            v -= v.mean()\n",
        "            v[0] -= v.sum()\n",
        "test_inverse.py::test_gradients_of_dense_problems",
    ),
    Mutant(
        "raw shares of pairs in the place of the flow",
        "inverse/demonstrations.py",
        "share[:, None] * policy, c, exact)",
        "(counts.sum(1) / counts.sum())[:, None] * policy, c, exact)",
        "test_inverse.py::test_only_the_share_of_actions_in_a_state_enters",
    ),
    Mutant(
        "errors as if steps fell as the flow does",
        "inverse/fit.py",
        "reach = share**2 * visits / (visits + expert.pseudo_count) ** 2",
        "reach = share / visits.sum()",
        "test_inverse.py::test_only_the_share_of_actions_in_a_state_enters",
    ),
    Mutant(
        "information without what lies ahead",
        "inverse/derivatives.py",
        "found = features + ahead - potential[:, None, :] - mean",
        "found = features - mean",
        "test_inverse.py::test_information_is_the_second_derivative",
    ),
    Mutant(
        "the second order is put on, not off",
        "empirical/uncertainty.py",
        "        here.gain - bias,\n",
        "        here.gain + bias,\n",
        "test_uncertainty.py::test_variance_is_the_derivative_of_the_value_with_the_rows",
    ),
    Mutant(
        "the optimist's bias is left out",
        "empirical/uncertainty.py",
        "            term += 0.5 * problem.beta * float((here.d * h**2).sum())  # Var_pi(p dV)\n",
        "            term += 0.0\n",
        "test_uncertainty.py::test_bias_is_the_second_derivative_with_the_rows",
    ),
    Mutant(
        "covariance of p and V is left out",
        "empirical/uncertainty.py",
        "    matrix = sp.csr_array((together, at), shape=(n, n))",
        "    matrix = sp.csr_array((0 * together, at), shape=(n, n))",
        "test_uncertainty.py::test_bias_is_the_second_derivative_with_the_rows",
    ),
    Mutant(
        "pairs never tried count for nothing",
        "empirical/uncertainty.py",
        "    untried = _untried(empirical, here) if optimal else 0.0",
        "    untried = 0.0",
        "test_uncertainty.py::test_pairs_never_tried_widen_one_side",
    ),
    Mutant(
        "no variance is an interval",
        "empirical/uncertainty.py",
        '        return "no pair shows any variance"',
        '        return ""',
        "test_uncertainty.py::test_interval_is_withheld_where_it_says_nothing",
    ),
    # -- online
    Mutant(
        "rho is moved before its clip at a phase's end",
        "learners/efficient_s1/algorithm.py",
        "log_rho = float(np.clip(log_rho, self.beta * low, self.beta * high))",
        "log_rho = float(np.clip(log_rho - 1.0, self.beta * low, self.beta * high))",
        "test_symmetries.py::test_online_rho_is_the_streamed_one_as_far_as_the_certificate_allows",
    ),
    Mutant(
        "rho is moved before its clip in a state that is yielded",
        "learners/efficient_s1/algorithm.py",
        "log_rho=float(np.clip(state.log_rho_in_use, self.beta * low, self.beta * high)),",
        "log_rho=float(np.clip(state.log_rho_in_use - 1.0, self.beta * low, self.beta * high)),",
        "test_symmetries.py::test_online_rho_is_the_streamed_one_as_far_as_the_certificate_allows",
    ),
    Mutant(
        "visits of a phase are counted on",
        "learners/efficient_s1/algorithm.py",
        "            fresh=np.zeros_like(state.fresh),\n",
        "",
        "test_symmetries.py::test_online_rho_is_the_streamed_one_as_far_as_the_certificate_allows",
    ),
    Mutant(
        "squares of rewards about the mean before",
        "learners/efficient_s1/kernels.py",
        "reward_squares[k] += off * (r[i] - reward[k])",
        "reward_squares[k] += off * off",
        "test_efficient_s1.py::test_online_counts_are_the_empirical_model",
    ),
    Mutant(
        "<V> is of the state left",
        "learners/efficient_s1/kernels.py",
        "(value[s_next[i]] - mean_value[k]) / visits[k]",
        "(value[s] - mean_value[k]) / visits[k]",
        "test_efficient_s1.py::test_a_phase_of_the_online_mode_agrees_with_its_direct_form",
    ),
    # -- recordings
    Mutant(
        "what is left of a chunk loses a tuple",
        "experience/transitions.py",
        "getattr(joined, name)[whole:].copy()",
        "getattr(joined, name)[whole + 1 :].copy()",
        "test_streams.py::test_chunks_are_multiples_and_parts_are_kept_in_memory_only",
    ),
    Mutant(
        "a tuple's number is off by one a chunk",
        "experience/experience.py",
        "        t -= len(chunk)\n",
        "        t -= len(chunk) - 1\n",
        "test_streams.py::test_a_failure_names_its_tuple_wherever_it_is_read_from",
    ),
    Mutant(
        "a selection takes what is left out",
        "experience/experience.py",
        "(chunk.where(mask) for chunk, mask in masked if mask.any())",
        "(chunk.where(~mask) for chunk, mask in masked if not mask.all())",
        "test_streams.py::test_learners_do_not_see_how_a_stream_is_cut",
    ),
    Mutant(
        "rows that are missing are those that are there",
        "experience/formats/npy.py",
        "self.short = claimed - length",
        "self.short = length",
        "test_streams.py::test_short_and_damaged_columns",
    ),
    Mutant(
        "a bad tuple's row counts within its batch",
        "experience/recording.py",
        'f"path={self.path}: {name}[{first + i}]"',
        'f"path={self.path}: {name}[{i}]"',
        "test_streams.py::test_bad_tuples_are_named_or_counted",
    ),
    Mutant(
        "a state equal to the size passes in a file",
        "experience/recording.py",
        "column.max() >= self._limits[name]",
        "column.max() > self._limits[name]",
        "test_streams.py::test_bad_tuples_are_named_or_counted",
    ),
    Mutant(
        "a header says the last chunk's length",
        "experience/formats/npy.py",
        "        self._n += len(chunk)\n",
        "        self._n = len(chunk)\n",
        "test_streams.py::test_columns_are_written_whole_or_not_at_all",
    ),
    Mutant(
        "a Minari episode that terminates leads to its own start",
        "experience/formats/minari.py",
        "s_next[-1] = begins[0]",
        's_next[-1] = batch["s"][0]',
        "test_streams.py::test_minari_episodes_become_tuples",
    ),
    Mutant(
        "Minari's a' is the action taken now",
        "experience/formats/minari.py",
        'a_next[:-1] = batch["a"][1:]',
        'a_next[:-1] = batch["a"][:-1]',
        "test_streams.py::test_minari_episodes_become_tuples",
    ),
    Mutant(
        "Minari's actions are the furthest",
        "experience/formats/minari.py",
        ".sum(2).argmin(1))",
        ".sum(2).argmax(1))",
        "test_streams.py::test_minari_boxes_are_binned",
    ),
    # -- collecting
    Mutant(
        "a truncated episode leads to the start",
        "experience/play.py",
        "s_next, mask = now if step.terminated else reached",
        "s_next, mask = now if step.last else reached",
        "test_experience.py::test_truncation_keeps_the_state_reached",
    ),
    Mutant(
        "a' of a stepped environment comes from the behaviour policy",
        "experience/play.py",
        "a_next = act_next(s_next, mask)",
        "a_next = act(s_next, mask)",
        "test_experience.py::test_law_of_the_stream",
    ),
    Mutant(
        "a' is the action taken next under any policy",
        "experience/play.py",
        "if plan.on_prior and not step.last:",
        "if not step.last:",
        "test_experience.py::test_law_of_the_stream",
    ),
    Mutant(
        "an episode that is cut off begins where it was",
        "experience/play.py",
        "now = reset(env, plan.rng.environment) if step.last else reached",
        "now = reset(env, plan.rng.environment) if step.terminated else reached",
        "test_experience.py::test_truncation_keeps_the_state_reached",
    ),
    Mutant(
        "a reset's reward is a step's",
        "experience/play.py",
        "reward = np.where(restarting, reward, stepped_reward)",
        "reward = stepped_reward",
        "test_experience.py::test_vector_environments_give_real_transitions_only",
    ),
    Mutant(
        "s and s' of a vector's tuples change places",
        "experience/play.py",
        "(state, action, reward, after, action_next))",
        "(after, action, reward, state, action_next))",
        "test_experience.py::test_vector_environments_give_real_transitions_only",
    ),
    Mutant(
        "a reward is that of the next pair",
        "experience/collect.py",
        "reward.ravel()[pair]",
        "reward.ravel()[pair_next]",
        "test_experience.py::test_law_of_the_stream",
    ),
    Mutant(
        "restarts are counted anew in every block",
        "experience/sampling.py",
        "        self.done += n\n",
        "",
        "test_experience.py::test_blocks_do_not_show",
    ),
    # -- bins, control tasks, mazes
    Mutant(
        "strides of equal dimensions",
        "envs/discretise.py",
        "            stride *= n\n",
        "            stride *= self.bins[0]\n",
        "test_discretise.py::test_cells_are_those_of_digitize",
    ),
    Mutant(
        "corners of the big-endian cell",
        "envs/discretise.py",
        'order="F"',
        'order="C"',
        "test_discretise.py::test_corners_enclose_the_cell",
    ),
    Mutant(
        "a bin above the last",
        "envs/discretise.py",
        "place = place.clip(0, n - 1)",
        "place = place.clip(0, n)",
        "test_discretise.py::test_cells_are_those_of_digitize",
    ),
    Mutant(
        "a box's distribution is big-endian",
        "envs/discretise.py",
        "np.outer(marginal, p).ravel()",
        "np.outer(p, marginal).ravel()",
        "test_discretise.py::test_distribution_of_a_box",
    ),
    Mutant(
        "Discrete actions count from 0",
        "envs/discretise.py",
        "np.arange(space.start, space.start + space.n)",
        "np.arange(space.n)",
        "test_discretise.py::test_discrete_actions_keep_their_numbers",
    ),
    Mutant(
        "every chunk of a model has the same numbers",
        "envs/estimate.py",
        "spawn_key=(chunk,)",
        "spawn_key=(0,)",
        "test_control.py::test_rows_of_a_model_share_no_random_numbers",
    ),
    Mutant(
        "a model's rewards keep their largest",
        "envs/estimate.py",
        "sampled.reward.reshape(self.space.n_cells, -1) - shift",
        "sampled.reward.reshape(self.space.n_cells, -1)",
        "test_control.py::test_model_against_fresh_steps",
    ),
    Mutant(
        "an episode's numbers depend on who still runs",
        "experience/rollouts.py",
        "a_next = self.draw(prior_cdf, s_next, rng.random(n)[episode])",
        "a_next = self.draw(prior_cdf, s_next, rng.random(n)[: len(episode)])",
        "test_control.py::test_an_episode_does_not_depend_on_the_ends_of_others",
    ),
    Mutant(
        "the last step of an episode costs as any other",
        "experience/rollouts.py",
        "np.where(terminated, 0.0, reward) - self.task.max_reward",
        "reward - self.task.max_reward",
        "test_control.py::test_collected_stream",
    ),
    Mutant(
        "rows and columns change places at the border",
        "envs/grid_world.py",
        "[[rows - 1], [cols - 1]]",
        "[[cols - 1], [rows - 1]]",
        "test_envs.py::test_cliff_is_the_authors",
    ),
    Mutant(
        "the first state is any",
        "envs/tabular.py",
        "self.np_random.choice(self.mdp.n_states, p=self.mdp.start)",
        "self.np_random.choice(self.mdp.n_states)",
        "test_envs.py::test_steps_follow_the_model_with_every_rule",
    ),
    Mutant(
        "traps stand beside the start",
        "envs/mazes.py",
        "kept[row - 1 : row + 2, col - 1 : col + 2] = True",
        "kept[row - 1 : row + 2, col - 1 : col + 1] = True",
        "test_mazes.py",
    ),
    Mutant(
        "wind blows on every tile of a maze",
        "envs/mazes.py",
        '        wind *= (tiles == "F").reshape(-1, 1, size, size)\n',
        "",
        "test_mazes.py",
    ),
    Mutant(
        "another motor breaks",
        "envs/shift.py",
        "(SUCCESS, SUCCESS, SUCCESS, up_success)",
        "(SUCCESS, up_success, SUCCESS, SUCCESS)",
        "test_envs.py::test_dynamics_shift_is_figure_4",
    ),
    # -- learners beside each other
    Mutant(
        "every replica has the first seed",
        "experience/simulation.py",
        "seed = int(self.seeds[replica])",
        "seed = int(self.seeds[0])",
        "test_replicas.py::test_every_learner_has_replicas",
    ),
    Mutant(
        "the state visited most in the last chunk",
        "learners/action_value/q_learning.py",
        "visits += np.bincount(chunk.s",
        "visits = np.bincount(chunk.s",
        "test_streams.py::test_learners_do_not_see_how_a_stream_is_cut",
    ),
    Mutant(
        "the read-out of z in nats",
        "learners/action_value/z_learning.py",
        "top + np.log(mean) / beta",
        "top + np.log(mean)",
        "test_action_value.py::test_read_out_of_z_learning_is_the_mean_over_visits",
    ),
    Mutant(
        "a gap is of the optimum's states",
        "solvers/optimum.py",
        "max(_mean(own, loss), 0.0) / beta",
        "max(_mean(optimum.stationary, loss), 0.0) / beta",
        "test_comparison.py::test_measures_are_their_definitions",
    ),
    Mutant(
        "KL of a comparison the other way round",
        "solvers/optimum.py",
        "kl = kl_per_state(optimum.policy, policy)",
        "kl = kl_per_state(policy, optimum.policy)",
        "test_comparison.py::test_measures_are_their_definitions",
    ),
    Mutant(
        "a fifth is trimmed",
        "run/compare.py",
        "trim_mean(values, 0.25, axis=axis)",
        "trim_mean(values, 0.2, axis=axis)",
        "test_comparison.py::test_interquartile_mean",
    ),
    Mutant(
        "every size of a curve learns from all",
        "run/compare.py",
        "learner.fit(data.first(size)",
        "learner.fit(data",
        "test_comparison.py::test_every_learner_has_the_same_experience",
    ),
    # -- the log
    Mutant(
        "constants are not written beside records",
        "log/tensorboard.py",
        "self.scalars({**values, **self._lines}, step)",
        "self.scalars(values, step)",
        "test_board.py::test_lines_stand_beside_every_record",
    ),
    Mutant(
        "a band is upside down",
        "log/tensorboard.py",
        "lower=entry[1], upper=entry[2])",
        "lower=entry[2], upper=entry[1])",
        "test_board.py::test_bands_have_their_lower_end_below",
    ),
    Mutant(
        "a run that failed is a success",
        "log/tensorboard.py",
        "api_pb2.STATUS_FAILURE",
        "api_pb2.STATUS_SUCCESS",
        "test_board.py::test_failed_runs_are_marked",
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
        "solvers/kernels.py",
        "sound = sound and (p[i, j] >= tiny or i == j)",
        "sound = sound",
        "test_rounding.py::test_digits_lost_in_the_elimination_are_known",
    ),
    Mutant(
        "a quarter of a drift's error in the gains",
        "solvers/certificate_kernels.py",
        "error[a] = 10.0 * epsilon * size",
        "error[a] = 2.5 * epsilon * size",
        "test_rounding.py::test_rounding_of_a_drift_is_in_the_bounds",
    ),
    Mutant(
        "a quarter of a drift's error in a policy's gains",
        "solvers/certificate_kernels.py",
        "policy[s, a] * (10.0 * epsilon * moved",
        "policy[s, a] * (2.5 * epsilon * moved",
        "test_rounding.py::test_rounding_of_a_drift_is_in_the_bounds",
    ),
    Mutant(
        "a quarter of the logarithm's error",
        "solvers/certificate_kernels.py",
        "(2 * n + 20) * epsilon * abs(size)",
        "(0.5 * n + 5) * epsilon * abs(size)",
        "test_rounding.py::test_rounding_of_many_small_priors_is_in_the_bounds",
    ),
    Mutant(
        "a quarter of the error of a sum of divergences",
        "solvers/certificate_kernels.py",
        "rounding = (n + 40) * epsilon * kl",
        "rounding = (0.25 * n + 10) * epsilon * kl",
        "test_rounding.py::test_rounding_of_a_sum_of_divergences_is_in_the_bounds",
    ),
    Mutant(
        "a divergence's terms have no error",
        "solvers/certificate_kernels.py",
        " + 8.0 * epsilon * size + n",
        " + n",
        "test_rounding.py::test_rounding_of_a_divergence_where_its_terms_cancel_is_in_the_bounds",
    ),
    Mutant(
        "a sum over actions has no error",
        "solvers/certificate_kernels.py",
        "error = 2.0 * error + (n_actions + 12) * epsilon * size",
        "error = 2.0 * error",
        "test_rounding.py::test_rounding_of_a_sum_over_actions_is_in_the_bounds",
    ),
    Mutant(
        "the luck of the best action is no matter",
        "empirical/uncertainty.py",
        " - 2 * bias_error - luck, high",
        " - 2 * bias_error, high",
        "test_uncertainty.py::test_interval_covers_where_the_best_is_the_luckiest",
    ),
    Mutant(
        "rows hide no reset",
        "empirical/uncertainty.py",
        "np.where(worth[reset] > worth[hidden], reset, hidden)",
        "hidden",
        "test_uncertainty.py::test_interval_covers_where_a_slip_may_be_unseen",
    ),
    # -- rules of the interval, and of what is said of it
    Mutant(
        "noise in rewards costs nothing",
        "empirical/uncertainty.py",
        "per_draw = cost + 0.5 * at**2 * noise",
        "per_draw = cost",
        "test_interval_rules.py::test_interval_of_one_row_is_students",
    ),
    Mutant(
        "noise in rewards moves nothing",
        "empirical/uncertainty.py",
        " + slope * np.exp(-log_price) * noise\n",
        "\n",
        "test_interval_rules.py::test_interval_of_one_row_is_students",
    ),
    Mutant(
        "n degrees of freedom of n draws",
        "empirical/uncertainty.py",
        "np.maximum(rows.n - 1, 1)).sum()",
        "np.maximum(rows.n, 1)).sum()",
        "test_interval_rules.py::test_interval_of_one_row_is_students",
    ),
    Mutant(
        "equal mean rewards are equal rewards",
        "empirical/uncertainty.py",
        "if np.ptp(rewards) == 0 and not model.reward_variance[empirical.used].any():",
        "if np.ptp(rewards) == 0:",
        "test_interval_rules.py::test_interval_of_one_row_is_students",
    ),
    Mutant(
        "rows that move keep their mean reward",
        "empirical/uncertainty.py",
        "np.add.reduceat(moved * given, p.indptr[:-1])",
        "0.0",
        "test_interval_rules.py::test_rewards_go_with_the_successor_that_a_row_moves_to",
    ),
    Mutant(
        "the successor hidden at the low end is the best",
        "empirical/uncertainty.py",
        "_with_successor(model, empirical, rows, sign * here.value)",
        "_with_successor(model, empirical, rows, here.value)",
        "test_interval_rules.py::test_a_row_hides_what_another_action_has_shown_on_either_side",
    ),
    Mutant(
        "single draws hide nothing more",
        "empirical/uncertainty.py",
        "    hidden[np.bincount(row, np.abs(draws - 1) < 0.5, n_rows) > 0] = np.argmax(worth)\n",
        "",
        "test_interval_rules.py::test_rows_with_a_single_draw_may_hide_any_state",
    ),
    Mutant(
        "the low end takes any second order",
        "empirical/uncertainty.py",
        "return low - max(bias, 0.0)",
        "return low - bias",
        "test_interval_rules.py::test_the_second_order_moves_the_end_that_it_widens",
    ),
    Mutant(
        "the high end takes any second order",
        "empirical/uncertainty.py",
        "high - min(bias, 0.0)",
        "high - bias",
        "test_interval_rules.py::test_the_second_order_moves_the_end_that_it_widens",
    ),
    Mutant(
        "the error over signs is left out at the low end",
        "empirical/uncertainty.py",
        " - 2 * bias_error - luck",
        " - luck",
        "test_interval_rules.py::test_the_second_order_moves_the_end_that_it_widens",
    ),
    Mutant(
        "the error over signs is left out at the high end",
        "empirical/uncertainty.py",
        "high - min(bias, 0.0) + 2 * bias_error",
        "high - min(bias, 0.0)",
        "test_interval_rules.py::test_error_of_the_mean_over_signs_is_in_the_interval",
    ),
    Mutant(
        "smallest visits of pairs that do not count",
        "empirical/uncertainty.py",
        "np.flatnonzero(variance > COUNTED_SHARE * total)",
        "np.flatnonzero(variance > 0)",
        "test_interval_rules.py::test_smallest_visits_are_of_pairs_that_count",
    ),
    Mutant(
        "pairs never tried bring the worst reward",
        "empirical/uncertainty.py",
        "best = np.max(rewards, axis=1)",
        "best = np.min(rewards, axis=1)",
        "test_interval_rules.py::test_a_pair_never_tried_may_bring_the_best_reward",
    ),
    Mutant(
        "a correction that is not trusted is made",
        "empirical/uncertainty.py",
        "        return replace(estimate, value=here.gain, bias=0.0)\n\n    @lru",
        "        return estimate\n\n    @lru",
        "test_interval_rules.py::test_a_correction_that_is_not_trusted_is_not_made",
    ),
    Mutant(
        "models that fall apart end where steps were",
        "empirical/uncertainty.py",
        "        except SingularChainError:\n            return sign * np.inf\n        gained",
        "        except SingularChainError:\n            return best\n        gained",
        "test_interval_rules.py::test_models_that_fall_apart_have_no_end",
    ),
    Mutant(
        "luck has the second order in it",
        "empirical/uncertainty.py",
        "np.maximum(gained - had, 0.0)",
        "gained",
        "test_interval_rules.py::test_luck_of_two_arms",
    ),
    Mutant(
        "luck is a sum over actions",
        "empirical/uncertainty.py",
        "special.logsumexp(exponent, axis=2) - np.log(tied[undecided].sum(1))",
        "special.logsumexp(exponent, axis=2)",
        "test_interval_rules.py::test_luck_of_two_arms",
    ),
    Mutant(
        "luck of actions that are worse",
        "empirical/uncertainty.py",
        "worth.max(1)[:, None] - worth <= TIED * np.sqrt(together)",
        "worth <= np.inf",
        "test_interval_rules.py::test_luck_is_of_arms_that_may_be_as_good",
    ),
    Mutant(
        "luck where beta is small",
        "empirical/uncertainty.py",
        "    tied &= problem.beta**2 * together > 1  # else the second order has it\n",
        "",
        "test_interval_rules.py::test_luck_is_of_arms_that_may_be_as_good",
    ),
    Mutant(
        "half widths from the value",
        "empirical/reservations.py",
        "return abs(theta - 0.5 * (low + high)) / (0.5",
        "return abs(theta - estimate.value) / (0.5",
        "test_reservations.py::test_half_widths_count_from_the_middle_of_a_lopsided_interval",
    ),
    Mutant(
        "far within the interval at the level of notes",
        "empirical/reservations.py",
        '    if low <= theta <= high:\n        return []\n    return [\n        Reservation(\n            "theta far',
        '    return [\n        Reservation(\n            "theta far',
        "test_reservations.py::test_theta_within_the_interval_at_the_level_of_notes_is_not_far",
    ),
    Mutant(
        "rounding takes theta out of range",
        "empirical/reservations.py",
        "if outside > RANGE_MARGIN * max(abs(low), abs(high)):",
        "if outside > 0:",
        "test_reservations.py::test_theta_out_of_range_by_rounding_is_not_out_of_range",
    ),
    Mutant(
        "states led to may be missing",
        "empirical/reservations.py",
        "return bool((tried | ~mdp.allowed)[members].all() and members[p.indices[entry]].all())",
        "return bool((tried | ~mdp.allowed)[members].all())",
        "test_reservations.py::test_data_without_a_state_that_theirs_lead_to_are_not_of_the_models_theta",
    ),
    Mutant(
        "replicas of a seed are held against the first one's beta",
        "run/replicas.py",
        "held[r] = data_of(here, learners[r])",
        "held[r] = data_of(here, learners[0])",
        "test_reservations.py::test_each_replica_of_a_seed_is_held_against_the_data_at_its_own_beta",
    ),
    Mutant(
        "theta ends outside its certificate",
        "learners/efficient_s1/algorithm.py",
        'message="; ".join(message)).with_theta_in((-high, -low))',
        'message="; ".join(message))',
        "test_efficient_s1.py::test_theta_ends_within_the_certificate",
    ),
    Mutant(
        "closed sets are no matter",
        "learners/efficient_s1/algorithm.py",
        "status = Status.REDUCIBLE if part.reducible else None",
        "status = None",
        "test_efficient_s1.py::test_a_stream_of_two_closed_sets_is_reducible",
    ),
    Mutant(
        "the lower end of a certificate rounds up",
        "learners/efficient_s1/algorithm.py",
        "    low, _ = policy_gains(",
        "    _, low = policy_gains(",
        "test_efficient_s1.py::test_ends_of_the_certificate_are_beyond_what_fractions_say",
    ),
    Mutant(
        "an answer that is not solved says nothing",
        "learners/certainty_equivalence.py",
        "        elif answer.status is not Status.CONVERGED:",
        "        elif False:",
        "test_certainty_equivalence.py::test_an_answer_that_is_not_solved_says_what_is_proven",
    ),
    Mutant(
        "a chain that falls apart once ends it",
        "solvers/eigenpair.py",
        "if refused > REFUSALS:",
        "if refused > 0:",
        "test_solvers.py::test_perron_goes_on_after_a_chain_that_falls_apart",
    ),
    Mutant(
        "gains that are no numbers have bounds",
        "solvers/eigenpair.py",
        "        if not np.isfinite(self.gain).all():\n            return -np.inf, np.inf\n",
        "",
        "test_solvers.py::test_gains_that_are_no_numbers_bound_nothing",
    ),
    Mutant(
        "power steps in logarithms are not averaged",
        "solvers/kernels.py",
        "h[s] += max(gain[s], mean) + math.log1p(math.exp(-abs(gain[s] - mean)))\n        h -=",
        "h[s] += gain[s]\n        h -=",
        "test_solvers.py::test_power_steps_are_not_caught_by_a_period",
    ),
    Mutant(
        "SuperLU's transposed solve is plain",
        "solvers/chains.py",
        "self._lu.solve(x[self._elimination.order], transposed)",
        "self._lu.solve(x[self._elimination.order])",
        "test_solvers.py::test_superlu_in_an_order_of_its_own_solves_what_dense_algebra_solves",
    ),
    Mutant(
        "SuperLU's diagonal keeps the order of states",
        "solvers/chains.py",
        "diagonal[elimination.order]",
        "diagonal",
        "test_solvers.py::test_superlu_in_an_order_of_its_own_solves_what_dense_algebra_solves",
    ),
    Mutant(
        "steps end at the first kink",
        "empirical/uncertainty.py",
        "policy, optimal, luck > 0)",
        "policy, optimal, False)",
        "test_interval_rules.py::test_the_low_end_of_the_best_of_equal_arms_is_where_all_are_low",
    ),
    Mutant(
        "what half of the states lead to is common",
        "empirical/uncertainty.py",
        "> COMMON * problem.n_states",
        ">= COMMON * problem.n_states",
        "test_interval_rules.py::test_any_row_may_hide_what_is_met_from_most_states",
    ),
    Mutant(
        "what most pairs lead to is common",
        "empirical/uncertainty.py",
        "row[p.data > 0] // n_actions]",
        "row[p.data > 0]]",
        "test_interval_rules.py::test_any_row_may_hide_what_is_met_from_most_states",
    ),
    # -- the one run loop
    Mutant(
        "figures of a broken epoch stay",
        "run/loop.py",
        'recorder.back(last["recorder"])',
        "pass",
        "test_checkpoint.py::test_any_error_keeps_what_was_learnt",
    ),
    Mutant(
        "rows of a broken epoch stay",
        "run/loop.py",
        'del outcome.history[last["n"] :]',
        "pass",
        "test_checkpoint.py::test_any_error_keeps_what_was_learnt",
    ),
    Mutant(
        "a run goes on with another stream",
        "run/loop.py",
        'if checkpoint["digest"] != self.digest:',
        "if False:",
        "test_checkpoint.py",
    ),
    Mutant(
        "metrics may change their names",
        "run/loop.py",
        "if before and row.keys() != before[0].keys():",
        "if False:",
        "test_session.py::test_metrics_that_change_end_the_run_and_what_was_learnt_is_kept",
    ),
    Mutant(
        "a state that no checkpoint gives back is learnt with",
        "run/checkpoint.py",
        "decode(encode(state), (*COMMON, *classes))",
        "encode(state)",
        "test_session.py::test_what_no_checkpoint_can_hold_is_refused_at_the_start",
    ),
    Mutant(
        "settings vary where the second replica differs",
        "run/groups.py",
        "any(row[name] != values[0][name] for row in values)",
        "any(row[name] != values[0][name] for row in values[:2])",
        "test_session.py::test_replicas_of_two_temperatures",
    ),
    Mutant(
        "the exact solver takes tuples and forgets them",
        "run/session.py",
        "if learner.needs_model != (experience is None):",
        "if not learner.needs_model and experience is None:",
        "test_session.py::test_bad_arguments_are_named",
    ),
    Mutant(
        "what was never tried sets the scale of u",
        "learners/efficient_s1/algorithm.py",
        "log_u = torch.where(self.weight > 0, self.log_average - self.log_psi_in_use[:, None], -torch.inf)",
        "log_u = self.log_average - self.log_psi_in_use[:, None]",
        "test_efficient_s1.py::test_u_is_of_the_pairs_that_take_part",
    ),
    # -- spaces, names, what environments return ---------------------------------------------------------------
    Mutant(
        "the parts of a Dict count in the order of their definition",
        "labels.py",
        "names = sorted(space.spaces)",
        "names = list(space.spaces)",
        "test_labels.py::test_the_last_entry_counts_fastest",
    ),
    Mutant(
        "half a state is a state",
        "labels.py",
        "good = np.isfinite(entries) & (entries == np.floor(entries)) & (abs(entries) < 2**63)",
        "good = np.isfinite(entries) & (abs(entries) < 2**63)",
        "test_labels.py::test_whole_numbers_are_taken_from_floats_and_nothing_else_is",
    ),
    Mutant(
        "a model is believed whatever overrides step",
        "mdp/from_gymnasium.py",
        "if len(owners) > 1 and not",
        "if len(owners) > 9 and not",
        "test_spaces.py::test_a_model_of_another_step_is_not_believed",
    ),
    Mutant(
        "a method replaced on the object is not seen",
        "mdp/from_gymnasium.py",
        'if method in getattr(base, "__dict__", {}):',
        "if False:",
        "test_spaces.py::test_a_replaced_method_is_seen",
    ),
    Mutant(
        "an entry of three never ends an episode",
        "mdp/from_gymnasium.py",
        "end[loose] = into_nothing[loose]",
        "end[loose] = False",
        "test_spaces.py::test_tables_are_read_as_they_are_meant",
    ),
    Mutant(
        "rewards that are NaN enter the stream",
        "experience/play.py",
        "    if not np.isfinite(r):\n        raise",
        "    if False:\n        raise",
        "test_spaces.py::test_a_wrong_step_is_named",
    ),
    Mutant(
        "the last state of a vector's episode keeps its own name",
        "envs/encoded.py",
        '[None if last is None else self._last(last) for last in info["final_obs"]]',
        '[None if last is None else 0 for last in info["final_obs"]]',
        "test_spaces.py::test_other_names_give_the_same_stream_of_vectors",
    ),
]


# What tests import, for all of them at once; nothing of the tree itself.
IMPORTED = ["gymnasium", "hydra", "matplotlib.pyplot", "numba", "pytest", "scipy.sparse.linalg", "scipy.stats", "torch"]
FORKS = multiprocessing.get_context("forkserver")


def _tested(nodes: list[str], tree: Path, said: Path) -> None:
    """In a process of its own: pytest in ``tree``, its output to ``said``."""
    import pytest

    os.setsid()  # killed with its children
    with said.open("wb") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    os.chdir(tree)
    os.environ["PYTHONPATH"] = str(tree)
    os.environ["PYTHONDONTWRITEBYTECODE"] = "1"
    sys.dont_write_bytecode = True
    sys.path[:] = [str(tree), *(entry for entry in sys.path if Path(entry or ".").resolve() not in (ROOT, HERE))]
    # Plain asserts: what is imported already cannot be rewritten.
    options = ["-x", "-n0", "-p", "no:cacheprovider", "--hypothesis-profile=unshrunk", "--tb=short", "--assert=plain"]
    sys.exit(int(pytest.main([*options, *nodes])))


class ByFunction:
    """Where Numba keeps a compiled function, for NUMBA_CACHE_LOCATOR_CLASSES: by the source that it is made of."""

    def __init__(self, py_func: Any, py_file: str) -> None:
        self._py_file = py_file
        self._digest = _sources(py_file)(inspect.unwrap(py_func).__name__)

    @classmethod
    def from_function(cls, py_func: Any, py_file: str) -> ByFunction:
        return cls(py_func, py_file)

    def ensure_cache_path(self) -> None:
        os.makedirs(self.get_cache_path(), exist_ok=True)

    def get_cache_path(self) -> str:
        return os.environ["NUMBA_CACHE_DIR"]

    def get_source_stamp(self) -> str:
        return self._digest

    def get_disambiguator(self) -> str:
        return self._digest


@functools.cache
def _sources(py_file: str) -> Callable[[str], str]:
    """name -> digest of that function of a file and of all in the file that it leads to."""
    tree = ast.parse(Path(py_file).read_text())
    defined = {node.name: node for node in tree.body if isinstance(node, ast.FunctionDef)}
    calls = {
        name: {n.id for n in ast.walk(node) if isinstance(n, ast.Name)} & defined.keys()
        for name, node in defined.items()
    }

    def digest(name: str) -> str:
        met, waiting = set(), {name}
        while waiting:
            met |= waiting
            waiting = set().union(*(calls[other] for other in waiting)) - met
        said = "\n".join(ast.dump(defined[other]) for other in sorted(met))
        return hashlib.sha256(said.encode()).hexdigest()[:16]

    return digest


class Workplace:
    """A copy of the tree, in which one mutant at a time is tried."""

    def __init__(self, folder: Path) -> None:
        self.tree, self.said = folder / "tree", folder / "said"
        for name in TREE:
            source = ROOT / name
            if source.is_dir():
                shutil.copytree(source, self.tree / name, ignore=shutil.ignore_patterns("__pycache__"))
            else:
                shutil.copy2(source, self.tree / name)

    def test(self, nodes: list[str], limit: float) -> tuple[int | None, str]:
        """(exit code of pytest, or None past the limit; its output)."""
        process = FORKS.Process(target=_tested, args=(nodes, self.tree, self.said))
        process.start()
        process.join(limit)
        code = process.exitcode
        if code is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.join()
        return code, self.said.read_text(errors="replace")

    def verdict(self, mutant: Mutant) -> str:
        path = self.tree / "erl_torch" / mutant.file
        text = path.read_text()
        if text.count(mutant.old) != 1 or mutant.old == mutant.new:
            return f"STALE: its text stands {text.count(mutant.old)} times in {mutant.file}"
        path.write_text(text.replace(mutant.old, mutant.new))
        try:
            code, said = self.test(mutant.nodes, LIMIT)
        finally:
            path.write_text(text)
        failed = re.findall(r"^(?:FAILED|ERROR) tests/(.+?)(?: - .*)?$", said, re.M)
        if code is None:
            return "killed by time"
        if code < 0:
            return f"killed by signal {-code}"
        if code == 0:
            return "SURVIVED"
        if code != 1 or UNCOMPILED.search(said):
            return f"BROKEN: {said.strip().splitlines()[-1]}"
        return f"killed by {failed[0]}"


class Record:
    """Verdicts by the names of the mutants, in a file if ``path`` is one."""

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self._found: dict[str, dict[str, Any]] = {}
        self._digests: dict[str, str] = {}
        if path is not None and path.exists():
            self._found = json.loads(path.read_text())

    def verdict(self, mutant: Mutant) -> str | None:
        found = self._found.get(mutant.name)
        return None if found is None or found["of"] != self._of(mutant) else str(found["verdict"])

    def keep(self, mutant: Mutant, verdict: str, seconds: float) -> None:
        from erl_torch.files import write_json  # not by ByFunction, which erl_torch is compiled with

        self._found[mutant.name] = {"verdict": verdict, "seconds": round(seconds), "of": self._of(mutant)}
        if self._path is not None:
            write_json(self._path, {m.name: self._found[m.name] for m in MUTANTS if m.name in self._found})

    def page(self, mutants: list[Mutant]) -> None:
        """Write the table of ``mutants``."""
        from erl_torch.files import write_bytes

        if self._path is None:
            return
        rows = [(m, self._found[m.name]) for m in mutants]
        killed = sum(row["verdict"].startswith("killed") for _, row in rows)
        lines = [
            "# Mistakes that the tests notice",
            "",
            f"    python benchmarks/mutants.py to={self._path.as_posix()}",
            "",
            f"{killed} of {len(rows)} killed. Each is one change of the sources, tried against the tests that must",
            "fail on it: what failed, and the seconds until then.",
            "",
            "| file | mistake | | s |",
            "|---|---|---|---|",
            *(
                f"| `{m.file}` | {m.name} | {_cell(row['verdict'])} | {row['seconds']} |"
                for m, row in sorted(rows, key=lambda row: row[0].file)
            ),
        ]
        write_bytes(self._path.with_suffix(".md"), ("\n".join(lines) + "\n").encode())

    def _of(self, mutant: Mutant) -> str:
        """Digest of the patch, the file that it spoils, and the files of its tests, as they were when first asked."""
        if mutant.name in self._digests:
            return self._digests[mutant.name]
        files = [ROOT / "erl_torch" / mutant.file, *(ROOT / node.split("::")[0] for node in mutant.nodes)]
        said = [*mutant, *(path.read_text() for path in files)]
        self._digests[mutant.name] = hashlib.sha256("\0".join(said).encode()).hexdigest()[:16]
        return self._digests[mutant.name]


def _cell(verdict: str) -> str:
    by = re.fullmatch(r"killed by (\S+::.+)", verdict)
    return f"`{by[1].replace('|', chr(92) + '|')}`" if by else verdict


def main(arguments: list[str]) -> int:
    options = dict(argument.split("=", 1) for argument in arguments if re.match(r"(processes|to)=", argument))
    parts = [argument for argument in arguments if not re.match(r"(processes|to)=", argument)]
    processes = int(options.get("processes", 1))
    double = [name for name, n in collections.Counter(m.name for m in MUTANTS).items() if n > 1]
    assert not double, double
    chosen = [m for m in MUTANTS if not parts or any(part in m.name for part in parts)]
    if not chosen:
        print(f"no mutant is named {' or '.join(parts)}", file=sys.stderr)
        return 2
    record = Record(Path(options["to"]) if "to" in options else None)
    left = [m for m in chosen if record.verdict(m) is None]
    began = time.monotonic()
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(processes) as pool:
        # Before the process starts that the tests are forked from: Numba reads them once.
        os.environ.setdefault("NUMBA_CACHE_DIR", str(Path(folder) / "cache"))
        os.environ["NUMBA_CACHE_LOCATOR_CLASSES"] = "benchmarks.mutants.ByFunction"
        FORKS.set_forkserver_preload(IMPORTED)
        places: Queue[Workplace] = Queue()
        for i in range(processes):
            places.put(Workplace(Path(folder) / str(i)))
        if left:
            code, said = places.queue[0].test(sorted({node for m in left for node in m.nodes}), 10 * LIMIT)
            if code != 0:
                print(said, "The tests fail without any mutant.", sep="\n")
                return 1
            print(f"without a mutant: {said.strip().splitlines()[-1]}", flush=True)

        def tried(mutant: Mutant) -> None:
            place, start = places.get(), time.monotonic()
            try:
                found = place.verdict(mutant)
            finally:
                places.put(place)
            seconds = time.monotonic() - start
            with keeping:
                record.keep(mutant, found, seconds)
            print(f"{mutant.file:32} {mutant.name:52} {seconds:5.0f} s  {found}", flush=True)

        keeping = Lock()
        list(pool.map(tried, left))
    record.page(chosen)
    found = {m: record.verdict(m) or "" for m in chosen}
    killed = sum(verdict.startswith("killed") for verdict in found.values())
    print(f"\n{killed} of {len(chosen)} killed, {len(left)} tried in {(time.monotonic() - began) / 60:.1f} minutes")
    for mutant, verdict in found.items():
        if not verdict.startswith("killed"):
            print(f"{mutant.file}: {mutant.name}: {verdict}")
    return 0 if killed == len(chosen) else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
