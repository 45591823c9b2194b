"""Around ``hydra.main``: help, and errors as one clear line with exit code 1 (bad input) or 2 (usage)."""

from __future__ import annotations

import contextlib
import functools
import math
import os
import re
import shlex
import shutil
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor
from pathlib import Path
from types import FrameType
from typing import Any

from hydra.conf import HydraConf
from hydra.core import utils as hydra_utils
from hydra.core.config_store import ConfigStore
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException, OverrideParseException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException, ValidationError

from erl_torch.checks import InputError, out_of_memory
from erl_torch.cli import named_classes, paths, sweeps
from erl_torch.cli.config import composed, options, overrides, register
from erl_torch.cli.typed import Typed
from erl_torch.files import alone, write_bytes
from erl_torch.guesses import did_you_mean, guess
from erl_torch.output import lasting
from erl_torch.run.origin import began_with
from erl_torch.run.settings import allowed

# Here, for jobs in processes of their own: loading the task imports this module, and names directories next.
register()

OF_CLASSES = ("env", "learner", "experience")
GROUPS = (*OF_CLASSES, "evaluation")
WITH_CLASSES = ("train", "compare")  # the commands that make what a class is named for
BY_RUN = (InputError, ArithmeticError, OSError, MemoryError, BrokenExecutor)
BY_CONFIGURATION = (HydraException, OmegaConfBaseException)
OPEN_NODES = (
    "env.kwargs.",
    "env.kwargs=",
    "env.tile_rewards.",
    "env.tile_rewards=",
    "experience.columns.",
    "experience.columns=",
    "vary.",
    "vary=",
)  # keys of the user's own: no schema lists them


ENV_ID = re.compile(r"(?:[\w.:-]+/)?[\w.:-]+-v\d+")  # of Gymnasium: NAMESPACE/NAME-vN, MODULE:NAME-vN


class Stopped(SystemExit):
    """A signal has ended the run in ``directory``."""

    def __init__(self, code: object, directory: Path) -> None:
        super().__init__(code)
        self.directory = directory


class Signals:
    """SIGINT and SIGTERM wait for a safe point: an exception out of a signal handler that happens to run
    inside the compiler or a compiled loop is lost there, or crashes the process. A second signal is not
    held back.

    So does a user's signal that has a handler: submitit's, which queues the job again before its time is up.
    The handler is called at the end."""

    def __init__(self) -> None:
        self.received: int | None = None
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Signals:
        if threading.current_thread() is threading.main_thread():
            numbers = [signal.SIGINT, signal.SIGTERM]
            numbers += [n for n in (signal.SIGUSR1, signal.SIGUSR2) if callable(signal.getsignal(n))]
            self._before = {n: signal.signal(n, self._note) for n in numbers}
        return self

    def __exit__(self, kind: type[BaseException] | None, *error: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
        if kind is SystemExit and self.received in (signal.SIGUSR1, signal.SIGUSR2):
            self._before[self.received](self.received, None)

    def safe_point(self) -> None:
        """Raise SystemExit(128 + signal) if one has come."""
        if self.received is not None:
            raise SystemExit(128 + self.received)

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.received = number
        if number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_DFL)
        with contextlib.suppress(OSError):  # past sys.stderr, which may be in the midst of a word
            os.write(2, b"\nstopping at the next safe point; what is done will be saved\n")


def job(work: Callable[[DictConfig, Path, Callable[[], None]], object]) -> Callable[[DictConfig], object]:
    """A Hydra task out of ``work(cfg, run_directory, safe_point)``.

    ``safe_point`` is to be called where the work may be ended: it raises SystemExit after a signal.
    Bad input ends a single run with one line and exit code 1; a run directory in which nothing was written goes
    again, and one that another process writes to is bad input. A job of a multirun that fails says so in a note
    (``erl_torch.cli.sweeps``) and returns None: a failed trial for a sweeper, and no matter for the other jobs.
    """

    @functools.wraps(work)
    def task(cfg: DictConfig) -> object:
        lasting()  # in a launcher's process too
        hydra = HydraConfig.get()
        directory = Path(hydra.runtime.output_dir)
        # A directory without a configuration is many runs'.
        attempt = functools.partial(_attempt, work, cfg, directory, shared=hydra.output_subdir is None)
        if hydra.mode == RunMode.MULTIRUN:
            return _one_of_many(attempt, hydra, directory)
        try:
            return attempt()
        except SystemExit as end:
            raise Stopped(end.code, directory) from None
        except Exception as error:
            if not expected(error):
                raise
            raise SystemExit(report(error)) from error

    return task


def expected(error: BaseException) -> bool:
    """Whether one line says all: no bug of this program, nor of a class of the user's."""
    if isinstance(error, ArithmeticError) and not type(error).__module__.startswith("erl_torch."):
        return False
    return isinstance(error, BY_RUN + BY_CONFIGURATION) or out_of_memory(error)


_held: dict[Path, str] = {}  # what Hydra had to write where a run has its own


def _save_config(cfg: DictConfig, filename: str, output_dir: Path) -> None:
    """Hydra's, which writes ``.hydra/`` before the work has had a look at the directory: a command that is refused
    there would put its settings in the place of the run's."""
    path = Path(str(output_dir)) / filename
    text = OmegaConf.to_yaml(cfg)
    if path.exists():
        _held[path] = text
    else:
        _held.pop(path, None)
        write_bytes(path, text.encode())


hydra_utils._save_config = _save_config


def _attempt(work: Callable[..., object], cfg: DictConfig, directory: Path, shared: bool) -> object:
    held = [path for path in _held if directory in path.parents]
    with contextlib.nullcontext() if shared else alone(directory):
        try:
            with Signals() as signals:
                value = work(cfg, directory, signals.safe_point)
            for path in held:
                write_bytes(path, _held[path].encode())
            return value
        except BY_RUN:
            if not held and {entry.name for entry in directory.iterdir()} <= {".hydra"}:
                shutil.rmtree(directory)
                above = directory.resolve().parent
                if above not in (Path.cwd(), *Path.cwd().parents):
                    with contextlib.suppress(OSError):  # not empty: other runs
                        above.rmdir()
            raise


def _one_of_many(attempt: Callable[[], object], hydra: HydraConf, directory: Path) -> object:
    sweep = Path(hydra.runtime.cwd, hydra.sweep.dir)  # a job may be elsewhere: hydra.job.chdir
    number, launcher = hydra.job.num, str(hydra.launcher._target_)
    sweeps.note(sweep, number, "running", directory=os.path.relpath(directory, sweep), complaint=None)
    try:
        value = attempt()
    except SystemExit:
        if "submitit" in launcher:
            raise  # queued again or cancelled: whoever waits for the job sees which
        sweeps.fail(sweep, number, "stopped by a signal")
        if "joblib" not in launcher:
            raise  # the signal was meant for the whole sweep
        return None
    except Exception as error:
        if not expected(error):
            traceback.print_exc()
        complaint = _line(error) if expected(error) else f"{type(error).__name__}: {error}"
        sweeps.fail(sweep, number, complaint)
        return None
    sweeps.note(sweep, number, "ended", value=value if isinstance(value, float) and math.isfinite(value) else None)
    return value


def run(main: Callable[[], Any], about: str, conf: Path, config_name: str) -> None:
    """Call a ``hydra.main`` function with our help and error lines.

    Args:
        main: the decorated function.
        about: head of the help text.
        conf: the configuration directory.
        config_name: the primary configuration.

    With HYDRA_FULL_ERROR=1 in the environment every traceback is shown.
    """
    lasting()
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())  # for classes of one's own
    asked = Typed.of_process(config_name)
    try:
        arguments, resumed, others = _understood(asked.arguments, conf, config_name)
    except InputError as error:
        raise SystemExit(report(error)) from None
    sys.argv[1:] = arguments
    full = bool(os.environ.get("HYDRA_FULL_ERROR"))
    # Hydra then raises what it would otherwise print over several lines.
    os.environ["HYDRA_FULL_ERROR"] = "1"
    rows: list[dict[str, Any]] = []
    directories: list[Path] = []
    try:
        sweeps.presets()
        for directory in resumed:
            named_classes.composed_again(directory, arguments, others, conf, config_name)
        _check_choices(arguments, conf)
        if {"-h", "--help"} & set(arguments):
            print(_help(about, conf, config_name, arguments))
            return
        with sweeps.patient_launchers() as directories:
            try:
                main()
            finally:
                rows = [row for directory in directories for row in sweeps.show(directory)]
    except KeyboardInterrupt:
        asked.say_how_to_go_on_sweeping(directories)
        raise SystemExit(130) from None
    except SystemExit as end:
        if isinstance(end, Stopped):
            asked.say_how_to_go_on(end.directory)
        elif end.code in (130, 143):
            asked.say_how_to_go_on_sweeping(directories)
        raise
    except Exception as error:
        if rows and len(sweeps.failures(rows)) == len(rows):
            raise SystemExit(1) from None  # a sweeper has nothing to choose from, and says so in its own way
        if full or not expected(error):
            raise
        raise SystemExit(report(error)) from None
    if sweeps.failures(rows):
        raise SystemExit(1)


def _understood(typed: Sequence[str], conf: Path, config_name: str) -> tuple[list[str], list[Path], list[str]]:
    """The arguments that were ``typed`` as Hydra takes them, the directories to be resumed, and what is typed besides.

    Classes of one's own are imported, and their arguments made keys. Raises InputError.
    """
    typed = [paths.given(a) if a.startswith("resume=") else a for a in typed]
    resumed = [Path(a.removeprefix("resume=")) for a in typed if a.startswith("resume=")]
    if config_name in WITH_CLASSES:
        typed = [named_classes.dotted(a) for a in typed]
    others = [a for a in typed if not a.startswith("resume=")]
    arguments = _resumed(typed)
    if config_name in WITH_CLASSES:
        arguments = named_classes.choices(arguments, conf)
        for directory in resumed:
            named_classes.named_again(directory, arguments, others)
        arguments = named_classes.offer(arguments)
        _offer_completions(typed, conf)
    sweeping = options(typed).multirun
    arguments = [paths.readable(a, sweeping, arguments) for a in arguments]
    # Keys that no schema lists need Hydra's "++"; the user need not know.
    arguments = [f"++{a}" if a.startswith(OPEN_NODES) else a for a in arguments]
    arguments = [b for a in arguments for b in _by_id(a, conf)]
    return arguments + (sweeps.directory(arguments) if sweeping else []), resumed, others


def _check_choices(arguments: Sequence[str], conf: Path) -> None:
    """Raise InputError for a group's value that Hydra would not take for a name: it has a bare ValueError for it."""
    for argument in arguments:
        group, _, value = argument.partition("=")
        if group in GROUPS and re.fullmatch(r"[-+.\d].*|true|false|null", value, re.IGNORECASE):
            names = sorted(path.stem for path in (conf / group).glob("*.yaml"))
            raise InputError(group, value, " or ".join(names))


def _offer_completions(arguments: Sequence[str], conf: Path) -> None:
    """What Tab completes is in the environment: its classes are offered too."""
    *words, last = os.environ.get("COMP_LINE", "").split(" ")
    if {"-sc", "--shell-completion"} & set(arguments):
        os.environ["COMP_LINE"] = " ".join([*named_classes.offer(named_classes.choices(words, conf)), last])


def _resumed(arguments: Sequence[str]) -> list[str]:
    """resume=RUN_DIR in full: the arguments that the run began with, and its directory."""
    given = [a for a in arguments if a.startswith("resume=")]
    if not given:
        return list(arguments)
    directory = Path(given[-1].removeprefix("resume="))
    began = began_with(directory, "resume")
    if began is None:
        raise InputError("resume", directory, "a run directory: one with .hydra/overrides.yaml")
    for argument in began:  # as Hydra notes them: none of its own settings and options
        if not re.fullmatch(r"(\+\+|\+|~)?(?!hydra\b)\w[\w@/.:-]*(=.*)?", argument, re.DOTALL):
            raise InputError("resume", directory, f"that of a run: {argument!r} in its overrides.yaml is no key=value")
    others = [a for a in overrides(arguments) if a not in given]
    of_hydra = [a for a in arguments if a not in (*given, *others)]  # at the end: Hydra wants all overrides together
    return [*began, *others, f"hydra.run.dir={paths.quoted(str(directory))}", *of_hydra]


def _by_id(argument: str, conf: Path) -> list[str]:
    """env=ID for env=NAME: the configuration with that id, or any environment of Gymnasium's."""
    key, _, value = argument.partition("=")
    if key != "env" or not any(map(ENV_ID.fullmatch, value.split(","))):
        return [argument]
    loaded = {path.stem: OmegaConf.load(path) for path in sorted((conf / "env").glob("*.yaml"))}
    ids = {str(node.get("id")): name for name, node in loaded.items() if isinstance(node, DictConfig)}
    names = [ids.get(name, name) for name in value.split(",")]
    if len(names) == 1 and names == [value]:
        return ["env=gym", f"env.id={value}"]
    for name in filter(ENV_ID.fullmatch, names):  # of several, each is a configuration of its own
        above, _, last = f"env/{name}".rpartition("/")
        node = {"defaults": ["/env/gym@_here_", "_self_"], "id": name}
        ConfigStore.instance().store(group=above, name=last, node=node)
    return [f"env={','.join(names)}"]


def _help(about: str, conf: Path, config_name: str, arguments: list[str]) -> str:
    cfg = composed(conf, config_name, arguments)
    choices = [
        f"  {group.name}={{{','.join(sorted(option.stem for option in group.glob('*.yaml')))}}}"
        for group in sorted(conf.iterdir())
        if group.is_dir() and "name" in (cfg.get(group.name) or {})
    ]
    head = [
        about.rstrip(),
        "",
        *(["Choices:", *choices, ""] if choices else []),
        "Keys and values (each is explained in conf/):",
        "",
    ]
    return "\n".join(head) + "\n" + OmegaConf.to_yaml(cfg).rstrip()


def report(error: Exception) -> int:
    """Print the one line; the exit code."""
    print(f"error: {_line(error)}", file=sys.stderr)
    return 2 if isinstance(error, OverrideParseException) else 1


def _line(error: Exception) -> str:
    if isinstance(error, OverrideParseException):
        key, _, value = error.override.partition("=")
        if not re.fullmatch(r"[+~]*[\w.@/:-]+", key) or not value:
            return f"{error.override}: not of the form key=value"
        whole = f"{key}={paths.quoted(value)}"
        typed = shlex.quote(whole) if re.search(r'[$`\\"!]', whole) else f'"{whole}"'
        remedy = f"text with signs of its own goes in quotes: {typed}"
        return f"{error.override}: not of the form key=value as Hydra reads it; {remedy}"
    if isinstance(error, BY_CONFIGURATION):
        return _explain(error)
    if isinstance(error, OSError):
        return f"{error.filename or 'file system'}: {error.strerror or error}"
    if out_of_memory(error):
        return f"memory: not enough ({str(error).splitlines()[0] if str(error) else 'the system gives no more'})"
    if isinstance(error, BrokenExecutor):
        return f"processes: one was killed, for want of memory perhaps ({error})"
    return " ".join(str(error).split())


def _meant(key: str, value: str, cfg: Any) -> str:  # a configuration of any kind
    """The guess at an unknown ``key``: one that ends so, or else one that resembles it."""
    group, dot, last = key.rpartition(".")
    known = [one for one in _keys(cfg, "") if not re.search(r"^hydra|suggest\.|\.(name|class)$", one)]
    near = [one for one in known if one.startswith(f"{group}.")] if dot else known
    words = {one.rpartition(".")[2]: one for one in reversed(near or known)}  # the first of each word
    word = last if last in words else guess(last, words)
    found = None if word is None else words[word]
    return "" if found is None else f"; did you mean {found}={value}?"


def _keys(node: Any, prefix: str) -> Iterator[str]:
    """The dotted keys of ``node``, groups among them."""
    for name in map(str, node):
        yield prefix + name
        known = not OmegaConf.is_missing(node, name) and not OmegaConf.is_interpolation(node, name)
        if known and OmegaConf.is_dict(node[name]):
            yield from _keys(node[name], f"{prefix}{name}.")


def _explain(error: Exception) -> str:
    """One line out of the several of Hydra and OmegaConf: the override where it is named, then the reason."""
    reason = error.__cause__ if isinstance(error.__cause__, OmegaConfBaseException) else error
    said = str(reason)
    choice = re.search(r"Could not find '(\S+)/([^'/]*)'\s+Available options in '[^']*':\n((?:\t\S+\n?)+)", said)
    if choice:
        group, name, options = choice.groups()
        if group.startswith("hydra/") and name in sweeps.EXTRAS:
            extra = sweeps.EXTRAS[name]
            return f"{group}={name}: not installed; pip install 'erl_torch[{extra}]' (in a clone: -e '.[{extra}]')"
        own = f", or MODULE:{'ID or MODULE:' * (group == 'env')}CLASS of your own" if group in OF_CLASSES else ""
        return str(InputError(group, name, " or ".join(options.split()) + own + did_you_mean(name, options.split())))
    missing = re.search(r"Missing mandatory value: (\S+)", said)
    if missing:
        return str(InputError(missing[1], "???", f"given, as in {missing[1]}=VALUE"))
    override = re.search(r"(?:Error merging override|Could not override) '?([^\s']+?)'?\.?(?:\s|$)", str(error))
    subject = override[1] if override else getattr(reason, "full_key", None)
    node = getattr(reason, "parent_node", None)
    if re.search(r"Key '[^']*' (is )?not in", said) and node is not None:
        names = [name for name in map(str, node) if name not in ("name", "hydra")]
        given = next((a for a in sys.argv[1:] if a.lstrip("+~").startswith(f"{subject}=")), str(subject))
        value = given.partition("=")[2]
        hint = _meant(str(subject), value, node._get_root())
        return f"{given}: no such key; there are {', '.join(names)}{hint}"
    given = next((a for a in sys.argv[1:] if a.startswith(str(subject))), str(subject))  # whole, if it has spaces
    key, typed, value = given.partition("=")
    key = key.lstrip("+~")
    takes = allowed(key) if typed else None
    if takes is not None and isinstance(reason, ValidationError):
        return str(InputError(key, value, takes))
    text = " ".join(re.sub(r"\n\s*(full_key|object_type|reference_type)[:=][^\n]*", "", said).split())
    return f"{subject}: {text}" if subject and subject not in text else text
