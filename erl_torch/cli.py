"""From exceptions to one clear line and an exit code: 1 for bad input, 2 for usage."""

from __future__ import annotations

import os
import re
import signal
import sys
from collections.abc import Callable
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException, OverrideParseException
from hydra.types import RunMode
from omegaconf.errors import OmegaConfBaseException

from erl_torch.checks import InputError


def run(main: Callable[[], Any]) -> None:
    """Call a ``hydra.main`` function; errors of input become one line on stderr and an exit code.

    With HYDRA_FULL_ERROR=1 in the environment every traceback is shown.
    """
    signal.signal(signal.SIGTERM, _terminate)
    if os.environ.get("HYDRA_FULL_ERROR"):
        main()
        return
    # Hydra then raises what it would otherwise print over several lines.
    os.environ["HYDRA_FULL_ERROR"] = "1"
    try:
        main()
    except OverrideParseException as error:
        _fail(f"{error.override}: not of the form key=value ({_one_line(error)})", 2)
    except (HydraException, OmegaConfBaseException) as error:
        _fail(_explain(error), 1)
    except (InputError, ArithmeticError) as error:
        _fail(str(error), 1)
    except OSError as error:
        _fail(f"{error.filename or 'file system'}: {error.strerror or error}", 1)
    except KeyboardInterrupt:
        _fail("stopped by Ctrl-C; what was logged is on disk", 130)


def is_multirun() -> bool:
    """Whether the running job is one of a multirun."""
    return bool(HydraConfig.get().mode == RunMode.MULTIRUN)


def _terminate(number: int, frame: Any) -> None:
    raise SystemExit(128 + number)


def _fail(line: str, code: int) -> None:
    print(f"error: {line}", file=sys.stderr)
    raise SystemExit(code)


def _explain(error: BaseException) -> str:
    """One line out of Hydra's and OmegaConf's several: the override if it is named, then the reason."""
    override = re.search(r"(?:override|Error merging override) '?([^\s']+)'?", str(error))
    reason = error.__cause__ if isinstance(error.__cause__, OmegaConfBaseException) else error
    text = _one_line(reason)
    missing = re.match(r"In '[^']+': Could not find '([^/]+(?:/[^/]+)*)/([^']+)' Available options .*?: (.+?)(?: Config|$)", text)
    if missing:
        group, choice, options = missing.groups()
        return f"{group}={choice}: must be one of {', '.join(options.split())}"
    key = getattr(reason, "full_key", None)
    name = override.group(1) if override else key
    return f"{name}: {text}" if name and name not in text else text


def _one_line(error: BaseException) -> str:
    text = str(error)
    text = re.sub(r"\n\s*(full_key|object_type|reference_type):[^\n]*", "", text)
    text = re.sub(r"\nTo append to your config use[^\n]*", "", text)
    return " ".join(text.split())
