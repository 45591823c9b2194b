"""Runs of learners with networks, in directories: figures, replicas, resume, play, bad input; the windy strip."""

import json
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from helpers import composed, scalars
from scipy.stats import norm

from erl_torch import InputError, solve_soft_bellman
from erl_torch.envs.windy_strip import MOVES, WindyStripEnv, strip_mdp
from erl_torch.networks.policy import load_policy
from erl_torch.networks.truth import StripTruth
from erl_torch.run.playing import play
from erl_torch.run.training import train

FEW = ("learner.n_steps=600", "learner.epoch_steps=200", "evaluation.n_episodes=3", "learner.hidden=[8,8]")


def run(directory, *overrides, **more):
    return train(composed(*overrides, *FEW), directory, **more)


# -- the windy strip ----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def strip():
    return strip_mdp(20, 30)


@pytest.mark.parametrize("action", range(4))
@pytest.mark.parametrize("cell", [0, 5, 8 * 30 + 29, 19 * 30 + 3])
def test_the_grid_is_the_environment_seen_in_cells(strip, action, cell):
    """Steps from uniform in a cell, by the environment itself: chances of falls, arrivals and cells."""
    env, n = WindyStripEnv(), 20_000
    env.reset(seed=cell)
    rng = np.random.default_rng(cell + action)
    low = strip.centres[cell] - np.array([0.025, 1 / 30])
    falls = arrivals = 0
    counts = np.zeros(600)
    for start in rng.uniform(low, low + np.array([0.05, 2 / 30]), (n, 2)):
        env._at = start
        observation, reward, over, _, info = env.step(action)
        falls, arrivals = falls + (over and info["failure"]), arrivals + (over and not info["failure"])
        assert reward == (-10 if over and info["failure"] else 5 if over else 0)
        if not over:
            ix, iy = min(int(observation[0] * 20), 19), min(int(observation[1] * 15), 29)
            counts[ix * 30 + iy] += 1

    def near(count, chance):
        assert abs(count - n * chance) <= 5 * np.sqrt(n * chance * (1 - chance)) + 1

    near(falls, strip.falls[cell, action])
    near(arrivals, strip.arrivals[cell, action])
    row = strip.mdp.transition[[cell * 4 + action]].toarray()[0]
    row = row - (strip.falls + strip.arrivals)[cell, action] * strip.mdp.start
    for to in np.argsort(row)[-4:]:
        near(counts[to], row[to])


def test_chances_of_a_fall_are_integrals(strip):
    """The mean over a cell of Phi((-x - shift)/sd), by quadrature."""
    x, weight = np.polynomial.legendre.leggauss(40)
    for action, (move, _) in enumerate(MOVES):
        at = 0.025 + 0.025 * x  # the first cell
        exact = weight @ norm.cdf((-at - move + 0.03) / 0.06) / 2
        assert strip.falls[0, action] == pytest.approx(exact, rel=1e-10)


def test_the_optimum_nears_that_of_the_continuous_strip(strip):
    """g* of grids two and four times as fine: .0277 and .02785; the optimist falls a hundred times as often."""
    truth = StripTruth(5.0)
    assert -truth.solution.theta == pytest.approx(0.0270262, abs=1e-6)
    best = truth.optimum
    assert best["loss_of_policy"] == pytest.approx(0.0, abs=1e-9)
    hopeful = truth.figures(lambda _: solve_soft_bellman(strip.mdp, 5.0, optimism=1.0).policy.numpy())
    assert best["falls"] == pytest.approx(0.180, abs=1e-3)
    assert hopeful["falls"] == pytest.approx(19.08, abs=0.01)
    assert hopeful["objective"] < best["objective"] - 0.3
    prior = truth.figures(lambda x: np.full((len(x), 4), 0.25))
    assert prior["objective"] == pytest.approx(prior["reward_per_step"])


def test_the_strip_keeps_gymnasiums_contract():
    env = gym.make("erl_torch/WindyStrip-v0")
    first = [env.reset(seed=3)[0], *(env.step(a % 4)[0] for a in range(9))]
    again = [env.reset(seed=3)[0], *(env.step(a % 4)[0] for a in range(9))]
    assert all(np.array_equal(a, b) for a, b in zip(first, again, strict=True))
    assert all(env.observation_space.contains(x) for x in first)
    from gymnasium.utils.env_checker import check_env

    check_env(env.unwrapped, skip_render_check=True)


# -- runs ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("learner", ["deep_s1", "asql"])
def test_a_run_says_what_it_has_learnt(tmp_path, learner, capsys):
    result = run(tmp_path, "env=windy_strip", f"learner={learner}")
    policy = load_policy(tmp_path / "policy.safetensors")
    truth = StripTruth(5.0)
    figures = truth.figures(policy)
    for name in ("loss_of_policy", "falls", "arrivals", "kl_to_optimal", "objective"):
        assert result[name] == pytest.approx(figures[name], rel=1e-6)
    assert result["exact_theta"] == pytest.approx(truth.solution.theta)
    assert json.loads((tmp_path / "result.json").read_text())["status"] == "completed"
    logged = scalars(tmp_path)
    assert [step for step, _ in logged["eval/loss_of_policy"]] == [0, 200, 400, 600]
    assert logged["eval/falls"][-1][1] == pytest.approx(figures["falls"], rel=1e-5)
    assert len(logged["learner/theta"]) == 3
    assert ("learner/residual_lower" in logged) == (learner == "deep_s1")
    said = capsys.readouterr().out
    assert "600 of 1 seed" in said
    assert "optimal" in said


def test_a_run_that_was_stopped_goes_on_with_the_same_bits(tmp_path):
    """Stopped after each epoch: weights, records and figures are those of a run left alone."""
    run(tmp_path / "whole", "env=windy_strip", "learner=deep_s1")

    def stop():
        raise SystemExit(1)

    for _ in range(2):
        with pytest.raises(SystemExit):
            run(tmp_path / "cut", "env=windy_strip", "learner=deep_s1", safe_point=stop)
    run(tmp_path / "cut", "env=windy_strip", "learner=deep_s1")
    files = [tmp_path / name / "policy.safetensors" for name in ("whole", "cut")]
    assert files[0].read_bytes() == files[1].read_bytes()
    whole, cut = (scalars(path.parent) for path in files)
    assert {k: v for k, v in whole.items() if not k.startswith("time/")} == {
        k: v for k, v in cut.items() if not k.startswith("time/")
    }


@pytest.mark.parametrize("threads", [1, 2])
def test_replicas_are_single_runs(tmp_path, threads):
    run(tmp_path / "many", "env=windy_strip", "learner=asql", "n_replicas=3", "seed=4", f"threads={threads}")
    for seed in (4, 6):
        run(tmp_path / str(seed), "env=windy_strip", "learner=asql", f"seed={seed}")
        alone = (tmp_path / str(seed) / "policy.safetensors").read_bytes()
        assert (tmp_path / "many" / f"policy-{seed}.safetensors").read_bytes() == alone
    result = json.loads((tmp_path / "many" / "result.json").read_text())
    assert result["groups"][0]["loss_of_policy"]["max"] >= result["groups"][0]["loss_of_policy"]["min"] > 0
    assert (tmp_path / "many" / "bands.png").stat().st_size > 10_000


def test_gymnasiums_own_are_found_with_their_presets(tmp_path):
    result = run(tmp_path, "env=mountain_car_v0", "learner=asql", "evaluation.horizon=60")
    assert result["end_reward"].startswith("+50")
    assert result["return"] == result["return_greedy"] == -60
    assert any("every step paid -1" in text for text in result["notes"])


def test_optimism_is_logged_with_what_it_is_worth(tmp_path):
    result = run(tmp_path, "env=windy_strip", "learner=asql", "learner.optimism=1")
    policy = load_policy(tmp_path / "policy.safetensors")
    hopeful = StripTruth(5.0, 1.0)
    assert result["objective"] == pytest.approx(hopeful.figures(policy)["objective"], rel=1e-6)
    assert result["objective_real"] == pytest.approx(StripTruth(5.0).figures(policy)["objective"], rel=1e-6)


def test_play_of_a_network(tmp_path, capsys):
    cfg = composed("env=windy_strip", "learner=asql", *FEW)
    train(cfg, tmp_path)
    (tmp_path / ".hydra").mkdir()
    from omegaconf import OmegaConf

    OmegaConf.save(cfg, tmp_path / ".hydra" / "config.yaml")
    asked = composed(f"run={tmp_path}", "n_episodes=4", command="play")
    played = play(asked)
    assert len(played.returns) == 4
    assert played.lengths.max() <= 1000
    assert "4, of which the environment ended" in capsys.readouterr().out
    again = play(asked)
    assert np.array_equal(played.returns, again.returns)


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        (["env=windy_cliff"], "env=windy_cliff: must be one with observations in a Box"),
        (["env=windy_strip", "+vary.beta=[1,2]"], "vary="),
        (["env=mountain_car_v0", "env.end_reward=auto"], "env.end_reward=auto: must be a number"),
        (["env=mountain_car_v0", "env.failures=none"], "env.failures=none: must be default or all"),
        (["env=windy_strip", "learner.hidden=[]"], "learner.hidden"),
        (["env=windy_strip", "learner.batch=0"], "learner.batch=0"),
    ],
)
def test_bad_keys_are_named(tmp_path, overrides, said):
    with pytest.raises(InputError, match=said):
        train(composed("learner=deep_s1", *overrides), tmp_path)
    assert not list(tmp_path.iterdir())


def test_learners_of_few_actions_point_at_those_of_boxes(tmp_path):
    with pytest.raises(InputError, match="learner=AverageSoftQ: must be deep_s1 or asac"):
        train(composed("env=pendulum_v1", "learner=asql"), tmp_path)


def test_learners_of_tables_point_at_networks(tmp_path):
    with pytest.raises(InputError, match="learner=deep_s1 takes it as it is"):
        train(composed("env=windy_strip"), tmp_path)


def test_lost_weights_are_told_and_the_last_good_ones_kept(tmp_path):
    with pytest.raises(ArithmeticError, match="weights left the finite numbers"):
        run(tmp_path, "env=windy_strip", "learner=asql", "learner.lr=1e30")
    result = json.loads((tmp_path / "result.json").read_text())
    assert result["status"] == "non_finite"
    policy: Any = load_policy(tmp_path / "policy.safetensors")
    assert np.isfinite(policy(np.zeros((1, 2), np.float32))).all()
    assert replace(policy, beta=1.0).beta == 1.0
