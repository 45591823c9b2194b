"""Sweeps: a job that fails or dies costs no other, and the table says what became of each."""

import contextlib
import json
import os
import signal
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from helpers import ROOT, composed, ended
from hydra.core.config_store import ConfigStore
from hydra.errors import HydraException
from omegaconf import OmegaConf

from erl_torch import InputError
from erl_torch.cli import main as cli
from erl_torch.cli import sweeps
from erl_torch.files import alone

# A program of jobs that end in every way there is, without torch: what they do is in the key `end`.
TOY = """
import os, signal
from pathlib import Path
import hydra
from hydra.core.config_store import ConfigStore
from erl_torch.cli import main as cli
from erl_torch.checks import InputError
from erl_torch.files import write_json

ConfigStore.instance().store(name="toy", node={"end": "well", "x": 1.0, "hydra": {"job": {"chdir": False}}})

@hydra.main(version_base="1.3", config_path=None, config_name="toy")
@cli.job
def main(cfg, directory, safe_point):
    started = directory / "started"
    before = started.exists()
    started.touch()
    if cfg.end == "dies" or (cfg.end == "dies_once" and not before):
        os.kill(os.getpid(), signal.SIGKILL)
    if cfg.end == "terminates":
        os.kill(os.getpid(), signal.SIGTERM)
        safe_point()
    if cfg.end == "bad_input":
        started.unlink()
        raise InputError("end", cfg.end, "well")
    if cfg.end == "bug" or (cfg.end == "unlucky" and cfg.x < 0.5):
        raise RuntimeError("a bug")
    write_json(directory / "result.json", {"status": "converged", "objective": -cfg.x, "seconds": 0.25})
    return -cfg.x

cli.run(main, "", Path("."), "toy")
"""


@pytest.fixture
def toy(tmp_path, start):
    """Starts the program in ``tmp_path``; gives the process."""
    (tmp_path / "toy.py").write_text(TOY)
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    return lambda *arguments: start(
        sys.executable, "toy.py", *arguments, "hydra/job_logging=none", cwd=tmp_path, env=environment
    )


def rows(sweep):
    return {row["overrides"][0].split("=")[1]: row for row in json.loads((sweep / "sweep.json").read_text())["jobs"]}


@pytest.mark.parametrize("launcher", ["basic", "joblib"])
def test_a_sweep_has_one_directory_whatever_its_name_is_made_of(tmp_path, toy, launcher):
    process = toy("-m", "x=2,3", "hydra.sweep.dir=of-${x}", f"hydra/launcher={launcher}")
    code, _, err = ended(process)
    assert code == 0, err
    (sweep,) = (path for path in tmp_path.iterdir() if path.is_dir())
    assert sweep.name == "of-1.0"
    assert [row["status"] for row in rows(sweep).values()] == ["converged"] * 2


def test_every_launcher_runs_all_jobs_and_lists_all_failures(tmp_path, toy):
    """... whatever becomes of a job; a process of its own may die, and the job is started once more."""
    ends = ["well", "bad_input", "bug", "last"]
    started = {
        "basic": (ends, ["hydra.sweeper.max_batch_size=1"]),
        "joblib": ([*ends[:3], "dies", "terminates", "last"], ["hydra/launcher=joblib", "hydra.launcher.n_jobs=2"]),
        "submitit_local": (["bad_input", "bug", "dies_once"], ["hydra/launcher=submitit_local"]),
    }
    processes = {
        name: toy("-m", f"end={','.join(ends)}", "x=2", f"hydra.sweep.dir={name}", *more)
        for name, (ends, more) in started.items()
    }
    for name, (ends, _) in started.items():
        code, out, err = ended(processes[name])
        assert code == 1, err
        found = rows(tmp_path / name)
        assert list(found) == ends
        assert [row["job"] for row in found.values()] == list(range(len(ends)))
        complaints = {
            "bad_input": "end=bad_input: must be well",
            "bug": "RuntimeError: a bug",
            "dies": "its process died, twice",
            "terminates": "stopped by a signal",
        }
        for end, row in found.items():
            if end in complaints:
                assert (row["status"], row["complaint"]) == ("failed", complaints[end])
                assert f"failed: job {row['job']} (end={end}): {complaints[end]}" in out
            else:
                assert (row["status"], row["objective"], row["seconds"], row["theta"]) == ("converged", -2, 0.25, None)
                assert (tmp_path / name / row["directory"] / "result.json").exists()
        assert out.count("\nfailed: job") == len(complaints.keys() & ends)
        assert f"{len(ends)} jobs, {len(complaints.keys() & ends)} failed; table: {name}/sweep.json" in out
        assert found["bad_input"]["directory"] is None
        assert not (tmp_path / name / ".jobs").exists()
        assert err.count("Traceback") == (0 if name == "submitit_local" else 1)  # of the bug
    # The table again, from the files alone, for a sweep whose driver did not live to see its end.
    (tmp_path / "basic" / ".jobs").mkdir()
    sweeps.note(tmp_path / "basic", 3, "running", directory="3")
    again = sweeps.collect(tmp_path / "basic")
    assert [row["status"] for row in again] == ["converged", "failed", "failed", "running"]
    with pytest.raises(InputError, match="that of a sweep"):
        sweeps.collect(tmp_path)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b'{"jobs": [',
        b"[]",
        b"\xff",
        b'{"jobs": []}',
        b'{"jobs": {}}',
        b'{"jobs": [1]}',
        b'{"jobs": [{"job": 0}]}',
    ],
)
def test_a_damaged_table_is_named_and_stays(tmp_path, content, capsys):
    (tmp_path / "sweep.json").write_bytes(content)
    assert sweeps.main([str(tmp_path)]) == 1
    out, err = capsys.readouterr()
    assert err.startswith(f"error: directory={tmp_path}/sweep.json: must be ")
    assert err.count("\n") == 1
    assert not out
    assert (tmp_path / "sweep.json").read_bytes() == content


@pytest.mark.parametrize("content", ["", "[]", '{"status": 5, "directory": 7}', '{"directory": "0"}'])
def test_damaged_notes_and_results_leave_their_figures_out(tmp_path, content):
    rows = [{"job": 0, "overrides": ["x=1"], "status": "waiting"}]
    (tmp_path / "sweep.json").write_text(json.dumps({"jobs": rows}))
    (tmp_path / ".jobs").mkdir()
    (tmp_path / ".jobs" / "0.json").write_text(content)
    (tmp_path / "0").mkdir()
    (tmp_path / "0" / "result.json").write_text('{"theta": "x", "objective": [], "status": 4}')
    (row,) = sweeps.show(tmp_path)
    assert (row["theta"], row["objective"]) == (None, None)


def test_optuna_maximises_the_objective_past_failed_trials(tmp_path, toy):
    search = ["hydra/sweeper=optuna", "hydra.sweeper.n_trials=6", "hydra.sweeper.sampler.seed=0"]
    process = toy("-m", *search, "end=unlucky", "x=interval(0,1)", "hydra.sweep.dir=here")
    code, out, err = ended(process)
    assert code == 1, err
    trials = json.loads((tmp_path / "here" / "sweep.json").read_text())["jobs"]
    values = [row["objective"] for row in trials if row["status"] == "converged"]
    assert len(trials) == 6
    assert 0 < len(values) < 6
    assert OmegaConf.load(tmp_path / "here" / "optimization_results.yaml").best_value == max(values)
    assert out.count("RuntimeError: a bug") == 6 - len(values)


def test_a_search_without_a_single_result_ends_in_its_failures(tmp_path, monkeypatch, capsys):
    """Optuna ends it with an exception of its own, which would tell the user less."""

    def main():
        sweeps.note(tmp_path, 0, "failed", complaint="a bug")
        raise ValueError("No trials are completed yet.")

    (tmp_path / "sweep.json").write_text('{"jobs": [{"job": 0, "overrides": ["x=1"], "status": "waiting"}]}')
    monkeypatch.setattr(sweeps, "patient_launchers", lambda: contextlib.nullcontext([tmp_path]))
    monkeypatch.setattr(sys, "argv", ["train.py", "-m"])
    monkeypatch.setenv("HYDRA_FULL_ERROR", "")
    with pytest.raises(SystemExit) as stopped:
        cli.run(main, "", ROOT / "conf", "train")
    assert stopped.value.code == 1
    assert "failed: job 0 (x=1): a bug" in capsys.readouterr().out


def test_processes_at_once_never_share_a_directory(tmp_path, toy):
    pattern = OmegaConf.load(ROOT / "conf" / "train.yaml").hydra.run._get_node("dir")._value()
    pattern = pattern.replace("${slug:${env.name}}", "toy")
    processes = [toy(f"hydra.run.dir='{pattern}'") for _ in range(4)]
    for process in processes:
        code, _, err = ended(process)
        assert code == 0, err
    results = list((tmp_path / "runs" / "toy").glob("*/result.json"))
    assert len(results) == 4
    with alone(tmp_path), pytest.raises(InputError, match="no other run is writing to"), alone(tmp_path):
        pass


def test_presets(monkeypatch):
    """Plugins have defaults of ours; one that is not installed is answered with the extra that brings it."""
    sweeps.presets()
    tune = composed("experiment=tune_step_sizes", "+hydra.job.num=0").learner
    assert tune.name == "s1"
    store = ConfigStore.instance().repo["hydra"]
    assert store["launcher"]["submitit_slurm.yaml"].node.max_num_timeout > 0
    assert store["sweeper"]["optuna.yaml"].node.direction.name == "maximize"
    for group, name, extra in [("launcher", "joblib", "joblib"), ("sweeper", "optuna", "optuna")]:
        monkeypatch.delitem(store[group], f"{name}.yaml")
        with pytest.raises(HydraException) as raised:
            composed(f"hydra/{group}={name}")
        line = cli._line(raised.value)
        assert line.startswith(f"hydra/{group}={name}: not installed; pip install 'erl_torch[{extra}]'")


def test_a_queue_s_signal_is_answered_after_the_safe_point():
    """Submitit's handler queues the job again and exits: not in the middle of an epoch."""
    calls = []

    def work(last):
        with cli.Signals() as signals:
            os.kill(os.getpid(), signal.SIGUSR2)
            calls.append("epoch")
            if not last:
                signals.safe_point()

    before = signal.signal(signal.SIGUSR2, lambda number, frame: calls.append("handler"))
    try:
        with pytest.raises(SystemExit):
            work(last=False)
        work(last=True)  # too late to stop for: the work is done
        assert calls == ["epoch", "handler", "epoch"]
    finally:
        signal.signal(signal.SIGUSR2, before)


def test_slurm_jobs_without_a_result_are_queued_again_once(tmp_path, monkeypatch):
    """By states as Slurm tells them: 0 ends well, 1 is killed once, 2 twice, 3 cancelled, 4 forgotten by Slurm."""

    class SlurmJob:
        def __init__(self, number):
            self.job_id = f"7_{number}"
            self.paths = SimpleNamespace(result_pickle=tmp_path / f"{number}.pkl")

        def exception(self):
            return None

    requeued, asked = [], []

    def states(array):
        assert array == "7"
        asked.append(array)
        if len(asked) == 1:
            return {}  # it does not answer
        if len(asked) == 2:
            (tmp_path / "0.pkl").touch()
        if "7_1" in requeued and len(asked) == 6:
            (tmp_path / "1.pkl").touch()
        first = "RUNNING" if "7_1" in requeued else "FAILED"
        return {"any": "GONE", "7_0": "COMPLETED", "7_1": first, "7_2": "OUT_OF_MEMORY", "7_3": "CANCELLED"}

    monkeypatch.setattr(sweeps, "ASK_SLURM", 0)
    monkeypatch.setattr("time.sleep", lambda _: None)
    monkeypatch.setattr(sweeps, "_slurm_states", states)
    monkeypatch.setattr(sweeps, "_requeue", lambda job: requeued.append(job) is None and job != "7_4")
    sweeps._wait(tmp_path, {number: SlurmJob(number) for number in range(5)})
    assert requeued == ["7_1", "7_2", "7_4"]
    ends = {n: json.loads((tmp_path / ".jobs" / f"{n}.json").read_text())["complaint"] for n in (2, 3, 4)}
    assert ends == {
        2: "Slurm job 7_2 ended without a result: OUT_OF_MEMORY",
        3: "Slurm job 7_3 ended without a result: CANCELLED",
        4: "Slurm job 7_4 ended without a result: GONE",
    }
    assert not Path(tmp_path / ".jobs" / "1.json").exists()
