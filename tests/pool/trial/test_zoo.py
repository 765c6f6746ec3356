"""The fault zoo: what FMUs do wrong, and what a user sees of it in each setting.

The table is in zoo_table.py and in tests/zoo/README.md. Each cell of it is visited in a process of
its own, or, with isolation, all in one process, to which nothing may happen.
"""

import contextlib
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import zoo_table
import zoo_tools
from zoo_table import SPECIMENS

from fmugym.environment.env_checker import check_fmu_env
from fmugym.errors import ContractError

HERE = Path(__file__).parents[2]
DOCUMENT = HERE / "zoo" / "README.md"

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="its faults are those of Linux")


class Host:
    """Visits cells; see ``zoo_host.py``."""

    def __init__(self, folder, *modes):
        environment = {k: v for k, v in os.environ.items() if k != "FMUGYM_PROBE"}
        environment |= {
            "FMUGYM_CACHE_DIR": str(folder / "cache"),
            "TMPDIR": str(folder),
            "OPENBLAS_NUM_THREADS": "1",  # a process that forks should have no threads
        }
        self._process = subprocess.Popen(
            [sys.executable, HERE / "tools" / "zoo_host.py", folder, *modes],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=environment,
            text=True,
        )

    def visit(self, cell):
        """What ``zoo_tools.visit`` returns."""
        self._process.stdin.write(json.dumps(cell) + "\n")
        self._process.stdin.flush()
        answer = self._process.stdout.readline()
        assert answer, "it ended the process"
        return json.loads(answer)

    def close(self):
        """Let the process end."""
        self._process.communicate()
        assert self._process.returncode == 0


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("zoo")


@pytest.fixture(scope="module")
def hosts(tmp_path_factory):
    """One for each setting."""
    apart = Host(tmp_path_factory.mktemp("apart"))
    together = Host(tmp_path_factory.mktemp("together"), "here")
    yield {s: together if "process" in s else apart for s in zoo_table.SETTINGS}
    apart.close()
    together.close()


def cells():
    """Each specimen in each setting, where the versions of FMI take turns."""
    for row, specimen in enumerate(SPECIMENS):
        for column, setting in enumerate(zoo_table.SETTINGS):
            version = specimen.versions[(row + column) % len(specimen.versions)]
            yield pytest.param(
                specimen, setting, version, id=f"{specimen.what}-{setting}-{version}"
            )


@pytest.mark.parametrize(("specimen", "setting", "version"), list(cells()))
def test_outcome(hosts, folder, specimen, setting, version):
    expected = specimen.expected(setting)
    for cell in specimen.cells(folder, version, setting):
        outcomes, harm = hosts[setting].visit(cell)
        for kind, reason in outcomes:
            assert (kind, ", ".join(harm)) == (expected.kind, expected.harm), (reason, cell)
            assert expected.reason in reason, cell


@pytest.mark.parametrize("version", [1, 2, 3])
def test_wrong_values_are_found_by_the_check(tmp_path, version):
    """The table says so."""
    values = zoo_tools.parameters("do_nothing", "reset", at=0)
    env = zoo_tools.ZooEnv(zoo_tools.zoo_fmu(tmp_path, version), model_parameters=values)
    with contextlib.closing(env), pytest.raises(ContractError, match="reset does not restore"):
        check_fmu_env(env)


def test_the_document_has_this_table():
    assert zoo_table.markdown() in DOCUMENT.read_text(), "python tests/tools/zoo_table.py prints it"
