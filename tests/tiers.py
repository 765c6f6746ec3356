"""Which tests the default run leaves out, so that it takes at most 90 s on two cores.

``python -m pytest -m ""`` runs every test, and so does ``.ci/run``. Every feature stays in the
default run: of a test with many combinations of parameters, it takes every n-th.
"""

SLOW_MODULES = {
    "test_benchmarks",
    "test_examples",
    "test_lab_programs",
    "test_packaging",
    "test_pendulum_sim_to_lab",
    "test_soak",
    "test_stand_in",
    "test_without_native",
}
"""Programs that train, build wheels or measure."""

EVERY = {
    "test_call_order": 6,
    "test_cli": 3,
    "test_equal_to_gymnasium": 2,
    "test_fmi": 3,
    "test_hooks": 6,
    "test_hostile_archive": 3,
    "test_lab_cells": 2,
    "test_lab_sessions": 2,
    "test_lifecycle": 3,
    "test_native_build": 12,
    "test_native_pool": 5,
    "test_number_types": 5,
    "test_pool": 5,
    "test_quirks": 9,
    "test_reproducibility": 5,
    "test_resources": 4,
    "test_trial": 2,
    "test_untidy_archives": 4,
    "test_user_mistakes": 2,
    "test_zoo": 11,
}
"""By module: of each test's combinations of parameters, the default run takes every n-th."""

EVERY_OF_OTHERS = {"test_vector": 6}
"""By the beginning of a module's name."""

SLOW_TESTS = {
    "test_cloud_pendulum.py::TestExits",
    "test_fuzz.py",
    "test_identification.py::TestOutputError",
    "test_identification.py::test_example",
    "test_lifecycle.py::TestManyLives",
    "test_native_pool.py::test_memory",
    "test_native_threads.py::test_stress",
    "test_process_pool.py::TestEndOfParent",
}
"""Others, by the beginning of their node ids."""


def is_slow(node_id, number):
    """Whether the default run leaves out a test.

    Args:
        node_id: As pytest writes it, relative to ``tests/``.
        number: How many combinations of the same test came before.
    """
    module = node_id.partition(".py")[0]
    if module in SLOW_MODULES or node_id.startswith(tuple(SLOW_TESTS)):
        return True
    every = EVERY.get(module)
    if every is None:
        starts = (n for name, n in EVERY_OF_OTHERS.items() if module.startswith(name))
        every = next(starts, 1)
    return number % every > 0
