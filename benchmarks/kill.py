"""One training, killed many times at random moments and gone on with each time, against one that was left alone.

    python benchmarks/kill.py [kills=100] [seed=0]       about ten minutes

Compared are the bits of solution.npz, every record of the event file, and the names of the files that are left.
"""

from __future__ import annotations

import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

ROOT = Path(__file__).parents[1]
RUN = ["learner.n_epochs=2000", "evaluation.pictures=false", "checkpoint_every=0", "experience.n_episodes=200"]


def start(directory: Path) -> subprocess.Popen[bytes]:
    command = [sys.executable, str(ROOT / "train.py"), *RUN, f"hydra.run.dir={directory}"]
    return subprocess.Popen(command, cwd=directory.parent, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def records(directory: Path) -> dict[str, list[tuple[int, float]]]:
    reader = EventAccumulator(str(directory), size_guidance={"scalars": 0}).Reload()
    tags = [tag for tag in reader.Tags()["scalars"] if not tag.startswith("time/")]
    return {tag: [(event.step, event.value) for event in reader.Scalars(tag)] for tag in tags}


def files(directory: Path) -> list[str]:
    found = (path.relative_to(directory) for path in directory.rglob("*"))
    return sorted("events" if "tfevents" in path.name else str(path) for path in found)


def main(kills: int = 100, seed: int = 0) -> None:
    rng = np.random.default_rng(seed)
    with tempfile.TemporaryDirectory() as folder:
        whole, cut = Path(folder) / "whole", Path(folder) / "cut"
        tick = time.perf_counter()
        process = start(whole)
        while not any(whole.glob("checkpoints/*.ckpt")):
            time.sleep(0.05)
        first = time.perf_counter() - tick
        assert process.wait() == 0
        alone = time.perf_counter() - tick
        # From before the first import to well into the learning.
        longest = first + min(1.0, (alone - first) / kills * 4)
        done = 0
        while done < kills:
            process = start(cut)
            time.sleep(rng.uniform(0.0, longest))
            if process.poll() is not None:
                raise SystemExit(f"complete after {done} kills: raise learner.n_epochs")
            process.send_signal(signal.SIGKILL)
            process.wait()
            done += 1
            steps = sorted(int(path.stem) for path in cut.glob("checkpoints/*.ckpt"))
            print(f"\rkill {done}: at tuple {steps[-1] if steps else 0:,}", end="", flush=True)
        assert start(cut).wait() == 0
        bits = (whole / "solution.npz").read_bytes() == (cut / "solution.npz").read_bytes()
        logged, left = records(whole) == records(cut), files(whole) == files(cut)
        n = sum(map(len, records(cut).values()))
        print(f"\n{kills} kills, left alone {alone:.0f} s: solution.npz {'equal' if bits else 'DIFFERS'}, ", end="")
        print(f"{n:,} records {'equal' if logged else 'DIFFER'}, files {'equal' if left else files(cut)}")
        if not (bits and logged and left):
            raise SystemExit(1)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
