"""Generated configurations and damaged checkpoints: each either runs, or gives one clear line.

    python benchmarks/fuzz.py configurations [n=10000] [seed=0]     about 25 minutes of one core
    python benchmarks/fuzz.py checkpoints [n=1000] [seed=0]         a minute

A failure is any exception but InputError and NonFiniteError, a message of more than one line, a result that is not
finite, or output of a run that was refused.
"""

from __future__ import annotations

import collections
import contextlib
import io
import json
import math
import shutil
import sys
import tempfile
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from hydra import compose, initialize_config_dir
from hydra.errors import HydraException
from omegaconf.errors import OmegaConfBaseException

from erl_torch import InputError, NonFiniteError, cli, config
from erl_torch.checkpoint import Checkpoints
from erl_torch.training import train

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


def attempt(overrides: list[str], directory: Path) -> str:
    """How one configuration ended."""
    silent = io.StringIO()
    try:
        with contextlib.redirect_stdout(silent), contextlib.redirect_stderr(silent), warnings.catch_warnings():
            warnings.simplefilter("error")
            warnings.filterwarnings("ignore", category=DeprecationWarning)
            result = train(compose("train", overrides), directory)
    except (HydraException, OmegaConfBaseException, InputError) as error:
        line = cli._line(error)
        if "\n" in line or not line or len(line) > 1500:
            return f"FAILURE: not one line: {line!r}"
        if any(directory.iterdir()):
            return f"FAILURE: refused ({line}), yet it left {[p.name for p in directory.iterdir()]}"
        return "refused by name"
    except NonFiniteError as error:
        written = json.loads((directory / "result.json").read_text())
        if "\n" in str(error) or written["status"] != "non_finite":
            return f"FAILURE: {error} with status {written['status']}"
        return "left the finite numbers, by name"
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt):
            raise
        return f"FAILURE: {type(error).__name__}: {error}"
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


if __name__ == "__main__":
    what, *numbers = sys.argv[1:] or ["configurations"]
    {"configurations": configurations, "checkpoints": checkpoints}[what](*map(int, numbers))
