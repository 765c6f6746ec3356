"""Write the texts of a hundred mistakes, as they were before parts of the package went.

PYTHONPATH=tests python -m golden.texts tests/golden/texts.json
"""

import contextlib
import json
import sys
import tempfile
from pathlib import Path

import mistakes

GROUPS = ("names", "files", "calls")


def texts(folder):
    """By group, the label and the text of each mistake."""
    mistakes.make_folder(folder)

    def told(mistake):
        return [mistake.label, mistake.make().replace(str(folder), "FOLDER")]

    with contextlib.chdir(folder):
        return {group: list(map(told, mistakes.GROUPS[group]())) for group in GROUPS}


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as place:
        text = json.dumps(texts(Path(place)), indent=0)
    Path(sys.argv[1]).write_text(text, encoding="utf-8")
