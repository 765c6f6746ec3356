"""The example train_system.py: three FMUs of two makers as one environment."""


def test_it_learns_to_beat_a_thermostat(example, tmp_path, capsys):
    home = example("train_system")
    final, reference = home.main(["--folder", str(tmp_path), "--generations", "12"])
    assert final > reference + 0.1
    assert "thermostat" in capsys.readouterr().out
    assert (tmp_path / "curve.png").read_bytes().startswith(b"\x89PNG")
    system = home.make_system(tmp_path)
    tools = [one.fmu.description.generation_tool for one in system.components.values()]
    assert ["PythonFMU" in tool for tool in tools] == [True, False, True]
