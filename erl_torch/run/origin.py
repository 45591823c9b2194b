"""What a run began with: the arguments noted in its directory, and the texts that its log shows."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from erl_torch.checks import InputError
from erl_torch.files import read_json

ALWAYS = ("env", "learner", "beta", "seed", "n_replicas", "n_experience")  # shown of a run that is no job of a sweep


def began_with(directory: Path, key: str = "overrides") -> list[str] | None:
    """The arguments that the run in ``directory`` began with; None where they are not noted.

    Raises:
        InputError: under ``key``, for a note that is damaged.
    """
    path = directory / ".hydra" / "overrides.yaml"
    if not path.exists():
        return None
    try:
        arguments: Any = OmegaConf.to_container(OmegaConf.load(path))
    except Exception as error:  # of the parser, of OmegaConf, of the file system, of text that is none
        cause = " ".join(str(error).split())[:200]
        raise InputError(key, path, f"a readable list of the arguments that the run began with ({cause})") from error
    if not isinstance(arguments, list) or not all(isinstance(item, str) for item in arguments):
        raise InputError(key, path, "the list of the arguments that the run began with, key=value each")
    return arguments


def shown(directory: Path) -> list[str] | None:
    """Keys of the settings that tell the run in ``directory`` from others: those that its sweep varies, or were typed.

    None where neither is noted.
    """
    try:
        typed = began_with(directory)
        jobs = (read_json(directory.resolve().parent / "sweep.json", "sweep", "") or {}).get("jobs")
    except InputError:
        return None
    if typed is None:
        return None
    if isinstance(jobs, list) and len(jobs) > 1:
        sets = [set(job["overrides"]) for job in jobs if isinstance(job, dict) and "overrides" in job]
        typed = [one for one in typed if not all(one in overrides for overrides in sets)]
        return [key_of(one) for one in typed]
    return [*ALWAYS, *map(key_of, typed)]


def key_of(override: str) -> str:
    """Of KEY=VALUE the key, without Hydra's signs."""
    return override.partition("=")[0].lstrip("+~")


def texts(configuration: str, directory: Path) -> dict[str, str]:
    """Markdown by tag: the ``configuration`` (YAML), and the command behind the run where ``directory`` notes it."""
    markdown = {"configuration": f"```yaml\n{configuration}```"}
    try:
        arguments = began_with(directory)
    except InputError as error:
        arguments = None
        print(f"warning: the log does without the command behind the run ({error})", file=sys.stderr)
    if arguments is not None:
        markdown["command"] = f"```\n{shlex.join(['python', 'train.py', *arguments])}\n```"
    return markdown
