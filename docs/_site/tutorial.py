"""The pictures of the tutorial: what its commands print, and what they draw.

    python docs/_site/tutorial.py FOLDER

FOLDER is one in which the tutorial was followed, so that it has House.fmu, house.toml, and the
files of training, comparison and report. The pictures are written to docs/images.
"""

from __future__ import annotations

import contextlib
import io
import os
import shlex
import sys
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Final

from PIL import Image

from fmugym.cli.command_line import run_command_line

IMAGES: Final = Path(__file__).parent.parent / "images"

THERMOSTAT: Final = "hysteresis of=T setpoint=21 band=0.3"
PRINTED: Final = {
    "info": ["fmugym info House.fmu"],
    "new": ["fmugym new House.fmu"],
    "validate": ["fmugym validate house.toml"],
    "simulate": [f'fmugym simulate house.toml --scenario frost --controller "{THERMOSTAT}"'],
}
"""By the name of a picture, commands whose output it shows."""

DRAWN: Final = {"training": "agent/evaluations.png", "comparison": "comparison.png"}
"""By the name of a picture, the file that a command of the tutorial has drawn."""

WIDTH: Final = 108  # characters in a line
LINES: Final = 26  # at most
_CHARACTER, _LINE, _EDGE = 7.25, 17, 14  # in pixels
_WIDEST: Final = 900  # pixels of a drawing

_SVG: Final = """\
<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}">
<rect width="{width}" height="{height}" rx="8" fill="#1d2329"/>
<g font-family="ui-monospace, 'DejaVu Sans Mono', Consolas, monospace" font-size="12" \
fill="#e6eaee">
{lines}
</g>
</svg>
"""


def printed(commands: Sequence[str]) -> list[str]:
    """The lines of a terminal with some commands, in the working directory."""
    lines = []
    for command in commands:
        text = io.StringIO()
        with contextlib.redirect_stdout(text), contextlib.redirect_stderr(io.StringIO()):
            run_command_line(shlex.split(command)[1:])
        told = text.getvalue().replace(str(Path.cwd()), "~/house")
        lines += [f"$ {command}", *told.splitlines()]
    return lines


def shortened(lines: Sequence[str]) -> list[str]:
    """As much as a picture shows."""
    cut = [line if len(line) <= WIDTH else f"{line[: WIDTH - 3]}..." for line in lines]
    return cut if len(cut) <= LINES else [*cut[: LINES - 1], "..."]


def terminal(lines: Sequence[str]) -> str:
    """Draw lines of a terminal as SVG."""
    shown = shortened(lines)
    texts = []
    for number, line in enumerate(shown):
        colour = ' fill="#7cc4f2"' if line.startswith("$ ") else ""
        y = _EDGE + 12 + number * _LINE
        texts.append(f'<text x="{_EDGE}" y="{y}"{colour}>{_spaced(line)}</text>')
    width = round(2 * _EDGE + _CHARACTER * max(map(len, shown)))
    height = 2 * _EDGE + len(shown) * _LINE
    return _SVG.format(width=width, height=height, lines="\n".join(texts))


def _spaced(line: str) -> str:
    """The text of a line whose spaces are all shown."""
    return escape(line).replace(" ", "\u00a0")


def write(folder: Path) -> None:
    """Write all pictures."""
    os.chdir(folder)
    for name, commands in PRINTED.items():
        (IMAGES / f"tutorial_{name}.svg").write_text(terminal(printed(commands)), encoding="utf-8")
    for name, file in DRAWN.items():
        with Image.open(folder / file) as image:
            image.thumbnail((_WIDEST, _WIDEST))
            image.convert("P", palette=Image.Palette.ADAPTIVE, colors=64).save(
                IMAGES / f"tutorial_{name}.png", optimize=True
            )


if __name__ == "__main__":
    write(Path(sys.argv[1]).absolute())
