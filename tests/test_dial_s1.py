"""Algorithm S1 at any optimism: against value iteration, exact iterations, the listing, and its special cases."""

import math
from dataclasses import replace

import hypothesis
import numpy as np
import oracle
import pytest
import torch
from helpers import composed, problems, random_mdp, random_policy, random_stream, scalars
from hypothesis import strategies as st

from erl_torch import AlgorithmS1, InputError, ListedS1, Replicas, Solution, Status, Transitions, collect
from erl_torch.empirical.counts import tally
from erl_torch.experience.simulation import Simulation
from erl_torch.learners.s1 import kernels
from erl_torch.learners.s1.algorithm import gains, gauge, line_12, reward_biases
from erl_torch.run.training import train

DIAL = (3.0, 1.0, 0.5, 0.0, -0.5, -1.0, -3.0)
IMPLEMENTATIONS = ("fast", "literal")


# -- an oracle of its own: dense NumPy, from the definitions -----------------------------------------------


def certainty_equivalent(p, value, kappa):
    """C V = log(sum_s' p exp(kappa V))/kappa, E V at 0. p [S, A, S], all entries > 0."""
    if kappa == 0:
        return p @ value
    exponent = kappa * value
    top = exponent.max()
    return (top + np.log(p @ np.exp(exponent - top))) / kappa


def value_iteration(p, r, prior, beta, optimism):
    """(theta, policy, V) of TV = V - theta, T with C V in place of E V."""
    value = np.zeros(len(r))
    for _ in range(20_000):
        exponent = np.log(prior) + beta * (r + certainty_equivalent(p, value, optimism * beta))
        top = exponent.max(1, keepdims=True)
        total = np.exp(exponent - top).sum(1, keepdims=True)
        gain = (top + np.log(total))[:, 0] / beta - value
        if np.ptp(gain) < 1e-14:
            break
        value = value + gain - gain[0]
    return -gain.mean(), np.exp(exponent - top) / total, value


def exact_lines(p, r, prior, beta, optimism, n):
    """Lines 2-14 with expectations for means and the dominant eigenpair for lines 9-11, as the theory writes them.

    The first n iterations, each a dict: psi, mean_psi and mean_log_psi (the power means), delta, rho, u, policy, theta.
    """
    n_states, n_actions = r.shape
    psi, found = np.ones(n_states), []
    for _ in range(n):
        power = p @ psi ** (1 - optimism)
        log_mean = p @ np.log(psi) if optimism == 0 else np.log(p @ psi**-optimism) / -optimism
        delta = (np.log(power) - (1 - optimism) * log_mean) / beta
        b = psi ** (1 - optimism) / power[..., None]
        weight = np.exp(beta * (r + delta - delta.max()))
        tilted = np.einsum("sa,sat,sat,tb->satb", weight, p, b, prior).reshape(n_states * n_actions, -1)
        values, vectors = np.linalg.eig(tilted)
        top = np.argmax(values.real)
        u, rho = np.abs(vectors[:, top].real).reshape(r.shape), float(values[top].real)
        u /= u.mean()
        policy = prior * u / (prior * u).sum(1, keepdims=True)
        theta = -np.log(rho) / beta - delta.max()
        mean_psi = power ** (1 / (1 - optimism)) if optimism != 1 else np.ones_like(power)
        found.append(
            {
                "psi": psi, "mean_psi": mean_psi, "mean_log_psi": log_mean, "delta": delta,
                "rho": rho, "u": u, "policy": policy, "theta": theta,
            }
        )  # fmt: skip
        psi = 1 / (prior * u).sum(1)
    return found


def small(seed, n_states=4, n_actions=3):
    """(MDP, prior, p [S, A, S])."""
    rng = np.random.default_rng(seed)
    mdp = random_mdp(rng, n_states, n_actions)
    return mdp, random_policy(rng, n_states, n_actions), mdp.transition.toarray().reshape(n_states, n_actions, -1)


# -- the exact solution ------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [0])
@pytest.mark.parametrize("optimism", DIAL)
def test_expected_lines_reach_the_exact_solution(seed, optimism):
    """The learner's own lines 2-8 and 12-14, and lines 9-11 with their mean over s' and a'."""
    mdp, prior, p = small(seed)
    beta, shape = 3.0, mdp.reward.shape
    theta, policy, value = value_iteration(p, mdp.reward, prior, beta, optimism)
    learner = AlgorithmS1(beta, optimism=optimism, prior_policy=prior)
    csr = mdp.transition.indptr.astype(np.int64), mdp.transition.indices.astype(np.int32), mdp.transition.data
    psi, log_psi_of = np.ones(4), []
    for _ in range(12):
        mean_psi, mean_log_psi = np.ones(12), np.zeros(12)
        learner.psi_phase(csr, np.zeros(12), psi, mean_psi, mean_log_psi)  # 1 - lr_psi = 0: one visit is the mean
        mean_psi, mean_log_psi = mean_psi.reshape(shape), mean_log_psi.reshape(shape)
        delta = reward_biases(mean_psi, mean_log_psi, beta, optimism)
        g = gains(mdp.reward, delta, mean_log_psi, psi, beta, prior, optimism)
        z, log_rho = np.ones(shape), 0.0
        for _ in range(2000):  # the fixed point of line 10: rho z = g E z(s',a')
            z = g * (p @ (prior * z).sum(1))
            log_rho = np.log(z.mean())
            z /= z.mean()
        u, psi = line_12(z / gauge(psi, optimism)[:, None], prior, None)
        log_psi_of.append(np.log(psi))
        found = -log_rho / beta - delta.max()
    weight = prior * u
    assert found == pytest.approx(theta, abs=1e-12)
    np.testing.assert_allclose(weight / weight.sum(1, keepdims=True), policy, atol=1e-11)
    C = [certainty_equivalent(p, value, beta * x) for x in (optimism, optimism - 1)]
    np.testing.assert_allclose(delta, (1 - optimism) * (C[0] - C[1]), atol=1e-10)
    learnt = -log_psi_of[-1] / beta
    np.testing.assert_allclose(learnt - learnt[0], value - value[0], atol=1e-11)


@pytest.mark.parametrize("optimism", DIAL)
def test_exact_lines_reach_the_exact_solution(optimism):
    mdp, prior, p = small(5)
    theta, policy, value = value_iteration(p, mdp.reward, prior, 3.0, optimism)
    last = exact_lines(p, mdp.reward, prior, 3.0, optimism, 14)[-1]
    assert last["theta"] == pytest.approx(theta, abs=1e-11)
    np.testing.assert_allclose(last["policy"], policy, atol=1e-10)
    # delta = (1 - optimism) (C V - C V at optimism - 1)
    C = [certainty_equivalent(p, value, 3.0 * x) for x in (optimism, optimism - 1)]
    np.testing.assert_allclose(last["delta"], (1 - optimism) * (C[0] - C[1]), atol=1e-10)


@pytest.mark.parametrize("implementation", IMPLEMENTATIONS)
@pytest.mark.parametrize("optimism", DIAL)
@pytest.mark.parametrize("k", [0, 2])
def test_expected_update_vanishes_at_the_exact_iterations(implementation, optimism, k):
    """At an exact eigenpair the mean of lines 10 and 11 over s', a' changes nothing."""
    mdp, prior, p = small(1)
    exact = exact_lines(p, mdp.reward, prior, 3.0, optimism, k + 1)[k]
    lr = 1e-7
    learner = AlgorithmS1(
        3.0, lr, lr, optimism=optimism, n_epochs=5, n_bias=9, prior_policy=prior, implementation=implementation
    )  # fmt: skip
    tables = {"psi_in_use": "psi", "mean_psi": "mean_psi", "mean_log_psi": "mean_log_psi", "reward_bias": "delta"}
    state = replace(
        learner.init(4, 3), bias_iteration=k, epoch=1, rho=exact["rho"], u=torch.from_numpy(exact["u"].copy()),
        **{name: torch.from_numpy(np.ascontiguousarray(exact[key])) for name, key in tables.items()},
    )  # fmt: skip
    assert state.theta == pytest.approx(exact["theta"], abs=1e-12)
    drift_u, drift_rho, before = np.zeros((4, 3)), np.zeros((4, 3)), exact["u"]
    for s, a, s_next, a_next in np.ndindex(4, 3, 4, 3):
        one = Transitions([s], [a], [mdp.reward[s, a]], [s_next], [a_next])
        after = learner.step(state, learner.prepare(one, 4, 3))
        weight, other = p[s, a, s_next] * prior[s_next, a_next], (s, (a + 1) % 3)
        u_after = after.u[s, a].item() / after.u[other].item() * before[other]  # u is rescaled after each epoch
        drift_u[s, a] += weight * (u_after - before[s, a]) / (lr * before[s, a])
        drift_rho[s, a] += weight * (after.rho - state.rho) / (lr * state.rho)
    np.testing.assert_allclose(drift_u, 0, atol=2e-6)
    np.testing.assert_allclose(drift_rho, 0, atol=2e-6)


@pytest.mark.slow
@pytest.mark.parametrize("optimism", [1.5, 1.0, 0.5, -0.5, -1.0])
def test_streams_come_near_the_exact_solution(optimism):
    mdp, prior, p = small(2, 3, 2)
    data = collect(mdp, 1, 100_000, 0, prior_policy=prior)
    found = AlgorithmS1(2.0, lr_u=0.002, optimism=optimism, lr_psi=0.002, n_epochs=8, n_bias=5, prior_policy=prior).fit(
        data, 3, 2
    )
    theta, policy, _ = value_iteration(p, mdp.reward, prior, 2.0, optimism)
    assert found.theta == pytest.approx(theta, abs=0.02)
    np.testing.assert_allclose(found.policy, policy, atol=0.02)


# -- the listing -------------------------------------------------------------------------------------------


@hypothesis.settings(max_examples=40)
@hypothesis.given(
    problem=problems(),
    beta=st.floats(0.1, 5.0),
    optimism=st.sampled_from((3.0, 1.5, 1.0, 0.5, 0.1, 0.0, -0.1, -0.5, -1.0, -3.0)),
    lr_u=st.floats(1e-3, 0.5),
    lr_psi=st.floats(0.01, 1.0),
    unvisited=st.sampled_from(("initial", "prior")),
    rho_init=st.sampled_from(("carry", "reset")),
    self_loop=st.sampled_from(("new", "old")),
    noisy=st.booleans(),
)
def test_fast_is_the_listing(problem, noisy, **options):
    rng, mdp, prior = problem
    data = random_stream(rng, mdp, 300)
    data = replace(data, r=data.r + (0.3 * rng.standard_normal(len(data)) if noisy else 0.0))
    fast, literal = (
        AlgorithmS1(n_epochs=2, n_bias=3, prior_policy=prior, implementation=i, **options).fit(
            data, mdp.n_states, mdp.n_actions
        )
        for i in IMPLEMENTATIONS
    )
    assert fast.status == literal.status == Status.COMPLETED
    assert fast.optimism == options["optimism"]
    assert fast.theta == pytest.approx(literal.theta, rel=1e-8, abs=1e-8)
    for name in ("policy", "u", "psi", "reward_bias"):
        np.testing.assert_allclose(getattr(fast, name), getattr(literal, name), rtol=1e-8, atol=1e-10)
    sign = np.sign(1 - options["optimism"])
    assert (sign * fast.reward_bias >= 0).all()
    assert sign != 0 or not fast.reward_bias.any()


@hypothesis.settings(max_examples=40)
@hypothesis.given(problem=problems(), optimism=st.floats(-4, 4), lr_psi=st.floats(1e-3, 1.0), epochs=st.integers(1, 6))
def test_the_psi_phase_is_the_sequential_one(problem, optimism, lr_psi, epochs):
    hypothesis.assume(abs(optimism) > 1e-3 and abs(1 - optimism) > 1e-3)
    rng, mdp, _ = problem
    n_states, n_actions = mdp.reward.shape
    data = random_stream(rng, mdp, 150)
    found, psi = tally(data, n_states, n_actions, lr_psi), rng.lognormal(size=n_states)
    first, second = np.zeros(n_states * n_actions), np.zeros(n_states * n_actions)
    done, change = kernels.power_phase(
        *found.psi_map, (1 - lr_psi) ** found.visits, np.log(psi), optimism, first, second, 1e-300, 1e-10, epochs
    )
    assert done == epochs or change < 1e-300
    x, m = np.ones(first.size), np.ones(first.size)
    for _ in range(epochs):
        for k, s in zip(data.s * n_actions + data.a, data.s_next, strict=True):
            x[k] = (1 - lr_psi) * x[k] + lr_psi * psi[s] ** (1 - optimism)
            m[k] = (1 - lr_psi) * m[k] + lr_psi * psi[s] ** -optimism
    np.testing.assert_allclose(first, np.log(x) / (1 - optimism), rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(second, -np.log(m) / optimism, rtol=1e-9, atol=1e-11)


def test_the_psi_phase_keeps_its_digits_where_powers_leave_double_precision_and_near_optimism_0():
    """psi from 1e-250 to 1e250 at optimism -30, and optimism 1e-12, where psi^(-optimism) is 1 but for a few bits."""
    data = Transitions([0, 0], [0, 0], [0.0, 0.0], [0, 1], [0, 0])
    psi_map = tally(data, 2, 1, 0.5).psi_map  # weights 1/4 and 1/2, and 1/4 is kept
    log_psi = np.array([-250.0, 250.0]) * math.log(10)
    first, second = np.zeros(2), np.zeros(2)
    kernels.power_phase(*psi_map, np.array([0.25, 1.0]), log_psi, -30.0, first, second, 1e-4, 1e-10, 1)
    assert first.tolist() == pytest.approx([log_psi[1] + math.log(0.5) / 31, 0.0], rel=1e-15)
    assert second.tolist() == pytest.approx([log_psi[1] + math.log(0.5) / 30, 0.0], rel=1e-15)
    log_psi = np.array([-3.0, 1.0])
    first, second = np.zeros(2), np.zeros(2)
    kernels.power_phase(*psi_map, np.array([0.25, 1.0]), log_psi, 1e-12, first, second, 1e-4, 1e-10, 1)
    assert second[0] == pytest.approx(-0.25, rel=1e-11)  # -3/4 + 1/2, and kappa Var/2 beside it
    assert first[0] == pytest.approx(math.log(0.25 + 0.25 * math.exp(-3) + 0.5 * math.exp(1)), rel=1e-11)


# -- special cases -------------------------------------------------------------------------------------------


def test_optimism_0_is_the_paper_and_nearby_is_near():
    mdp, _, _ = small(3)
    data = random_stream(np.random.default_rng(0), mdp, 2000)
    plain, zero, near = (
        AlgorithmS1(2.0, n_epochs=3, n_bias=4, **options).fit(data, 4, 3)
        for options in ({}, {"optimism": -0.0}, {"optimism": 1e-9})
    )
    assert zero.theta == plain.theta
    assert torch.equal(zero.policy, plain.policy)
    assert near.theta == pytest.approx(plain.theta, abs=1e-8)
    np.testing.assert_allclose(near.policy, plain.policy, atol=1e-8)


@pytest.mark.parametrize("kind", [AlgorithmS1, ListedS1])
@pytest.mark.parametrize("implementation", IMPLEMENTATIONS)
def test_optimism_1_is_plain_u_learning(kind, implementation):
    """Biasing iteration 0, again and again: b = 1, delta = 0, and no psi phase (whose means of 1 are 1 to rounding)."""
    mdp, _, _ = small(3)
    data = random_stream(np.random.default_rng(0), mdp, 500)
    learner = kind(2.0, lr_u=0.05, optimism=1.0, n_epochs=2, n_bias=3, implementation=implementation)
    states = list(learner.iterate(data, 4, 3))
    first = list(replace(learner, optimism=0.0, n_bias=1).iterate(data, 4, 3))
    for state, other in zip(states, first, strict=False):
        assert state.rho == pytest.approx(other.rho, rel=1e-13)
        np.testing.assert_allclose(state.u, other.u, rtol=1e-13)
    assert not any(state.reward_bias.any() or state.psi_epochs or state.psi_error for state in states)
    if kind is ListedS1:  # rho is reset, too
        assert torch.equal(states[1].u, states[3].u)
        assert states[1].theta == states[5].theta


@pytest.mark.parametrize("implementation", IMPLEMENTATIONS)
def test_optimism_1_is_the_listings_two_lines_without_biases(implementation):
    mdp, _, _ = small(3)
    data = random_stream(np.random.default_rng(0), mdp, 500)
    options = dict(n_epochs=1, n_bias=1, lr_rho=0.01, implementation=implementation)
    found = ListedS1(2.0, lr_u=0.05, optimism=1.0, **options).fit(data, 4, 3)
    expected = oracle.lines_9_to_11(data, (4, 3), 2.0, 0.05, 0.01, 1.0)
    assert found.rho == pytest.approx(expected.rho, rel=1e-12)
    np.testing.assert_allclose(found.u, expected.u / expected.u.mean(), rtol=1e-12)


def test_rewards_that_vary_count_jointly_at_optimism_1():
    """One state and action: rho = E exp(beta r), so that theta = -log(E exp(beta r)) / beta at every optimism."""
    n, beta = 4000, 2.0
    r = np.where(np.random.default_rng(0).random(n) < 0.3, -1.0, 0.0)
    data = Transitions(np.zeros(n, int), np.zeros(n, int), r, np.zeros(n, int), np.zeros(n, int))
    expected = -math.log(np.exp(beta * r).mean()) / beta
    for optimism in (1.0, -1.0):
        found = ListedS1(beta, lr_u=0.01, optimism=optimism, lr_rho=0.002, n_epochs=20, n_bias=2).fit(data, 1, 1)
        assert found.theta == pytest.approx(expected, abs=0.01)


# -- what can go wrong ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("value", [math.nan, math.inf, "right", 1e101, 1e-120])
def test_bad_optimism_is_named(value):
    with pytest.raises(InputError, match=r"^optimism="):
        AlgorithmS1(optimism=value)


@pytest.mark.parametrize(("implementation", "optimism"), [("fast", -1e4), ("literal", 1e4)])
def test_leaving_the_numbers_is_named(implementation, optimism):
    mdp, _, _ = small(3)
    data = random_stream(np.random.default_rng(0), mdp, 300)
    found = AlgorithmS1(5.0, lr_u=0.1, optimism=optimism, n_epochs=1, n_bias=3, implementation=implementation).fit(
        data, 4, 3
    )
    assert found.status is Status.NON_FINITE
    assert "lower beta" in found.message
    assert torch.isfinite(found.policy).all()


# -- replicas --------------------------------------------------------------------------------------------------


def same(one, other):
    for name in ("policy", "u", "psi", "reward_bias"):
        assert torch.equal(getattr(one, name), getattr(other, name)), name
    assert (one.theta, one.rho, one.status, one.optimism) == (other.theta, other.rho, other.status, other.optimism)
    assert list(one.history) == list(other.history)
    for name, column in one.history.items():
        assert np.array_equal(column, other.history[name]), name


SWEEP = (1.5, 1.0, 0.5, 0.1, 0.0, -0.1, -0.5, -1e4)  # the last leaves the numbers


@pytest.mark.parametrize("source", ["shared", "noisy", "recorded", "kept", "again"])
@pytest.mark.parametrize("layout", ["lanes", "tables"])
def test_replicas_at_any_optimism_come_out_as_alone(source, layout):
    mdp, prior, _ = small(4)
    rng, n = np.random.default_rng(0), len(SWEEP)
    learner = AlgorithmS1(5.0, lr_u=0.1, n_epochs=2, n_bias=3, prior_policy=prior)
    replicas = Replicas.of(learner, optimism=SWEEP, threads=2, block=3, layout=layout)
    streams = [collect(mdp, 1, 2000, seed, prior_policy=prior) for seed in range(n)]
    experience: object = streams
    if source in ("kept", "again"):
        experience = Simulation(mdp, 1, 2000, range(n), keep=source == "kept")
    elif source != "recorded":
        noise = 0.1 * rng.standard_normal(2000) if source == "noisy" else 0.0
        shared = replace(streams[0], r=streams[0].r + noise)
        experience, streams = shared, [shared] * n
    found = replicas.fit(experience, 4, 3)
    assert list(found.failures) == [n - 1]
    assert found.optimism.tolist() == list(SWEEP)
    for r, one in enumerate(replicas.learners):
        same(found[r], one.fit(streams[r], 4, 3))


def test_torch_operations_are_the_compiled_loop():
    mdp, prior, _ = small(4)
    data = collect(mdp, 1, 300, 0, prior_policy=prior)
    learner = AlgorithmS1(3.0, lr_u=0.1, n_epochs=2, n_bias=3, prior_policy=prior)
    compiled, by_torch = (
        Replicas.of(learner, optimism=SWEEP[:-1], backend=backend).fit(data, 4, 3) for backend in ("compiled", "torch")
    )
    np.testing.assert_allclose(by_torch.policy, compiled.policy, rtol=1e-9)
    np.testing.assert_allclose(by_torch.theta, compiled.theta, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("optimism", [1.5, 1.0, 0.5, -0.5])
def test_goes_on_from_any_state_with_the_same_bits(optimism):
    mdp, _, _ = small(4)
    data = random_stream(np.random.default_rng(1), mdp, 500)
    learner = AlgorithmS1(3.0, lr_u=0.05, optimism=optimism, n_epochs=2, n_bias=3)
    states = list(learner.iterate(data, 4, 3))
    for state in states[:-1]:
        last = list(learner.iterate(data, 4, 3, state))[-1]
        assert last.rho == states[-1].rho
        assert torch.equal(last.u, states[-1].u)
        assert torch.equal(last.mean_log_psi, states[-1].mean_log_psi)


# -- runs --------------------------------------------------------------------------------------------------------


class Killed(BaseException):
    """As SIGKILL."""


def run_and_go_on(cfg, directory):
    """The result of a run that was killed after its third epoch and gone on with; "whole" beside "cut"."""
    train(cfg, directory / "whole")
    left = [3 + (2 if cfg.n_replicas == 1 else 0)]  # safe points while tuples are collected

    def safe_point():
        left[0] -= 1
        if not left[0]:
            raise Killed

    with pytest.raises(Killed):
        train(cfg, directory / "cut", safe_point)
    assert any((directory / "cut/checkpoints").iterdir())
    result = train(cfg, directory / "cut")
    assert scalars(directory / "cut") == scalars(directory / "whole")
    return result


SHORT = (
    "experience.n_episodes=3", "evaluation.n_episodes=2", "evaluation.horizon=50", "checkpoint_every=0",
    "evaluation.pictures=false", "learner.n_epochs=2", "learner.n_bias=3",
)  # fmt: skip


@pytest.mark.slow
def test_the_command_line_sweeps_optimism_and_goes_on_with_the_same_bits(tmp_path):
    values = [1.5, 0, -0.5]
    cfg = composed("n_replicas=2", f"+vary.optimism={values}", "learner=s1", *SHORT)
    result = run_and_go_on(cfg, tmp_path)
    assert [group["settings"] for group in result["groups"]] == [{"optimism": value} for value in values]
    assert [group["optimism"] for group in result["groups"]] == values
    files = [(tmp_path / name / "replicas.npz").read_bytes() for name in ("whole", "cut")]
    assert files[0] == files[1]


@pytest.mark.parametrize("optimism", [1.0, -0.5])
def test_a_single_run_goes_on_with_the_same_bits(tmp_path, optimism):
    result = run_and_go_on(composed("learner=s1", f"learner.optimism={optimism}", *SHORT), tmp_path)
    assert result["optimism"] == optimism
    files = [(tmp_path / name / "solution.npz").read_bytes() for name in ("whole", "cut")]
    assert files[0] == files[1]
    assert Solution.load(tmp_path / "whole/solution.npz").optimism == optimism


@pytest.mark.parametrize("values", [b"1", bytearray(b"1"), memoryview(b"1")])
def test_bytes_are_no_list_of_numbers(values):
    with pytest.raises(InputError, match="optimism"):
        Replicas.of(AlgorithmS1(), optimism=values)
