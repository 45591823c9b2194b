"""Compare learners on the same experience, against the exact optimum of a known model.

python compare.py env=windy_cliff 'learners=[s1,differential_soft_q]' seeds=20
python compare.py beta=5 experience.n_episodes=100 processes=2
python compare.py 'learners=[s1,u_learning]' learner.s1.n_bias=1      settings of one of them
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import hydra
from omegaconf import DictConfig

from erl_torch.cli import config
from erl_torch.cli import main as cli

config.register()


@hydra.main(version_base="1.3", config_path="conf", config_name="compare")
@cli.job
def main(cfg: DictConfig, directory: Path, safe_point: Callable[[], None]) -> Any:
    # Imported here: torch takes seconds, and --help and Tab completion do not need it.
    from erl_torch.run.compare import run_comparison

    return run_comparison(cfg, directory, safe_point)


if __name__ == "__main__":
    cli.run(main, __doc__, Path(__file__).parent / "conf", "compare")
