"""Tokens, leases, heartbeats and threads: who may do what, and for how long."""

import gc
import os
import threading
import time

import numpy as np
import pytest
from lab_tools import TOKEN, experiment, ideal_lab, track
from zoo_tools import resident_bytes

from fmugym.lab import CellType, Client, Lab, LabError, ManualClock, RealClock

SINGLE = [CellType.SINGLE]


@pytest.fixture(name="client")
def fixture_client(lab):
    return Client(lab)


def keep_alive(lab, client, token, duration):
    for _ in range(round(duration)):
        lab.clock.advance(1.0)
        client.get_position(token)


class TestHeartbeat:
    def test_two_seconds_without_a_request_end_the_session(self, lab, client):
        _, token = experiment(lab)
        lab.clock.advance(1.99)
        client.get_position(token)
        lab.clock.advance(2.01)
        with pytest.raises(LabError, match="the experiment has ended: no request for 2 s"):
            client.get_position(token)
        with pytest.raises(LabError, match="no request for 2 s"):
            client.set_torque(0.1, token)
        assert client.stop_experiment(token) == ""

    @pytest.mark.parametrize(
        "request_of",
        [
            lambda client, token: client.get_position(token),
            lambda client, token: client.get_velocity(token),
            lambda client, token: client.get_torque(token),
            lambda client, token: client.set_position(None, token),
            lambda client, token: client.set_velocity(0.0, token),
            lambda client, token: client.set_torque(0.0, token),
            lambda client, token: client.set_impedance_controller_params(0, 0, token),
        ],
    )
    def test_every_request_is_one(self, lab, client, request_of):
        _, token = experiment(lab)
        for _ in range(3):
            lab.clock.advance(1.5)
            request_of(client, token)

    def test_a_refused_value_is_one_too(self, lab, client):
        _, token = experiment(lab)
        for _ in range(3):
            lab.clock.advance(1.5)
            with pytest.raises(LabError, match="entries"):
                client.set_torque([1, 2, 3], token)

    def test_preparation_needs_none(self, lab, client):
        _, token = experiment(lab, preparation_time=10.0)
        client.get_position(token)

    def test_leases_need_none(self, lab, client):
        gym = client.start_gym(TOKEN, 60, SINGLE)
        lab.clock.advance(30.0)
        client.start_episode(gym, "SimplePendulum", 1)

    def test_its_time_is_an_option(self):
        with ideal_lab(heartbeat=20.0) as lab:
            client, token = experiment(lab)
            lab.clock.advance(19.0)
            client.get_position(token)


class TestEnds:
    def test_by_time(self, lab, client):
        _, token = experiment(lab, length=5.0)
        keep_alive(lab, client, token, 5.0)
        lab.clock.advance(0.09)
        client.get_position(token)
        lab.clock.advance(0.02)
        with pytest.raises(LabError, match="the experiment has ended: its time of 5 s is over"):
            client.get_position(token)
        assert client.stop_experiment(token) == ""

    def test_by_a_stop(self, lab, client):
        _, token = experiment(lab)
        assert client.stop_experiment(token) == ""
        with pytest.raises(LabError, match="has ended: it was stopped"):
            client.get_position(token)
        with pytest.raises(LabError, match="was stopped before"):
            client.stop_experiment(token)

    def test_episode_by_the_end_of_its_lease(self, lab, client):
        gym = client.start_gym(TOKEN, 3, SINGLE)
        token, _ = client.start_episode(gym, "SimplePendulum", 10)
        keep_alive(lab, client, token, 2.0)
        lab.clock.advance(1.5)
        with pytest.raises(LabError, match="the episode has ended: the lease of its gym is over"):
            client.get_position(token)
        with pytest.raises(LabError, match="the gym has ended: its time is over"):
            client.start_episode(gym, "SimplePendulum", 1)
        assert client.stop_episode(token) == ""
        client.stop_gym(gym)
        with pytest.raises(LabError, match="the gym was stopped before"):
            client.stop_gym(gym)

    def test_episodes_by_a_stop_of_their_lease(self, lab, client):
        gym = client.start_gym(TOKEN, 30, SINGLE * 2)
        tokens = [client.start_episode(gym, "SimplePendulum", 10)[0] for _ in range(2)]
        client.stop_gym(gym)
        for token in tokens:
            with pytest.raises(LabError, match="the episode has ended: its gym was stopped"):
                client.get_position(token)
            assert client.stop_episode(token) == ""
        with pytest.raises(LabError, match="the gym has ended: it was stopped"):
            client.start_episode(gym, "SimplePendulum", 1)

    def test_stops_of_others_change_nothing(self, lab, client):
        first, second = client.start_gym(TOKEN, 9, SINGLE), client.start_gym(TOKEN, 9, SINGLE)
        token, _ = client.start_episode(second, "SimplePendulum", 9)
        client.stop_gym(first)
        client.get_position(token)


class TestTokens:
    @pytest.fixture(name="tokens")
    def fixture_tokens(self, client):
        client.get_user_info(TOKEN)
        gym = client.start_gym(TOKEN, 60, SINGLE)
        episode, _ = client.start_episode(gym, "SimplePendulum", 60)
        session, _ = client.start_experiment(TOKEN, "SimplePendulum", 60)
        return {"user": TOKEN, "gym": gym, "episode": episode, "session": session}

    @pytest.mark.parametrize(
        ("kind", "method"),
        [
            ("user", "get_position"),
            ("gym", "get_position"),
            ("user", "stop_episode"),
            ("gym", "stop_episode"),
            ("session", "stop_episode"),
            ("user", "stop_experiment"),
            ("episode", "stop_experiment"),
            ("user", "stop_gym"),
            ("episode", "stop_gym"),
            ("gym", "get_user_info"),
        ],
    )
    def test_of_the_wrong_kind(self, client, tokens, kind, method):
        with pytest.raises(LabError, match="token"):
            getattr(client, method)(tokens[kind])

    @pytest.mark.parametrize("kind", ["user", "episode", "session"])
    def test_episodes_need_a_gym_token(self, client, tokens, kind):
        with pytest.raises(LabError, match="this gym token is not valid"):
            client.start_episode(tokens[kind], "SimplePendulum", 1)

    @pytest.mark.parametrize("kind", ["gym", "episode", "session"])
    def test_leases_need_a_user_token(self, client, tokens, kind):
        with pytest.raises(LabError, match="not a user token"):
            client.start_gym(tokens[kind], 10, SINGLE)

    def test_of_another_lab(self, tokens):
        with ideal_lab() as other:
            client = Client(other)
            with pytest.raises(LabError, match="unknown"):
                client.get_position(tokens["session"])
            with pytest.raises(LabError, match="unknown"):
                client.start_episode(tokens["gym"], "SimplePendulum", 1)

    @pytest.mark.parametrize("token", ["1234567890123456789", "", None, 5, ["a"]])
    def test_made_up(self, client, tokens, token):
        for method in (client.get_position, client.stop_episode, client.stop_gym):
            with pytest.raises(LabError, match="token"):
                method(token)

    def test_long_expired_ones_are_forgotten(self, lab, client):
        gym = client.start_gym(TOKEN, 3000, SINGLE)
        first, _ = client.start_episode(gym, "SimplePendulum", 1)
        client.stop_episode(first)
        for _ in range(300):
            client.stop_episode(client.start_episode(gym, "SimplePendulum", 1)[0])
        with pytest.raises(LabError, match="unknown or has long expired"):
            client.get_position(first)


class TestWaiting:
    def test_experiments_wait_for_a_free_cell(self, lab, client):
        gym = client.start_gym(TOKEN, 7, SINGLE * 4)
        token, _ = client.start_experiment(TOKEN, "SimplePendulum", 5)
        assert lab.clock.time() == pytest.approx(7.0, abs=0.03)
        assert client.get_position(token) == 0.0
        with pytest.raises(LabError, match="the gym has ended"):
            client.start_episode(gym, "SimplePendulum", 1)

    def test_leases_wait_for_enough_cells(self, lab, client):
        experiment(lab, length=1.5)
        client.start_gym(TOKEN, 10, SINGLE * 3)
        assert lab.clock.time() == 0.0
        client.start_gym(TOKEN, 10, SINGLE)
        assert lab.clock.time() == pytest.approx(1.6, abs=0.03)

    def test_a_cell_of_an_abandoned_session_is_freed(self, lab, client):
        with ideal_lab(clock=lab.clock, cells={CellType.SINGLE: 1}):
            client = Client()
            client.start_experiment(TOKEN, "SimplePendulum", 60)
            client.start_experiment(TOKEN, "SimplePendulum", 60)
            assert lab.clock.time() == pytest.approx(2.0, abs=0.03)

    def test_episodes_wait_within_their_lease(self, lab, client):
        gym = client.start_gym(TOKEN, 10, SINGLE)
        client.start_episode(gym, "SimplePendulum", 1.5)
        client.start_episode(gym, "SimplePendulum", 5)
        assert lab.clock.time() == pytest.approx(1.6, abs=0.03)

    def test_until_the_lease_is_over(self, lab, client):
        gym = client.start_gym(TOKEN, 1, SINGLE)
        client.start_episode(gym, "SimplePendulum", 5)
        with pytest.raises(LabError, match="the gym has ended"):
            client.start_episode(gym, "SimplePendulum", 5)

    def test_a_lease_that_ends_during_the_preparation(self, lab, client):
        gym = client.start_gym(TOKEN, 1, SINGLE)
        with pytest.raises(LabError, match="the gym has ended: its time is over"):
            client.start_episode(gym, "SimplePendulum", 5, 2.0)
        client.start_gym(TOKEN, 1, SINGLE * 4)
        assert lab.clock.time() == 2.0

    def test_interrupted_waits_leave_the_cell_free(self, lab, client, monkeypatch):
        def interrupt(seconds):
            raise KeyboardInterrupt

        with monkeypatch.context() as patch:
            patch.setattr(lab.clock, "sleep", interrupt)
            with pytest.raises(KeyboardInterrupt):
                client.start_experiment(TOKEN, "SimplePendulum", 5, 1.0)
        client.start_gym(TOKEN, 1, SINGLE * 4)
        assert lab.clock.time() == 0.0


class TestThreads:
    def test_four_cells_swing_at_once(self, lab, client):
        gym, swings = client.start_gym(TOKEN, 30, SINGLE * 4), {}

        def swing(angle):
            own = Client()
            token, _ = own.start_episode(gym, "SimplePendulum", 5, initial_position=[angle])
            swings[angle] = track(lab, own, token, 2.0)
            own.stop_episode(token)

        threads = [lab.clock.thread(swing, (angle,)) for angle in (0.5, 1.0, -1.0, 2.0)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(30)
        alone, token = experiment(ideal_lab(), initial_position=[0.5])
        assert len(swings) == 4
        assert swings[0.5] == track(alone.lab, alone, token, 2.0)
        assert swings[1.0] == pytest.approx([-q for q in swings[-1.0]], abs=1e-9)
        alone.lab.close()

    def test_a_killed_thread_loses_its_cell_only(self, lab, client):
        gym, tokens = client.start_gym(TOKEN, 30, SINGLE * 2), []

        def start_and_vanish():
            tokens.append(Client().start_episode(gym, "SimplePendulum", 20)[0])

        thread = threading.Thread(target=start_and_vanish)
        thread.start()
        thread.join(10)
        survivor, _ = client.start_episode(gym, "SimplePendulum", 20)
        keep_alive(lab, client, survivor, 5.0)
        client.start_episode(gym, "SimplePendulum", 5)  # takes the lost one's cell
        assert client.get_position(survivor) == 0.0
        with pytest.raises(LabError, match="no request for 2 s"):
            client.get_position(tokens[0])

    def test_close_while_others_work(self):
        lab, at_work, refused = ideal_lab(clock=RealClock()), threading.Barrier(5), []

        def work():
            own = Client(lab)
            token, _ = own.start_experiment(TOKEN, "SimplePendulum", 60)
            at_work.wait(10)
            try:
                while True:
                    own.get_position(token)
            except LabError as error:
                refused.append(str(error))

        threads = [threading.Thread(target=work) for _ in range(4)]
        for thread in threads:
            thread.start()
        at_work.wait(10)
        lab.close()
        for thread in threads:
            thread.join(10)
        assert refused == ["the lab is closed"] * 4

    def test_close_while_others_wait_for_a_cell(self):
        lab, refused = ideal_lab(clock=RealClock(), cells={CellType.SINGLE: 1}), []
        Client(lab).start_gym(TOKEN, 60, SINGLE)

        def wait():
            try:
                Client(lab).start_experiment(TOKEN, "SimplePendulum", 1)
            except LabError as error:
                refused.append(str(error))

        thread = threading.Thread(target=wait)
        thread.start()
        time.sleep(0.05)
        lab.close()
        thread.join(10)
        assert refused == ["the lab is closed"]


def resources():
    files = len(os.listdir("/proc/self/fd")) if os.path.isdir("/proc/self/fd") else 0
    return threading.active_count(), files


class TestNothingLeaks:
    def test_over_200_sessions(self, temp_root):
        with ideal_lab() as lab:
            client = Client()
            gym = client.start_gym(TOKEN, 3000, SINGLE * 2)

            def live(number):
                kind = ("stopped", "left to its time", "abandoned", "ended by a limit")[number % 4]
                token, _ = client.start_episode(gym, "DoubleIntegrator", 1)
                client.set_torque(0.15 if kind == "ended by a limit" else 0.001, token)
                lab.clock.advance(0.5)
                if kind == "stopped":
                    client.stop_episode(token)
                elif kind == "left to its time":
                    lab.clock.advance(0.7)
                    client.stop_episode(token)

            for number in range(20):
                live(number)
            gc.collect()
            before, before_memory = resources(), resident_bytes()
            for number in range(200):
                live(number)
            gc.collect()
            assert resources() == before
            assert resident_bytes() - before_memory < 5 * 2**20
            assert len(list(temp_root.iterdir())) == 2  # the FMU, once for each of two cells
            assert len(lab.running) <= 3
        assert list(temp_root.iterdir()) == []
        assert threading.active_count() == before[0]

    def test_over_50_labs(self, temp_root):
        def live():
            with Lab(clock=ManualClock()) as lab:
                client, token = experiment(lab, initial_position=[1.0])
                client.get_position(token)

        live()
        gc.collect()
        before = resources()
        for _ in range(50):
            live()
        gc.collect()
        assert resources() == before
        assert list(temp_root.iterdir()) == []

    def test_a_lab_that_was_forgotten(self, temp_root):
        client, token = experiment(ideal_lab())
        assert np.isfinite(client.get_position(token))
        del client
        gc.collect()
        assert list(temp_root.iterdir()) == []
