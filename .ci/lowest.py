"""Print the lowest versions that pyproject.toml promises, as constraints for pip.

python .ci/lowest.py [name ...] > lowest.txt      but for the packages named
"""

import re
import sys
import tomllib
from pathlib import Path

project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]
asked = {*project["dependencies"], *(one for group in project["optional-dependencies"].values() for one in group)}
for requirement in sorted(asked):
    name, version = re.match(r"([\w.-]+)(?:\[\w+\])?(?:>=([\w.]+))?", requirement).groups()
    if version and name not in sys.argv[1:]:
        print(f"{name}=={version}")
