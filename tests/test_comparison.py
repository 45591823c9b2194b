"""The comparison of learners: figures against direct evaluation, same bits for any number of processes."""

import json
import warnings
from functools import partial

import gymnasium as gym
import numpy as np
import oracle
import pytest
from helpers import composed, random_mdp, random_policy
from matplotlib.image import imread

from erl_torch import (
    AlgorithmS1,
    InputError,
    TabularMDP,
    collect,
    pictures,
    smallest_charge,
    solve_soft_bellman,
    tabular_mdp,
)
from erl_torch.cli import main as cli
from erl_torch.learners import LEARNERS, DifferentialSoftQ, SoftQ
from erl_torch.mdp.from_gymnasium import model_ends
from erl_torch.run.compare import MEASURES, compare, interquartile_mean, iqm_interval, run_comparison
from erl_torch.solvers.optimum import measure, solve_optimum
from erl_torch.solvers.policy import objective

SMALL = ("experience.n_episodes=4", "experience.episode_length=500", "seeds=2", "n_sizes=2")
compared = partial(composed, command="compare")
PAIR = "learners=[differential_soft_q,soft_q]"


def complaint(directory, *overrides):
    try:
        run_comparison(compared(*SMALL, *overrides), directory)
    except (*cli.BY_CONFIGURATION, *cli.BY_RUN) as error:
        return cli._line(error)
    raise AssertionError(f"{overrides} ran")


@pytest.fixture(scope="module")
def problem():
    rng = np.random.default_rng(7)
    return random_mdp(rng, 5, 3), random_policy(rng, 5, 3)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    directory = tmp_path_factory.mktemp("comparison")
    return directory, run_comparison(compared(*SMALL, PAIR), directory)


# -- the measures -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("beta", [0.5, 5.0])
def test_measures_are_their_definitions(problem, beta):
    mdp, prior = problem
    p = mdp.transition.toarray().reshape(5, 3, 5)
    best = oracle.biasing_iterations(p, mdp.reward, prior, beta, 25)[-1]
    solution = DifferentialSoftQ(beta=beta, n_epochs=1, prior_policy=prior).fit(collect(mdp, 1, 400, 3), 5, 3)
    policy = solution.policy.numpy()
    found = measure(mdp, solve_optimum(mdp, beta, prior), solution, beta)
    assert found["gap"] == pytest.approx(-best.theta - oracle.worth(p, mdp.reward, prior, beta, policy), abs=1e-10)
    kl = (best.policy * np.log(best.policy / policy)).sum(1)
    share = oracle.stationary(np.einsum("sa,sat->st", best.policy, p))
    assert found["kl"] == pytest.approx(share @ kl, rel=1e-8)
    assert found["kl_states"] == pytest.approx(kl.mean(), rel=1e-8)
    assert found["theta_error"] == pytest.approx(abs(solution.theta - best.theta), abs=1e-9)
    assert found["n_steps"] == 400
    exact = measure(mdp, solve_optimum(mdp, beta, prior), solve_soft_bellman(mdp, beta, prior), beta)
    assert max(exact[name] for name in ("gap", "kl", "kl_states", "theta_error")) < 1e-14


def test_gap_is_finite_where_the_optimal_policy_underflows():
    mdp = TabularMDP([[[0.5, 0.5]] * 2] * 2, [[0.0, -1.0], [-2.0, 0.0]])
    solution = SoftQ(beta=1.0, n_epochs=1).fit(collect(mdp, 1, 100), 2, 2)
    best = solve_optimum(mdp, 2000.0)
    assert best.policy.min() == 0.0
    found = measure(mdp, best, solution, 2000.0)
    expected = -best.theta - objective(mdp, solution.policy.numpy(), np.full((2, 2), 0.5), 2000.0)
    assert found["gap"] == pytest.approx(expected, rel=1e-9)


def test_interquartile_mean():
    assert interquartile_mean(np.array([9.0, 1.0, 2.0, -50.0])) == 1.5
    assert interquartile_mean(np.array([3.0, 1.0])) == 2.0
    np.testing.assert_allclose(interquartile_mean(np.arange(16.0).reshape(2, 8)), [3.5, 11.5])


def test_interval_of_the_interquartile_mean():
    assert iqm_interval(np.array([3.0])) is None
    # Two values: the quantile of a Cauchy variable, tan(.475 pi); below 0 nothing is possible.
    assert iqm_interval(np.array([90.0, 92.0])) == pytest.approx((91 - 12.7062047, 91 + 12.7062047), rel=1e-8)
    assert iqm_interval(np.array([1.0, 3.0])) == pytest.approx((0.0, 14.7062047), rel=1e-8)
    # 1 to 8: 4 used, their ends doubled for the rest (3 3 3 4 5 6 6 6, squares 14); 3.18244631 is t of 3 degrees.
    half = 3.18244631 * np.sqrt(14 / (4 * 3))
    assert iqm_interval(np.arange(8, 0, -1.0)) == pytest.approx((4.5 - half, 4.5 + half), rel=1e-8)
    assert iqm_interval(np.full(5, 7.0)) == (7.0, 7.0)
    assert iqm_interval(np.zeros(5)) == (0.0, 0.0)
    assert iqm_interval(np.array([1e300, 1e300, 3e300]))[0] == 0.0


@pytest.mark.parametrize("n", [2, 3, 4, 20])
def test_interval_holds_the_truth_as_often_as_stated(n):
    """Normal values: in 95 % of 1000 cases, from four on in .93 or more; and three standard errors of such a count."""
    draws = np.random.default_rng(n).normal(100.0, 1.0, size=(1000, n))
    held = [low <= 100.0 <= high for low, high in map(iqm_interval, draws)]
    assert (0.95 if n < 4 else 0.93) - 0.024 < np.mean(held) < 0.95 + 0.021


# -- compare ----------------------------------------------------------------------------------------------


def learners(prior):
    return {
        "s1": AlgorithmS1(beta=2.0, n_epochs=2, n_bias=2, lr_u=0.05, prior_policy=prior),
        "soft_q": SoftQ(beta=2.0, n_epochs=2, prior_policy=prior),
    }


def test_every_learner_has_the_same_experience(problem):
    mdp, prior = problem
    behaviour = random_policy(np.random.default_rng(1), 5, 3)
    seen = []
    found = compare(
        mdp, learners(prior), 4, 500, (3, 8), behaviour, prior, n_sizes=2, report=lambda *done: seen.append(done)
    )
    assert found.sizes == (1000, 2000)
    assert found.seeds == (3, 8)
    assert seen == [(1, 4), (2, 4), (3, 4), (4, 4)]
    best = solve_optimum(mdp, 2.0, prior)
    for i, learner in enumerate(learners(prior).values()):
        for j, seed in enumerate(found.seeds):
            data = collect(mdp, 4, 500, seed, behaviour, prior)
            for k, size in enumerate(found.sizes):
                expected = measure(mdp, best, learner.fit(data.first(size), 5, 3), 2.0)
                for name, value in expected.items():
                    np.testing.assert_equal(found.measures[name][i, j, k], value)
    assert (found.measures["seconds"] > 0).all()
    assert found.status["s1"] == [["completed"] * 2] * 2


@pytest.mark.slow
def test_processes_change_nothing(problem):
    mdp, prior = problem
    one, two = (compare(mdp, learners(prior), 2, 500, 2, None, prior, processes=n) for n in (1, 2))
    for name in set(MEASURES) - {"seconds"}:
        np.testing.assert_array_equal(one.measures[name], two.measures[name])
    assert one.status == two.status


def test_one_seed_has_no_interval_and_a_failure_no_figure(problem):
    mdp, prior = problem
    found = compare(mdp, learners(prior), 1, 500, 1, None, prior)
    assert found.summary()["table"]["s1"]["gap"]["interval"] is None
    found.measures["kl"][0] = np.inf
    found.status["s1"][0][-1] = "non_finite"
    summary = found.summary()
    assert summary["table"]["s1"]["kl"] == {"mean": None, "iqm": None, "interval": None}
    assert summary["measures"]["kl"]["s1"] == [[None]]
    json.dumps(summary, allow_nan=False)
    assert "1 of 1 seeds left the finite numbers" in found.table()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"learners": {}}, "learners={}: must be at least one"),
        ({"learners": {"a": SoftQ(), "b": SoftQ(beta=3.0)}}, "b: beta=3.0: must be that of a, 10"),
        ({"learners": {"a": SoftQ(prior_policy=[[0.2, 0.3, 0.5]] * 5)}}, "a: prior_policy=array: must be the prior"),
        ({"seeds": 0}, "seeds=0"),
        ({"seeds": ()}, r"seeds=\[\]"),
        ({"seeds": (0, -1)}, "seeds=-1"),
        ({"n_sizes": 0}, "n_sizes=0"),
        ({"processes": 0}, "processes=0"),
        ({"n_episodes": 0}, "n_episodes=0"),
    ],
)
def test_bad_arguments(problem, change, message):
    arguments = {"learners": {"a": SoftQ()}, "n_episodes": 1, "episode_length": 100, "seeds": 1} | change
    with pytest.raises(InputError, match=message):
        compare(problem[0], **arguments)


def test_a_model_without_one_optimum():
    with pytest.raises(InputError, match="model=reducible: must be one with an exact solution"):
        compare(TabularMDP(np.eye(2)[:, None], np.zeros((2, 1))), {"a": SoftQ()}, 1, 100, 1)


# -- the command ------------------------------------------------------------------------------------------


def test_run_directory(finished):
    directory, result = finished
    assert sorted(p.name for p in directory.iterdir()) == ["compare.json", "compare.png"]
    assert json.loads((directory / "compare.json").read_text()) == result
    assert result["theta"] == pytest.approx(1.0101363366, abs=1e-9)
    assert result["sizes"] == [1000, 2000]
    gaps = np.array(result["measures"]["gap"]["soft_q"])
    assert gaps.shape == (2, 2)
    row = result["table"]["soft_q"]
    assert row["gap"]["mean"] == pytest.approx(gaps[:, 1].mean(), rel=1e-12)
    half = abs(np.diff(gaps[:, 1])[0]) / 2 * np.tan(0.475 * np.pi)  # two seeds: Student's t, one degree of freedom
    middle = gaps[:, 1].mean()
    assert row["gap"]["interval"] == pytest.approx([max(middle - half, 0), middle + half], rel=1e-9)
    assert row["theta_error"]["mean"] is None
    assert result["curves"]["soft_q"][0]["iqm"] == pytest.approx(gaps[:, 0].mean(), rel=1e-12)
    assert result["curves"]["soft_q"][1] == row["gap"]
    picture = imread(directory / "compare.png")
    assert picture.shape[1] > picture.shape[0] > 500


def test_experience_is_that_of_train(finished):
    from erl_torch.mdp.from_gymnasium import known_mdp
    from erl_torch.run.build import make_env

    mdp = known_mdp(make_env(composed().env))
    solution = DifferentialSoftQ().fit(collect(mdp, 4, 500, 1), 15, 4)
    expected = measure(mdp, solve_optimum(mdp, 10.0), solution, 10.0)["gap"]
    assert finished[1]["measures"]["gap"]["differential_soft_q"][1][1] == expected


def test_settings_of_one_learner_and_of_all(tmp_path):
    result = run_comparison(
        compared(*SMALL, PAIR, "learner.soft_q.n_epochs=2", "beta=3", "n_sizes=1", "seed=5"), tmp_path
    )
    assert result["beta"] == 3.0
    assert result["seeds"] == [5, 6]
    assert result["table"]["soft_q"]["n_steps"]["mean"] == 4000
    assert result["table"]["differential_soft_q"]["n_steps"]["mean"] == 30_000


def test_the_charge_is_that_of_the_prior(tmp_path):
    """end_reward=auto: the smallest charge under the prior that is compared with, given for all or in settings."""
    env = gym.make("FrozenLake-v1")
    prior = np.full((16, 4), 0.1)
    prior[:, 1] = 0.7
    np.save(tmp_path / "p.npy", prior)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = smallest_charge(tabular_mdp(env), model_ends(env).failed, 5.0, 0.01, prior)
    few = (
        "env=frozen_lake",
        "env.end_reward=auto",
        "env.end_target=0.01",
        "learners=[s1_efficient]",
        "seeds=1",
        "n_sizes=1",
    )
    for i, of_all in enumerate(("", "learner.s1_efficient.")):
        result = run_comparison(
            compared(*SMALL, *few, f"{of_all}beta=5", f"{of_all}prior_policy={tmp_path}/p.npy"), tmp_path / str(i)
        )
        assert result["theta"] == pytest.approx(found.solution.theta, rel=1e-9)
        assert any(f"{-found.charge:.9g}" in one for one in result["notes"])


def test_every_learner_can_be_compared():
    cfg = compared()
    assert set(cfg.learner) == {name for name, learner in LEARNERS.items() if hasattr(learner, "fit")}
    assert set(cfg.learners) <= set(cfg.learner)


@pytest.mark.parametrize(
    ("overrides", "expected"),
    [
        (["learners=[s1,sarse]"], "learners=sarse: must be certainty_equivalence or "),
        (["learners=[exact]"], "learners=exact: must be certainty_equivalence or "),
        (["learners=[]"], "learners=[]: must be at least one"),
        (["seeds=0"], "seeds=0: must be a whole number >= 1"),
        (["beta=-1"], "learner.s1.beta=-1.0: must be a finite number > 0"),
        (["learner.s1.beta=5"], "s1_listing: beta=10.0: must be that of s1, 5"),
        (["learner.s1.lr_u=7"], "learner.s1.lr_u=7.0: must be"),
        (["+learner.s1.lr=7"], "learner.s1.lr"),
        (["+learner.s3.lr=7"], "learner.s3"),
        (["+sedes=3"], "sedes"),
        (["env=frozen_lake", "env.use_model=false"], "env=frozen_lake: must be one with a known model"),
        (["experience.save_to=x.npz"], "experience.save_to=x.npz: must be null"),
    ],
)
def test_complaints(tmp_path, overrides, expected):
    line = complaint(tmp_path, *overrides)
    assert line.startswith(expected)
    assert "\n" not in line
    assert list(tmp_path.iterdir()) == []


def test_recorded_experience_is_refused(tmp_path):
    cfg = compared("experience=recorded", "experience.path=x.npz")
    with pytest.raises(InputError, match="experience=recorded: must be simulate: every seed needs a stream"):
        run_comparison(cfg, tmp_path)


def test_command_line(tmp_path, typed_here):
    code, out, err = typed_here("compare.py", *SMALL, PAIR, "n_sizes=1")
    assert code == 0, err
    (directory,) = (tmp_path / "runs" / "windy_cliff").iterdir()
    assert directory.name.startswith("compare-")
    assert {".hydra", "compare.json", "compare.png"} == {p.name for p in directory.iterdir()}
    lines = out.splitlines()
    rows = [line.split() for line in lines if line.startswith(("differential_soft_q", "soft_q"))]
    result = json.loads((directory / "compare.json").read_text())
    for row in rows:
        assert float(row[1]) == pytest.approx(result["table"][row[0]]["gap"]["mean"], rel=1e-2)
    assert [float(row[2]) for row in rows] == sorted(float(row[2]) for row in rows)
    assert lines[-1].endswith(f"runs/windy_cliff/{directory.name}")


def test_errors_and_help(typed_here):
    code, _, err = typed_here("compare.py", "learners=[s4]")
    assert code == 1
    assert err.startswith("error: learners=s4: must be")
    assert err.count("\n") == 1
    _, about, _ = typed_here("compare.py", "--help")
    assert "windy_cliff,windy_frozen_lake" in about
    assert "learner={" not in about


# -- the picture ------------------------------------------------------------------------------------------


def near(picture, colour):
    wanted = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)])
    return np.argwhere(np.abs(picture.astype(int) - wanted).max(-1) < 12)


def test_curves_have_a_colour_each_and_follow_the_gap():
    def points(*values):
        return [{"mean": v, "iqm": v, "interval": [v / 2, v * 2] if v else None} for v in values]

    curves = {"high": points(1e-1, 1e-1), "low": points(1e-3, 1e-4), "absent": points(None, None)}
    picture = pictures.learning_curves([100, 10_000], curves, "title")
    assert picture.dtype == np.uint8
    inside = slice(None, 150 * 6)  # left of the names
    high, low = (near(picture[:, inside], pictures.COLOURS[i]) for i in (0, 1))
    assert high[:, 0].mean() < low[:, 0].mean()  # rows count from the top
    assert np.ptp(high[:, 0]) < 20  # level
    left, right = low[low[:, 1] < 400], low[low[:, 1] > 700]
    assert left[:, 0].mean() < right[:, 0].mean()  # falling
    assert not len(near(picture, pictures.COLOURS[2]))


def test_picture_of_one_size_or_nothing():
    point = {"mean": 1.0, "iqm": 1.0, "interval": None}
    for curves in ({"a": [point]}, {"a": [point | {"iqm": None}]}):
        assert pictures.learning_curves([100], curves, "title").std() > 1
