"""A finite MDP on representatives, from recorded tuples; recorded tuples as experience of networks."""

import json

import numpy as np
import pytest
from helpers import composed

from erl_torch import InputError, TabularMDP, solve_soft_bellman
from erl_torch.envs.windy_strip import WindyStripEnv
from erl_torch.networks.kernel_s1 import KernelS1
from erl_torch.networks.learner import AverageSoftQ
from erl_torch.networks.problem import BoxProblem
from erl_torch.networks.replay import COLUMNS, Recorded, Steps
from erl_torch.networks.strip_pictures import OnGrid
from erl_torch.networks.truth import StripTruth
from erl_torch.run.training import train


def on_the_strip(n, seed, policy):
    """Tuples of which half are drawn uniformly, half from ``policy``."""
    env, rng = WindyStripEnv(), np.random.default_rng(seed)
    now, _ = env.reset(seed=seed)
    rows = []
    for _ in range(n):
        a = int(rng.integers(4)) if rng.random() < 0.5 else int(policy.draw(now[None], rng.random((1, 1)))[0][0])
        after, reward, ended, _, _ = env.step(a)
        after = env.reset()[0] if ended else after
        rows.append((now, a, reward, after, ended))
        now = after
    return Steps(*map(np.array, zip(*rows, strict=True)))


@pytest.fixture(scope="module")
def truth():
    return StripTruth(5.0)


@pytest.mark.parametrize("seed", range(3))
def test_the_strip_from_15_000_tuples(truth, seed):
    data = on_the_strip(15_000, seed, OnGrid(truth.solution.policy.numpy()))
    model = KernelS1(5.0, (20, 30)).fit(data, 4)
    figures = truth.figures(model)
    assert 0 <= figures["loss_of_policy"] < 0.007
    assert abs(model.solution.theta - truth.solution.theta) < 0.01
    low, high = model.solution.theta_bounds
    assert low <= model.solution.theta <= high
    hopeful = KernelS1(5.0, (20, 30), optimism=1.0).fit(data, 4)
    assert truth.figures(hopeful)["falls"] > 20 * figures["falls"]


def test_on_the_points_of_a_finite_mdp_it_is_certainty_equivalence():
    """Observations 0, 1, 2, a narrow kernel: every pair's tuples alone, so that the model is that of the counts."""
    rng = np.random.default_rng(0)
    n = 3000
    s, a, after = rng.integers(3, size=n), rng.integers(2, size=n), rng.integers(3, size=n)
    reward = s - 0.5 * a + 0.0
    s[:3], after[:3] = [0, 1, 2], [0, 1, 2]
    data = Steps(s[:, None] * 1.0, a, reward, after[:, None] * 1.0, np.zeros(n, bool))
    model = KernelS1(2.0, (3,), neighbours=n, width=1e-3, reach=0.6).fit(data, 2)
    p = np.zeros((3, 2, 3))
    np.add.at(p, (s, a, after), 1.0)
    p /= p.sum(2, keepdims=True)
    mean = np.zeros((3, 2))
    np.add.at(mean, (s, a), reward)
    counts = np.zeros((3, 2))
    np.add.at(counts, (s, a), 1)
    exact = solve_soft_bellman(TabularMDP(p, mean / counts), 2.0)
    # Cells are a third of the range: their centres are 1/3, 1, 5/3, and 0 and 2 are nearest to the outer ones.
    assert model.solution.theta == pytest.approx(exact.theta, abs=1e-9)
    assert model(np.array([[0.0], [1.0], [2.0]])) == pytest.approx(exact.policy.numpy(), abs=1e-9)


def test_an_action_without_a_tuple_nearby_is_one_that_is_lacking(truth):
    data = on_the_strip(4000, 0, OnGrid(truth.prior))
    left = data.observation[:, 0] < 0.5
    keep = ~((data.action == 2) & left)
    cut = Steps(*(getattr(data, name)[keep] for name in COLUMNS))
    model = KernelS1(5.0, (10, 10)).fit(cut, 4)
    policy = model(np.array([[0.1, 0.1]]))
    assert policy[0, 2] == 0
    assert policy.sum() == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: KernelS1(5.0, ()), "cells"),
        (lambda: KernelS1(5.0, (1,)), "cells=1"),
        (lambda: KernelS1(5.0, (10,) * 5), "one to 4 numbers"),
        (lambda: KernelS1(5.0, (1000, 1000)), "at most 100,000"),
        (lambda: KernelS1(5.0, (5,), width=0), "width=0"),
        (lambda: KernelS1(5.0, (5,)).fit(on_the_strip(20, 0, OnGrid(np.full((600, 4), 0.25))), 4), "cells.*2 numbers"),
        (lambda: KernelS1(5.0, (5, 5)).fit(on_the_strip(20, 0, OnGrid(np.full((600, 4), 0.25))), 2), "action"),
    ],
)
def test_what_cannot_be_is_named(make, said):
    with pytest.raises(InputError, match=said):
        make()


# -- recorded tuples ----------------------------------------------------------------------------------------------

FEW = ("learner.n_steps=300", "learner.epoch_steps=100", "evaluation.n_episodes=2", "learner.hidden=[8,8]")


@pytest.fixture
def recorded(tmp_path, truth):
    return on_the_strip(500, 1, OnGrid(truth.prior)).save(tmp_path / "tuples.npz")


def test_networks_learn_from_a_file(tmp_path, recorded):
    """The bits of the same tuples in Python; a stop changes nothing; replicas are single runs."""
    asked = ("env=windy_strip", "learner=asql", "experience=recorded", f"experience.path={recorded}", *FEW)
    result = train(composed(*asked, "seed=3"), tmp_path / "run")
    assert result["status"] == "completed"
    data = Steps.load(recorded)
    where = BoxProblem(lambda: WindyStripEnv(), 2, 4)
    learner = AverageSoftQ(beta=5.0, n_steps=300, epoch_steps=100, hidden=(8, 8))
    *_, state = learner.run(where, Recorded(data, 3))
    learner.policy(where, state).save(tmp_path / "own.safetensors")
    alone = (tmp_path / "run" / "policy.safetensors").read_bytes()
    assert alone == (tmp_path / "own.safetensors").read_bytes()

    def stop():
        raise SystemExit(1)

    for _ in range(2):
        with pytest.raises(SystemExit):
            train(composed(*asked, "seed=3"), tmp_path / "cut", safe_point=stop)
    train(composed(*asked, "seed=3"), tmp_path / "cut")
    assert (tmp_path / "cut" / "policy.safetensors").read_bytes() == alone
    train(composed(*asked, "seed=2", "n_replicas=2"), tmp_path / "many")
    assert (tmp_path / "many" / "policy-3.safetensors").read_bytes() == alone
    assert json.loads((tmp_path / "many" / "result.json").read_text())["n_replicas"] == 2


def test_other_tuples_are_another_run(tmp_path, recorded, truth):
    asked = ("env=windy_strip", "learner=asql", "experience=recorded", f"experience.path={recorded}", *FEW)

    def stop():
        raise SystemExit(1)

    with pytest.raises(SystemExit):
        train(composed(*asked), tmp_path / "run", safe_point=stop)
    on_the_strip(500, 2, OnGrid(truth.prior)).save(recorded)
    with pytest.raises(InputError, match="experience=another stream"):
        train(composed(*asked), tmp_path / "run")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda d: d.pop("ended"), "lacks ended"),
        (lambda d: d.update(reward=d["reward"] * np.nan), r"reward.*finite"),
        (lambda d: d.update(action=d["action"] + 9), "action=others: must be whole numbers in"),
        (lambda d: d.update(action=d["action"] * 0.5), "action"),
        (
            lambda d: d.update(observation=d["observation"][:, :1], following=d["following"][:, :1]),
            "observation=1 numbers",
        ),
        (lambda d: d.update(following=d["following"][:9]), "following"),
    ],
)
def test_bad_files_get_one_line(tmp_path, recorded, change, said):
    found = dict(np.load(recorded))
    change(found)
    np.savez(tmp_path / "bad.npz", **found)
    asked = ("env=windy_strip", "learner=asql", "experience=recorded", f"experience.path={tmp_path}/bad.npz", *FEW)
    with pytest.raises(InputError, match=said):
        train(composed(*asked), tmp_path / "run")
