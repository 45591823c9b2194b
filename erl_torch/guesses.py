"""What was probably meant by a word that is not among those allowed."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable


def guess(word: object, allowed: Iterable[str]) -> str | None:
    """The one of ``allowed`` that ``word`` resembles, or None; capitals, ``_``, ``-`` and a version do not count."""
    plain: dict[str, str] = {}
    for one in allowed:
        plain.setdefault(_plain(one), one)
    close = difflib.get_close_matches(_plain(str(word)), plain, n=1, cutoff=0.7)
    return plain[close[0]] if close else None


def did_you_mean(word: object, allowed: Iterable[str], form: str = "{}") -> str:
    """``; did you mean ...?``, or nothing. ``form`` says how the guess is written."""
    found = guess(word, allowed)
    return "" if found is None else f"; did you mean {form.format(found)}?"


def _plain(word: str) -> str:
    return re.sub(r"[-_ ]+", "", re.sub(r"-v\d+$", "", word)).lower()
