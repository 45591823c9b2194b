"""Values that are paths, as the shell hands them over: with ``=``, ``#``, brackets, quotes, accents, and ``~``.

Hydra's grammar knows most of these as signs of its own. So what it would not read as it stands is quoted for it.
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException

# Settings whose value is a path, with and without the name of a learner in a comparison.
KEYS = re.compile(
    r"(env\.(path|wind)|experience\.(path|save_to|behaviour_policy)|(learner(\.\w+)?\.)?prior_policy|run|resume"
    r"|hydra\.(run|sweep)\.dir)"
)
AS_THEY_ARE = re.compile(r"""null|\?\?\?|'.*'|".*"|\[.*\]|.*\$\{.*\}.*""", re.DOTALL)  # no path, or quoted already
FUNCTIONS = re.compile(r"(choice|glob|range|shuffle|sort|tag|interval)\(.*\)", re.DOTALL)  # of sweeps


def quoted(text: str) -> str:
    """``text`` as a quoted value of Hydra's grammar."""
    doubled = re.sub(r"(\\+)(?='|$)", r"\1\1", text)
    return "'" + doubled.replace("'", "\\'") + "'"


def unquoted(text: str) -> str:
    """``text`` without the quotes that somebody has typed for Hydra's grammar."""
    for quote in "'\"":
        if len(text) > 1 and text[0] == text[-1] == quote and not os.path.exists(text):
            return text[1:-1].replace(f"\\{quote}", quote)
    return text


def expanded(text: str) -> str:
    """``text`` with the home directory for a ``~`` in front, unless there is a file of that name."""
    return text if os.path.exists(text) else os.path.expanduser(text)


def given(argument: str) -> str:
    """``argument`` (KEY=PATH) as it is meant: without quotes that were typed for Hydra, ``~`` expanded."""
    key, _, value = argument.partition("=")
    return f"{key}={expanded(unquoted(value))}"


def readable(argument: str, sweeping: bool, others: Sequence[str] = ()) -> str:
    """``argument`` (KEY=VALUE), its value quoted where KEY takes a path that Hydra would not read as it stands.

    Args:
        argument: of a command.
        sweeping: commas part the values of a sweep, and a sweep's functions are meant as such.
        others: all arguments: with hydra.job.chdir=true, what is there to be read is found from anywhere.
    """
    key, equals, value = argument.partition("=")
    if not equals or not value or not KEYS.fullmatch(key.lstrip("+")):
        return argument
    if AS_THEY_ARE.fullmatch(value) and not os.path.exists(value):
        return argument
    moving = any(re.fullmatch(r"hydra\.job\.chdir=(true|yes|on|1)", a, re.IGNORECASE) for a in others)
    absolute = moving and not key.startswith("hydra.") and not key.endswith("save_to")
    if sweeping and not os.path.exists(value):
        if FUNCTIONS.fullmatch(value):
            return argument
        return f"{key}=" + ",".join(_readable(one, absolute) for one in value.split(","))
    return f"{key}={_readable(value, absolute)}"


def _readable(path: str, absolute: bool) -> str:
    path = expanded(path)
    if absolute and os.path.exists(path):
        path = os.path.abspath(path)
    try:
        read = OverridesParser.create().parse_override(f"key={path}").value()
    except HydraException:
        read = None
    return path if read == path and isinstance(read, str) else quoted(path)
