"""The client's methods, one by one: what they give, take and refuse."""

import graphlib
import logging
import re
from pathlib import Path

import pytest
from lab_tools import TOKEN, experiment, ideal_lab

import fmugym
from fmugym import ConfigError, FMUGymError
from fmugym.lab import CellType, Client, Lab, LabError, current_lab


class TestImports:
    def test_modules_are_named_as_those_of_the_real_client(self):
        from fmugym.lab.client import Client as SameClient
        from fmugym.lab.data import CellType as SameCellType

        assert SameClient is Client
        assert SameCellType is CellType

    def test_errors_are_runtime_errors_of_this_package(self):
        assert issubclass(LabError, RuntimeError)
        assert issubclass(LabError, FMUGymError)

    @pytest.mark.parametrize("room", ["lab", "rendering"])
    def test_modules_of_a_room_form_no_circle(self, room):
        """Neither by imports at the top nor by imports in functions or for types."""
        folder = Path(fmugym.__file__).parent / room
        needs = {}
        for path in folder.glob("*.py"):
            if path.stem != "__init__":
                found = re.findall(rf"from fmugym\.{room}(\.\w+)? import (\w+)", path.read_text())
                needs[path.stem] = {module.lstrip(".") or name for module, name in found}
        assert any(needs.values())
        graphlib.TopologicalSorter(needs).prepare()  # raises CycleError


class TestWhichLab:
    def test_default_lab_is_made_once(self):
        assert Client().lab is Client().lab is current_lab()
        assert Client().lab.options.sample_period == 0.002

    def test_default_lab_is_made_anew_after_a_close(self):
        first = Client().lab
        first.close()
        assert Client().lab is not first

    def test_block_and_argument_select(self, lab):
        with ideal_lab() as inner:
            assert Client().lab is inner
            assert Client(lab).lab is lab
        assert Client().lab is lab

    def test_end_of_the_outermost_block_closes(self):
        lab = ideal_lab()
        with lab, lab:
            pass
        with pytest.raises(LabError, match="the lab is closed"):
            Client(lab).get_user_info(TOKEN)
        lab.close()

    def test_requests_after_the_close_are_refused(self, lab):
        client, token = experiment(lab)
        lab.close()
        for request in (client.get_position, client.stop_experiment):
            with pytest.raises(LabError, match="closed"):
                request(token)
        with pytest.raises(LabError, match="closed"):
            client.start_experiment(TOKEN, "SimplePendulum", 1)


class TestOptions:
    def test_unknown_option(self):
        with pytest.raises(ConfigError, match="did you mean 'heartbeat'"):
            Lab(heart_beat=1.0)

    @pytest.mark.parametrize(
        ("name", "value"),
        [
            ("heartbeat", -1),
            ("heartbeat", "2 s"),
            ("homing_time", float("inf")),
            ("get_time", (0.1, float("nan"))),
            ("get_time", (1e-3, 2.0)),
            ("get_time", 0.1),
            ("coulomb_friction", (2e-3, 1e-3)),
            ("longest_stall", 1e-3),
            ("drive_step", 0.1),
            ("stall_share", 1.1),
            ("seed", -1),
            ("seed", [[]]),
            ("cells", {CellType.SINGLE: -1}),
            ("cells", {"single": 1}),
            ("parameters", {CellType.SINGLE: {"m": "heavy"}}),
            ("parameters", {CellType.SINGLE: {"q_0": 1.0}}),
        ],
    )
    def test_value_that_makes_no_sense(self, name, value):
        word = "q_0" if "q_0" in str(value) else "'m'" if "heavy" in str(value) else name
        with pytest.raises(ConfigError, match=word):
            Lab(**{name: value})

    def test_a_client_needs_a_lab(self):
        with pytest.raises(ConfigError, match="'lab'"):
            Client("lab")


class TestUserTokens:
    def test_user_info_has_the_fields_of_the_tutorial(self, lab):
        info = Client().get_user_info(TOKEN)
        assert info.number_of_attempts == 1000
        assert (info.max_experiment_length, info.max_gym_length) == (60.0, 3600.0)
        assert info.gym_bucket_size == info.gym_max_bucket_size == 20

    @pytest.mark.parametrize("token", ["", None, 7])
    def test_must_be_a_text(self, lab, token):
        with pytest.raises(LabError, match="must be a text"):
            Client().get_user_info(token)


class TestCells:
    def test_numbers_can_be_chosen(self):
        with ideal_lab(cells={CellType.SINGLE: 9}):
            client = Client()
            client.start_gym(TOKEN, 10, [CellType.SINGLE] * 9)
            with pytest.raises(LabError, match="no cell of type DOUBLE for Acrobot"):
                client.start_experiment(TOKEN, "Acrobot", 1)


class TestStartingGyms:
    def test_token_has_19_digits(self, lab):
        token = Client().start_gym(TOKEN, 10, [CellType.SINGLE])
        assert isinstance(token, str)
        assert token.isdecimal()
        assert len(token) == 19

    def test_livestream_is_logged_and_not_printed(self, lab, capsys, caplog):
        with caplog.at_level(logging.INFO, "fmugym.lab"):
            token = Client().start_gym(TOKEN, 10, [CellType.SINGLE, CellType.DOUBLE])
        assert capsys.readouterr() == ("", "")
        assert "livestream: fmugym-lab://cells/101+201" in caplog.text
        assert token not in caplog.text

    @pytest.mark.parametrize("cells", [[], ["single"], [1], None, 7, iter(list(CellType))])
    def test_not_a_list_of_cell_types(self, lab, cells):
        with pytest.raises(LabError, match="list of cell types"):
            Client().start_gym(TOKEN, 10, cells)

    def test_refused_requests_take_nothing(self, lab):
        client = Client()
        with pytest.raises(LabError, match="has 4 cells of type SINGLE, not 5"):
            client.start_gym(TOKEN, 10, [CellType.SINGLE] * 5)
        with pytest.raises(LabError, match="gym_time 7200 is outside the limits"):
            client.start_gym(TOKEN, 7200, [CellType.SINGLE])
        with pytest.raises(LabError):
            client.start_experiment(TOKEN, "SimplePendulum", 1000)
        assert lab.running == []


class TestStartingSessions:
    def test_gives_token_and_url(self, lab):
        token, url = Client().start_experiment(TOKEN, "SimplePendulum", 5)
        assert token.isdecimal()
        assert len(token) == 19
        assert url == "fmugym-lab://cells/101"

    def test_blocks_through_the_preparation(self, lab):
        client, token = experiment(lab, preparation_time=4.0, initial_position=[1.0])
        assert lab.clock.time() == 4.0
        assert client.get_position(token) == pytest.approx(1.0, abs=1e-12)

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            ({"length": "5"}, "must be a number, got '5'"),
            ({"length": 10**400}, "must be a number"),
            ({"preparation_time": None}, "preparation_time must be a number"),
            ({"initial_position": "1"}, "initial_position must be a number"),
            ({"kind": ["SimplePendulum"]}, "unknown experiment type"),
            ({"length": 61.0}, "61.0 is outside the limits"),
            ({"length": 0.0}, "0.0 is outside the limits"),
            ({"length": float("nan")}, "must be finite"),
            ({"initial_position": [7.0]}, "initial_position 7.0 is outside the limits"),
            ({"initial_position": [0.1, 0.2]}, "initial_position has 2 entries, .* 1 joints"),
            ({"initial_position": ["up"]}, "each entry.*must be a number"),
            ({"preparation_time": -1.0}, "preparation_time -1.0 is outside the limits"),
            ({"kind": "SimplePendlum"}, "did you mean 'SimplePendulum'"),
        ],
    )
    def test_mistakes(self, lab, arguments, message):
        with pytest.raises(LabError, match=message):
            experiment(lab, **arguments)
