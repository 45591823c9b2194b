"""Rebuild a figure or table of the paper: numbers as CSV and JSON, picture as PNG and SVG.

python reproduce.py artifact=figure_5                  a small version, in seconds to a minute
python reproduce.py artifact=table_s1 scale=full       the whole of it
python reproduce.py artifact=all scale=full            everything
Ours stand beside what is printed in the paper, read off its pictures, or computed independently (no claim of it).
Stopped or killed, the same command goes on where it was. Files: runs/reproduce/ARTIFACT-SCALE-seedSEED.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import hydra
from omegaconf import DictConfig

from erl_torch.cli import config
from erl_torch.cli import main as cli
from erl_torch.reproduction import ARTIFACTS

config.register()


@hydra.main(version_base="1.3", config_path="conf", config_name="reproduce")
@cli.job
def main(cfg: DictConfig, directory: Path, safe_point: Callable[[], None]) -> Any:
    # Imported here: torch takes seconds, and --help and Tab completion do not need it.
    from erl_torch.reproduction.runner import reproduce

    reproduce(cfg, directory, safe_point)


if __name__ == "__main__":
    names = [f"  {name:10} {about}" for name, about in {**ARTIFACTS, "all": "every one of these"}.items()]
    cli.run(main, "\n".join([__doc__, "Artifacts:", *names]), Path(__file__).parent / "conf", "reproduce")
