"""Play a learnt policy in its environment.

python play.py run=latest                              the newest run below runs/
python play.py run=runs/windy_cliff/1124-101500-123456 n_episodes=100 seed=1
python play.py run=latest render=gif                   an episode as a picture that moves, in the run directory
python play.py run=latest replica=3 greedy=true        the third replica's policy, most probable actions only
"""

from pathlib import Path

import hydra
from omegaconf import DictConfig

from erl_torch.cli import config
from erl_torch.cli import main as cli

config.register()


@hydra.main(version_base="1.3", config_path="conf", config_name="play")
def main(cfg: DictConfig) -> None:
    # Imported here: torch takes seconds, and --help and Tab completion do not need it.
    from erl_torch.run.playing import play

    try:
        play(cfg)
    except Exception as error:  # Hydra would add a line of its own
        if not cli.expected(error):
            raise
        raise SystemExit(cli._report(error)) from None


if __name__ == "__main__":
    cli.run(main, __doc__, Path(__file__).parent / "conf", "play")
