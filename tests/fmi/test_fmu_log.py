"""Messages of FMUs arrive at Python's logging: level, text and sender, for each FMI version."""

import gc
import logging
import threading

import pytest
from combinations import in_turn
from fmu_tools import (
    MAJOR_VERSIONS,
    PlainEnv,
    edited_fmu,
    library_name,
    probe_config,
    probe_library,
)

LEVELS = {0: "INFO", 1: "WARNING", 2: "WARNING", 3: "ERROR", 4: "CRITICAL", 9: "INFO"}


@pytest.fixture(autouse=True)
def all_levels(caplog):
    with caplog.at_level(logging.DEBUG):
        yield


def records(caplog, name="fmugym.PlainEnv"):
    return [(r.levelname, r.getMessage()) for r in caplog.records if r.name == name]


@in_turn({"status,level": LEVELS.items(), "version": MAJOR_VERSIONS})
def test_level_and_text(probe, caplog, version, status, level):
    config = probe_config(model_parameters={"log_status": status, "label": "Träger"})
    env = PlainEnv(probe(version), config, logging.INFO)
    env.reset()
    env.step(0.0)
    *_, (found, text) = records(caplog)  # the first one tells how the pool runs
    env.close()
    assert found == level
    assert text.endswith("[probe] step 1 of Träger is 100%")
    assert text.startswith("Probe_")


@pytest.mark.parametrize("version", MAJOR_VERSIONS)
def test_messages_below_the_level_are_not_asked_for(probe, caplog, version):
    env = PlainEnv(probe(version), probe_config(model_parameters={"log_status": 0}))
    env.reset()
    env.step(0.0)
    env.close()
    assert records(caplog) == []


@pytest.mark.parametrize("version", MAJOR_VERSIONS)
def test_every_instance_has_its_own_name_and_receiver(probe, caplog, version):
    """FMPy's own logger gives all messages to the instance made last, and crashes after it."""
    envs = []
    for index in range(3):
        cls = type(f"Env{index}", (PlainEnv,), {})
        parameters = {"log_status": 1, "label": f"env {index}"}
        envs.append(cls(probe(version), probe_config(model_parameters=parameters)))
        envs[-1].reset()
    envs.pop(1).close()
    gc.collect()
    for env in envs:
        env.step(0.0)
    for index in (0, 2):
        ((level, text),) = records(caplog, f"fmugym.Env{index}")
        assert level == "WARNING"
        assert text.endswith(f"step 1 of env {index} is 100%")
    for env in envs:
        env.close()


@pytest.mark.parametrize("version", MAJOR_VERSIONS)
def test_threads(probe, caplog, version):
    def run(index):
        cls = type(f"Thread{index}", (PlainEnv,), {})
        parameters = {"log_status": 1, "label": f"thread {index}"}
        env = cls(probe(version), probe_config(model_parameters=parameters))
        env.reset()
        for _ in range(20):
            env.step(0.0)
        env.close()

    threads = [threading.Thread(target=run, args=(index,)) for index in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for index in range(4):
        texts = [text for _, text in records(caplog, f"fmugym.Thread{index}")]
        ends = [text.partition("[probe] ")[2] for text in texts]
        assert ends == [f"step {i} of thread {index} is 100%" for i in range(1, 21)]


@pytest.mark.parametrize("version", MAJOR_VERSIONS)
def test_bytes_that_are_not_utf_8(probe, tmp_path, caplog, version):
    library = probe_library(version).replace(b" is 100%", b" \xe9\xff 100%")
    path = edited_fmu(probe(version), tmp_path, add={library_name(version): library})
    env = PlainEnv(path, probe_config(model_parameters={"log_status": 1}))
    env.reset()
    env.step(0.0)
    env.close()
    ((_, text),) = records(caplog)
    assert text.endswith("step 1 of probe \ufffd\ufffd 100%")
