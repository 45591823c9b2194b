"""Docstrings as the API reference needs them; the sources stay as they read best in an editor.

fields      what stands after ``# `` on a field's line joins its class as an ``Attributes`` section
members     of an enumeration join it in the same way, with their values
symbols     the brackets of ``<psi>`` and the asterisk of ``pi*`` become characters that are no markup
"""

from __future__ import annotations

import ast
import io
import re
import tokenize
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from griffe import Class, Docstring, Extension, Object


def _file(cls: Class) -> Path:
    assert isinstance(cls.filepath, Path)  # only a namespace package has several
    return cls.filepath


class Docstrings(Extension):
    """The extension that mkdocs.yml names."""

    def on_instance(self, *, obj: Object, **_: Any) -> None:
        if obj.docstring is not None:
            text = re.sub(r"<([\w.][\w. ]*)>", "\u27e8\\1\u27e9", obj.docstring.value)
            obj.docstring.value = re.sub(r"(?<![\w*])(theta|pi|[A-Za-z])\*(?![\w*])", "\\1\u2217", text)

    def on_class_members(self, *, node: Any, cls: Class, **_: Any) -> None:
        if isinstance(node, ast.ClassDef):
            rows = [f"    {name}: {text}" for name, text in _described(node, cls.lines_collection[_file(cls)])]
            before = cls.docstring.value.rstrip() if cls.docstring else ""
            if rows:
                cls.docstring = Docstring("\n".join([before, "", "Attributes:", *rows]), parent=cls, lineno=cls.lineno)


def _described(node: ast.ClassDef, lines: Sequence[str]) -> Iterator[tuple[str, str]]:
    """(name, text) of the public fields with a comment, and of the members of an enumeration."""
    for item in node.body:
        match item:
            case ast.AnnAssign(target=ast.Name(id=name), end_lineno=int(end)):
                text = _comment(lines[end - 1])
                if text and not name.startswith("_"):
                    yield name, text
            case ast.Assign(targets=[ast.Name(id=name)], value=ast.Constant(value=str(text))) if name.isupper():
                yield name, text


def _comment(line: str) -> str:
    try:
        tokens = list(tokenize.generate_tokens(io.StringIO(line.strip()).readline))
    except (tokenize.TokenError, IndentationError):
        return ""
    comments = [token.string for token in tokens if token.type == tokenize.COMMENT]
    text = comments[-1].split("# ")[-1].strip() if comments else ""
    return "" if text.startswith(("type:", "noqa")) else text
