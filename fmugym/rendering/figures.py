"""Figures of Matplotlib that notebooks show."""

from __future__ import annotations

from io import BytesIO

from matplotlib import figure

__all__ = ["Figure"]


class Figure(figure.Figure):
    """A figure that a notebook shows as a picture.

    Those of Matplotlib are shown only after ``%matplotlib inline`` or an import of pyplot.
    """

    def _repr_png_(self) -> bytes:
        file = BytesIO()
        self.savefig(file, format="png")
        return file.getvalue()
