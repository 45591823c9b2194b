"""Write files under a temporary name, then rename them; read them without pickle."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import json
import os
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from erl_torch.checks import InputError

END_BYTES, LONGEST_COMMENT = 22, (1 << 16) - 1  # of a zip's last record
UNCOUNTED = (1 << 16) - 1  # the count of members there that means "this many or more"


def _write(path: str | os.PathLike[str], fill: Callable[[BinaryIO], None]) -> Path:
    path = Path(path)
    if path.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with open(temporary, "wb") as file:
            fill(file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
    return path


def here(path: Path) -> Path:
    """A path as a user would write it: below the working directory, or in full; so that itself, where the program may
    have gone alone (hydra.job.chdir)."""
    whole = path.resolve()
    with contextlib.suppress(ValueError):
        return whole if whole == Path.cwd() else whole.relative_to(Path.cwd())
    return path


def write_npz(path: str | os.PathLike[str], arrays: Mapping[str, Any]) -> Path:
    """Write a compressed npz; the same arrays give the same bytes. Object arrays are refused."""

    def fill(file: BinaryIO) -> None:
        with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=3) as archive:
            for name, value in arrays.items():
                # A fixed date: equal results are then equal files.
                member = zipfile.ZipInfo(f"{name}.npy", date_time=(1980, 1, 1, 0, 0, 0))
                member.compress_type = zipfile.ZIP_DEFLATED
                with archive.open(member, "w", force_zip64=True) as entry:
                    np.lib.format.write_array(entry, np.asarray(value), allow_pickle=False)

    return _write(path, fill)


def write_bytes(path: str | os.PathLike[str], content: bytes) -> Path:
    """Write ``content`` as it is."""

    def fill(file: BinaryIO) -> None:
        file.write(content)

    return _write(path, fill)


def write_json(path: str | os.PathLike[str], value: Mapping[str, Any]) -> Path:
    """Write JSON (no NaN or infinity)."""
    return write_bytes(path, (json.dumps(value, indent=2, allow_nan=False) + "\n").encode())


def read_json(path: str | os.PathLike[str], key: str, remedy: str) -> dict[str, Any] | None:
    """A JSON object; None where there is no such file.

    Raises InputError (under ``key``) for a file that holds anything else; ``remedy`` tells what to do about it.
    """
    try:
        value = json.loads(Path(path).read_bytes())
    except FileNotFoundError:
        return None
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(key, path, f"readable JSON ({error}); {remedy}") from error
    if not isinstance(value, dict):
        raise InputError(key, path, f"a JSON object; {remedy}")
    return value


def write_png(path: str | os.PathLike[str], pixels: np.ndarray) -> Path:
    """Write an image [H, W, 3] uint8."""
    from matplotlib.image import imsave

    return _write(path, lambda file: imsave(file, pixels, format="png", metadata={"Software": ""}))


@contextlib.contextmanager
def alone(directory: str | os.PathLike[str], key: str = "hydra.run.dir") -> Iterator[None]:
    """Lock a run directory. The lock ends with the process, however that ends, and leaves no file.

    Raises InputError under ``key`` if another process holds the lock. A file system without locks lets every process
    in.
    """
    descriptor = os.open(directory, os.O_RDONLY)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise InputError(key, directory, "a directory that no other run is writing to") from error
        except OSError:
            pass
        yield
    finally:
        os.close(descriptor)


def write_gif(path: str | os.PathLike[str], frames: Sequence[np.ndarray], fps: float) -> Path:
    """Write pictures [H, W, 3] uint8 as an endless loop, ``fps`` pictures per second; the format allows up to 50."""
    from PIL import Image

    first, *others = (Image.fromarray(frame) for frame in frames)
    milliseconds = max(20, round(1000 / fps))

    def fill(file: BinaryIO) -> None:
        first.save(file, format="gif", save_all=True, append_images=others, duration=milliseconds, loop=0)

    return _write(path, fill)


def read_npz(path: str | os.PathLike[str], key: str = "path") -> dict[str, np.ndarray]:
    """All arrays of an npz file, without pickle.

    Raises InputError (under ``key``) if the file is missing, damaged, or holds objects; the message names the member.
    """
    member = ""
    try:
        with zipfile.ZipFile(path) as archive:
            check_directory(archive)
            arrays = {}
            for member in archive.namelist():
                with archive.open(member) as file:
                    arrays[member.removesuffix(".npy")] = np.lib.format.read_array(file, allow_pickle=False)
                    # np.load does not read to the end of a member, where the checksum is compared.
                    if rest := len(file.read()):
                        raise ValueError(f"{rest} bytes too many")
            return arrays
    except Exception as error:
        # Damage raises a dozen kinds of exception, zlib's and struct's among them.
        reason = f"{member}: {error}" if member else f"{error}"
        raise InputError(key, path, f"a readable npz file without pickled objects ({reason})") from error


def check_directory(archive: zipfile.ZipFile) -> None:
    """Raise ValueError unless ``archive`` has as many members as its last record counts, and each array once.

    A damaged length in the directory makes one entry swallow those after it. No other check notices that.
    """
    file = archive.fp
    assert file is not None
    size = file.seek(0, os.SEEK_END)
    file.seek(max(0, size - END_BYTES - LONGEST_COMMENT))
    tail = file.read()
    begin = tail.rfind(b"PK\x05\x06")
    counted = int.from_bytes(tail[begin + 10 : begin + 12], "little")
    names = [name.removesuffix(".npy") for name in archive.namelist()]
    if counted not in (len(names), UNCOUNTED):
        raise ValueError(f"{counted} members are announced, and {len(names)} listed")
    if len(set(names)) < len(names):
        raise ValueError(f"{next(name for name in names if names.count(name) > 1)} is there twice")


def read_npy(path: str | os.PathLike[str], key: str = "path") -> np.ndarray:
    """One array from an npy file, without pickle. Raises InputError under ``key``."""
    try:
        with open(path, "rb") as file:
            array = np.load(file, allow_pickle=False)
    except Exception as error:
        raise InputError(key, path, f"a readable npy file without pickled objects ({error})") from error
    if not isinstance(array, np.ndarray):
        raise InputError(key, path, "an npy file")
    return array
