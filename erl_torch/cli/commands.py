"""The four commands, as ``erl-torch train|compare|play|reproduce`` and as the scripts at the top of the tree.

Each is Hydra's ``main`` over one configuration of ``conf/``, which is installed as ``erl_torch.conf``. What does the
work is imported when it begins: torch takes seconds, and --help and Tab completion do not need it.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import hydra
from omegaconf import DictConfig

from erl_torch import configurations
from erl_torch.cli import main as cli
from erl_torch.guesses import did_you_mean
from erl_torch.reproduction import ARTIFACTS

TRAIN = """Learn the optimal entropy-regularised policy of a stochastic MDP from a stream of tuples.

python train.py env=windy_cliff                        the paper's Figure 5
python train.py learner.beta=5 experience.n_episodes=200
python train.py env=FrozenLake-v1                      any environment of Gymnasium's with finite spaces
python train.py env=my_module:MyEnv                    one of your own: a class of my_module.py, or an id it registers
python train.py learner=s1_efficient                   the learner to use
python train.py learner.class=my_package.MyLearner     one of your own; experience.class likewise
python train.py -m learner.beta=2,5,10 seed=0,1        one run per combination
python train.py resume=RUN_DIR                         go on after a stop
tensorboard --logdir runs                              look at the runs
"""

COMPARE = """Compare learners on the same experience, against the exact optimum of a known model.

python compare.py env=windy_cliff 'learners=[s1,differential_soft_q]' seeds=20
python compare.py beta=5 experience.n_episodes=100 processes=2
python compare.py 'learners=[s1,u_learning]' learner.s1.n_bias=1      settings of one of them
"""

PLAY = """Play a learnt policy in its environment.

python play.py run=latest                              the newest run below runs/
python play.py run=runs/windy_cliff/1124-101500-123456 n_episodes=100 seed=1
python play.py run=latest render=gif                   an episode as a picture that moves, in the run directory
python play.py run=latest replica=3 greedy=true        the third replica's policy, most probable actions only
"""

REPRODUCE = """Rebuild a figure or table of the paper: numbers as CSV and JSON, picture as PNG and SVG.

python reproduce.py artifact=figure_5                  a small version, in seconds to a minute
python reproduce.py artifact=table_s1 scale=full       the whole of it
python reproduce.py artifact=all scale=full            everything
Ours stand beside what is printed in the paper, read off its pictures, or computed independently (no claim of it).
Stopped or killed, the same command goes on where it was. Files: runs/reproduce/ARTIFACT-SCALE-seedSEED.
"""


CONF = configurations.folder()


@hydra.main(version_base="1.3", config_path=str(CONF), config_name="train")
@cli.job
def _train(cfg: DictConfig, directory: Path, safe_point: Callable[[], None]) -> object:
    from erl_torch.run.training import train as run

    return run(cfg, directory, safe_point)["objective"]


@hydra.main(version_base="1.3", config_path=str(CONF), config_name="compare")
@cli.job
def _compare(cfg: DictConfig, directory: Path, safe_point: Callable[[], None]) -> object:
    from erl_torch.run.compare import run_comparison

    return run_comparison(cfg, directory, safe_point)


@hydra.main(version_base="1.3", config_path=str(CONF), config_name="play")
def _play(cfg: DictConfig) -> None:
    from erl_torch.run.playing import play as run

    try:
        run(cfg)
    except Exception as error:  # Hydra would add a line of its own
        if not cli.expected(error):
            raise
        raise SystemExit(cli.report(error)) from None


@hydra.main(version_base="1.3", config_path=str(CONF), config_name="reproduce")
@cli.job
def _reproduce(cfg: DictConfig, directory: Path, safe_point: Callable[[], None]) -> None:
    from erl_torch.reproduction.runner import reproduce as run

    run(cfg, directory, safe_point)


def train() -> None:
    """``train`` with the arguments of the process."""
    cli.run(_train, TRAIN, CONF, "train")


def compare() -> None:
    """``compare`` with the arguments of the process."""
    cli.run(_compare, COMPARE, CONF, "compare")


def play() -> None:
    """``play`` with the arguments of the process."""
    cli.run(_play, PLAY, CONF, "play")


def reproduce() -> None:
    """``reproduce`` with the arguments of the process."""
    names = [f"  {name:10} {about}" for name, about in {**ARTIFACTS, "all": "every one of these"}.items()]
    cli.run(_reproduce, "\n".join([REPRODUCE, "Artifacts:", *names]), CONF, "reproduce")


COMMANDS = {
    "train": (train, TRAIN),
    "compare": (compare, COMPARE),
    "play": (play, PLAY),
    "reproduce": (reproduce, REPRODUCE),
}


def main() -> None:
    """``erl-torch COMMAND key=value ...``; exit code 2 where there is no such command."""
    if len(sys.argv) < 2 or sys.argv[1] not in COMMANDS:
        given = sys.argv[1] if len(sys.argv) > 1 else ""
        asked = given in ("-h", "--help")
        lines = [f"erl-torch {name} ...    {text.splitlines()[0]}" for name, (_, text) in COMMANDS.items()]
        if not asked:
            hint = did_you_mean(given, COMMANDS)
            print(f"error: {given or 'no command'}: must be one of {', '.join(COMMANDS)}{hint}", file=sys.stderr)
        print("\n".join(lines), file=sys.stdout if asked else sys.stderr)
        raise SystemExit(0 if asked else 2)
    command, _ = COMMANDS[sys.argv.pop(1)]
    command()


if __name__ == "__main__":
    main()
