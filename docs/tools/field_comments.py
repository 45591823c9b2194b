"""Docstrings as the API reference needs them; the sources stay as they read best in an editor.

fields      what stands after ``# `` on a field's line joins its class as an ``Attributes`` section
members     of an enumeration join it in the same way, with their values
averages    ``<psi>`` gets brackets that are no HTML
"""

from __future__ import annotations

import ast
import io
import re
import tokenize
from typing import Any

from griffe import Class, Docstring, Extension, Object


class FieldComments(Extension):
    """The extension that mkdocs.yml names."""

    def on_instance(self, *, obj: Object, **_: Any) -> None:
        if obj.docstring is not None:
            obj.docstring.value = re.sub(
                r"<([\w.][\w. ]*)>",
                "\N{MATHEMATICAL LEFT ANGLE BRACKET}\\1\N{MATHEMATICAL RIGHT ANGLE BRACKET}",
                obj.docstring.value,
            )

    def on_class_members(self, *, node: Any, cls: Class, **_: Any) -> None:
        if not isinstance(node, ast.ClassDef):
            return
        lines = cls.lines_collection[cls.filepath]
        fields = [item for item in node.body if isinstance(item, ast.AnnAssign) and isinstance(item.target, ast.Name)]
        described = [(item.target.id, _comment(lines[item.end_lineno - 1])) for item in fields]  # type: ignore[union-attr, operator]
        if any(str(base) in ("Enum", "enum.Enum") for base in cls.bases):
            described = [
                (item.targets[0].id, item.value.value)
                for item in node.body
                if isinstance(item, ast.Assign)
                and isinstance(item.targets[0], ast.Name)
                and isinstance(item.value, ast.Constant)
            ]
        rows = [f"    {name}: {text}" for name, text in described if text and not name.startswith("_")]
        if not rows:
            return
        before = cls.docstring.value if cls.docstring else ""
        cls.docstring = Docstring("\n".join([before.rstrip(), "", "Attributes:", *rows]), parent=cls, lineno=cls.lineno)


def _comment(line: str) -> str:
    try:
        tokens = list(tokenize.generate_tokens(io.StringIO(line.strip()).readline))
    except (tokenize.TokenError, IndentationError):
        return ""
    comments = [token.string for token in tokens if token.type == tokenize.COMMENT]
    text = comments[-1].split("# ")[-1].strip() if comments else ""
    return "" if text.startswith(("type:", "noqa")) else text
