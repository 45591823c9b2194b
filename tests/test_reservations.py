"""Reservations: each fault has its own note, in single runs and in replicas, and true streams have none."""

import itertools
import json
import math
import warnings

import numpy as np
import oracle
import pytest
from helpers import composed, random_mdp, random_policy

import erl_torch
from erl_torch import NonFiniteError, TabularMDP, Transitions, collect
from erl_torch.empirical import reservations
from erl_torch.empirical.counts import empirical_mdp, tally
from erl_torch.empirical.reservations import (
    ADVICE,
    CONTRADICTED,
    FAR_HALF_WIDTHS,
    Reservation,
    _covered,
    count,
    divergence,
    half_widths,
    of_actions,
    of_model,
    of_outcome,
    of_replicas,
    of_states,
    of_theta,
)
from erl_torch.empirical.reservations import unlikely as is_unlikely
from erl_torch.empirical.uncertainty import Estimate, theta_uncertainty
from erl_torch.envs.windy_cliff import WindyCliffEnv
from erl_torch.learners import LEARNERS, CertaintyEquivalence, EfficientS1
from erl_torch.notes import collected, note
from erl_torch.run.replicas import reservations_of
from erl_torch.run.training import train
from erl_torch.solution import Status
from erl_torch.solvers import solve_soft_bellman

SHORT = ("learner.n_epochs=2", "learner.n_bias=2", "evaluation.pictures=false")
NOISE, FROM_PRIOR = "rewards vary for the same (s,a)", "no draws from the prior policy"
EQUAL, WORSE, MODEL = "every reward of the stream is", "worse than the prior", "the data contradict the model"
OF_DATA = (NOISE, FROM_PRIOR, EQUAL, MODEL)
OUT_OF_RANGE, FAR_OFF = "theta* lies in", "half widths from what the data say"
UNMET = "states that the model can reach"


def changed(data, **columns):
    return Transitions(**{name: columns.get(name, getattr(data, name)) for name in ("s", "a", "r", "s_next", "a_next")})


@pytest.fixture(autouse=True)
def no_pictures(monkeypatch):
    """Replicas always draw: seconds, and tests of their own."""
    monkeypatch.setattr("erl_torch.run.replicas.pictures.bands", lambda *_, **__: np.zeros((4, 4, 3), np.uint8))


@pytest.fixture(scope="module")
def cliff():
    return WindyCliffEnv().mdp


@pytest.fixture(scope="module")
def recordings(tmp_path_factory, cliff):
    """Paths by name: a stream of the windy cliff as it is, and with one fault each."""
    rng = np.random.default_rng(0)
    data = collect(cliff, 50, 1000, 0)
    follow = np.array([0.1, 0.1, 0.1, 0.7])
    other = TabularMDP(np.roll(cliff.transition.toarray(), 1, axis=1), cliff.reward)
    made = {
        "true": data,
        "noisy": changed(data, r=data.r + rng.standard_normal(len(data))),
        "fuzz": changed(data, r=data.r * (1 + 1e-9 * rng.standard_normal(len(data)))),
        "single": changed(data, r=data.r.astype(np.float32).astype(np.float64)),
        "policy": changed(data, a_next=rng.choice(4, len(data), p=follow)),
        "dynamics": collect(other, 50, 1000, 0),
        "wind": collect(WindyCliffEnv(wind_strength=0.6).mdp, 500, 1000, 0),
        "rewards": changed(data, r=np.where(data.s == 7, data.r - 0.01, data.r)),
        "behaviour": collect(cliff, 50, 1000, 0, np.tile(follow, (15, 1))),
    }
    directory = tmp_path_factory.mktemp("streams")
    return {name: stream.save(directory / f"{name}.npz") for name, stream in made.items()}


def notes(tmp_path, *overrides, learner=SHORT, capsys=None):
    """The notes of a run; each is in ``result.json``, and where ``capsys`` is given also printed and in the summary."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        result = train(composed(*overrides, *learner), tmp_path)
    assert json.loads((tmp_path / "result.json").read_text())["notes"] == result["notes"]
    if capsys is not None:
        out, err = capsys.readouterr()
        n = len(result["notes"])
        ended = ("", ", with 1 note")[n] if n < 2 else f", with {n} notes"
        assert f": {result['status']}{ended}\n" in out
        for line in result["notes"]:
            assert err.count(f"note: {line}\n") == 1
            assert out.count(f"{'note':18}{line}\n") + out.endswith(f"{'note':18}{line}") == 1
    return result["notes"]


def of_stream(path):
    return ("env=windy_cliff", "experience=recorded", f"experience.path={path}")


def having(lines, *texts):
    """Of the reservations about data, exactly these."""
    found = [line for line in lines if any(text in line for text in OF_DATA)]
    assert len(found) == len(texts), found
    for text in texts:
        assert sum(text in line for line in found) == 1, found
    return found


# -- end to end -----------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("name", ["true", "fuzz", "single"])
def test_a_true_recording_has_no_note(tmp_path, recordings, name):
    assert notes(tmp_path, *of_stream(recordings[name]), learner=("evaluation.pictures=false",)) == []


@pytest.mark.slow
@pytest.mark.parametrize(
    ("learner", "concerned"),
    [
        (("learner=s1", *SHORT), True),
        (("learner=u_learning", "learner.n_epochs=1"), True),
        (("learner=z_learning", "learner.n_epochs=1"), True),
        (("learner=s1_efficient", "learner.mean_reward=false", *SHORT), True),
        (("learner=s1_efficient", *SHORT), False),
        (("learner=differential_soft_q", "learner.n_epochs=1"), False),
        (("learner=certainty_equivalence",), False),
    ],
)
def test_noise_in_rewards(tmp_path, capsys, recordings, learner, concerned):
    found = notes(tmp_path, *of_stream(recordings["noisy"]), learner=learner, capsys=capsys)
    lines = having(found, *[NOISE] * concerned)
    if concerned:  # 10 * 1 / 2, of the noisiest of 60 pairs with hundreds of visits or tens
        size = float(lines[0].split("beta Var/2 = ")[1].split()[0])
        assert 5 < size < 15


def test_noise_beyond_its_expansion_is_bounded_by_the_largest_reward(cliff):
    data = collect(cliff, 50, 1000, 0)
    rare = changed(data, r=data.r + 3.0 * (np.random.default_rng(0).random(len(data)) < 0.1))
    counted = count(rare, 15, 4, False)
    (line,) = erl_torch.empirical.reservations.of_noise(counted, 100.0)
    at = line.text.split("(s=")[1].split(")")[0]
    s, a = map(int, at.split(", a="))
    here = rare.r[(rare.s == s) & (rare.a == a)]
    assert f"about {rare.r.max() - here.mean():.2g} (its largest reward" in line.text


@pytest.mark.parametrize(
    ("stream", "learner", "concerned"),
    [
        ("policy", ("learner=s1", "evaluation.pictures=false"), True),
        ("policy", ("learner=s1_efficient", "learner.expected_backup=false", *SHORT), True),
        ("policy", ("learner=s1_efficient", *SHORT), False),
        ("policy", ("learner=z_learning", "learner.n_epochs=1"), False),
        ("behaviour", ("learner=z_learning", "learner.n_epochs=1"), True),
        ("behaviour", ("learner=s1", *SHORT), False),
        ("behaviour", ("learner=u_learning", "learner.n_epochs=1"), False),
    ],
)
def test_actions_of_another_policy(tmp_path, recordings, stream, learner, concerned):
    found = notes(tmp_path, *of_stream(recordings[stream]), learner=learner)
    having(found, *[FROM_PRIOR] * concerned)


def test_theta_beside_the_proven_one_has_its_note(tmp_path, capsys, cliff):
    """a' of another policy: theta is far from the 1.0101 proven beside it, and the summary says why."""
    data = collect(cliff, 500, 1000, 0)
    greedy = LEARNERS["certainty_equivalence"](beta=10.0).fit(data, 15, 4).policy.numpy()
    cdf = np.cumsum(greedy, axis=1)
    draws = np.random.default_rng(1).random(len(data))
    path = changed(data, a_next=(cdf[data.s_next] < draws[:, None]).sum(1).clip(max=3)).save(tmp_path / "t.npz")
    result = train(composed(*of_stream(path), "evaluation.pictures=false"), tmp_path / "run")
    out = capsys.readouterr().out
    low, high = result["theta_bounds"]
    assert (low, high) == pytest.approx((1.0101363366,) * 2, abs=1e-8)
    assert result["theta"] < 0.99
    assert "completed, with 2 notes\n" in out
    assert sum(FAR_OFF in line for line in result["notes"]) == 1
    having(result["notes"], FROM_PRIOR)


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("dynamics", "transitions are impossible in it, as from s="),
        ("wind", "transition counts are no draws from its rows"),
        ("rewards", "mean rewards of 4 of 58 pairs are others, as -1.01 for -1 at s=7, a=0"),
    ],
)
def test_data_of_another_model(tmp_path, capsys, recordings, name, says):
    (line,) = having(notes(tmp_path, *of_stream(recordings[name]), capsys=capsys), MODEL)
    assert says in line
    assert "What is proven is of the model alone" in line
    if name == "rewards":
        many = notes(tmp_path / "many", *of_stream(recordings[name]), "++vary.beta=[5,10]", capsys=capsys)
        assert having(many, MODEL)[0] == f"2 of 2 replicas: {line}"


def test_impossible_transitions_are_counted(recordings, cliff):
    data = Transitions.load(recordings["dynamics"])
    p = cliff.transition.toarray().reshape(15, 4, 15)
    impossible = int((p[data.s, data.a, data.s_next] == 0).sum())
    (found,) = of_model(count(data, 15, 4, False), cliff)
    assert f"{impossible:,} of 50,000 transitions" in found.text
    s, a, s_next = (int(found.text.split(key)[1].split()[0].strip(",")) for key in ("from s=", "a=", "to s'="))
    assert p[s, a, s_next] == 0
    assert f"({((data.s == s) & (data.a == a) & (data.s_next == s_next)).sum():,} times)" in found.text


def test_mean_rewards_that_differ_among_noise(cliff):
    """By half a standard deviation at one state; and the same noise about the model's own means says nothing."""
    data = collect(cliff, 200, 1000, 1)
    noise = 0.2 * np.random.default_rng(2).standard_normal(len(data))
    assert of_model(count(changed(data, r=data.r + noise), 15, 4, False), cliff) == []
    often = np.bincount(data.s).argmax()
    (found,) = of_model(count(changed(data, r=data.r + noise + 0.5 * (data.s == often)), 15, 4, False), cliff)
    assert f"at s={often}, a=" in found.text


def test_equal_rewards(tmp_path, capsys):
    """CartPole-v1 pays 1 a step, whatever is done."""
    bins = ("env.bins=[3,3,6,6]", "env.low=[-2.4,-3,-0.21,-3]", "env.high=[2.4,3,0.21,3]")
    few = ("experience.n_episodes=20", "learner=s1_efficient")
    arguments = ("env=gym", "env.id=CartPole-v1", *bins, *few)
    having(notes(tmp_path / "one", *arguments, capsys=capsys), EQUAL + " 1:")
    (line,) = having(notes(tmp_path / "many", *arguments, "n_replicas=2", capsys=capsys), EQUAL + " 1:")
    assert line.startswith("2 of 2 replicas: ")


def test_equal_rewards_of_a_simulated_model(tmp_path, cliff):
    TabularMDP(cliff.transition, np.full((15, 4), -2.0)).save(tmp_path / "mdp.npz")
    arguments = ("env=mdp", f"env.path={tmp_path}/mdp.npz", "experience.n_episodes=3", "learner.lr_u=0.001")
    one = having(notes(tmp_path / "one", *arguments), EQUAL + " -2:")
    many = having(notes(tmp_path / "many", *arguments, "n_replicas=3"), EQUAL + " -2:")
    assert many == [f"3 of 3 replicas: {line}" for line in one]


def test_a_policy_worse_than_the_prior(tmp_path, capsys):
    """Steps of .6 on few tuples; the same seeds alone say the same, and only those that are worse are counted."""
    arguments = ("experience.n_episodes=2", "learner.lr_u=0.6", "learner.lr_rho=0.001")
    alone = [notes(tmp_path / str(seed), *arguments, f"seed={seed}") for seed in range(3)]
    many = notes(tmp_path / "many", *arguments, "n_replicas=3", capsys=capsys)
    worse = [line for lines in alone for line in lines if WORSE in line]
    assert worse, alone
    (line,) = [line for line in many if WORSE in line]
    assert line.startswith(f"{len(worse)} of 3 replicas: {worse[0]}")


def test_replicas_that_left_the_numbers(tmp_path, capsys):
    few = ("experience.n_episodes=5", "n_replicas=2", "++vary.beta=[10,600]")
    with pytest.raises(NonFiniteError):
        train(composed(*few, *SHORT), tmp_path)
    out, err = capsys.readouterr()
    (line,) = [line for line in json.loads((tmp_path / "result.json").read_text())["notes"] if "non_finite" in line]
    assert line.startswith("2 of 4 replicas: non_finite: ")
    assert f"note: {line}" in err
    assert "non_finite, with " in out


def test_what_was_a_note_already_is_kept(tmp_path):
    few = ("experience.n_episodes=2", "evaluation.exact_up_to=1", "evaluation.n_episodes=2")
    found = notes(tmp_path / "a", "env=frozen_lake", *few)
    assert any("the reward depends on s'" in line for line in found)
    assert any("a large model (evaluation.exact_up_to)" in line for line in found)
    again = notes(tmp_path / "b", "env=frozen_lake", *few, "n_replicas=2")
    assert any("a large model" in line for line in again)


# -- a theta that is wrong ---------------------------------------------------------------------------------


def test_rewards_bound_theta_whatever_the_dynamics():
    """theta* of random models is never spoken of, a step outside always."""
    rng = np.random.default_rng(1)
    for _ in range(20):
        mdp = random_mdp(rng, rng.integers(1, 6), rng.integers(1, 4))
        prior = 0.99 * random_policy(rng, mdp.n_states, mdp.n_actions) + 0.01 / mdp.n_actions
        theta = solve_soft_bellman(mdp, 10 ** rng.uniform(-2, 3), prior).theta
        rewards = (mdp.reward.min(), mdp.reward.max())
        assert of_theta(theta, rewards) == []
        for wrong in (-rewards[1] - 1e-3, -rewards[0] + 1e-3):
            (found,) = of_theta(wrong, rewards)
            assert OUT_OF_RANGE in found.text
    assert of_theta(None, (0.0, 1.0)) == of_theta(math.nan, (0.0, 1.0)) == []
    assert of_theta(-1.0, (1.0, 1.0)) == []


def test_theta_far_from_the_data_is_counted_in_half_widths():
    """Of an interval value -+ 1.96 se."""
    estimate, half = Estimate("theta", 1.0, 0.01), 1.959964 * 0.01
    for k in (0.0, 0.9, -3.0, 30.0):
        assert half_widths(1 + k * half, estimate) == pytest.approx(abs(k), rel=1e-5, abs=1e-9)
    rewards = (-2.0, 0.0)
    assert of_theta(1 + 0.99 * FAR_HALF_WIDTHS * half, rewards, estimate) == []
    for sign in (1, -1):
        (found,) = of_theta(1 + sign * 1.01 * FAR_HALF_WIDTHS * half, rewards, estimate)
        assert f"is {1.01 * FAR_HALF_WIDTHS:.3g} {FAR_OFF}, theta = 1.000 +- 0.020" in found.text
    # Of data that the proof contradicts, the learnt theta on its side or on theirs, nothing closer is advised.
    for proven, wrong in (((0.5, 0.5), True), ((0.9, 0.95), False), ((1.5, 1.6), True), ((-np.inf, np.inf), False)):
        (found,) = of_theta(1 - 1.01 * FAR_HALF_WIDTHS * half, rewards, estimate, proven)
        assert (ADVICE in found.text) is not wrong
        assert (CONTRADICTED in found.text) is wrong
    withheld = Estimate("theta", 1.0, 0.01, withheld="of few events")
    assert of_theta(1.9, rewards, withheld) == []
    assert math.isnan(half_widths(1.9, withheld))


@pytest.mark.slow
def test_published_s1_at_a_high_temperature_is_far_off_and_says_so(tmp_path, capsys):
    """Beta 2: its constant steps end tens of half widths from the data; each replica says what its run alone says."""
    full = ("learner.beta=2", "evaluation.pictures=false")
    alone = notes(tmp_path / "one", learner=full, capsys=capsys)
    (line,) = [line for line in alone if FAR_OFF in line]
    theta, away, value, half = (
        line.split(before)[1].split()[0].strip(",") for before in ("theta ", " is ", "theta = ", "+- ")
    )
    unit = 10.0 ** -len(half.partition(".")[2])  # half is rounded up
    theta, away, value, half = map(float, (theta, away, value, half))
    assert abs(theta - value) / half <= 1.01 * away
    assert abs(theta - value) / (half - unit) >= 0.99 * away
    assert away > FAR_HALF_WIDTHS
    result = json.loads((tmp_path / "one" / "result.json").read_text())
    assert result["data_half_widths"] == pytest.approx(away, rel=0.01)
    many = notes(tmp_path / "many", "n_replicas=2", learner=full)
    assert any(said.endswith(f"{line} (so replica 0)") or said == f"1 of 2 replicas: {line}" for said in many)


@pytest.mark.parametrize("learner", ["s1", "s1_efficient", "certainty_equivalence"])
def test_binned_cart_pole_is_no_success_unless_theta_is_right(tmp_path, capsys, learner):
    """It pays 1 a step: theta* = -1. Hundreds of pairs are seen once or twice."""
    bins = (
        "env.bins=[6,6,12,12]",
        "env.low=[-2.4,-3,-0.21,-3]",
        "env.high=[2.4,3,0.21,3]",
        "evaluation.pictures=false",
    )
    arguments = ("env=gym", "env.id=CartPole-v1", *bins, "experience.n_episodes=20", "evaluation.n_episodes=2")
    found = notes(tmp_path, *arguments, f"learner={learner}", learner=("learner.beta=1",), capsys=capsys)
    result = json.loads((tmp_path / "result.json").read_text())
    assert abs(result["theta"] + 1) > 0.1
    (line,) = [line for line in found if OUT_OF_RANGE in line]
    assert f"theta {result['theta']:.6g} is wrong" in line
    assert "[-1, -1]" in line
    assert result["data"]  # the figure, or why there is none


def test_why_the_data_say_nothing(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("erl_torch.run.judge.SMALL", 14)
    result = train(composed("experience.n_episodes=20", *SHORT), tmp_path)
    out = capsys.readouterr().out
    assert result["data"] == "nothing: the stream meets 15 states, and more than 14 are not solved beside a run"
    assert f"{'the data say':18}{result['data']}\n" in out


# -- no false alarms ------------------------------------------------------------------------------------

BUILT_IN = (
    "cart_pole", "cliff_walking", "dynamics_shift", "mountain_car", "pendulum", "taxi", "windy_cliff",
    "windy_frozen_lake", "windy_maze",
)  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("env", BUILT_IN)
def test_built_in_environments(tmp_path, env):
    """Their data have no reservation but for states never met, where there are. (Two passes may well end worse than the
    prior, or at a wrong theta; FrozenLake's rewards depend on s', and Acrobot's model is too large for exact figures:
    notes that are right.)"""
    small = ["env.n_samples=2"] * (env in ("cart_pole", "mountain_car", "pendulum"))
    found = notes(tmp_path, f"env={env}", "experience.n_episodes=10", "evaluation.n_episodes=2", *small)
    of_two_passes = (WORSE, OUT_OF_RANGE, FAR_OFF, UNMET, "in which nothing is left to chance")
    assert [line for line in found if not any(text in line for text in of_two_passes)] == []


def test_hundreds_of_true_streams():
    """Short and long streams of random models and policies, against the model and the prior: none is spoken of."""
    rng = np.random.default_rng(0)
    for seed in range(300):
        n_states, n_actions = rng.integers(2, 8), rng.integers(2, 5)
        mdp = random_mdp(rng, n_states, n_actions)
        prior = 0.99 * random_policy(rng, n_states, n_actions) + 0.01 / n_actions
        data = collect(mdp, 1, int(10 ** rng.uniform(0.5, 3.5)), seed, prior_policy=prior)
        counted = count(data, n_states, n_actions, True)
        assert of_model(counted, mdp) == []
        assert of_actions(counted.next_actions, prior, "a'") == []
        assert of_actions(counted.model.visits, prior, "a") == []


# -- the bound ------------------------------------------------------------------------------------------


def compositions(n, k):
    return (c for c in itertools.product(range(n + 1), repeat=k) if sum(c) == n)


@pytest.mark.parametrize("p", [(0.5, 0.5), (0.9, 0.1), (0.999, 0.001), (0.2, 0.3, 0.5), (0.98, 0.01, 0.01)])
@pytest.mark.parametrize("n", [1, 3, 8])
def test_bound_on_the_divergence(p, n):
    """Agrawal's bound on the moments of n KL, behind the level, by summing over every outcome."""
    for x in (0.3, 0.7, 0.95):
        moment = 0.0
        for c in compositions(n, len(p)):
            chance = math.factorial(n) * math.prod(q**m / math.factorial(m) for q, m in zip(p, c, strict=True))
            total = sum(m * math.log(m / (n * q)) for q, m in zip(p, c, strict=True) if m)
            moment += chance * math.exp(x * total)
        assert moment <= (1 - x) ** -(len(p) - 1) * (1 + 1e-12)


def test_divergence_pools_small_cells_of_a_row():
    p = np.array([0.5, 0.5, 0.98, 0.01, 0.01])
    row = np.array([0, 0, 1, 1, 1])
    counts = np.array([30, 10, 45, 5, 0])
    total, freedom = divergence(counts, row, p, 2)
    by_hand = 30 * np.log(30 / 20) + 10 * np.log(10 / 20) + 45 * np.log(45 / 49) + 5 * np.log(5 / 1)
    assert total == pytest.approx(by_hand, rel=1e-12)
    assert freedom == 2
    assert divergence(np.array([1, 0]), row[:2], p[:2], 1) == (0.0, 0)  # all pooled: too few to tell


def test_level():
    """For 1 degree of freedom, e D exp(-D) = 1e-9 at D = 24.9..."""
    below, above = 24.0, 25.0
    assert math.e * below * math.exp(-below) > 1e-9 > math.e * above * math.exp(-above)
    assert not is_unlikely(below, 1)
    assert is_unlikely(above, 1)
    assert not is_unlikely(0.5, 1)
    assert not is_unlikely(1e-15, 0)


def test_actions_in_states_that_are_met_a_few_times_count_together():
    """300 states, 8 draws each, never the second action: no row tells alone, all of them do."""
    prior = np.full((300, 2), 0.5)
    assert of_actions(np.tile([8, 0], (1, 1)), prior[:1], "a'") == []
    assert len(of_actions(np.tile([8, 0], (300, 1)), prior, "a'")) == 1


# -- words --------------------------------------------------------------------------------------------------


def test_declarations():
    asks = {name: (one.averages_exp_reward, one.drawn_from_prior) for name, one in
            ((n, c()) for n, c in LEARNERS.items() if n != "exact")}  # fmt: skip
    assert {name for name, (exp, _) in asks.items() if exp} == {"s1", "s1_listing", "u_learning", "z_learning"}
    drawn = {name: column for name, (_, column) in asks.items() if column}
    assert drawn == {"s1": "a_next", "s1_listing": "a_next", "z_learning": "a"}
    assert EfficientS1.published().averages_exp_reward
    assert EfficientS1.published().drawn_from_prior == "a_next"


def test_outcome():
    assert of_outcome(Status.COMPLETED, "", -1.0, -1.6) == []
    assert of_outcome(Status.CONVERGED, "", -1.6, -1.6) == []
    assert of_outcome(Status.COMPLETED, "", float("nan"), float("nan")) == []
    ended, worse = of_outcome(Status.PSI_LIMIT, "said so", -2.0, -1.6)
    assert ended.text.startswith("psi_limit: ")
    assert "(said so)" in ended.text
    assert WORSE in worse.text


def test_replicas_say_each_kind_once():
    same, differs = Reservation("x", "x"), [Reservation("y", "y 1"), Reservation("y", "y 2")]
    assert of_replicas([[], []]) == []
    assert of_replicas([[same], [same, differs[0]], [differs[1]]]) == [
        "2 of 3 replicas: x",
        "2 of 3 replicas: y 1 (so replica 1)",
    ]


def test_notes_are_warnings_of_their_own_class():
    with pytest.warns(erl_torch.Note, match="^two lines$"):
        note("two\n  lines")
    with collected() as found:
        note("a")
        note("b")
        note("a")
    assert found == ["a", "b"]


def test_a_note_is_of_the_line_that_called_the_package():
    rows = np.array([[[0.5, 0.5 + 1e-7]], [[0.5, 0.5]]])
    with pytest.warns(erl_torch.Note, match="^rows of transition did not sum") as seen:
        TabularMDP(rows, np.zeros((2, 1)))
    assert [found.filename for found in seen] == [__file__]
    with pytest.warns(erl_torch.Note, match="^start did not sum") as seen:
        TabularMDP(rows.round(3), np.zeros((2, 1)), np.array([0.5, 0.5 + 1e-7]))
    assert len(seen) == 1


def test_states_never_met_are_counted():
    """0 -> 1 -> 0; action 1 leads from 1 to 2 and on to 3, which the stream has not found. 4 is out of reach."""
    p = np.zeros((5, 2, 5))
    for s, to in enumerate([(1, 1), (0, 2), (3, 3), (0, 0), (0, 0)]):
        p[s, [0, 1], to] = 1.0
    mdp = TabularMDP(p, np.zeros((5, 2)), np.eye(5)[0])
    s, a = np.array([0, 1] * 4), np.zeros(8, int)
    (found,) = of_states(count(Transitions(s, a, 0.0 * s, 1 - s, a), 5, 2, False).tally, mdp)
    assert found.kind == "states never met"
    assert "meets 2 of the 4 states" in found.text
    s, a, to = np.array([0, 1, 2, 3] * 3), np.array([0, 1, 0, 0] * 3), np.array([1, 2, 3, 0] * 3)
    assert not of_states(count(Transitions(s, a, 0.0 * s, to, a), 5, 2, False).tally, mdp)


@pytest.mark.parametrize(("theta", "said"), [(-0.5, False), (-0.499, False), (-0.3, True), (-0.6, True)])
def test_theta_of_data_without_chance(theta, said):
    """0 and 1 follow each other; 1 pays 1: theta = -1/2."""
    s, a = np.array([0, 1] * 4), np.zeros(8, int)
    estimate = theta_uncertainty(empirical_mdp(Transitions(s, a, 1.0 * s, 1 - s, a), 2, 1), 1.0)
    assert estimate.withheld
    assert bool(of_theta(theta, (0.0, 1.0), estimate)) is said


def test_half_widths_count_from_the_middle_of_a_lopsided_interval():
    estimate = Estimate("theta", 1.0, 1.0, limits=lambda _: (0.0, 10.0))
    assert [half_widths(theta, estimate) for theta in (0.0, 5.0, 10.0, -5.0)] == pytest.approx([1, 0, 1, 2])


def test_theta_within_the_interval_at_the_level_of_notes_is_not_far():
    """20 half widths off: of Student's distribution with one degree of freedom chance enough, of a normal one not."""
    for freedom, found in ((1.0, 0), (np.inf, 1)):
        estimate = Estimate("theta", 0.0, 1.0, freedom=freedom)
        _, half = estimate.interval()
        assert len(of_theta(20 * half, (-1e3, 1e3), estimate)) == found


def test_theta_out_of_range_by_rounding_is_not_out_of_range():
    assert of_theta(1 + 1e-8, (-1.0, 0.0)) == of_theta(-1e-8, (-1.0, 0.0)) == []
    assert [found.kind for found in of_theta(1.01, (-1.0, 0.0))] == ["theta out of range"]


def test_data_without_a_state_that_theirs_lead_to_are_not_of_the_models_theta():
    """0 leads to 1 in one of ten steps, which five tuples do not show."""
    mdp = TabularMDP(np.array([[[0.9, 0.1]], [[1.0, 0.0]]]), np.zeros((2, 1)))
    zero = np.zeros(5, int)
    short = Transitions(zero, zero, np.zeros(5), zero, zero)
    back = Transitions(np.append(zero, 1), np.zeros(6, int), np.zeros(6), np.zeros(6, int), np.zeros(6, int))
    assert not _covered(tally(short, 2, 1), mdp)
    assert _covered(tally(back, 2, 1), mdp)


def test_each_replica_of_a_seed_is_held_against_the_data_at_its_own_beta():
    """The optimum of the counts by value iteration, at each beta."""
    rng = np.random.default_rng(0)
    mdp, prior = random_mdp(rng, 3, 2), np.full((3, 2), 0.5)
    experience, betas = erl_torch.Simulation(mdp, 5, 200, [7, 7, 8]), (0.5, 5.0, 5.0)
    _, held = reservations_of(experience, [EfficientS1(beta) for beta in betas], prior, None, True, lambda: None)
    for r, beta in enumerate(betas):
        p, reward, _ = oracle.counted(experience.stream(r, prior), 3, 2)
        best, _ = oracle.soft_optimum(p, reward, prior, beta)
        assert held[r].estimate.value + held[r].estimate.bias == pytest.approx(-best, abs=1e-8)


def test_actions_never_tried_cost_their_share_of_the_prior():
    """One state, three actions of which one was tried, r = 1: theta of the data is -1 + log(3)/beta, and not wrong."""
    n = 10
    data = Transitions([0] * n, [0] * n, [1.0] * n, [0] * n, [0] * n)
    seen = reservations.count(data, 1, 3, False).tally
    prior = np.full((1, 3), 1 / 3)
    learnt = CertaintyEquivalence(2.0).fit(data, 1, 3).theta
    assert learnt == pytest.approx(-1 + np.log(3) / 2)
    assert reservations.lacks_actions(seen, prior)
    assert not reservations.lacks_actions(seen, np.array([[1.0, 0.0, 0.0]]))
    for lacking in (True, False):
        (found,) = reservations.of_theta(learnt, seen.reward_range, lacking=lacking)
        assert ("never tried cost it" in found.text) == lacking
