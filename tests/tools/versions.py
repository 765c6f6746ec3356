"""Compare the places that give the version: ``python tests/tools/versions.py [TAG]``.

``pyproject.toml`` decides. With the tag of a release, the tag and the newest section of the
changelog must have this version, too.
"""

import re
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def versions(tag=None):
    """The version that each place gives."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    found = {
        "pyproject.toml": project["version"],
        "CITATION.cff": re.search(r"^version: (\S+)$", citation, re.MULTILINE)[1],
    }
    if tag is not None:
        changelog = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
        found["CHANGELOG.md"] = re.search(r"^## \[(.+?)\]", changelog, re.MULTILINE)[1]
        found["the tag"] = tag.removeprefix("v")
    return found


def main(arguments):
    found = versions(*arguments)
    for place, version in found.items():
        print(f"{place}: {version}")
    return int(len(set(found.values())) > 1)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
