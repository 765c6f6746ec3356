"""Where the FMUs that come with the package are."""

from __future__ import annotations

from pathlib import Path

from fmugym.errors import unknown_name

__all__ = ["FMI_VERSIONS", "MODELS", "bundled_fmu"]

FMI_VERSIONS = ("1.0", "2.0", "3.0")
"""The FMI versions of the bundled FMUs."""

MODELS = ("CartPole", "Pendulum")
"""The names of the bundled models."""

_PACKAGE = Path(__file__).parent
_FOLDERS = (_PACKAGE / "fmus", _PACKAGE.parent / "resources" / "fmus")
"""In an installed package, and in a checkout of the repository."""


def bundled_fmu(model: str, fmi_version: str | float = "2.0") -> Path:
    """Find a bundled FMU.

    Args:
        model: One of ``MODELS``.
        fmi_version: One of ``FMI_VERSIONS``, as text or number.

    Returns:
        The path of the FMU.

    Raises:
        ConfigError: If there is no such model or version.
    """
    version = str(float(fmi_version)) if isinstance(fmi_version, int | float) else fmi_version
    if model not in MODELS:
        raise unknown_name("bundled model", model, MODELS)
    if version not in FMI_VERSIONS:
        raise unknown_name("FMI version", version, FMI_VERSIONS)
    candidates = [folder / version / f"{model}.fmu" for folder in _FOLDERS]
    return next((path for path in candidates if path.exists()), candidates[0])
