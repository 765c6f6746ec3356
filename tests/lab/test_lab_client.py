"""The client's methods, one by one: what they give, take and refuse."""

import graphlib
import logging
import re
from datetime import timedelta
from pathlib import Path

import pytest
from lab_tools import TOKEN, experiment

import fmugym
from fmugym import ConfigError, FMUGymError
from fmugym.lab import CellType, Client, Lab, LabError, ManualClock, User, current_lab


def strict(**changes):
    user = User(name="Ada", **changes)
    return Lab("ideal", clock=ManualClock(), users={"secret": user, "plain": User(gym=False)})


class TestImports:
    def test_modules_are_named_as_those_of_the_real_client(self):
        from fmugym.lab.client import Client as SameClient
        from fmugym.lab.data import CellType as SameCellType

        assert SameClient is Client
        assert SameCellType is CellType

    def test_errors_are_runtime_errors_of_this_package(self):
        assert issubclass(LabError, RuntimeError)
        assert issubclass(LabError, FMUGymError)

    @pytest.mark.parametrize("room", ["lab", "identification", "rendering"])
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
        assert Client().lab.options.sample_period == 0.002  # the preset hardware

    def test_default_lab_is_made_anew_after_a_close(self):
        first = Client().lab
        first.close()
        assert Client().lab is not first

    def test_block_and_argument_select(self, lab):
        with Lab("ideal", clock=ManualClock()) as inner:
            assert Client().lab is inner
            assert Client(lab).lab is lab
        assert Client().lab is lab

    def test_end_of_the_outermost_block_closes(self):
        lab = Lab("ideal", clock=ManualClock())
        with lab, lab:
            pass
        with pytest.raises(LabError, match="the lab is closed"):
            Client(lab).get_cells(TOKEN)
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
    def test_unknown_preset(self):
        with pytest.raises(ConfigError, match="unknown preset 'hardwear'; did you mean 'hardware'"):
            Lab("hardwear")

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
            ("clamp_setters", "yes"),
            ("starts_per_window", 2.5),
            ("seed", -1),
            ("seed", [[]]),
            ("cells", {CellType.SINGLE: -1}),
            ("cells", {"single": 1}),
            ("users", {"secret": "Ada"}),
            ("parameters", {CellType.SINGLE: {"m": "heavy"}}),
            ("parameters", {CellType.SINGLE: {"q_0": 1.0}}),
            ("video_folder", ""),
            ("video_folder", __file__),
            ("clock", 0.0),
        ],
    )
    def test_value_that_makes_no_sense(self, name, value):
        word = "q_0" if "q_0" in str(value) else "'m'" if "heavy" in str(value) else name
        with pytest.raises(ConfigError, match=word):
            Lab("ideal", **{name: value})

    @pytest.mark.parametrize("answer", [float("nan"), float("inf"), "noon", None])
    def test_clocks_must_give_a_time(self, answer):
        class OddClock(ManualClock):
            is_odd = False

            def time(self):
                return answer if self.is_odd else super().time()

        clock = OddClock()
        client, token = experiment(Lab("ideal", clock=clock))
        clock.is_odd = True
        with pytest.raises(LabError, match="clock"):
            client.get_position(token)
        with pytest.raises(ConfigError, match="clock"):
            Lab(clock=clock)
        clock.is_odd = False
        assert client.get_position(token) == 0.0
        client.lab.close()

    def test_a_clock_that_stands_still_is_no_endless_wait(self):
        class Stopped(ManualClock):
            def sleep(self, seconds):
                pass

        with Lab("ideal", clock=Stopped(), cells={CellType.SINGLE: 1}):
            client = Client()
            client.start_gym(TOKEN, 5, [CellType.SINGLE])
            with pytest.raises(LabError, match="stands still"):
                client.start_gym(TOKEN, 5, [CellType.SINGLE])

    def test_a_client_needs_a_lab(self):
        with pytest.raises(ConfigError, match="'lab'"):
            Client("lab")

    @pytest.mark.parametrize(
        ("name", "value"),
        [
            ("refil_interval", 0.0),
            ("max_bucket_size", "3"),
            ("experiment_types", "SimplePendulum"),
            ("valid_for", float("nan")),
            ("name", 3),
        ],
    )
    def test_users_that_make_no_sense(self, name, value):
        with pytest.raises(ConfigError, match=name):
            User(**{name: value})

    def test_a_user_for_ever(self):
        with Lab("ideal", clock=ManualClock(), users={"x": User(valid_for=float("inf"))}):
            assert Client().get_user_info("x").valid_until.year == 9999


class TestUserInfo:
    def test_has_all_fields(self, lab):
        info = Client().get_user_info(TOKEN)
        assert info.user_name == "guest"
        assert info.number_of_attempts == 1000
        assert info.max_experiment_length == 60.0
        assert info.bucket_size == info.max_bucket_size == 20
        assert info.refil_interval == 30.0
        assert info.valid_until - info.valid_from == timedelta(days=365)
        assert set(info.experiment_types) >= {"SimplePendulum", "Acrobot"}
        assert info.max_gym_length == 3600.0
        assert info.gym_bucket_size == info.gym_max_bucket_size == 20

    def test_experiments_count_down_and_time_fills_up(self, lab):
        client, token = experiment(lab)
        client.stop_experiment(token)
        info = client.get_user_info(TOKEN)
        assert (info.number_of_attempts, info.bucket_size, info.gym_bucket_size) == (999, 19, 20)
        lab.clock.advance(30.0)
        info = client.get_user_info(TOKEN)
        assert (info.number_of_attempts, info.bucket_size) == (999, 20)

    def test_gyms_count_down_and_episodes_do_not(self, lab):
        client = Client()
        token = client.start_gym(TOKEN, 10, [CellType.SINGLE])
        client.start_episode(token, "SimplePendulum", 1)
        info = client.get_user_info(TOKEN)
        assert (info.number_of_attempts, info.bucket_size, info.gym_bucket_size) == (1000, 20, 19)

    def test_a_bucket_fills_up_bit_by_bit(self, lab):
        client = Client()
        for _ in range(5):
            client.stop_experiment(client.start_experiment(TOKEN, "SimplePendulum", 1)[0])
        sizes = []
        for _ in range(4):
            sizes.append(client.get_user_info(TOKEN).bucket_size)
            lab.clock.advance(45.0)
        assert sizes == [15, 16, 18, 19]

    def test_users_do_not_share(self, lab):
        experiment(lab)
        assert Client().get_user_info("another").number_of_attempts == 1000

    def test_no_attempts_left(self):
        with strict(number_of_attempts=1):
            client = Client()
            client.start_experiment("secret", "SimplePendulum", 1)
            with pytest.raises(LabError, match="'Ada' has no attempts left"):
                client.start_experiment("secret", "SimplePendulum", 1)

    def test_empty_buckets_say_when_to_try_again(self):
        with strict(max_bucket_size=1, gym_max_bucket_size=1, refil_interval=10.0) as lab:
            client = Client()
            client.stop_experiment(client.start_experiment("secret", "SimplePendulum", 1)[0])
            lab.clock.advance(2.5)
            with pytest.raises(LabError, match="Too many requests, try again in 8 seconds"):
                client.start_experiment("secret", "SimplePendulum", 1)
            client.start_gym("secret", 5, [CellType.SINGLE])
            with pytest.raises(LabError, match="Too many requests, try again in 10 seconds"):
                client.start_gym("secret", 5, [CellType.SINGLE])
            lab.clock.advance(7.6)
            client.start_experiment("secret", "SimplePendulum", 1)


class TestUserTokens:
    @pytest.mark.parametrize("token", ["", None, 7])
    def test_must_be_a_text(self, lab, token):
        with pytest.raises(LabError, match="must be a text"):
            Client().get_user_info(token)

    def test_strict_lab_knows_its_users(self):
        with strict():
            assert Client().get_user_info("secret").user_name == "Ada"
            with pytest.raises(LabError, match="unknown user token"):
                Client().get_user_info("stranger")

    def test_without_gym_permission(self):
        with strict():
            client = Client()
            info = client.get_user_info("plain")
            assert (info.max_gym_length, info.gym_bucket_size, info.gym_max_bucket_size) == (
                0,
                0,
                0,
            )
            with pytest.raises(LabError, match="no gym permission"):
                client.start_gym("plain", 5, [CellType.SINGLE])
            client.start_experiment("plain", "SimplePendulum", 1)

    def test_expire(self):
        with strict(valid_for=100.0) as lab:
            lab.clock.advance(101.0)
            with pytest.raises(LabError, match="has expired"):
                Client().get_cells("secret")

    def test_experiment_types(self):
        refused = pytest.raises(LabError, match=r"'Ada' may not start .* 'Acrobot'")
        with strict(experiment_types=("SimplePendulum",)), refused:
            Client().start_experiment("secret", "Acrobot", 1)


class TestCells:
    def test_of_the_default_lab(self, lab):
        cells = Client().get_cells(TOKEN)
        kinds = [cell.cell_type for cell in cells]
        assert kinds.count(CellType.SINGLE) == 4
        assert kinds.count(CellType.DOUBLE) == 2
        assert len({cell.cell_id for cell in cells}) == 6

    def test_can_be_chosen(self, lab):
        client, token = experiment(lab, cell_id=103)
        assert "cell 103" in client.get_logs(token)

    @pytest.mark.parametrize("cell_id", [99, 201])
    def test_must_fit(self, lab, cell_id):
        with pytest.raises(LabError, match=f"no cell of type SINGLE and number {cell_id}"):
            experiment(lab, cell_id=cell_id)

    def test_numbers_can_be_chosen(self):
        with Lab("ideal", clock=ManualClock(), cells={CellType.SINGLE: 9}):
            assert len(Client().get_cells(TOKEN)) == 9
            with pytest.raises(LabError, match="no cell of type DOUBLE for Acrobot"):
                Client().start_experiment(TOKEN, "Acrobot", 1)


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
        assert lab.livestream_url(token) == "fmugym-lab://cells/101+201"

    @pytest.mark.parametrize("cells", [[], ["single"], [1], None, 7, iter(list(CellType))])
    def test_not_a_list_of_cell_types(self, lab, cells):
        with pytest.raises(LabError, match="list of cell types"):
            Client().start_gym(TOKEN, 10, cells)

    def test_refused_requests_cost_nothing(self, lab):
        client = Client()
        with pytest.raises(LabError, match="has 4 cells of type SINGLE, not 5"):
            client.start_gym(TOKEN, 10, [CellType.SINGLE] * 5)
        with pytest.raises(LabError, match="gym_time 7200 is outside the limits"):
            client.start_gym(TOKEN, 7200, [CellType.SINGLE])
        with pytest.raises(LabError):
            client.start_experiment(TOKEN, "SimplePendulum", 1000)
        info = client.get_user_info(TOKEN)
        assert (info.number_of_attempts, info.bucket_size, info.gym_bucket_size) == (1000, 20, 20)


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

    def test_positional_arguments_are_those_of_the_lab(self, lab):
        client = Client()
        token, _ = client.start_experiment(TOKEN, "SimplePendulum", 5.0, 1.0, False, [0.5, 0.0])
        assert client.get_position(token) == pytest.approx(0.5)

    def test_initial_state_of_two_joints(self, lab):
        client, token = experiment(lab, "DoublePendulum", initial_state=[0.5, -0.2, 0.0, 0.0])
        assert client.get_position(token) == pytest.approx([0.5, -0.2])

    def test_arms_cannot_be_thrown(self, lab):
        with pytest.raises(LabError, match="initial_position has 2 entries"):
            experiment(lab, initial_state=[0.5, 1.0])

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            ({"length": "5"}, "must be a number, not '5'"),
            ({"length": 10**400}, "is outside the limits"),
            ({"preparation_time": None}, "preparation_time must be a number"),
            ({"record": "no"}, "record must be True or False"),
            ({"cell_id": [101]}, "cell_id must be"),
            ({"initial_state": 5}, "initial_state must be a list"),
            ({"initial_position": "1"}, "initial_position must be a number"),
            ({"disturbances": [object()]}, "is not a disturbance"),
            ({"kind": ["SimplePendulum"]}, "unknown experiment type"),
            ({"length": 61.0}, "61.0 is outside the limits"),
            ({"length": 0.0}, "0.0 is outside the limits"),
            ({"length": float("nan")}, "nan is outside the limits"),
            ({"initial_position": [7.0]}, "initial_position 7.0 is outside the limits"),
            ({"initial_position": [0.1, 0.2]}, "initial_position has 2 entries, .* 1 joints"),
            ({"initial_position": ["up"]}, "each entry.*must be a number"),
            ({"preparation_time": -1.0}, "preparation_time -1.0 is outside the limits"),
            ({"disturbances": "earthquake"}, "unknown disturbance preset 'earthquake'"),
            ({"kind": "SimplePendlum"}, "did you mean 'SimplePendulum'"),
        ],
    )
    def test_mistakes(self, lab, arguments, message):
        with pytest.raises(LabError, match=message):
            experiment(lab, **arguments)

    def test_rate_limit(self):
        with Lab("ideal", clock=ManualClock(), starts_per_window=3, start_window=10.0) as lab:
            client = Client()
            gym = client.start_gym(TOKEN, 60, [CellType.SINGLE])
            for _ in range(2):
                client.stop_episode(client.start_episode(gym, "SimplePendulum", 1)[0])
                lab.clock.advance(1.0)
            with pytest.raises(LabError, match="Too many requests, try again in 8 seconds"):
                client.start_episode(gym, "SimplePendulum", 1)
            lab.clock.advance(8.1)
            client.start_episode(gym, "SimplePendulum", 1)
