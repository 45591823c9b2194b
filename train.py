"""Learn the optimal entropy-regularised policy of a stochastic MDP from a stream of tuples.

python train.py env=windy_cliff                        the paper's Figure 5
python train.py learner.beta=5 experience.n_episodes=200
python train.py env=FrozenLake-v1                      any environment of Gymnasium's with finite spaces
python train.py learner=s1_efficient                   the learner to use
python train.py -m learner.beta=2,5,10 seed=0,1        one run a combination
tensorboard --logdir runs                              look at the runs
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import hydra
from omegaconf import DictConfig

from erl_torch.cli import config
from erl_torch.cli import main as cli

config.register()


@hydra.main(version_base="1.3", config_path="conf", config_name="train")
@cli.job
def main(cfg: DictConfig, directory: Path, safe_point: Callable[[], None]) -> Any:
    # Imported here: torch takes seconds, and --help and Tab completion do not need it.
    from erl_torch.run.training import train

    return train(cfg, directory, safe_point)["objective"]


if __name__ == "__main__":
    cli.run(main, __doc__, Path(__file__).parent / "conf", "train")
