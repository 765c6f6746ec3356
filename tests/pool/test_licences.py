"""FMUs that need a licence for each instance."""

import functools
import itertools
import logging
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
from combinations import in_turn
from demanding_tools import DemandingEnv, expected_outputs, make_fmu

import fmugym
from fmugym.environment.config import EnvConfig
from fmugym.errors import LicenceError
from fmugym.pool.licences import speaks_of_licence
from fmugym.pool.trial.verdict import known_verdict

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="its library is made for Linux")

TOKENS = ["licensed", "licensed at initialization"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("licences")


class LicenceServer:
    """The licence server of the FMUs in a test."""

    def __init__(self, path, monkeypatch):
        self._path = path
        monkeypatch.setenv("LICENCES", str(path))
        self.limit = lambda count: monkeypatch.setenv("LICENCES_LIMIT", str(count))
        self.limit(1)

    @property
    def most(self):
        """The most licences that were taken at once."""
        path = self._path.with_name(f"{self._path.name}.most")
        return max(map(int, path.read_text().split())) if path.exists() else 0

    @property
    def taken(self):
        return len(self._path.read_bytes()) // 4 if self._path.exists() else 0

    def take(self, process):
        """Give a licence to another program until it ends."""
        self._path.write_bytes(process.pid.to_bytes(4, sys.byteorder))


@pytest.fixture
def licences(own_trials, tmp_path, monkeypatch):
    """A licence server, beside trials as users have them."""
    return LicenceServer(tmp_path / "seats", monkeypatch)


@pytest.fixture
def other_program(licences, caplog):
    """Start another program that has a licence until this one waits for it."""
    over, threads = threading.Event(), []

    def start():
        program = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
        licences.take(program)
        threads.append(threading.Thread(target=end, args=[program]))
        threads[-1].start()

    def end(program):
        while not over.wait(0.05) and "waiting for" not in caplog.text:
            pass
        program.kill()
        program.wait()

    yield start
    over.set()
    for thread in threads:
        thread.join()


def play(env, steps=3):
    env.reset(seed=0)
    for _ in range(steps):
        env.step(np.array([0.5], np.float32))
    return float(env.state[0])


EXPECTED = expected_outputs(1.5, [0.5] * 3)[-1]


class TestLimits:
    @pytest.mark.parametrize("token", TOKENS)
    @pytest.mark.parametrize("config", [{}, {"isolation": "process"}])
    def test_one_is_enough_for_one_environment(self, folder, licences, token, config):
        env = DemandingEnv(make_fmu(folder, token), max_instances=1, **config)
        assert [play(env), play(env)] == [EXPECTED, EXPECTED]
        assert licences.taken == 1
        env.close()
        assert licences.most == 1
        assert licences.taken == 0

    @pytest.mark.parametrize("options", [{}, {"isolation": "process", "workers": 2}])
    def test_a_vector_environment_takes_one_for_each(self, folder, licences, options):
        licences.limit(3)
        path = make_fmu(folder, "licensed")
        envs = fmugym.FMUVectorEnv(lambda: DemandingEnv(path, max_instances=3), 3, **options)
        envs.reset(seed=0)
        for _ in range(3):
            envs.step(np.full((3, 1), 0.5, np.float32))
        assert [state[0] for state in envs.get_attr("state")] == [EXPECTED] * 3
        assert licences.taken == 3
        envs.close()
        assert licences.most == 3

    def test_no_trial_starts_if_more_are_asked_for_than_allowed(self, folder, licences):
        path = make_fmu(folder, "licensed")
        make = functools.partial(DemandingEnv, path, max_instances=2)
        with pytest.raises(fmugym.ConfigError, match=r"3 environments need 3 .*allows 2"):
            fmugym.FMUVectorEnv(make, 3)
        with pytest.raises(fmugym.ConfigError, match=r"3 environments need 3 .*allows 2"):
            fmugym.FMUVectorEnv(make, 3, isolation="process", workers=1)
        assert licences.most == 0

    @pytest.mark.parametrize(("count", "text"), [(1, "1 instance at"), (2, "2 instances at")])
    def test_the_trial_says_how_many_it_used(self, folder, licences, caplog, cli, count, text):
        caplog.set_level(logging.INFO, "fmugym")
        licences.limit(count)
        path = make_fmu(folder, "licensed")
        fmugym.FMUVectorEnv(lambda: DemandingEnv(path), count).close()
        assert licences.most == count
        assert known_verdict(fmugym.FMU(path)).instances == count
        assert f"was tried with {count} instance(s) at once" in caplog.text
        assert f"tried with {text} once" in cli("info", path)[1]


class TestRefusal:
    @pytest.mark.parametrize(
        ("token", "config"),
        [
            *itertools.product(TOKENS, [{}, {"isolation": "process"}, {"probe_timeout": None}]),
            *itertools.product(["licensed or dead"], [{}, {"isolation": "process"}]),
        ],
    )
    def test_has_the_words_of_the_fmu(self, folder, licences, token, config):
        licences.limit(0)
        with pytest.raises(LicenceError) as caught:
            DemandingEnv(make_fmu(folder, token), **config).reset()
        text = str(caught.value)
        assert "FLEXlm error -4: checkout of Demanding failed, all 0 seats taken" in text
        assert "licence_wait" in text or token == "licensed at initialization"
        assert isinstance(caught.value, fmugym.FMULoadError)
        assert isinstance(caught.value, fmugym.SimulationError)

    @pytest.mark.parametrize("token", TOKENS)
    def test_of_a_second_instance_is_no_sign_of_shared_globals(
        self, folder, licences, token, caplog
    ):
        path = make_fmu(folder, token)
        with pytest.raises(LicenceError, match=r"used 2 instance\(s\) at once.*all 1 seats taken"):
            fmugym.FMUVectorEnv(lambda: DemandingEnv(path), 2)
        assert "disturb" not in caplog.text
        licences.limit(2)
        envs = fmugym.FMUVectorEnv(lambda: DemandingEnv(path), 2)  # nothing wrong was remembered
        envs.reset()
        envs.close()
        assert "disturb" not in caplog.text

    def test_in_a_later_reset(self, folder, licences):
        env = DemandingEnv(
            make_fmu(folder, "licensed at initialization"),
            reset_method="instance",
        )
        env.reset()
        licences.limit(0)
        with pytest.raises(LicenceError, match="all 0 seats taken"):
            env.reset()
        licences.limit(1)
        assert play(env) == EXPECTED
        env.close()

    @pytest.mark.parametrize(
        ("said", "expected"),
        [
            ("no licence for 5 seats", True),
            ("License checkout failed", True),
            ("ready | Could not connect to lmgrd", True),
            ("the dongle is missing", True),
            ("License checked out. | the table is not there", False),
            ("failed to find the heat source", False),
        ],
    )
    def test_is_recognized_by_its_words(self, said, expected):
        assert speaks_of_licence(f"no seats.fmu failed; the FMU said: {said}") is expected
        assert not speaks_of_licence(said)  # these are not the FMU's words


class TestWaiting:
    @in_turn({"config": [{}, {"isolation": "process"}, {"probe_timeout": None}], "token": TOKENS})
    def test_ends_when_another_program_returns_its_licence(
        self, folder, licences, other_program, token, config, caplog
    ):
        other_program()
        env = DemandingEnv(make_fmu(folder, token), licence_wait=20, **config)
        assert play(env) == EXPECTED
        env.close()
        assert "all 1 seats taken; waiting for" in caplog.text
        assert licences.most == 1

    def test_ends_when_its_time_is_over(self, folder, licences):
        licences.limit(0)
        start = time.monotonic()
        with pytest.raises(LicenceError, match=r"no licence came within 0\.8 s \(licence_wait\)"):
            DemandingEnv(make_fmu(folder, "licensed"), licence_wait=0.8, probe_timeout=None)
        assert 0.8 <= time.monotonic() - start < 30.0

    @pytest.mark.parametrize("options", [{}, {"isolation": "process"}])
    def test_in_a_reset_of_some_environments(
        self, folder, licences, other_program, options, make_envs
    ):
        licences.limit(2)
        path = make_fmu(folder, "licensed at initialization")
        envs = make_envs(
            lambda: DemandingEnv(path, reset_method="instance", licence_wait=20), 2, **options
        )
        other_program()
        envs.reset(seed=0)
        for _ in range(3):
            envs.step(np.full((2, 1), 0.5, np.float32))
        assert [state[0] for state in envs.get_attr("state")] == [EXPECTED] * 2


@pytest.mark.parametrize(
    ("key", "value"),
    [
        *(("max_instances", value) for value in (0, -1, 1.5, "2", True)),
        *(("licence_wait", value) for value in (-1, float("nan"), "2", None)),
    ],
)
def test_odd_values_are_refused(key, value):
    with pytest.raises(fmugym.ConfigError, match=key):
        EnvConfig.from_dict(
            {"model_input_names": "u", "model_output_names": "y", "foreign": {key: value}}
        )


class TestInitializations:
    """A trial says how many it took; a wait for licences changes nothing."""

    @pytest.mark.parametrize("config", [{}, {"licence_wait": 1.0}])
    def test_of_one_environment(self, folder, licences, caplog, config, ran):
        caplog.set_level(logging.INFO, "fmugym")
        path = make_fmu(folder, "licensed")
        DemandingEnv(path, **config).close()
        verdict = known_verdict(fmugym.FMU(path))
        assert 4 <= verdict.initializations <= 9
        assert verdict.reset_method == "restore"
        text = f"and {verdict.initializations} initialization(s) in all"
        assert text in caplog.text
        assert f"{verdict.initializations} initializations" in ran("info", path)

    def test_what_is_known_of_one_is_not_tried_again(self, folder, licences):
        licences.limit(2)
        path = make_fmu(folder, "licensed")
        make = functools.partial(DemandingEnv, path, licence_wait=20.0)
        make().close()
        before = known_verdict(fmugym.FMU(path))
        fmugym.FMUVectorEnv(make, 2).close()
        after = known_verdict(fmugym.FMU(path))
        assert after.neighbours == "independent"
        assert after.resets == before.resets != {}
        assert after.initializations > before.initializations

    def test_trials_keep_to_the_limit_as_well(self, folder, licences):
        """The other environment needs a trial of its own; no more than one instance exists."""
        licences.limit(2)
        path = make_fmu(folder, "licensed")
        env = DemandingEnv(path, max_instances=1)
        with pytest.raises(LicenceError, match=r"for a trial.*1 for an env"):
            DemandingEnv(path, max_instances=1, time_step=0.1)
        assert play(env) == EXPECTED
        env.close()
        DemandingEnv(path, max_instances=1, time_step=0.1).close()
        assert licences.most == 1

    def test_without_a_trial_two_instances_are_compared_within_the_limit(self, folder, licences):
        licences.limit(3)
        make = functools.partial(
            DemandingEnv, make_fmu(folder, "licensed"), max_instances=2, probe_timeout=None
        )
        env = make()
        with pytest.raises(LicenceError, match=r"needs 2 more instance.* for a trial"):
            fmugym.FMUVectorEnv(make, 2)
        env.close()
