"""Generated configurations and damaged files: each either runs, or gives one clear line.

    python benchmarks/fuzz.py configurations [n=10000] [seed=0]     about 25 minutes of one core
    python benchmarks/fuzz.py extremes                              every key with every extreme value, 15 minutes
    python benchmarks/fuzz.py checkpoints [n=1000] [seed=0]         a minute
    python benchmarks/fuzz.py directories [n=3000] [seed=0]         run directories and sweeps with one damaged file

A failure is any exception but InputError and NonFiniteError, a message of more than one line, a result that is not
finite, output of a run that was refused, or a good file that is changed by a run that was refused.
"""

from __future__ import annotations

import collections
import contextlib
import io
import json
import math
import os
import resource
import shutil
import signal
import sys
import tempfile
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from erl_torch import InputError, NonFiniteError, pictures
from erl_torch.cli import config, sweeps
from erl_torch.cli import main as cli
from erl_torch.files import write_json
from erl_torch.reproduction.runner import reproduce
from erl_torch.run.checkpoint import Checkpoints
from erl_torch.run.compare import run_comparison
from erl_torch.run.playing import play
from erl_torch.run.training import train

ROOT = Path(__file__).parents[1]
CHEAP = ["experience.n_episodes=2", "experience.episode_length=40", "evaluation.n_episodes=1", "evaluation.horizon=20"]
ENVS = ["windy_cliff", "windy_frozen_lake", "windy_maze", "dynamics_shift", "frozen_lake", "cliff_walking"]
WHOLE = ["-1", "0", "1", "2", "3", "4", "5", "7"]
NUMBERS = [*WHOLE, "0.5", "0.1", "1e-3", "1e-300", "1e300", "1.5", "40", "745", "1e9", "nan", "inf", "-inf"]
WORDS = [
    "fast",
    "literal",
    "reset",
    "carry",
    "new",
    "old",
    "prior",
    "auto",
    "on",
    "off",
    "initial",
    "exclude",
    "biasing",
]
OTHERS = [
    "true",
    "false",
    "null",
    "''",
    "abc",
    "[]",
    "[1,2]",
    "{}",
    "cpu",
    "cuda:9",
    "holes",
    "empty",
    "nowhere.npz",
    "restart",
    "absorb",
]
FIXED = ("name", "id", "suggest", "experience.save_to", "env.size", "env.n_actions", "threads")  # costs, or other runs


def keys(learner: str, env: str) -> dict[str, list[str]]:
    """Every key, with values of the kind it has."""
    cfg: Any = compose("train", [f"learner={learner}", f"env={env}"])
    found = {key: cfg[key] for key in ("seed", "n_replicas", "checkpoint_every", "shared_stream", "keep_tuples")}
    for group in ("learner", "env", "experience", "evaluation"):
        found |= {f"{group}.{key}": cfg[group][key] for key in map(str, cfg[group])}
    kinds = {bool: ["true", "false"], int: WHOLE, float: NUMBERS, str: WORDS}
    usable = {key: value for key, value in found.items() if key.split(".")[-1] not in FIXED and key not in FIXED}
    return {key: kinds.get(type(value), NUMBERS + WORDS + OTHERS) for key, value in usable.items()}


def configurations(n: int = 10_000, seed: int = 0) -> None:
    config.register()
    rng = np.random.default_rng(seed)
    learners = sorted(path.stem for path in (ROOT / "conf" / "learner").glob("*.yaml"))
    ends: collections.Counter[str] = collections.Counter()
    failures = []
    began = time.perf_counter()
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"), tempfile.TemporaryDirectory() as folder:
        known = {}
        for i in range(n):
            learner, env = str(rng.choice(learners)), str(rng.choice(ENVS))
            if (learner, env) not in known:
                known[learner, env] = keys(learner, env)
            of_kind = known[learner, env]
            changed = rng.choice(sorted(of_kind), size=int(rng.integers(1, 3)), replace=False)
            overrides = [f"learner={learner}", f"env={env}", *CHEAP, "evaluation.pictures=false"]
            every = NUMBERS + WORDS + OTHERS
            overrides += [f"{key}={rng.choice(of_kind[key] if rng.random() < 0.8 else every)}" for key in changed]
            if rng.random() < 0.1:
                group, key = rng.choice(["learner", "env", "vary", "evaluation"]), rng.choice(["beta", "zz"])
                overrides.append(f"++{group}.{key}=[2,5]")
            directory = Path(folder) / str(i)
            directory.mkdir()
            end = attempt(overrides, directory)
            ends[end.split(":")[0]] += 1
            if end.startswith("FAILURE"):
                failures.append(f"{' '.join(overrides)}\n    {end}")
                print(f"\n{failures[-1]}", flush=True)
            shutil.rmtree(directory)
            print(f"\r{i + 1}/{n} {dict(ends)}", end="", flush=True)
    print(f"\n{n} configurations in {time.perf_counter() - began:.0f} s: {dict(ends)}")
    if failures:
        raise SystemExit(1)


def perform(program: str, overrides: list[str], directory: Path) -> dict[str, Any]:
    """What ``program`` makes of ``overrides``."""
    cfg = compose(program, overrides)
    if program == "train":
        return train(cfg, directory)
    if program == "compare":
        run_comparison(cfg, directory)
    elif program == "play":
        play(cfg)
    else:
        reproduce(cfg, directory)
    return {"objective": 0.0}


def attempt(overrides: list[str], directory: Path, program: str = "train") -> str:
    """How one configuration ended."""
    silent = io.StringIO()
    try:
        with contextlib.redirect_stdout(silent), contextlib.redirect_stderr(silent), warnings.catch_warnings():
            warnings.simplefilter("error")
            warnings.filterwarnings("ignore", category=DeprecationWarning)
            result = perform(program, overrides, directory)
    except NonFiniteError as error:
        written = json.loads((directory / "result.json").read_text())
        if "\n" in str(error) or written["status"] != "non_finite":
            return f"FAILURE: {error} with status {written['status']}"
        return "left the finite numbers, by name"
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt):
            raise
        if not isinstance(error, (*cli.BY_CONFIGURATION, InputError)):
            return f"FAILURE: {type(error).__name__}: {error}"
        line = cli._line(error)
        if "\n" in line or not line or len(line) > 1500:
            return f"FAILURE: not one line: {line!r}"
        if any(directory.iterdir()):
            return f"FAILURE: refused ({line}), yet it left {[p.name for p in directory.iterdir()]}"
        return "refused by name"
    if result["objective"] is None or not math.isfinite(result["objective"]):
        return f"FAILURE: objective {result['objective']}"
    return "ran"


def checkpoints(n: int = 1000, seed: int = 0) -> None:
    config.register()
    rng = np.random.default_rng(seed)
    ends: collections.Counter[str] = collections.Counter()

    class Stop(BaseException):
        pass

    def stop_after(calls: int) -> Any:
        left = [calls]

        def safe_point() -> None:
            left[0] -= 1
            if not left[0]:
                raise Stop

        return safe_point

    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"), tempfile.TemporaryDirectory() as folder:
        cfg = compose("train", [*CHEAP, "evaluation.pictures=false", "checkpoint_every=0", "learner.n_bias=2"])
        whole, cut = Path(folder) / "whole", Path(folder) / "cut"
        silent = io.StringIO()
        with contextlib.redirect_stdout(silent), contextlib.redirect_stderr(silent):
            train(cfg, whole)
            with contextlib.suppress(Stop):
                train(cfg, cut, stop_after(9))
        bits = (whole / "solution.npz").read_bytes()
        for i in range(n):
            directory = Path(folder) / str(i)
            shutil.copytree(cut, directory)
            for path in sorted(directory.glob("checkpoints/*.ckpt"))[-int(rng.integers(1, 3)) :]:
                body = bytearray(path.read_bytes())
                kind = rng.integers(4)
                if kind == 0:
                    body = body[: rng.integers(len(body))]
                elif kind == 1:
                    for at in rng.integers(len(body), size=rng.integers(1, 20)):
                        body[at] ^= 1 << rng.integers(8)
                elif kind == 2:
                    body = bytearray(rng.bytes(int(rng.integers(0, 5000))))
                else:
                    at = int(rng.integers(len(body)))
                    body[at:at] = rng.bytes(int(rng.integers(1, 100)))
                path.write_bytes(body)
            if rng.random() < 0.2:
                (directory / "checkpoints" / ".000.ckpt.1.tmp").write_bytes(b"x")
            with contextlib.redirect_stdout(silent), contextlib.redirect_stderr(silent):
                if i < n // 20:  # all the way; for the rest what is read of the directory is enough
                    train(cfg, directory)
                    assert (directory / "solution.npz").read_bytes() == bits
                    ends["ran to the same bits"] += 1
                else:
                    (directory / "settings.json").unlink()
                    found = Checkpoints(directory, {}, None).read()
                    ends["begins anew" if found is None else "goes on"] += 1
            shutil.rmtree(directory)
    print(f"{n} damaged checkpoints: {dict(ends)}")


# -- every key with every extreme value ----------------------------------------------------------------

EXTREME = ["1" + "0" * 30, "-1" + "0" * 30, str(2**63), str(2**63 - 1), str(2**31), "1000000000", "0", "-1", "0.5"]
EXTREME += ["nan", "inf", "-inf", "1e308", "1e-308", "abc", "true", "[]", "[1]", "[nan]", "{}", "null", "''"]
ROOM = 3 << 30  # bytes that a case may take: what it is refused for is what it would take more
PATIENCE = 4.0  # seconds; what still runs then has begun to work


def extremes() -> None:
    config.register()
    ends: collections.Counter[str] = collections.Counter()
    failures: list[str] = []
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"), tempfile.TemporaryDirectory() as folder:
        base = Path(folder) / "base"
        cheap = [*CHEAP, "evaluation.pictures=false", "learner.n_bias=1", "learner.n_epochs=1"]
        cfg = compose("train", cheap)
        silently(lambda: train(cfg, base))  # compiles
        (base / ".hydra").mkdir()
        OmegaConf.save(cfg, base / ".hydra" / "config.yaml")
        for program, overrides, key in every_key(base):
            for value in EXTREME:
                given = [*overrides, f"{key}={value}"]
                end = apart(program, given, Path(folder) / "case")
                ends[end.split(":")[0]] += 1
                if end.startswith("FAILURE"):
                    failures.append(f"{program} {' '.join(given)}\n    {end}")
                    print(f"\n{failures[-1]}", flush=True)
                print(f"\r{sum(ends.values())} {dict(ends)}", end="", flush=True)
    print(f"\n{sum(ends.values())} extreme values: {dict(ends)}")
    if failures:
        raise SystemExit(1)


def every_key(base: Path) -> Iterator[tuple[str, list[str], str]]:
    """(program, overrides that make a cheap run of it, key), each key of each schema once."""
    seen: set[str] = set()
    choices = [[f"learner={path.stem}"] for path in sorted((ROOT / "conf" / "learner").glob("*.yaml"))]
    choices += [[f"env={env}"] for env in [*ENVS, "cart_pole", "pendulum"]]
    choices += [["n_replicas=2"], ["experience=recorded", f"experience.path={base}/none.npz"]]
    for choice in choices:
        cheap = [o for o in CHEAP if "recorded" not in choice[0] or not o.startswith("experience")]
        cheap += ["evaluation.pictures=false", *choice]
        cfg: Any = compose("train", cheap)
        found = ["seed", "n_replicas", "threads", "checkpoint_every", "shared_stream", "keep_tuples", "++vary.beta"]
        for group in ("learner", "env", "experience", "evaluation"):
            found += [f"{group}.{key}" for key in map(str, cfg[group])]
        for key in found:
            name = f"{cfg.learner.name}:{key}" if key.startswith("learner") else key
            name = f"{cfg.env.name}:{key}" if key.startswith("env") else name
            if (name in seen and "n_replicas" not in choice[0]) or key.split(".")[-1] in (
                "class",
                "name",
                "id",
                "save_to",
            ):
                continue
            seen.add(name)
            yield "train", cheap, key
    small = ["learners=[s1]", "seeds=1", "n_sizes=1", "experience.n_episodes=2", "experience.episode_length=40"]
    for key in ("learners", "seeds", "seed", "beta", "n_sizes", "processes", "prior_policy"):
        yield "compare", small, key
    for key in ("artifact", "scale", "seed", "processes"):
        yield "reproduce", ["artifact=figure_4"], key
    for key in ("n_episodes", "seed", "greedy", "module", "replica", "render", "n_steps"):
        yield "play", [f"run={base}", "n_episodes=1"], key


def apart(program: str, overrides: list[str], directory: Path) -> str:
    """How one case ended, in a process of its own: of little memory, and not for long."""
    shutil.rmtree(directory, ignore_errors=True)
    directory.mkdir()
    said = directory.with_suffix(".end")
    said.unlink(missing_ok=True)
    child = os.fork()
    if not child:
        used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + ROOM, used + ROOM))
        said.write_text(attempt(overrides, directory, program))
        os._exit(0)
    until = time.monotonic() + PATIENCE
    while time.monotonic() < until:
        if os.waitpid(child, os.WNOHANG)[0]:
            return said.read_text() if said.exists() else "FAILURE: the process died"
        time.sleep(0.01)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return "was at work"


# -- damaged directories ---------------------------------------------------------------------------------


def directories(n: int = 3000, seed: int = 0) -> None:
    config.register()
    rng = np.random.default_rng(seed)
    ends: collections.Counter[str] = collections.Counter()
    failures = []

    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"), tempfile.TemporaryDirectory() as folder:
        runs = templates(Path(folder))
        for i in range(n):
            kind = str(rng.choice(sorted(runs)))
            cfg, template, bits = runs[kind]
            directory = Path(folder) / "case"
            shutil.rmtree(directory, ignore_errors=True)
            shutil.copytree(template, directory)
            path = rng.choice(sorted(p for p in directory.rglob("*") if p.is_file()))
            how = damage(path, rng)
            deed = str(rng.choice(["collect"] if kind == "sweep" else ["again", "resume", "play"]))
            about = f"{kind}: {path.relative_to(directory)} {how}, then {deed}"
            end = after_damage(cfg, directory, path, deed, bits)
            ends[f"{deed}, {end.split(':')[0]}"] += 1
            if end.startswith("FAILURE"):
                failures.append(f"{about}\n    {end}")
                print(f"\n{failures[-1]}", flush=True)
            print(f"\r{i + 1}/{n} {dict(ends)}", end="", flush=True)
    print(f"\n{n} damaged directories: {dict(ends)}")
    if failures:
        raise SystemExit(1)


def templates(folder: Path) -> dict[str, tuple[Any, Path, dict[str, bytes]]]:
    """By name: configuration, directory, and the results of a run that was left alone."""
    pictures.bands = lambda *_, **__: np.zeros((2, 2, 3), np.uint8)  # most of the time
    found: dict[str, tuple[Any, Path, dict[str, bytes]]] = {}
    base = [*CHEAP, "evaluation.pictures=false", "checkpoint_every=0", "learner.n_bias=2", "learner.n_epochs=3"]
    for name, more in {"single": [], "replicas": ["n_replicas=2"], "exact": ["learner=exact"]}.items():
        overrides = [o for o in base if name != "exact" or not o.startswith("learner")] + more
        cfg = compose("train", overrides)
        whole, cut = folder / name, folder / f"{name}-cut"
        for directory, calls in ((whole, -1), (cut, 3 if name == "replicas" else 6)):
            (directory / ".hydra").mkdir(parents=True)
            OmegaConf.save(cfg, directory / ".hydra" / "config.yaml")
            OmegaConf.save(OmegaConf.create(overrides), directory / ".hydra" / "overrides.yaml")
            left = [calls]

            def safe_point(left: list[int] = left) -> None:
                left[0] -= 1
                if not left[0]:
                    raise SystemExit(143)

            with contextlib.suppress(SystemExit):
                silently(lambda cfg=cfg, directory=directory, stop=safe_point: train(cfg, directory, stop))
        bits = {path.name: path.read_bytes() for path in whole.glob("*.npz")}
        found |= {name: (cfg, whole, bits), f"{name}, cut": (cfg, cut, bits)}
    sweep = folder / "sweep"
    rows = []
    for job in range(3):
        shutil.copytree(folder / "single", sweep / str(job))
        rows.append({"job": job, "overrides": [f"seed={job}"], "status": "waiting"})
        sweeps.note(sweep, job, "ended" if job else "running", directory=str(job), complaint=None, value=1.0)
    write_json(sweep / "sweep.json", {"jobs": rows})
    return found | {"sweep": (None, sweep, {})}


def damage(path: Path, rng: np.random.Generator) -> str:
    body = bytearray(path.read_bytes())
    how = str(rng.choice(["cut", "flipped", "empty", "deleted", "junk", "grown", "other JSON", "a directory", "text"]))
    if how == "cut":
        body = body[: rng.integers(max(len(body), 1))]
    elif how == "flipped" and body:
        for at in rng.integers(len(body), size=rng.integers(1, 20)):
            body[at] ^= 1 << rng.integers(8)
    elif how == "empty":
        body = bytearray()
    elif how == "junk":
        body = bytearray(rng.bytes(int(rng.integers(1, 5000))))
    elif how == "grown":
        body += rng.bytes(int(rng.integers(1, 500)))
    elif how == "other JSON":
        body = bytearray(
            str(rng.choice(["[]", "3", "null", "{}", '{"status": 3, "jobs": [1]}', '{"jobs": {}}'])).encode()
        )
    elif how == "text":
        body = bytearray(b"- env: [\n- {a: ${b}}\n")
    path.unlink()
    if how == "a directory":
        path.mkdir()
    elif how != "deleted":
        path.write_bytes(body)
    return how


def after_damage(cfg: Any, directory: Path, path: Path, deed: str, bits: dict[str, bytes]) -> str:
    """How ``deed`` ended, and whether all good files are as they were where it was refused."""
    before = contents(directory)
    before.pop(path.relative_to(directory), None)
    try:
        if deed == "collect":
            silently(lambda: sweeps.show(directory))
        elif deed == "play":
            player = compose("play", [f"run={directory}", "n_episodes=1", "n_steps=1"])
            silently(lambda: play(player))
        else:
            if deed == "resume":
                overrides = [a for a in cli._resumed([f"resume={directory}"]) if not a.startswith("hydra.")]
                cfg = compose("train", overrides)
            silently(lambda: train(cfg, directory))
    except BaseException as error:
        if not cli.expected(error):
            return f"FAILURE: {type(error).__name__}: {error}"
        line = cli._line(error)
        if "\n" in line or not line or len(line) > 1500:
            return f"FAILURE: not one line: {line!r}"
        after = contents(directory)
        lost = [name for name, content in before.items() if after.get(name) != content and name.suffix != ".tmp"]
        return f"FAILURE: refused ({line}), yet changed {lost}" if lost else "refused by name"
    if deed in ("collect", "play"):
        lost = {name for name in before if not (directory / name).exists() and ".jobs" not in name.parts}
        return f"FAILURE: lost {lost}" if lost else "answered"
    intact = [name for name in bits if directory / name != path]
    other = [name for name in intact if (directory / name).read_bytes() != bits[name]]
    return f"FAILURE: other bits of {other}" if other else "ran to the same bits"


def contents(directory: Path) -> dict[Path, bytes]:
    return {path.relative_to(directory): path.read_bytes() for path in directory.rglob("*") if path.is_file()}


def silently(call: Any) -> Any:
    silent = io.StringIO()
    with contextlib.redirect_stdout(silent), contextlib.redirect_stderr(silent):
        return call()


if __name__ == "__main__":
    what, *numbers = sys.argv[1:] or ["configurations"]
    parts = {
        "configurations": configurations,
        "extremes": extremes,
        "checkpoints": checkpoints,
        "directories": directories,
    }
    parts[what](*map(int, numbers))
