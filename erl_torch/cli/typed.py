"""The command as it was typed, and the one that goes on after a stop."""

from __future__ import annotations

import contextlib
import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from erl_torch.cli import named_classes
from erl_torch.cli.config import config_dir
from erl_torch.files import here


@dataclass(frozen=True)
class Typed:
    """A command.

    Args:
        program: its words before the arguments, as in ("python", "train.py").
        arguments: the others.
        command: train, compare, play or reproduce.
    """

    program: tuple[str, ...]
    arguments: tuple[str, ...]
    command: str

    @staticmethod
    def of_process(command: str) -> Typed:
        """The command of this process; Python has taken the interpreter's own name from it."""
        script = Path(sys.argv[0])
        program: tuple[str, ...]
        if script.suffix != ".py":
            program = (script.name, command)
        elif script.name == "commands.py":
            program = ("python", "-m", "erl_torch.cli.commands", command)
        else:
            program = ("python", sys.argv[0])
        return Typed(program, tuple(sys.argv[1:]), command)

    def say_how_to_go_on(self, directory: Path) -> None:
        """Print the command that goes on with the run in ``directory``, or begins it again."""
        if self.command == "train" and any((directory / "checkpoints").glob("*.ckpt")):
            folder = config_dir(self.arguments)
            given = [] if folder is None else ["--config-dir", str(folder)]
            _say([*self.program, f"resume={here(directory)}", *named_classes.needed(directory), *given])
        elif self.command == "reproduce":
            _say([*self.program, *self.arguments])
        else:
            _say([*self.program, *self.arguments], "nothing is kept; to begin again")

    def say_how_to_go_on_sweeping(self, sweeps: Sequence[Path]) -> None:
        """Print the command that goes on with the sweep in the last of these directories, if there is one."""
        if sweeps:
            others = [a for a in self.arguments if not a.startswith("hydra.sweep.dir=")]
            _say([*self.program, *others, f"hydra.sweep.dir={here(sweeps[-1])}"])


def _say(words: Sequence[str], what: str = "to go on") -> None:
    with contextlib.suppress(OSError):
        print(f"{what}: {shlex.join(words)}", file=sys.stderr)
