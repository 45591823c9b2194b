"""Screenshots of TensorBoard over a few runs, for the documentation: docs/images/tensorboard-*.png.

Needs Chromium (Debian: apt-get install chromium). Makes its runs in a temporary directory, a minute or two.

    python benchmarks/screenshots.py [--to docs/images]
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
    ("hydra.run.dir=runs/one/windy_cliff",),
    ("hydra.run.dir=runs/replicas/windy_cliff", "n_replicas=50"),
    ("-m", "hydra.sweep.dir=runs/sweep", "learner=s1,s1_efficient,rvi_soft_q,certainty_equivalence", "seed=0,1"),
)
FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--hide-scrollbars",
    "--disable-background-networking", "--disable-component-update", "--disable-sync", "--virtual-time-budget=20000",
)  # fmt: skip
# Name of the picture -> runs to show, what follows the address, and the window.
SHOTS = {
    "custom-scalars": ("one/windy_cliff", "#custom_scalars&_smoothingWeight=0", 1300, 1800),
    "text": ("one/windy_cliff", "#text", 1300, 800),
    "images": ("one", "#images", 1300, 1300),
    "scalars": ("sweep", "#scalars&_smoothingWeight=0&tagFilter=%5Eeval%7Clearner/theta%24", 1300, 1000),
    "hparams": ("sweep", "#hparams", 2350, 620),
    "replicas": ("replicas", "#custom_scalars&_smoothingWeight=0", 1300, 1500),
}


@contextlib.contextmanager
def tensorboard(logdir: Path) -> Iterator[str]:
    """The address of a TensorBoard on a free port of loopback that has read ``logdir``, which it shows by its name."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    log = tempfile.TemporaryFile()  # noqa: SIM115
    process = subprocess.Popen(
        [
            sys.executable, "-m", "tensorboard.main", "--logdir", logdir.name, "--host", "127.0.0.1",
            "--port", str(port), "--load_fast", "false", "--reload_interval", "1",
        ],
        stdout=log, stderr=log, cwd=logdir.parent,
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


def shoot(browser: str, address: str, width: int, height: int) -> Image.Image:
    """What ``browser`` shows at ``address`` in a window of that size."""
    with tempfile.TemporaryDirectory() as scratch:
        target = Path(scratch) / "shot.png"
        subprocess.run(
            [
                browser, *FLAGS, f"--user-data-dir={scratch}/profile", f"--window-size={width},{height}",
                f"--screenshot={target}", address,
            ],
            check=True, capture_output=True, timeout=120,
        )  # fmt: skip
        return Image.open(io.BytesIO(target.read_bytes())).convert("RGB")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--to", type=Path, default=ROOT / "docs" / "images")
    arguments = parser.parse_args()
    browser = shutil.which("chromium") or shutil.which("chromium-browser")
    if browser is None:
        raise SystemExit("error: needs Chromium (apt-get install chromium)")
    with tempfile.TemporaryDirectory() as scratch:
        for run in RUNS:
            subprocess.run([sys.executable, str(ROOT / "train.py"), *run], cwd=scratch, check=True)
        for name, (runs, tab, width, height) in SHOTS.items():
            with tensorboard(Path(scratch) / "runs" / runs) as address:
                picture = shoot(browser, f"{address}/{tab}", width, height)
            # Few colours: a third of the size, and nothing lost to the eye.
            picture.quantize(128).save(arguments.to / f"tensorboard-{name}.png", optimize=True)


if __name__ == "__main__":
    main()
