"""Replicas against the same learners alone: bit for bit, for any experience, block, layout and number of threads."""

import json
import tracemalloc
from dataclasses import replace
from typing import Any

import hypothesis
import numpy as np
import oracle
import pytest
import torch
from helpers import composed, events, overshooting, problems, random_mdp, random_policy, undocumented
from hypothesis import strategies as st

from erl_torch import (
    AlgorithmS1,
    InputError,
    ListedS1,
    NonFiniteError,
    Replicas,
    ReplicaSolution,
    Simulation,
    Status,
    Transitions,
    collect,
    pictures,
    solve_soft_bellman,
)
from erl_torch.empirical.counts import tally
from erl_torch.evaluation import Judge
from erl_torch.experience.sampling import Sampler
from erl_torch.experience.simulation import tuples_of
from erl_torch.learners import LEARNERS
from erl_torch.learners.s1 import kernels
from erl_torch.rng import streams
from erl_torch.run.training import train
from erl_torch.solvers.policy import objective, reward_per_step

N = 7  # replicas
SMALL = ("experience.n_episodes=5", "learner.n_epochs=2", "learner.n_bias=3")


def assert_same(one, other, history=True):
    for name in ("policy", "u", "psi", "reward_bias"):
        assert torch.equal(getattr(one, name), getattr(other, name)), name
    for name in ("rho", "theta", "reward_bias_max", "n_steps", "status", "message"):
        assert getattr(one, name) == getattr(other, name), name
    if history:
        assert set(one.history) == set(other.history)
        for name, values in one.history.items():
            assert np.array_equal(values, other.history[name]), name


@pytest.fixture(scope="module")
def small():
    """(MDP, its own streams of 60 x 100 tuples, the same with rewards that vary in every other one)."""
    rng = np.random.default_rng(0)
    mdp = random_mdp(rng, 6, 3)
    data = [collect(mdp, 60, 100, seed) for seed in range(N)]
    noise = [0.1 * rng.standard_normal(len(d)) * (i % 2) for i, d in enumerate(data)]
    return mdp, data, [replace(d, r=d.r + e) for d, e in zip(data, noise, strict=True)]


READINGS = {
    "listing": {},
    "script": {"rho_init": "carry", "self_loop": "old"},
    "prior": {"unvisited": "prior", "rescale_every": 7},
}
HOW = [
    {"threads": 1},
    {"threads": 2, "block": 3, "layout": "lanes"},
    {"threads": 2, "block": 2, "layout": "tables"},
    {"threads": 1, "block": 1},
]


@pytest.fixture(scope="module", params=READINGS)
def alone(request, small):
    """A learner, and what it makes of each stream, and of each noisy one, alone."""
    learner = AlgorithmS1(beta=3.0, lr_u=0.02, n_epochs=2, n_bias=3, **READINGS[request.param])
    return learner, *([learner.fit(d, 6, 3) for d in streams_] for streams_ in small[1:])


@pytest.mark.slow
@pytest.mark.parametrize("how", HOW, ids=lambda how: "-".join(f"{k}={v}" for k, v in how.items()))
def test_bits_of_replicas_are_those_of_single_runs(small, alone, how):
    (mdp, data, noisy), (learner, plain, varied) = small, alone
    replicas = Replicas.of(learner, N, **how)
    for experience, expected in (
        (Simulation(mdp, 60, 100, range(N), keep=True), plain),
        (Simulation(mdp, 60, 100, range(N), keep=False), plain),
        (data, plain),
        (noisy, varied),
    ):
        found = replicas.fit(experience, 6, 3)
        assert len(found) == N
        for r in range(N):
            assert_same(found[r], expected[r])


@pytest.mark.parametrize("how", HOW[:2])
@pytest.mark.parametrize("noisy", [False, True])
def test_bits_on_a_shared_stream(small, how, noisy):
    """A sweep: temperatures and step sizes of their own, one stream."""
    data = small[2 if noisy else 1][1]
    vectors: dict[str, Any] = {
        "beta": np.linspace(0.5, 6, 9),
        "lr_u": np.geomspace(0.001, 0.4, 9),
        "lr_psi": [0.1, 0.3, 1.0] * 3,
    }
    learner = AlgorithmS1(n_epochs=2, n_bias=3)
    found = Replicas.of(learner, **vectors, **how).fit(data, 6, 3)
    assert found.policy.shape == (9, 6, 3)
    for r in range(9):
        own = replace(learner, **{name: float(values[r]) for name, values in vectors.items()})
        assert_same(found[r], own.fit(data, 6, 3))


@hypothesis.settings(max_examples=25)
@hypothesis.given(
    problem=problems(),
    rates=st.lists(st.tuples(st.floats(0.1, 8.0), st.floats(1e-3, 0.5), st.floats(0.01, 1.0)), min_size=1, max_size=5),
    block=st.integers(1, 5),
    layout=st.sampled_from(("lanes", "tables")),
    keep=st.booleans(),
    episode=st.sampled_from((1, 3, 64, 400)),
    behaves=st.booleans(),
)
def test_bits_of_any_mixture(problem, rates, block, layout, keep, episode, behaves):
    rng, mdp, prior = problem
    behaviour = random_policy(rng, *prior.shape) if behaves else None
    columns = dict(zip(("beta", "lr_u", "lr_psi"), zip(*rates, strict=True), strict=True))
    learner = AlgorithmS1(n_epochs=2, n_bias=2, prior_policy=prior)
    replicas = Replicas.of(learner, **columns, block=block, layout=layout, threads=2)
    experience = Simulation(mdp, 400 // episode, episode, range(len(rates)), behaviour, keep)
    found = replicas.fit(experience, *prior.shape)
    for r, own in enumerate(replicas.learners):
        data = collect(mdp, 400 // episode, episode, r, behaviour, prior)
        assert_same(found[r], own.fit(data, *prior.shape))


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(set(LEARNERS) - {"exact", "s1"}))
def test_every_learner_has_replicas(small, name):
    """All that stream, on every kind of experience; betas of their own."""
    mdp, data, _ = small
    learner = LEARNERS[name]()
    betas = (2.0, 4.0, 8.0)
    replicas = Replicas.of(learner, beta=betas, threads=2)
    for experience in (Simulation(mdp, 60, 100, range(3), keep=False), data[:3], data[0]):
        found = replicas.fit(experience, 6, 3)
        for r, beta in enumerate(betas):
            assert_same(found[r], replace(learner, beta=beta).fit(tuples_of(experience, r, None), 6, 3))


def test_streams_of_different_lengths_run_side_by_side(small):
    data = [d.first(1000 * (i + 1)) for i, d in enumerate(small[1][:3])]
    learner = AlgorithmS1(n_epochs=2, n_bias=2)
    found = Replicas.of(learner, 3).fit(data, 6, 3)
    for r in range(3):
        assert_same(found[r], learner.fit(data[r], 6, 3))


@pytest.mark.parametrize("self_loop", ["new", "old"])
def test_torch_operations_are_the_compiled_loop(small, self_loop):
    mdp, data, noisy = small
    learner = AlgorithmS1(beta=3.0, lr_u=0.05, n_epochs=2, n_bias=2, self_loop=self_loop, rescale_every=800)
    short = [d.first(2000) for d in data[:3]]
    for experience in (Simulation(mdp, 20, 100, range(3), keep=False), short, noisy[1].first(2000)):
        on_torch = Replicas.of(learner, 3, backend="torch").fit(experience, 6, 3)
        compiled = Replicas.of(learner, 3).fit(experience, 6, 3)
        for name in ("policy", "u", "psi"):
            ours, theirs = getattr(on_torch, name), getattr(compiled, name)
            np.testing.assert_allclose(ours, theirs, rtol=1e-11, atol=1e-14)
        np.testing.assert_allclose(on_torch.theta, compiled.theta, rtol=1e-12)


def test_rewards_that_vary_are_cut_without_a_trace(small, monkeypatch):
    """exp(beta r) is made a piece at a time: streams longer than a piece."""
    monkeypatch.setattr("erl_torch.learners.s1.lanes.NOISY_ROWS", 777)
    noisy, learner = small[2], AlgorithmS1(beta=3.0, lr_u=0.02, n_epochs=1, n_bias=2)
    for experience in (noisy, noisy[1]):
        found = Replicas.of(learner, N).fit(experience, 6, 3)
        for r in range(N):
            assert_same(found[r], learner.fit(tuples_of(experience, r, None), 6, 3))


@pytest.mark.parametrize("backend", ["compiled", "torch"])
def test_replicas_clip_rho(backend):
    data = [overshooting(r) for r in (-0.02, 0.0, 0.2)]
    found = Replicas.of(AlgorithmS1(5.0, lr_u=0.05, lr_rho=0.1, n_epochs=1, n_bias=1), 3, backend=backend).fit(
        data, 2, 1
    )
    np.testing.assert_allclose(found.rho, [1.0, 1.0, np.exp(1.0)], rtol=1e-14)
    shared = Replicas.of(AlgorithmS1(5.0, n_epochs=1, n_bias=1), lr_u=[0.05, 0.06], lr_rho=[0.1, 0.1], backend=backend)
    np.testing.assert_allclose(shared.fit(data[2], 2, 1).rho, np.exp(1.0), rtol=1e-14)


def test_a_psi_phase_cut_short_is_remembered(authors_tuples):
    learner = ListedS1(n_epochs=1, n_bias=8, max_psi_epochs=60)
    found = Replicas.of(learner, lr_psi=[0.1, 1.0]).fit(authors_tuples, 15, 4)
    assert [solution.history["psi_error"][-1] < 1e-4 for solution in found.solutions] == [True, True]
    assert [solution.status for solution in found.solutions] == [Status.PSI_LIMIT, Status.COMPLETED]


# -- streams -----------------------------------------------------------------------------------------------


def sampled_by_hand(mdp, prior, behaviour, seed, n, episode_length):
    """A stream drawn with NumPy's generators, a number at a time."""
    rng = streams(seed)
    p, on_prior = mdp.transition.toarray(), behaviour is None
    behaviour = prior if on_prior else behaviour

    def draw(row, generator):
        return int(np.flatnonzero(row)[np.searchsorted(np.cumsum(row[row > 0])[:-1], generator.random(), "right")])

    rows = []
    for t in range(n):
        if t % episode_length == 0:
            s = draw(mdp.start, rng.environment)
            a = draw(behaviour[s], rng.behaviour)
        s_next = draw(p[s * mdp.n_actions + a], rng.environment)
        a_next = draw(prior[s_next], rng.behaviour)
        rows.append((s * mdp.n_actions + a, s_next * mdp.n_actions + a_next))
        s, a = s_next, a_next if on_prior else draw(behaviour[s_next], rng.behaviour)
    return np.array(rows)


@pytest.mark.parametrize("on_prior", [True, False])
@pytest.mark.parametrize("lanes", [1, 6])
def test_a_lane_draws_what_numpy_draws(on_prior, lanes):
    rng = np.random.default_rng(5)
    p = rng.dirichlet(np.full(9, 0.2), size=(9, 5)) * (rng.random((9, 5, 9)) < 0.6) + np.eye(9)[:, None] * 1e-3
    mdp = type(random_mdp(rng, 2, 1))(p / p.sum(-1, keepdims=True), rng.random((9, 5)), rng.dirichlet(np.ones(9)))
    prior, behaviour = random_policy(rng, 9, 5), random_policy(rng, 9, 5)
    sampler = Sampler(mdp, [streams(s) for s in range(lanes)], 17, prior if on_prior else behaviour, prior, on_prior)
    parts = [sampler.take(n) for n in (1, 16, 17, 100, 3)]
    pair, entry, pair_next = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    assert np.array_equal(mdp.transition.indices[entry], pair_next // 5)
    for lane in range(lanes):
        by_hand = sampled_by_hand(mdp, prior, None if on_prior else behaviour, lane, 137, 17)
        assert np.array_equal(pair[:, lane], by_hand[:, 0])
        assert np.array_equal(pair_next[:, lane], by_hand[:, 1])


def test_generators_go_on_where_the_stream_ends(small):
    whole, cut = collect(small[0], 6, 50, streams(3)), streams(3)
    parts = [collect(small[0], 2, 50, cut), collect(small[0], 4, 50, cut)]
    for name in ("s", "a", "r", "s_next", "a_next"):
        assert np.array_equal(getattr(whole, name), np.concatenate([getattr(part, name) for part in parts]))


def test_sampled_passes_do_not_grow_with_the_stream():
    mdp = random_mdp(np.random.default_rng(1), 4, 2)
    replicas = Replicas.of(AlgorithmS1(beta=2.0, n_epochs=1, n_bias=1), 8, threads=1)
    peaks = []
    for n_episodes in (10, 1000):
        tracemalloc.start()
        replicas.fit(Simulation(mdp, n_episodes, 100, range(8), keep=False), 4, 2)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < peaks[0] + 100_000  # the tuples themselves would be 6.4 MB


# -- ends and errors -----------------------------------------------------------------------------------------


def exploding(n=12_000):
    """exp(beta r) = 0 at r = -100: u halves at each visit until it is 0."""
    zeros = np.zeros(n, int)
    return tuple(Transitions(zeros, zeros, np.full(n, r), zeros + 1, zeros) for r in (-1.0, -100.0, -1.0))


@pytest.mark.parametrize("backend", ["compiled", "torch"])
def test_a_replica_that_fails_leaves_the_others_alone(backend):
    data = exploding()
    learner = AlgorithmS1(beta=10.0, lr_u=0.5, lr_rho=1e-3, n_epochs=2, n_bias=1)
    found = Replicas.of(learner, 3, backend=backend).fit(data, 2, 1)
    assert [s.status for s in found.solutions] == [Status.COMPLETED, Status.NON_FINITE, Status.COMPLETED]
    assert list(found.failures) == [1]
    for r in range(3):
        assert_same(found[r], learner.fit(data[r], 2, 1))


def test_a_failure_later_on_keeps_the_last_good_epoch():
    """Steps of .02 take u from 1 to 0 (2**-1075) in at most 36,900 visits: in the third epoch."""
    data = exploding()
    learner = AlgorithmS1(beta=10.0, lr_u=0.02, lr_rho=1e-3, n_epochs=5, n_bias=1)
    found = Replicas.of(learner, 3).fit(data, 2, 1)
    assert set(found.failures) == {1}
    assert found[1].n_steps == 24_000
    for r in range(3):
        assert_same(found[r], learner.fit(data[r], 2, 1))


def test_a_replica_that_was_at_0_has_failed():
    """Halved 1074 times, 1 is the smallest number; once more, and it is 0. In a self-loop the listing's rho does not
    see it, and what comes afterwards lifts u again."""
    n = 1075
    zeros, after = np.zeros(n + 25, int), np.arange(n + 25) // n
    data = [Transitions(zeros, zeros, np.where(after == 0, r, -1.0), after, zeros) for r in (-1.0, -100.0, -1.0)]
    learner = ListedS1(beta=10.0, lr_u=0.5, lr_rho=1e-3, n_epochs=1, n_bias=1, rescale_every=n)
    found = Replicas.of(learner, 3).fit(data, 2, 1)
    assert set(found.failures) == {1}
    assert "no longer a positive finite number at tuple 1074 (s=0, a=0, r=-100)" in found[1].message
    for r in range(3):
        assert_same(found[r], learner.fit(data[r], 2, 1))


def test_rewards_that_overflow_fail_by_name():
    data = Transitions([0], [0], [100.0], [0], [0])
    found = Replicas.of(AlgorithmS1(n_epochs=1), beta=[1.0, 10.0]).fit(data, 1, 1)
    assert found[0].status is Status.COMPLETED
    assert "beta*max(r) = 1000" in found[1].message
    assert set(found.failures) == {1}


BAD = [
    (dict(n_replicas=0), r"n_replicas=0: must be a whole number >= 1"),
    (dict(), r"n_replicas=None: must be given"),
    (dict(n_replicas=3, beta=[1.0, 2.0]), r"beta=2 values: must be one for each of 3"),
    (dict(beta=[1.0, -2.0]), r"beta=-2.0: must be a finite number > 0"),
    (dict(betta=[1.0]), r"betta=.*left out: the arguments of the learner are beta"),
    (dict(n_replicas=2, threads=0), r"threads=0: must be a whole number >= 1"),
    (dict(n_replicas=2, block=0), r"block=0"),
    (dict(n_replicas=2, layout="rows"), r"layout=rows: must be auto or lanes or tables"),
    (dict(n_replicas=2, backend="cuda"), r"backend=cuda: must be auto or compiled or torch"),
]


@pytest.mark.parametrize(("arguments", "message"), BAD)
def test_bad_arguments_are_named(arguments, message):
    with pytest.raises(InputError, match=message):
        Replicas.of(AlgorithmS1(), **arguments)


def test_bad_experience_is_named(small):
    mdp, data, _ = small
    replicas = Replicas.of(AlgorithmS1(n_epochs=1, n_bias=1), 3)
    with pytest.raises(InputError, match="experience=2 streams: must be one, or one for each of 3"):
        replicas.fit(data[:2], 6, 3)
    with pytest.raises(InputError, match=r"experience=an MDP of shape \(6, 3\): must be of shape \(5, 3\)"):
        replicas.fit(Simulation(mdp, 1, 10, range(3)), 5, 3)
    with pytest.raises(InputError, match="seeds=-1"):
        Simulation(mdp, 1, 10, [-1])
    with pytest.raises(InputError, match=r"learners\[1\].prior_policy"):
        Replicas((AlgorithmS1(), AlgorithmS1(prior_policy=np.tile([0.5, 0.25, 0.25], (6, 1))))).fit(data[0], 6, 3)
    with pytest.raises(InputError, match="learners=EfficientS1: must be all AlgorithmS1"):
        Replicas((AlgorithmS1(), LEARNERS["s1_efficient"]()))
    with pytest.raises(InputError, match="backend=torch: must be compiled or auto"):
        Replicas.of(LEARNERS["s1_efficient"](), 2, backend="torch")


def test_solutions_round_trip(tmp_path, small):
    found = Replicas.of(AlgorithmS1(n_epochs=1, n_bias=2), 3).fit(small[1][:3], 6, 3)
    loaded = ReplicaSolution.load(found.save(tmp_path / "replicas.npz"))
    assert len(loaded) == 3
    for r in range(3):
        assert_same(found[r], loaded[r], history=False)
    assert torch.equal(loaded.policy, found.policy)
    assert loaded.theta.dtype == torch.float64
    with pytest.raises(AttributeError):
        _ = loaded.nothing
    found[0].save(tmp_path / "one.npz")
    np.savez(tmp_path / "other.npz", x=np.ones(3))
    with pytest.raises(InputError, match=r"other\.npz: must be the solutions of replicas"):
        ReplicaSolution.load(tmp_path / "other.npz")


# -- exact figures of many policies --------------------------------------------------------------------------


@hypothesis.settings(max_examples=25)
@hypothesis.given(problem=problems(), zeros=st.booleans())
def test_judge_has_the_exact_figures(problem, zeros):
    rng, mdp, prior = problem
    policy = random_policy(rng, *prior.shape)
    if zeros:
        policy[0] = np.eye(prior.shape[1])[0]
    judge, p = Judge(mdp, prior, 50), mdp.transition.toarray().reshape(*prior.shape, -1)
    chain, reward = np.einsum("sa,sat->st", policy, p), (policy * mdp.reward).sum(1)
    rate = sum(mdp.start @ np.linalg.matrix_power(chain, t) @ reward for t in range(50)) / 50
    j = oracle.worth(p, mdp.reward, prior, 2.0, policy)
    for found in (judge.reward_per_step(policy), reward_per_step(mdp, policy, 50)):
        assert found == pytest.approx(rate, abs=1e-12)
    for found in (judge.objective(policy, 2.0), objective(mdp, policy, prior, 2.0)):
        assert found == pytest.approx(j, abs=1e-11)


def test_gth_is_used_only_where_it_holds():
    """Two closed sets of states, and a transient one."""
    p = np.zeros((3, 2, 3))
    p[0, 0, 1] = p[0, 1, 2] = 1
    p[1, :, 1] = p[2, :, 2] = 1
    mdp = type(random_mdp(np.random.default_rng(0), 2, 1))(p, np.array([[0.0, 0], [1, 2], [4, 8]]), np.eye(3)[0])
    prior = np.full((3, 2), 0.5)
    assert Judge(mdp, prior, 10).objective(prior, 1.0) == pytest.approx(0.5 * 1.5 + 0.5 * 6)


# -- whole runs --------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    directory = tmp_path_factory.mktemp("replicas")
    return directory, train(composed(*SMALL, "n_replicas=5", "seed=3"), directory)


def test_replica_of_a_run_is_the_run_of_its_seed(finished, tmp_path):
    directory, result = finished
    assert sorted(p.name for p in directory.iterdir() if "tfevents" not in p.name) == [
        "bands.png",
        "replicas.npz",
        "result.json",
        "settings.json",
    ]
    assert json.loads((directory / "result.json").read_text()) == result
    replicas = ReplicaSolution.load(directory / "replicas.npz")
    with np.load(directory / "replicas.npz") as archive:
        assert archive["seed"].tolist() == [3, 4, 5, 6, 7]
        record = archive["record/objective"]
    alone = train(composed(*SMALL, "seed=5"), tmp_path)
    assert alone["theta"] == replicas[2].theta
    assert alone["objective"] == pytest.approx(record[-1, 2], abs=1e-12)
    assert alone["reward_per_step"] == pytest.approx(result["groups"][0]["reward_per_step"]["mean"], abs=1.0)


def test_bands_are_the_statistics(finished):
    directory, result = finished
    replicas = ReplicaSolution.load(directory / "replicas.npz")
    reader = events(directory)
    theta = replicas.theta.numpy()
    for key, value in (("mean", theta.mean()), ("q25", np.quantile(theta, 0.25)), ("max", theta.max())):
        assert [e.value for e in reader.Scalars(f"replicas/theta_{key}")][-1] == pytest.approx(value, rel=1e-6)
        assert result["groups"][0]["theta"][key] == pytest.approx(value, rel=1e-12)
    (group,) = result["groups"]
    assert group["exact"]["theta"] == pytest.approx(1.0101363366, abs=1e-9)
    assert group["replicas"] == 5
    assert group["return"]["mean"] == pytest.approx(1000 * group["reward_per_step"]["mean"], rel=1e-12)
    steps = [e.step for e in reader.Scalars("replicas/objective_mean")]
    assert steps == [0, *range(5000, 30_001, 5000)]


def test_lines_of_optimum_and_prior(finished):
    directory, result = finished
    assert undocumented(directory) == set()
    reader = events(directory)
    (group,) = result["groups"]
    steps = [e.step for e in reader.Scalars("replicas/objective_mean")]
    first = reader.Scalars("replicas/return_mean")[0].value
    for tag, value in [
        ("objective_optimal", group["exact"]["objective"]),
        ("theta_optimal", group["exact"]["theta"]),
        ("return_prior", first),
    ]:
        found = reader.Scalars(f"replicas/{tag}")
        assert [e.value for e in found] == pytest.approx([value] * len(found), rel=1e-6)
        assert [e.step for e in found] == steps[len(steps) - len(found) :]
    (gap,) = reader.Scalars("Final/gap")
    assert gap.value == pytest.approx(group["exact"]["objective"] - group["objective"]["mean"], abs=1e-6)


@pytest.mark.slow
def test_settings_that_vary(tmp_path, monkeypatch):
    titles, draw = set(), pictures.bands
    monkeypatch.setattr(
        pictures, "bands", lambda panels, x, title, *a, **k: titles.add(title) or draw(panels, x, title, *a, **k)
    )
    result = train(composed(*SMALL, "n_replicas=2", "++vary.beta=[5,10]", "++vary.lr_u=[0.01,0.02]"), tmp_path)
    assert [g["settings"] for g in result["groups"]] == [
        {"beta": b, "lr_u": lr} for b in (5, 10) for lr in (0.01, 0.02)
    ]
    title = "windy_cliff, s1: 2 replicas of each setting"
    assert titles == {title, f"{title}, at the end"}
    tags = events(tmp_path).Tags()
    assert "beta_5-lr_u_0.01/theta_mean" in tags["scalars"]
    assert {"bands/theta", "bands/objective", "sweep/theta", "sweep/delta_max"} < set(tags["images"])
    assert undocumented(tmp_path) == set()
    one = train(composed(*SMALL, "learner.beta=5", "learner.lr_u=0.02", "seed=1"), tmp_path / "one")
    assert ReplicaSolution.load(tmp_path / "replicas.npz")[3].theta == one["theta"]
    mdp = __import__("erl_torch.envs.windy_cliff", fromlist=["WindyCliffEnv"]).WindyCliffEnv().mdp
    for group in result["groups"]:
        assert group["exact"]["theta"] == pytest.approx(solve_soft_bellman(mdp, group["beta"]).theta, abs=1e-9)


@pytest.mark.slow
def test_improved_learner_on_a_recorded_stream(tmp_path):
    collect(random_mdp(np.random.default_rng(2), 4, 2), 5, 100, 0).save(tmp_path / "t.npz")
    mdp = random_mdp(np.random.default_rng(2), 4, 2)
    mdp.save(tmp_path / "mdp.npz")
    arguments = ("env=mdp", f"env.path={tmp_path}/mdp.npz", "experience=recorded", f"experience.path={tmp_path}/t.npz")
    result = train(composed(*arguments, "learner=s1_efficient", "++vary.beta=[1,2,4]"), tmp_path / "run")
    assert result["status"] == "converged"
    data = Transitions.load(tmp_path / "t.npz")
    for group, beta in zip(result["groups"], (1, 2, 4), strict=True):
        assert group["theta"]["mean"] == LEARNERS["s1_efficient"](beta=beta).fit(data, 4, 2).theta


def test_a_model_too_large_is_judged_by_playing(tmp_path):
    large = ("evaluation.exact_up_to=1", "evaluation.n_episodes=2", "evaluation.horizon=20")
    few = ("experience.n_episodes=2", "experience.episode_length=100", "learner.n_epochs=2", "learner.n_bias=3")
    result = train(composed("env=frozen_lake", *few, *large, "n_replicas=2"), tmp_path)
    assert np.isfinite(result["objective"])
    assert result["groups"][0]["exact"] == {}
    assert [e.step for e in events(tmp_path).Scalars("replicas/return_mean")] == [0, 400, 800, 1200]


def test_a_failed_replica_ends_the_run_with_a_line_after_all_is_written(tmp_path):
    arguments = (*SMALL, "n_replicas=2", "++vary.beta=[10,600]")
    with pytest.raises(NonFiniteError, match=r"replica 2 \(seed 0, beta 600\).*2 of 4 replicas"):
        train(composed(*arguments), tmp_path)
    result = json.loads((tmp_path / "result.json").read_text())
    assert result["status"] == "non_finite"
    assert set(result["failures"]) == {"2", "3"}
    assert result["groups"][0]["replicas"] == 2
    assert result["groups"][0]["theta"]["mean"] > 0.5


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["n_replicas=0"], "n_replicas=0: must be a whole number >= 1"),
        (["n_replicas=2", "shared_stream=true"], "n_replicas=2: must be 1: on one stream"),
        (["shared_stream=true"], "shared_stream=True: must be left out, or used with n_replicas"),
        (["++vary.betta=[1,2]"], r"vary.betta=\[1, 2\]: must be left out: the settings of the learner are beta"),
        (["++vary.beta=[1,x]"], "vary.beta=.*must be a list of numbers"),
        (["++vary.beta=[]"], "vary.beta=.*must be a list of numbers"),
        (["++vary.beta=[1,-2]"], "vary.beta=-2.0: must be a finite number > 0"),
        (["n_replicas=2", "learner=exact"], "learner=exact: must be one that learns"),
        (["n_replicas=2", "experience.save_to=x.npz"], "experience.save_to=x.npz: must be null"),
        (["n_replicas=2", "threads=0"], "threads=0"),
    ],
)
def test_bad_keys_are_named(tmp_path, arguments, message):
    with pytest.raises(InputError, match=message):
        train(composed(*arguments), tmp_path)
    assert not any(tmp_path.iterdir())


def test_survey_is_the_map_of_the_recorded_stream(small):
    mdp, data, _ = small
    p = mdp.transition
    sampler = Sampler(mdp, [streams(s) for s in range(N)], 100, np.full((6, 3), 1 / 3), np.full((6, 3), 1 / 3), True)
    lr = np.linspace(0.01, 1.0, N)
    visits, weight, scale = np.zeros((N, 18), np.int64), np.zeros((N, p.nnz)), np.ones((N, 18))
    for rows in (1, 999, 5000):
        pair, entry, _ = sampler.take(rows)
        kernels.survey(p.indptr, pair, entry, 1 - lr, lr, visits, weight, scale)
    weight *= np.repeat(scale, np.diff(p.indptr), axis=1)
    for r, d in enumerate(data):
        pair = d.s * np.int32(3) + d.a
        assert np.array_equal(visits[r], np.bincount(pair, minlength=18))
        indptr, indices, values = tally(d, 6, 3, lr[r]).psi_map
        sparse = type(p)((weight[r], p.indices, p.indptr), shape=p.shape)
        assert np.array_equal(sparse.toarray(), type(p)((values, indices, indptr), shape=p.shape).toarray())
