"""Screenshots of TensorBoard over a few runs, for the documentation: docs/images/tensorboard-*.png.

Needs Chromium (Debian: apt-get install chromium). Makes its runs in a temporary directory, about a minute.

    python benchmarks/screenshots.py [--logdir RUNS] [--to docs/images]
"""

from __future__ import annotations

import argparse
import contextlib
import io
import shutil
import socket
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path

from PIL import Image

ROOT = Path(__file__).parents[1]
RUNS = (
    ("hydra.run.dir=runs/s1",),
    ("hydra.run.dir=runs/exact", "learner=exact"),
    ("hydra.run.dir=runs/replicas", "n_replicas=50"),
    (
        "-m", "hydra.sweep.dir=runs/sweep", "learner=s1,s1_efficient,rvi_soft_q", "seed=0,1",
    ),
)  # fmt: skip
FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--hide-scrollbars",
    "--disable-background-networking", "--disable-component-update", "--disable-sync", "--virtual-time-budget=20000",
)  # fmt: skip
# Tab -> what follows the address, and the height of the window.
TABS = {
    "scalars": ("#scalars", 900),
    "custom-scalars": ("#custom_scalars", 1150),
    "hparams": ("#hparams", 700),
    "images": ("#images", 900),
}


@contextlib.contextmanager
def tensorboard(logdir: Path) -> Iterator[str]:
    """The address of a TensorBoard on a free port of loopback that has read ``logdir``."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    log = tempfile.TemporaryFile()  # noqa: SIM115
    process = subprocess.Popen(
        [
            sys.executable, "-m", "tensorboard.main", "--logdir", str(logdir), "--host", "127.0.0.1",
            "--port", str(port), "--load_fast", "false", "--reload_interval", "1",
        ],
        stdout=log, stderr=log,
    )  # fmt: skip
    address = f"http://127.0.0.1:{port}"
    wanted = sum(1 for _ in {path.parent for path in logdir.rglob("events.out.*")})
    try:
        for _ in range(600):
            if process.poll() is not None:
                break
            with contextlib.suppress(OSError), urllib.request.urlopen(f"{address}/data/runs", timeout=5) as answer:
                if answer.read().count(b'"') == 2 * wanted:
                    yield address
                    return
            time.sleep(0.1)
        log.seek(0)
        raise RuntimeError(f"TensorBoard did not start: {log.read().decode(errors='replace')[-2000:]}")
    finally:
        process.terminate()
        process.wait(20)
        log.close()


def shoot(browser: str, address: str, height: int) -> Image.Image:
    """What ``browser`` shows at ``address``, 1400 pixels wide."""
    with tempfile.TemporaryDirectory() as scratch:
        target = Path(scratch) / "shot.png"
        subprocess.run(
            [
                browser, *FLAGS, f"--user-data-dir={scratch}/profile", f"--window-size=1400,{height}",
                f"--screenshot={target}", address,
            ],
            check=True, capture_output=True, timeout=120,
        )  # fmt: skip
        return Image.open(io.BytesIO(target.read_bytes())).convert("RGB")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--logdir", type=Path, help="runs to show; left out, a few are made")
    parser.add_argument("--to", type=Path, default=ROOT / "docs" / "images")
    arguments = parser.parse_args()
    browser = shutil.which("chromium") or shutil.which("chromium-browser")
    if browser is None:
        raise SystemExit("error: needs Chromium (apt-get install chromium)")
    with tempfile.TemporaryDirectory() as scratch:
        if arguments.logdir is None:
            for run in RUNS:
                subprocess.run([sys.executable, str(ROOT / "train.py"), *run], cwd=scratch, check=True)
        with tensorboard(arguments.logdir or Path(scratch) / "runs") as address:
            for name, (tab, height) in TABS.items():
                picture = shoot(browser, f"{address}/{tab}", height)
                # Few colours: a tenth of the size, and nothing lost to the eye.
                picture.quantize(128).save(arguments.to / f"tensorboard-{name}.png", optimize=True)


if __name__ == "__main__":
    main()
