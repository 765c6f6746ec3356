"""Pictures of systems."""

from __future__ import annotations

import os
from typing import Any, Final

from fmugym.checks import check_path
from fmugym.errors import ConfigError, printable, reason
from fmugym.extras import imported
from fmugym.files import replaced
from fmugym.signals import ordinary
from fmugym.systems.placing import Box, Picture, Wire, picture_of
from fmugym.systems.wired import WiredSystem

__all__ = ["draw"]

_LINE: Final = "#0072b2"
_LOOP: Final = "#d55e00"
_GREY: Final = "#6f6f6f"
_FILL: Final = "#eef3f8"
_OWN_FILL: Final = "#fdf3dc"
_EDGE: Final = "#4a5a6a"
_MARGIN: Final = 0.3
_TITLE: Final = 0.45
_STYLE: Final = {"svg.fonttype": "none", "svg.hashsalt": "fmugym", "font.family": "sans-serif"}
_MASTERS: Final = {"gauss_seidel": "Gauss-Seidel", "jacobi": "Jacobi"}


def draw(system: WiredSystem, path: str | os.PathLike[str] | None = None) -> Any:
    """Draw a system: components, connections with their gains, inputs and outputs, loops.

    Args:
        system: The system.
        path: A file to write, such as ``system.png`` or ``system.svg``; None for no file.

    Returns:
        The figure of Matplotlib.

    Raises:
        ConfigError: If Matplotlib is missing, the format of the file is unknown, or the file cannot
            be written.
    """
    matplotlib: Any = imported("matplotlib", "plot")
    with matplotlib.rc_context(_STYLE):
        figure = _figure(system, picture_of(system))
        if path is not None:
            file = check_path("the path of a picture", path)
            try:
                with replaced(file) as part:
                    figure.savefig(part, dpi=150, metadata=_metadata(file.suffix))
            except ordinary(ValueError, OSError) as error:  # of the format or the folder
                raise ConfigError(f"no picture can be written: {reason(error)}") from None
    return figure


def _metadata(suffix: str) -> dict[str, None] | None:
    """No date, so that a picture is the same each time."""
    return {"Date": None} if suffix.lower() == ".svg" else None


def _figure(system: WiredSystem, picture: Picture) -> Any:
    figures: Any = imported("fmugym.figures", "plot")
    width, height = picture.size
    size = max(width + 2 * _MARGIN, 5.0), height + 2 * _MARGIN + 2 * _TITLE
    figure = figures.Figure(figsize=size)
    axes = figure.add_axes((0, 0, 1, 1))
    top = max(box.y for box in picture.boxes.values())
    axes.set_xlim(-_MARGIN, size[0] - _MARGIN)
    axes.set_ylim(top + _MARGIN + _TITLE - size[1], top + _MARGIN + _TITLE)
    axes.axis("off")
    for wire in picture.wires:
        _draw_wire(axes, wire, picture.boxes[wire.target[0]])
    for key, name in picture.open_ports:
        x, y = picture.boxes[key].port(name, left=True)
        axes.plot([x - 0.22, x], [y, y], color=_GREY, lw=0.9, ls=":")
    for box in picture.boxes.values():
        _draw_box(axes, box)
    _write_captions(axes, system, top, top + _MARGIN + _TITLE - size[1])
    return figure


def _draw_box(axes: Any, box: Box) -> None:
    patches: Any = imported("matplotlib.patches", "plot")
    corner, fill = (box.x, box.y - box.height), _FILL if box.is_component else _OWN_FILL
    style = "round,pad=0,rounding_size=" + ("0.06" if box.is_component else "0.15")
    axes.add_patch(
        patches.FancyBboxPatch(
            corner, box.width, box.height, boxstyle=style, fc=fill, ec=_EDGE, lw=1.0, zorder=3
        )
    )
    middle = box.x + box.width / 2
    text = {"va": "center", "zorder": 4, "parse_math": False}
    if not box.is_component:
        axes.text(middle, box.y - 0.15, printable(box.title), fontsize=8, ha="center", **text)
        return
    title, subtitle = printable(box.title), printable(box.subtitle)
    axes.text(middle, box.y - 0.17, title, fontsize=10, ha="center", weight="bold", **text)
    axes.text(middle, box.y - 0.37, subtitle, fontsize=7, ha="center", color=_GREY, **text)
    for left, names in ((True, box.inputs), (False, box.outputs)):
        for name in names:
            x, y = box.port(name, left=left)
            side = {"ha": "left" if left else "right", "fontsize": 8}
            axes.text(x + (0.08 if left else -0.08), y, printable(name), **side, **text)


def _draw_wire(axes: Any, wire: Wire, target: Box) -> None:
    patches: Any = imported("matplotlib.patches", "plot")
    colour = _LOOP if wire.in_loop else _LINE
    axes.add_patch(
        patches.FancyArrowPatch(
            path=_path(wire),
            arrowstyle="-|>,head_length=4,head_width=2",
            color=colour,
            lw=1.2,
            shrinkA=0,
            shrinkB=0,
            joinstyle="miter",
            zorder=2,
        )
    )
    if wire.text:
        x, y = wire.points[-1]
        behind = {"facecolor": "white", "edgecolor": "none", "pad": 0.6, "alpha": 0.85}
        x -= 0.16 if target.is_component else 0.12
        text = {"ha": "right", "va": "bottom", "fontsize": 6.5, "color": _GREY, "bbox": behind}
        axes.text(x, y + 0.03, wire.text, zorder=2.5, parse_math=False, **text)


def _path(wire: Wire) -> Any:
    paths: Any = imported("matplotlib.path", "plot").Path
    first, *rest = wire.points
    vertices, codes = [first], [paths.MOVETO]
    for point in rest:
        before = vertices[-1]
        if wire.leads_back or before[1] == point[1]:
            vertices.append(point)
            codes.append(paths.LINETO)
            continue
        middle = (before[0] + point[0]) / 2
        vertices += [(middle, before[1]), (middle, point[1]), point]
        codes += [paths.CURVE4] * 3
    return paths(vertices, codes)


def _write_captions(axes: Any, system: WiredSystem, top: float, bottom: float) -> None:
    axes.text(
        0,
        top + _MARGIN,
        printable(system.name),
        fontsize=11,
        weight="bold",
        va="bottom",
        parse_math=False,
    )
    order = " \u2192 ".join(
        f"({', '.join(group.components)})" if group.loop else ", ".join(group.components)
        for group in system.order.groups
    )
    text = f"{_MASTERS[system.master]}: {order}"
    axes.text(0, bottom + 0.22, printable(text), fontsize=8, color=_GREY, parse_math=False)
    if system.order.loops:
        axes.text(0, bottom + 0.06, "algebraic loop", fontsize=8, color=_LOOP)
