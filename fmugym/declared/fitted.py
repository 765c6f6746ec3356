"""Results of a fit to logs of a plant: rows of parameters, one of which an episode draws."""

from __future__ import annotations

from zipfile import BadZipFile

import numpy as np

from fmugym.checks import require_regular
from fmugym.declared.entries import Entry
from fmugym.distributions import DrawnColumn
from fmugym.errors import ConfigError, shown

__all__ = ["read_fitted"]


def read_fitted(entry: Entry) -> dict[str, DrawnColumn]:
    """Read a file of ``fmugym.fit.write_rows``.

    Args:
        entry: The path.

    Returns:
        By the names of the FMU, the values in its units.

    Raises:
        ConfigError: If it is no such file; the text says where the task names it.
    """
    path = entry.path()
    with entry.placing():
        try:
            require_regular(path)
            with np.load(path, allow_pickle=False) as file:
                names, rows = np.atleast_1d(file["names"]).tolist(), file["rows"]
        except FileNotFoundError:
            raise ConfigError(f"there is no file {shown(str(path))}") from None
        except (OSError, ValueError, KeyError, TypeError, EOFError, BadZipFile):
            raise _not_fitted(path) from None
        is_table = rows.ndim == 2 and rows.dtype.kind == "f" and rows.shape[1] == len(names)
        if not (is_table and rows.size and np.isfinite(rows).all()):
            raise _not_fitted(path)
    columns = zip(names, rows.T.tolist(), strict=True)
    return {str(name): DrawnColumn(values, table=str(path)) for name, values in columns}


def _not_fitted(path: object) -> ConfigError:
    return ConfigError(
        f"{shown(str(path))} is no file that 'fmugym fit' has written: it needs 'names', and "
        "'rows' of finite numbers with a column for each"
    )
