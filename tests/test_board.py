"""What TensorBoard shows: every tag documented, lines and boards, and its own API over real runs."""

import json
import re
import sys
import urllib.request

import numpy as np
import pytest
from helpers import PATIENCE, ROOT, composed, events, undocumented, wait_until
from omegaconf import OmegaConf
from tensorboard.plugins.custom_scalar import layout_pb2
from tensorboard.plugins.hparams import plugin_data_pb2

from erl_torch import InputError, NonFiniteError, collect, solve_soft_bellman
from erl_torch.envs.windy_cliff import WindyCliffEnv
from erl_torch.log import tensorboard as board
from erl_torch.log.quantities import BIAS, CONVERGENCE, QUANTITIES, RETURNS, Quantity, with_own
from erl_torch.run.origin import shown
from erl_torch.run.training import train
from erl_torch.solvers import certify

pytestmark = pytest.mark.slow  # whole runs
SMALL = ("experience.n_episodes=20", "learner.n_epochs=2")


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """A directory with a run of every kind, and what train returned of each."""
    root = tmp_path_factory.mktemp("runs")
    hydra = root / "s1" / ".hydra"
    hydra.mkdir(parents=True)
    (hydra / "overrides.yaml").write_text("- env=windy_cliff\n- ++vary.beta=[1, 2]\n")
    kinds = {
        "s1": SMALL,
        "efficient": ("learner=s1_efficient", "experience.n_episodes=20", "evaluation.pictures=false"),
        "soft_q": ("learner=soft_q", *SMALL, "evaluation.pictures=false"),
        "exact": ("learner=exact", "evaluation.pictures=false"),
        "replicas": (*SMALL, "n_replicas=3"),
    }
    return root, {name: train(composed(*overrides), root / name) for name, overrides in kinds.items()}


def test_no_tag_is_undocumented(runs):
    root, kinds = runs
    assert {name: undocumented(root / name) for name in kinds} == {name: set() for name in kinds}


@pytest.mark.parametrize("name", ["s1", "efficient", "soft_q"])
def test_lines_stand_beside_every_record(runs, name):
    """The cliff's closed figures: theta* = 1.0101363366 at beta 10, and the prior's reward a step."""
    root, kinds = runs
    reader = events(root / name)
    steps = [e.step for e in reader.Scalars("eval/objective")]
    best = solve_soft_bellman(WindyCliffEnv().mdp, 10.0)
    for tag, value in [
        ("optimal/theta", 1.0101363366),
        ("optimal/theta_lower", best.theta_bounds[0]),
        ("optimal/theta_upper", best.theta_bounds[1]),
        ("optimal/objective", -1.0101363366),
        ("optimal/reward_per_step", -0.95593),
        ("optimal/return", -955.93),
        ("optimal/delta_max", best.reward_bias_max),
        ("optimal/rho", best.rho),
        ("prior/reward_per_step", -1.6263453),
        ("prior/return", reader.Scalars("eval/return")[0].value),
    ]:
        found = reader.Scalars(tag)
        assert [e.step for e in found] == steps
        assert [e.value for e in found] == pytest.approx([value] * len(steps), rel=1e-5)
    for final in ("theta", "objective", "return", "reward_per_step", "gap"):
        if kinds[name][final] is not None:
            (event,) = reader.Scalars(f"Final/{final}")
            assert (event.step, event.value) == (steps[-1], pytest.approx(kinds[name][final], rel=1e-6, abs=1e-12))


def test_constants_are_runs_of_their_own(runs):
    """A chart has one colour and one name per run: those below a run's directory hold, under the tags of what is
    learnt, what it is held against."""
    reader = events(runs[0] / "efficient")
    steps = {e.step for e in reader.Scalars("learner/theta")}
    expected = {
        ("optimum", "learner/theta"): 1.0101363366,
        ("optimum", "eval/objective"): -1.0101363366,
        ("prior", "eval/reward_per_step"): -1.6263453,
        ("data_95_low", "learner/theta"): reader.Scalars("data/theta_lower")[0].value,
        ("data_95_high", "learner/theta"): reader.Scalars("data/theta_upper")[0].value,
    }
    for (run, tag), value in expected.items():
        found = events(runs[0] / "efficient" / run).Scalars(tag)
        assert {e.step for e in found} == steps
        assert [e.value for e in found] == pytest.approx([value] * len(found), rel=1e-6)
    assert {path.name for path in (runs[0] / "efficient").iterdir() if path.is_dir()} == {run for run, _ in expected}


def test_jobs_of_a_sweep_have_no_runs_below_theirs(tmp_path):
    (tmp_path / "sweep.json").write_text("{}")
    train(composed(*SMALL, "learner=s1_efficient", "evaluation.pictures=false"), tmp_path / "0")
    assert not [path for path in (tmp_path / "0").iterdir() if path.is_dir()]
    tags = set(events(tmp_path / "0").Tags()["scalars"])
    layout = layout_pb2.Layout.FromString(events(tmp_path / "0").Tensors("custom_scalars__config__")[0]
                                          .tensor_proto.string_val[0])  # fmt: skip
    lines = [tag for one in layout.category for chart in one.chart for tag in chart.multiline.tag]
    assert "optimal/theta$" in lines
    assert "optimal/theta" in tags


def test_lines_of_the_exact_learner(runs):
    reader = events(runs[0] / "exact")
    last = reader.Scalars("eval/objective")[-1]
    found = reader.Scalars("optimal/objective")
    assert [e.step for e in found] == [0, last.step]
    assert [e.value for e in found] == pytest.approx([last.value] * 2, rel=1e-6)


def test_certificate_of_a_known_optimum():
    mdp = WindyCliffEnv().mdp
    best, other = solve_soft_bellman(mdp, 10.0), solve_soft_bellman(mdp, 5.0)
    one, two = certify(other, mdp, 10.0), certify(other, mdp, 10.0, best=best)
    assert (one.gap, one.theta_bounds) == (two.gap, two.theta_bounds)


def test_charts_are_those_that_have_data():
    known = {"data/theta", "data/theta_lower", "data/theta_upper"}
    charts = board.layout(["learner/theta", "eval/objective"], known)
    assert [list(charts[title]) for title in (CONVERGENCE, BIAS, RETURNS)] == [
        ["theta; theta* of the model, ends of the data's 95%", "learner/theta in its bands: proven, data's 95%"],
        [],
        ["objective; optimal, prior"],
    ]
    assert charts[CONVERGENCE]["learner/theta in its bands: proven, data's 95%"] == [
        ("learner/theta",) * 3,
        ("data/theta", "data/theta_lower", "data/theta_upper"),
    ]
    assert len(board.layout(["learner/theta"], [])[CONVERGENCE]) == 1  # no band is known
    alone = board.layout(["learner/theta", "eval/objective"], known, alone=True)
    assert alone[CONVERGENCE] == {"theta": [r"(learner|s1|exact)/theta$"]}
    assert alone[RETURNS] == {"objective": ["eval/objective$"]}


def test_bands_have_their_lower_end_below():
    """Of a run and of replicas, as TensorBoard's own message has them."""
    one = board.layout(["learner/theta"], ["optimal/theta", "optimal/theta_lower", "data/theta", "data/theta_lower"])
    many = board.replica_layout({"all": ["theta"]}, ["theta"])
    ends = {
        (series.value, series.lower, series.upper)
        for boards in (one, many)
        for category in board._layout(boards).category
        for chart in category.chart
        for series in chart.margin.series
    }
    assert ends >= {
        ("optimal/theta", "optimal/theta_lower", "optimal/theta_upper"),
        ("data/theta", "data/theta_lower", "data/theta_upper"),
        ("all/theta_mean", "all/theta_q25", "all/theta_q75"),
        ("all/theta_median", "all/theta_min", "all/theta_max"),
    }


def test_charts_show_runs_of_before_too():
    """Their tags begin with s1/ and exact/."""
    patterns = [pattern for titles in board.charts().values() for chart in titles.values() for pattern in chart]
    for tag in ("learner/theta", "s1/theta", "exact/theta", "s1/psi_error", "learner/q_max", "exact/kl_max"):
        assert sum(bool(re.match(pattern, tag)) for pattern in patterns) == 1, tag


def test_every_quantity_has_its_own_name_and_tags():
    names = [quantity.name for quantity in QUANTITIES]
    tags = [tag for quantity in QUANTITIES for tag in quantity.tags]
    assert len(set(names)) == len(names)
    assert len(set(tags)) == len(tags)
    assert all(quantity.unit and quantity.meaning for quantity in QUANTITIES)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (lambda: Quantity("a b", "1", ""), "quantities='?a b"),
        (lambda: Quantity("a", "1", "", prefixes=("mine",)), "quantities.a='?mine"),
        (lambda: with_own((Quantity("theta", "1", ""),)), "quantities='?theta"),
        (lambda: with_own((Quantity("epoch", "1", ""),)), "quantities='?epoch"),
        (lambda: with_own((Quantity("a", "1", ""),) * 2), "quantities='?a"),
    ],
)
def test_wrong_quantities_are_refused(wrong, message):
    with pytest.raises(InputError, match=message):
        wrong()


def test_a_metric_of_your_own(tmp_path, monkeypatch):
    """The example of docs/logging.md, trained alone and as replicas, counts pairs as the tuples themselves do."""
    page = (ROOT / "docs" / "logging.md").read_text()
    example = page.partition("## A metric of your own")[2].partition("```python\n")[2].partition("```")[0]
    (tmp_path / "counting.py").write_text(example)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "counting", raising=False)
    overrides = ("learner=rvi_soft_q", "learner.class=counting.CountingSoftQ")
    overrides += ("experience.n_episodes=2", "experience.episode_length=20", "learner.n_epochs=2")
    overrides += ("evaluation.pictures=false", "checkpoint_every=0")
    tuples = [collect(WindyCliffEnv().mdp, 2, 20, seed) for seed in (0, 1)]
    left = [60 - len({*zip(data.s.tolist(), data.a.tolist(), strict=True)}) for data in tuples]

    train(composed(*overrides), tmp_path / "one")
    one = events(tmp_path / "one")
    assert [event.value for event in one.Scalars("learner/never_tried")] == [60, left[0], left[0]]
    train(composed(*overrides, "n_replicas=2"), tmp_path / "two")
    two = events(tmp_path / "two")
    assert [event.value for event in two.Scalars("replicas/never_tried_min")] == [min(left)] * 2
    assert [event.value for event in two.Scalars("replicas/never_tried_max")] == [max(left)] * 2
    for reader, title in ((one, "never tried, pairs"), (two, "replicas: never_tried")):
        (event,) = reader.Tensors("custom_scalars__config__")
        boards = layout_pb2.Layout.FromString(event.tensor_proto.string_val[0])
        assert title in {chart.title for category in boards.category for chart in category.chart}


def settings(*overrides):
    """A configuration as plain containers."""
    return OmegaConf.to_container(composed(*overrides), resolve=True)


def test_hyperparameters_are_numbers_and_text():
    found = board.hyperparameters(settings("env=frozen_lake"), n_replicas=3, vary=[1, 2])
    assert found["learner"] == "s1"
    assert found["clip_rho"] == "true"
    assert found["n_replicas"] == 3
    assert found["vary"] == "[1, 2]"
    assert board.hyperparameters(settings("env=windy_frozen_lake", "env.desc=[SFG]"))["env.desc"] == '["SFG"]'
    assert found["env.on_end"] == "restart"
    assert not {"lr_rho", "env.suggest", "env.id", "name"} & set(found)  # lr_rho: null


def test_only_settings_that_tell_runs_apart_are_shown(tmp_path):
    """Of a run those that were typed, of a job those that its sweep varies."""
    run = tmp_path / "sweep" / "1"
    (run / ".hydra").mkdir(parents=True)
    typed = ["env=windy_cliff", "learner.beta=5", "+env.size=3", "evaluation.every=2"]
    (run / ".hydra" / "overrides.yaml").write_text("".join(f"- {one}\n" for one in typed))
    cfg = settings("learner.beta=5", "evaluation.every=2")
    found = board.hyperparameters(cfg, shown(run), n_experience=7)
    always = {"env": "windy_cliff", "learner": "s1", "beta": 5, "seed": 0, "n_experience": 7}
    assert found == always | {"evaluation.every": 2}
    jobs = [{"overrides": ["learner.beta=2", *typed[2:]]}, {"overrides": typed[1:]}]
    (tmp_path / "sweep" / "sweep.json").write_text(json.dumps({"jobs": jobs}))
    typed = typed[1:]
    (run / ".hydra" / "overrides.yaml").write_text("".join(f"- {one}\n" for one in typed))
    assert board.hyperparameters(cfg, shown(run), n_experience=7) == {"beta": 5}
    assert shown(tmp_path) is None  # nothing is noted: a run from Python


def test_texts(runs):
    reader = events(runs[0] / "s1")
    configuration, command = (
        reader.Tensors(f"{tag}/text_summary")[0].tensor_proto.string_val[0].decode()
        for tag in ("configuration", "command")
    )
    written = OmegaConf.create(configuration.removeprefix("```yaml\n").removesuffix("```"))
    assert written.learner.beta == 10  # resolved
    assert command == "```\npython train.py env=windy_cliff '++vary.beta=[1, 2]'\n```"
    assert "command/text_summary" not in events(runs[0] / "exact").summary_metadata


def test_failed_runs_are_marked(tmp_path):
    with pytest.raises(NonFiniteError):
        train(composed(*SMALL, "learner.beta=300", "learner.lr_u=0.9", "evaluation.pictures=false"), tmp_path)
    plugin = events(tmp_path).summary_metadata["_hparams_/session_end_info"].plugin_data
    assert plugin_data_pb2.HParamsPluginData.FromString(plugin.content).session_end_info.status == 2  # failure


# -- TensorBoard's own API -----------------------------------------------------------------------------------


@pytest.fixture
def tensorboard(tmp_path, start):
    """``tensorboard(logdir, n_runs)``: asks the API of one, on a port of its choice, once it has read so many runs."""

    def serve(logdir, n_runs):
        arguments = ["--logdir", logdir, "--host", "127.0.0.1", "--port", 0, "--load_fast", "false"]
        printed = tmp_path / "printed"
        with printed.open("w") as log:
            command = [sys.executable, "-W", "ignore", "-m", "tensorboard.main", *arguments]
            process = start(*command, stdout=log, stderr=log)

        def address():
            assert process.poll() is None, printed.read_text()
            return re.search(r"http://127\.0\.0\.1:\d+", printed.read_text())

        def ask(path, body=None):
            data = None if body is None else json.dumps(body).encode()
            headers = {"Content-Type": "application/json"}
            request = urllib.request.Request(f"{address()[0]}/data/{path}", data, headers)
            with urllib.request.urlopen(request, timeout=PATIENCE) as answer:
                return json.load(answer)

        wait_until(address, "TensorBoard")
        wait_until(lambda: len(ask("runs")) == n_runs, "its reading")
        return ask

    return serve


def test_api_has_tags_boards_and_columns(runs, tensorboard):
    root, kinds = runs
    directories = {path.parent for path in root.rglob("*tfevents*")}  # those of constants, too
    ask = tensorboard(root, len(directories))
    tags = {str(path.relative_to(root)): set(events(path).Tags()["scalars"]) for path in directories}

    def read():
        return {run: set(found) for run, found in ask("plugin/scalars/tags").items()}

    wait_until(lambda: read() == tags, "all tags")  # it knows of a run before it has read it to the end
    last = ask("plugin/scalars/scalars?run=s1&tag=learner/theta")[-1]
    assert last[1:] == [kinds["s1"]["n_tuples"], pytest.approx(kinds["s1"]["theta"], rel=1e-6)]

    boards = {category["title"]: category["chart"] for category in ask("plugin/custom_scalars/layout")["category"]}
    assert list(boards) == [CONVERGENCE, BIAS, RETURNS]
    titles = {chart["title"] for charts in boards.values() for chart in charts}
    missing = {title for charts in board.charts(alone=True).values() for title in charts} - titles
    # Of environments whose episodes end, and of learners at another optimism than 0.
    assert missing <= {"success rate", "objective in the real world"}
    written = set().union(*tags.values())
    for chart in (chart for charts in boards.values() for chart in charts):
        for band in chart.get("margin", {}).get("series", []):
            assert set(band.values()) <= written
        for pattern in chart.get("multiline", {}).get("tag", []):
            assert any(re.match(pattern, tag) for tag in written), pattern

    found = ask("plugin/hparams/experiment", {"includeMetrics": True})
    columns = {column["name"] for column in found["hparamInfos"]}
    union = set().union(*(board.hyperparameters(settings(*o)) for o in ((), ("learner=s1_efficient",))))
    assert union | {"discount", "method", "n_replicas", "n_experience"} <= columns
    metrics = [metric["name"]["tag"] for metric in found["metricInfos"]]
    first = ["Final/gap", "Final/objective", "Final/return", "Final/reward_per_step", "Final/theta"]
    assert metrics[:5] == first  # those that its table shows at first
    rows = ask(
        "plugin/hparams/session_groups",
        {
            "startIndex": 0, "sliceSize": 100, "allowedStatuses": ["STATUS_SUCCESS"],
            "colParams": [{"metric": {"tag": tag}} for tag in first] + [{"hparam": "learner"}],
        },
    )["sessionGroups"]  # fmt: skip
    assert {row["sessions"][0]["name"]: row["hparams"]["learner"] for row in rows} == {
        "s1": "s1", "efficient": "s1_efficient", "soft_q": "soft_q", "exact": "exact", "replicas": "s1",
    }  # fmt: skip
    objective = {
        row["sessions"][0]["name"]: value["value"]
        for row in rows
        for value in row["metricValues"]
        if value["name"]["tag"] == "Final/objective"
    }
    np.testing.assert_allclose([objective[n] for n in kinds], [kinds[n]["objective"] for n in kinds], rtol=1e-6)
