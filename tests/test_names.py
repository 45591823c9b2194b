"""Public names: today's load, yesterday's load with one warning that says what to write instead."""

import importlib
import warnings

import pytest

import erl_torch

TODAY = {
    "FileRecording": "erl_torch.experience.recording.FileRecording",
    "Recording": "erl_torch.experience.experience.Experience",
    "open_recording": "erl_torch.experience.recording.read_experience",
    "record": "erl_torch.experience.collect.record",
    "save_columns": "erl_torch.experience.recording.write_experience",
}


@pytest.mark.parametrize("old", TODAY)
def test_old_names_load_with_one_warning(old):
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        value = getattr(erl_torch, old)
    module, name = TODAY[old].rsplit(".", 1)
    assert value is getattr(importlib.import_module(module), name)
    (warning,) = warned
    assert warning.category is DeprecationWarning
    assert warning.filename == __file__
    assert str(warning.message).startswith(f"erl_torch.{old} is deprecated: use ")


def test_old_names_are_in_no_list():
    assert not set(TODAY) & {*erl_torch.__all__, *dir(erl_torch)}


def test_every_listed_name_loads_without_a_warning():
    for name in erl_torch.__all__:
        assert name in dir(erl_torch)
        getattr(erl_torch, name)
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        _ = erl_torch.nothing
