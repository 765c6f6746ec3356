"""The FMUs that come with the package."""

from __future__ import annotations

from pathlib import Path

from fmugym.checks import check_option, number_of
from fmugym.errors import ConfigError

__all__ = ["BUNDLED_FMUS", "FMI_VERSIONS", "MODELS", "bundled_fmu", "is_bundled"]

FMI_VERSIONS = ("1.0", "2.0", "3.0")
"""The FMI versions of the bundled FMUs."""

_VERSIONS = {
    "CartPole": FMI_VERSIONS,
    "Pendulum": FMI_VERSIONS,
    "DoublePendulum": ("2.0", "3.0"),
    "House": ("2.0", "3.0"),
}

MODELS = tuple(_VERSIONS)
"""The names of the bundled models."""

BUNDLED_FMUS = tuple(
    (model, version) for model, versions in _VERSIONS.items() for version in versions
)
"""Each bundled FMU's model and FMI version."""

_PACKAGE = Path(__file__).parent.parent
_FOLDERS = (_PACKAGE / "fmus", _PACKAGE.parent / "resources" / "fmus")
"""In an installed package, and in a checkout of the repository."""


def bundled_fmu(model: str, fmi_version: str | float = "2.0") -> Path:
    """Find a bundled FMU.

    Args:
        model: One of ``MODELS``.
        fmi_version: One of ``FMI_VERSIONS``, as text or number. The double pendulum and
            the house have only "2.0" and "3.0".

    Returns:
        The path of the FMU.

    Raises:
        ConfigError: If there is no such model or version, or no such model in this version.
    """
    is_number = isinstance(fmi_version, int | float)
    version = str(number_of("fmi_version", fmi_version)) if is_number else fmi_version
    model = check_option("bundled model", model, MODELS)
    version = check_option("FMI version", version, FMI_VERSIONS)
    if version not in _VERSIONS[model]:
        there = " and ".join(_VERSIONS[model])
        raise ConfigError(f"there is no bundled {model} for FMI {version}, only for {there}")
    candidates = [folder / version / f"{model}.fmu" for folder in _FOLDERS]
    return next((path for path in candidates if path.exists()), candidates[0])


def is_bundled(path: Path) -> bool:
    """Whether an FMU comes with the package."""
    return any(path.is_relative_to(folder) for folder in _FOLDERS)
