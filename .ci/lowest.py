"""Print constraints for pip: the lowest versions that pyproject.toml promises users, and the tested ones of tools.

python .ci/lowest.py [name ...] > lowest.txt      the tested version of the packages named too
"""

import re
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]
project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
extras = project["optional-dependencies"]
tested = dict(re.findall(r"^([\w.-]+)==(\S+)", (ROOT / "constraints.txt").read_text(), re.M))
tools = {re.match(r"[\w.-]+", requirement)[0] for requirement in extras["dev"] + extras["docs"]}
promised = {*project["dependencies"], *(one for name in extras.keys() - {"dev", "docs"} for one in extras[name])}
for requirement in sorted(promised):
    name, version = re.match(r"([\w.-]+)(?:\[\w+\])?(?:>=([\w.]+))?", requirement).groups()
    if version and name not in sys.argv[1:]:
        print(f"{name}=={version}")
for name in sorted((tools | set(sys.argv[1:])) & set(tested)):
    print(f"{name}=={tested[name]}")
