"""Where Numba keeps compiled loops, on machines where it may write neither beside the package nor at home."""

from __future__ import annotations

import atexit
import os
import shutil
import stat
import sys
import tempfile
from pathlib import Path

PACKAGE = Path(__file__).parent
_found: list[str] = []  # the folder that was named


def find_room() -> None:
    """Name a folder for compiled loops (``NUMBA_CACHE_DIR``) where Numba would find none, and raise for each of them.

    To be called before a module with loops is imported. The folder is the user's own, below the system's for temporary
    files, and is used again; nothing is set where Numba has room, or nothing is compiled.
    """
    given = os.environ.get("NUMBA_CACHE_DIR")
    own = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    # As Numba looks for room, in its order.
    places = (given, str(PACKAGE / "__pycache__"), os.path.join(own, "numba"))
    if any(_can_be_written(place) for place in places if place):
        return
    folder = str(_of_this_user())
    _found.append(folder)
    os.environ["NUMBA_CACHE_DIR"] = folder
    if "numba" in sys.modules:  # it has read its environment
        sys.modules["numba"].config.CACHE_DIR = folder


def announcement() -> str:
    """What a run says before it compiles."""
    elsewhere = f", and kept in {_found[0]}, as neither package nor home can be written to" if _found else ""
    return f"compiling the loops, about ten seconds: on the first run only{elsewhere}"


def _can_be_written(folder: str) -> bool:
    """Whether files can be written in ``folder``, which is made if it can be."""
    try:
        os.makedirs(folder, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


def _of_this_user() -> Path:
    """A folder of temporary files that nobody else can write to: what is in it is run."""
    folder = Path(tempfile.gettempdir(), f"erl_torch-loops-{os.getuid()}")
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        found = folder.lstat()
        if stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & 0o077:
            return folder
    except OSError:
        pass
    own = Path(tempfile.mkdtemp(prefix="erl_torch-loops-"))
    atexit.register(shutil.rmtree, own, ignore_errors=True)
    return own
