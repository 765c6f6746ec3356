"""Three tiers of tests: the default run, ``slow`` tests, and ``exhaustive`` ones among these.

The default run takes a minute or two on two cores. ``.ci/run`` also runs the slow tests that are
not exhaustive, and ``.ci/full`` runs every test, as ``python -m pytest -m ""`` does. The default
run has a test of every feature but licences and quirks of FMUs, systems of FMUs, searches, fits,
surrogates, planners, reports, plants and exports, and none of the rules of the code. Of a test with
many combinations of parameters, it takes every n-th.
"""

SLOW_MODULES = {
    "test_array_derivatives",
    "test_baselines_mpc",
    "test_benchmarks",
    "test_call_order",
    "test_cli_advice",
    "test_cli_docs",
    "test_cli_residual",
    "test_cli_resume",
    "test_cli_search",
    "test_cli_surrogate",
    "test_cli_tuning",
    "test_clock_fractions",
    "test_compile",
    "test_copies",
    "test_declared_dates",
    "test_declared_physical",
    "test_declared_units",
    "test_docs",
    "test_docs_plant",
    "test_docs_tutorial",
    "test_events",
    "test_examples",
    "test_examples_references",
    "test_examples_system",
    "test_examples_two_zones",
    "test_export",
    "test_export_fmu",
    "test_export_onnx",
    "test_export_sb3",
    "test_export_search",
    "test_fuzz_forms",
    "test_fuzz_systems",
    "test_guessing",
    "test_house_plant",
    "test_identification_odd_arguments",
    "test_keys_in_editors",
    "test_lab_cells",
    "test_lab_programs",
    "test_layers",
    "test_licences",
    "test_limited_instances",
    "test_log_fit",
    "test_mutated_archives",
    "test_mutated_tasks",
    "test_names",
    "test_native_build",
    "test_native_threads",
    "test_negated_aliases",
    "test_neighbours",
    "test_odd_arguments",
    "test_odd_hooks",
    "test_order_of_step",
    "test_packaging",
    "test_pendulum_sim_to_lab",
    "test_pettingzoo",
    "test_plant",
    "test_plant_opcua",
    "test_process_ends",
    "test_quirks",
    "test_search",
    "test_series",
    "test_several_instances",
    "test_shared_data",
    "test_snapshot_machine",
    "test_soak",
    "test_fortran_libraries",
    "test_start_times",
    "test_strings",
    "test_surrogate",
    "test_systems",
    "test_systems_arrays",
    "test_systems_clocks",
    "test_systems_description",
    "test_systems_faces",
    "test_systems_isolated",
    "test_systems_linearization",
    "test_systems_many",
    "test_systems_resets",
    "test_systems_ssp",
    "test_systems_strings",
    "test_value_arrays",
    "test_value_sizes",
    "test_value_types",
    "test_vector_ends",
    "test_vector_masks",
    "test_wild_equations",
    "test_without_native",
    "test_zoo",
}
"""Programs that train, build, measure, or make cases by the hundred."""

WITHOUT_EXTENSION = {
    "test_clock_shift",
    "test_conversions",
    "test_declared_tables",
    "test_distributions",
    "test_executable",
    "test_expressions",
    "test_files",
    "test_fmu_log",
    "test_hostile_archive",
    "test_kept",
    "test_keys",
    "test_lenient",
    "test_model_description",
    "test_progress_bars",
    "test_rendering_scenes",
    "test_temporary",
    "test_untidy_archives",
    "test_without_native",
}
"""Modules that run where the C extension was not built, but for tests with ``engine``."""

EVERY = {
    "test_expressions": 5,
    "test_commands": 5,
    "test_contract": 17,
    "test_golden_tasks": 8,
    "test_hostile_archive": 19,
    "test_pool": 7,
    "test_slow_models": 7,
    "test_words": 121,
}
"""By module: of each test's combinations of parameters, the default run takes every n-th."""

EVERY_OF_OTHERS = 61
"""For the modules that are not in ``EVERY``."""

EVERY_IN_CI = {
    "test_commands": 5,
    "test_contract": 13,
    "test_golden_tasks": 1,
    "test_expressions": 3,
    "test_exported_expressions": 3,
    "test_export_search": 3,
    "test_declared_physical": 3,
    "test_declared_weather": 3,
    "test_shared_data": 2,
    "test_user_mistakes": 3,
    "test_array_derivatives": 3,
    "test_compile": 3,
    "test_copies": 3,
    "test_declared_sensors": 5,
    "test_declared_warm_up": 5,
    "test_events": 5,
    "test_isolated_rollouts": 3,
    "test_packaging": 2,
    "test_pool": 11,
    "test_process_ends": 11,
    "test_quirks": 43,
    "test_several_instances": 11,
    "test_start_times": 5,
    "test_strings": 5,
    "test_systems": 5,
    "test_systems_isolated": 3,
    "test_systems_resets": 5,
    "test_value_arrays": 3,
    "test_value_sizes": 3,
    "test_value_types": 3,
    "test_words": 5,
    "test_zoo": 29,
}
"""By module: of each test's combinations, ``.ci/run`` takes every n-th.

Where FMI versions and ways of running are multiplied, the numbers have no factor in common with
theirs, so that each of these occurs with others in turn.
"""

EVERY_OF_OTHERS_IN_CI = 7
"""For the modules that are not in ``EVERY_IN_CI``; their parameters take turns."""

SLOW_TESTS = (
    "test_contract.py::test_worker_processes",
    "test_env.py::test_time_is_exact",
    "test_exported_expressions.py::test_an_agent_in_onnx",
    "test_exported_expressions.py::test_curves_in_onnx",
    "test_exported_expressions.py::test_onnx_has",
    "test_identification.py::TestMeasured",
    "test_process_files.py::test_names_of_instances",
    "test_golden_tasks.py::test_an_onnx",
    "test_golden_tasks.py::test_is_as_it_was[exported",
    "test_golden_tasks.py::test_is_as_it_was[training",
    "test_proposal.py::test_bundled",
    "test_baselines_tuning.py::test_the_same",
    "test_cli_playing.py::TestBench::test_a_table",
    "test_cli_playing.py::TestRecord::test_a_report",
    "test_cli_playing.py::TestInterruption",
    "test_cli_playing.py::TestRecord::test_several",
    "test_cli_left_out.py::TestProgress::test_of_the_test",
    "test_cli_left_out.py::TestTrain",
    "test_cli_signals.py::TestEnd::test_is_not",
    "test_cli_signals.py::TestEnd::test_of_simulate",
    "test_cli_signals.py::TestEnd::test_while",
    "test_cli_signals.py::test_of_train",
    "test_cloud_pendulum.py::TestExits",
    "test_declared.py::test_spawned",
    "test_examples_mpc.py::test_it_swings",
    "test_examples_mpc.py::test_the_program_draws",
    "test_executable.py::TestMissingLibraries::test_beside",
    "test_files.py::test_a_search",
    "test_files.py::test_force",
    "test_gate.py::test_every_row",
    "test_gate.py::test_trees_are",
    "test_gate.py::test_another_package",
    "test_gate.py::test_the_time_of",
    "test_lab_sessions.py::TestNothingLeaks",
    "test_lifecycle.py::TestManyLives",
    "test_model_exchange.py::TestEnvironments::test_a_solver",
    "test_model_exchange.py::TestPools",
    "test_model_exchange.py::TestSolvers::test_the_stiff",
    "test_native_guards.py::TestRecords::test_are_each_of_their_own_episode",
    "test_isolated_rollouts.py::test_a_hang",
    "test_isolated_rollouts.py::test_a_rollout",
    "test_isolated_rollouts.py::test_faults",
    "test_isolated_rollouts.py::test_results",
    "test_isolated_environments.py::test_interrupts",
    "test_native_pool.py::test_memory",
    "test_process_pool.py::TestChoice",
    "test_resources.py::test_linux_libraries",
    "test_rollouts.py::TestValues::test_of_many_candidates",
    "test_instance_limit.py::test_are_waited",
    "test_instance_limit.py::test_of_a_vector",
    "test_instance_limit.py::test_waiting_ends",
    "test_signals_in_python.py::test_a_command",
    "test_slow_models.py::TestProgress::test_is_not",
    "test_slow_models.py::TestProgress::test_of_a_trial_is_logged",
    "test_snapshots.py::TestForeign",
    "test_specs.py::test_a_class_of_a_script",
    "test_trajectories.py::TestDifferences::test_of_fmi",
    "test_trajectories.py::TestDirectional::test_error",
    "test_trajectories.py::TestModelExchange",
    "test_trajectories.py::TestRefusals::test_of_an_",
    "test_trajectories.py::TestTimeDependentFMU::test_with",
    "test_trial.py::TestDeath::test_a_hang",
    "test_trial.py::TestDeath::test_before_a_vector",
    "test_trial.py::TestDeath::test_of_a_second",
    "test_trial.py::TestIsolated",
    "test_trial.py::TestSurvival::test_a_refusal",
    "test_trial.py::TestSurvival::test_a_verdict",
    "test_trial.py::TestSurvival::test_is_remembered",
    "test_trial.py::TestSurvival::test_without_a_place",
    "test_vector_infos.py::test_gathered_as",
    "test_other_makers.py::test_vector[pythonfmu",
    "test_other_makers.py::test_who_calls_python",
    "test_other_makers.py::test_single[pythonfmu",
    "test_cli_inspection.py::TestSkeleton",
    "test_executable.py::TestMissingLibraries",
    "test_process_border.py",
    "test_clock_shift.py::test_a_shift",
    "test_native_pool.py::TestIsolation",
    "test_formula_programs.py::test_a_task_that_is_too_long",
    "test_cli_validate.py::test_",
    "test_commands.py::TestHelp::test_shells",
    "test_commands.py::TestCtrlC::test_it_ends_a_command_at_any_moment[0.3",
    "test_commands.py::TestCtrlC::test_it_ends_a_command_at_any_moment[0.9",
    "test_cli_training.py::TestTrain::test_an_agent_learns",
    "test_streams.py::test_many_normal_numbers",
    "test_notebooks.py::test_figures_are_pictures",
)
"""Others, by the beginning of their node ids."""

EXHAUSTIVE_TESTS = (
    "test_baselines_mpc.py::TestCommandLine::test_a_report",
    "test_baselines_tuning.py::test_it_finds",
    "test_benchmarks.py::test_tables",
    "test_cli_inspection.py::TestSkeleton::test_paths",
    "test_cli_inspection.py::TestSkeleton::test_runs_for",
    "test_cli_docs.py::test_examples_of_commands_run[evaluate1",
    "test_cli_residual.py::TestTraining::test_it_goes_on",
    "test_cli_search.py::TestCourse::test_a_search_that_time",
    "test_cli_search.py::test_targets_are_reached",
    "test_copies.py::test_no_growth",
    "test_declared_rewards.py::test_what_is_too_large",
    "test_executable.py::TestMissingLibraries::test_are_named",
    "test_fuzz_forms.py::test_damaged",
    "test_guessing.py",
    "test_held_out.py::test_a_folder",
    "test_hostile_archive.py::TestMemory",
    "test_identification.py::TestOutputError",
    "test_lab_programs.py::TestIdentification::test_finds_the_length",
    "test_licences.py::TestRefusal",
    "test_native_guards.py::test_want_of_memory",
    "test_native_threads.py::test_stress",
    "test_packaging.py::test_an_installed_wheel",
    "test_pendulum_sim_to_lab.py",
    "test_plant.py::TestFaults",
    "test_plant.py::TestPredictions",
    "test_plant_opcua.py::TestEncryption",
    "test_plant_opcua.py::test_tags",
    "test_proposal.py::test_types",
    "test_quirks.py::TestEpisodes",
    "test_quirks.py::TestVerdict",
    "test_quirks.py::test_an_",
    "test_search.py::TestBudget::test_steps_are_a_ceiling",
    "test_search.py::test_a_process_that_constants",
    "test_series.py::TestPictures::test_long",
    "test_series.py::TestReport::test_it_has_the_interval",
    "test_series.py::TestReport::test_it_is_one",
    "test_several_instances.py::TestLength",
    "test_shared_data.py::test_steps_in_threads",
    "test_slow_models.py::TestTime",
    "test_systems_many.py",
    "test_systems_ssp.py::TestLarge",
    "test_quirks.py::test_the_check_finds_bad_resets[3-stops, slow at first",
    "test_cli_advice.py::TestSolvers::test_stiff_models_get_one_for_stiff_models[robertson",
    "test_cli_advice.py::TestSolvers::test_stiff_models_get_one_for_stiff_models[van_der_pol",
    "test_baselines_mpc.py::TestCommandLine::test_thinking_ahead",
    "test_baselines_mpc.py::TestCommandLine::test_training_compares",
    "test_docs_plant.py::test_its_commands",
    "test_docs_plant.py::test_the_agent_beats",
    "test_docs_tutorial.py::test_its_commands",
    "test_examples.py::test_the_program_takes",
    "test_log_fit.py::test_intervals_cover",
    "test_lab_programs.py::test_a_program_for_the_real_lab",
    "test_native_build.py::test_core_compiles",
    "test_native_build.py::test_zig_builds",
    "test_native_helpers.py::test_a_busy",
    "test_packaging.py::test_an_editable",
    "test_plant_opcua.py::test_a_server_that_goes",
    "test_proposal.py::test_foreign",
    "test_examples_system.py",
    "test_systems_faces.py::TestCommandLine::test_validation",
    "test_systems_ssp.py::TestDamaged",
    "test_model_exchange.py::TestEvents::test_time_does_not",
    "test_windows_fmus.py::TestProgram::test_a_build",
    "test_windows_fmus.py::TestProgram::test_its_sources_fit",
    "test_packaging.py::test_without_a_compiler",
    "test_benchmarks.py::test_heavy_steps",
    "test_cli_advice.py::TestSolvers::test_stiff_models_get_one_for_stiff_models[prothero",
    "test_soak.py",
)
"""Slow tests that are left to ``.ci/full``, by the beginning of their node ids."""


TESTS_IN_WINE = (
    "test_process_ends.py::TestKilled::test_of_an_fmu_in_wine",
    "test_process_ends.py::test_an_interrupt_while_wine_starts",
)


def is_in_wine(node_id):
    """Whether a test needs Wine, whose folder and worker program take half a minute to make."""
    is_named = node_id.startswith(TESTS_IN_WINE) or "::TestInWine" in node_id
    return is_named or "wine" in node_id.partition("[")[2]


def is_slow(node_id, number):
    """Whether the default run leaves out a test.

    Args:
        node_id: As pytest writes it, without the folder.
        number: How many combinations of the same test came before.
    """
    module = node_id.partition(".py")[0]
    if (
        module in SLOW_MODULES
        or node_id.startswith(SLOW_TESTS + EXHAUSTIVE_TESTS)
        or is_in_wine(node_id)
    ):
        return True
    return number % EVERY.get(module, EVERY_OF_OTHERS) > 0


def is_exhaustive(node_id, number):
    """Whether a slow test is left to ``.ci/full``; the arguments are those of ``is_slow``."""
    module = node_id.partition(".py")[0]
    if node_id.startswith(EXHAUSTIVE_TESTS) or is_in_wine(node_id):
        return True
    every = EVERY_IN_CI.get(module, EVERY_OF_OTHERS_IN_CI)
    return is_slow(node_id, number) and number % every > 0
