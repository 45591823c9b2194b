"""Shape comments of fields in the API reference: what stands after ``# `` on a field's line becomes its description."""

from __future__ import annotations

import ast
import io
import tokenize
from typing import Any

from griffe import Attribute, Docstring, Extension


class FieldComments(Extension):
    """The trailing comment of each attribute without a docstring."""

    def on_attribute_instance(self, *, node: Any, attr: Attribute, **_: Any) -> None:
        if attr.docstring is not None or not isinstance(node, ast.AnnAssign) or node.end_lineno is None:
            return
        line = attr.lines_collection[attr.filepath][node.end_lineno - 1]
        try:
            tokens = list(tokenize.generate_tokens(io.StringIO(line.strip()).readline))
        except (tokenize.TokenError, IndentationError):
            return
        comments = [token.string.lstrip("# ") for token in tokens if token.type == tokenize.COMMENT]
        text = comments[-1].split("# ")[-1] if comments else ""
        if text and not text.startswith(("type:", "noqa")):
            attr.docstring = Docstring(text.replace("[", r"\["), parent=attr, lineno=node.lineno)
