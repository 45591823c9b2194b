"""What mkdocs does to a page of this folder, which reads well as it is on a code host too.

formulas    $...$ and ```math become MathML here, so that the site loads nothing from elsewhere
README      <!-- README: Heading --> is replaced by that section of the README: tables stand in one place
examples    <!-- examples --> is replaced by the scripts and notebooks of examples/
links       to files outside docs/ become plain text, if the file is there (if not, the build says so)
"""

from __future__ import annotations

import html
import json
import re
from pathlib import Path
from typing import Any

from latex2mathml.converter import convert
from mkdocs.structure.files import File

ROOT = Path(__file__).parent.parent.parent
# Pages that may not be here yet.
ELSEWHERE = {
    "sweeps.md": "Sweeps and clusters",
    "policies.md": "Using a learnt policy",
    "reproduction.md": "Reproduction",
}
FENCE = re.compile(r"(^```.*?^```|^ {4}.*?$)", re.M | re.S)


def on_files(files: Any, config: Any, **_: Any) -> Any:
    for name, title in ELSEWHERE.items():
        if files.get_file_from_path(name) is None:
            files.append(File.generated(config, name, content=f"# {title}\n\nTo come.\n"))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    markdown = re.sub(r"^<!-- README: (.+?) -->$", lambda found: _section(found[1]), markdown, flags=re.M)
    markdown = re.sub(r"^<!-- file: (\S+) -->$", lambda found: _code(found[1]), markdown, flags=re.M)
    markdown = markdown.replace("<!-- examples -->", _examples())
    here = (ROOT / "docs" / page.file.src_uri).parent

    def link(found: re.Match[str]) -> str:
        target = (here / found[2].split("#")[0]).resolve()
        outside = target.exists() and not target.is_relative_to(ROOT / "docs")
        return found[1] if outside or target.is_dir() else found[0]

    # Fenced and indented code stays as it is.
    parts = FENCE.split(markdown)
    parts[::2] = [re.sub(r"(?<!!)\[([^\]]*)\]\((?!\w+:|#)([^)\s]+)\)", link, part) for part in parts[::2]]
    return "".join(parts)


def _code(path: str) -> str:
    """A Python file of the tree, in full."""
    return f'```python title="{Path(path).name}"\n{(ROOT / path).read_text()}```'


def on_page_content(html_text: str, **_: Any) -> str:
    return re.sub(r'<(span|div) class="arithmatex">(.*?)</\1>', _mathml, html_text, flags=re.S)


def _mathml(found: re.Match[str]) -> str:
    tag, text = found[1], html.unescape(found[2]).strip()
    formula = text.removeprefix(r"\(").removeprefix(r"\[").removesuffix(r"\)").removesuffix(r"\]").strip()
    shown = convert(formula, display="block" if tag == "div" else "inline")
    # Browsers pass over bold variants, and set no space after the name of a function.
    shown = re.sub(r'<mn mathvariant="bold">1</mn>', "<mi>\N{MATHEMATICAL BOLD DIGIT ONE}</mi>", shown)
    shown = re.sub(r"<mi>log</mi>(?!<mo)", '<mi>log</mi><mspace width="0.17em"/>', shown)
    return f'<{tag} class="arithmatex">{shown}</{tag}>'


def _section(heading: str) -> str:
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    found = re.search(rf"^## {re.escape(heading)}\n(.*?)(?=^## |\Z)", readme, re.M | re.S)
    if found is None:
        raise LookupError(f"README.md has no section '{heading}'")
    return re.sub(r"\]\(docs/", "](", found[1].strip())


def _examples() -> str:
    parts = []
    for path in sorted((ROOT / "examples").iterdir()):
        if path.suffix == ".py":
            parts += [f"## {path.name}", f"```python\n{path.read_text(encoding='utf-8').strip()}\n```"]
        elif path.suffix == ".ipynb":
            parts.append(f"## {path.name}")
            for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
                text = "".join(cell["source"])
                shown = re.sub(r"^# ", "### ", text, flags=re.M)
                parts.append(f"```python\n{text}\n```" if cell["cell_type"] == "code" else shown)
    return "\n\n".join(parts)
