"""Output that a run outlives: full devices, readers that have gone, closed descriptors."""

import contextlib
import io
import json
import os
import sys

import pytest
from helpers import ROOT, composed, ended, events

from erl_torch.output import Lasting
from erl_torch.run.training import train as perform

SMALL = ("experience.n_episodes=2", "learner.n_epochs=2", "learner.n_bias=2", "evaluation.pictures=false")


class Failing(io.StringIO):
    """A stream that fails in a given way from the second word on."""

    def __init__(self, error):
        super().__init__()
        self.error = error

    def write(self, text):
        if self.getvalue():
            raise self.error
        return super().write(text)

    def flush(self):
        if self.getvalue():
            raise self.error


@pytest.mark.parametrize("error", [BrokenPipeError(32, "Broken pipe"), OSError(28, "full"), ValueError("closed file")])
def test_what_cannot_be_written_is_dropped(error):
    stream = Lasting(Failing(error))
    for word in ("one", "two", "three"):
        assert stream.write(word) == len(word)
        stream.flush()
    assert stream.getvalue() == "one"
    assert bool(stream.broken) == isinstance(error, OSError)


def test_a_pipe_that_is_full_for_a_while_takes_what_comes_later():
    end, start = os.pipe()
    os.set_blocking(start, False)
    stream = Lasting(io.TextIOWrapper(io.FileIO(start, "w"), write_through=True))
    stream.write("x" * 200_000)
    assert not stream.broken
    os.read(end, 200_000)
    stream.write("later")
    assert os.read(end, 200_000).endswith(b"later")
    stream.close()
    os.close(end)


def test_lost_output_is_sent_nowhere_and_named_once(monkeypatch, capfd):
    """The descriptor too: buffers are written out at exit, and libraries write to it themselves."""
    with open("/dev/full", "w") as full:
        monkeypatch.setattr(sys, "stdout", Lasting(full))
        for _ in range(3):
            sys.stdout.write("word")
            sys.stdout.flush()
        os.write(full.fileno(), b"word")
    assert capfd.readouterr().err.count("warning: standard output is lost (No space left on device)") == 1


def test_runs_end_well_without_their_output(tmp_path, start):
    """On a full device, with a reader that is gone, with closed descriptors, and a sweep."""
    perform(composed(*SMALL), tmp_path / "here")  # compiles the loops, once for all processes
    train = [sys.executable, str(ROOT / "train.py"), *SMALL]
    end, broken = os.pipe()
    os.close(end)
    with contextlib.ExitStack() as stack:
        full = stack.enter_context(open("/dev/full", "w"))
        processes = {
            "full": start(*train, "hydra.run.dir=full", cwd=tmp_path, stdout=full, stderr=broken),
            "closed": start("sh", "-c", '"$@" hydra.run.dir=closed 0<&- >&- 2>&-', "sh", *train, cwd=tmp_path),
            "sweep": start(
                *train[:2], "-m", *SMALL, "seed=0", "hydra.sweep.dir=sweep", "hydra.sweep.subdir=job",
                cwd=tmp_path, stdout=broken, stderr=full,
            ),
            "bad": start(*train, "learner.beta=0", cwd=tmp_path, stdout=full, stderr=broken),
        }  # fmt: skip
        os.close(broken)
        codes = {name: ended(process)[0] for name, process in processes.items()}
    assert codes == {"full": 0, "closed": 0, "sweep": 0, "bad": 1}
    for directory in (tmp_path / "full", tmp_path / "closed", tmp_path / "sweep" / "job"):
        assert json.loads((directory / "result.json").read_text())["status"] == "completed"
        assert (directory / "solution.npz").exists()
        assert events(directory).Scalars("Final/theta")  # the last record: no words between those before
    assert json.loads((tmp_path / "sweep" / "sweep.json").read_text())["jobs"][0]["status"] == "completed"
