"""Train a learner: ``python train.py env=windy_cliff``; ``--help`` shows what can be set."""

from pathlib import Path
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from erl_torch import cli, config

config.register()


@hydra.main(version_base="1.3", config_path="conf", config_name="train")
def main(cfg: DictConfig) -> Any:
    # Imported here: torch takes seconds, and --help and Tab completion do not need it.
    from erl_torch.training import train

    return train(cfg, Path(HydraConfig.get().runtime.output_dir))["objective"]


if __name__ == "__main__":
    cli.run(main)
