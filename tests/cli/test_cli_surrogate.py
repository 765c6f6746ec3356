"""``fmugym export --surrogate``, and controllers that plan on a surrogate."""

import json
import shutil
import sys

import fmpy
import pytest

TASK = "fmugym/Pendulum-v0"


@pytest.mark.skipif(sys.platform == "win32" or not shutil.which("cc"), reason="needs a C compiler")
def test_an_fmu_and_a_picture_are_written(tmp_path, ran):
    pytest.importorskip("matplotlib", reason="needs the extra 'plot'")
    fmu, picture = tmp_path / "twin.fmu", tmp_path / "twin.png"
    options = "--surrogate", "--steps", "300", "--output", fmu, "--plot", picture
    told = json.loads(ran("export", TASK, *options, "--json"))
    assert [one["name"] for one in told["measurements"]] == ["tau"]
    assert [one["name"] for one in told["actions"]] == ["theta", "theta_dot"]
    assert picture.read_bytes().startswith(b"\x89PNG")
    result = fmpy.simulate_fmu(str(fmu), stop_time=0.5, output=["theta"])
    assert len(result)


def test_plans_may_be_made_on_a_surrogate(ran):
    """By the text of a controller."""
    planner = "mpc horizon=0.5s candidates=16 rounds=2 model=surrogate steps=200"
    options = "--controller", planner, "--episodes", "1", "--json"
    scores = json.loads(ran("evaluate", TASK, *options))
    assert planner in json.dumps(scores)
