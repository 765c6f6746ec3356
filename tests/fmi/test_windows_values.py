"""Values of FMUs that have only a library for Windows: the tests of other FMUs, in Wine."""

import pytest
import test_value_arrays as arrays
import test_value_sizes as sizes
import test_value_types as types
import values_tools
from combinations import in_turn
from wine_tools import building_for_windows

VERSIONS = (1, 2, 3)


@pytest.fixture(scope="module")
def feedthrough(wine, tmp_path_factory):
    folder = tmp_path_factory.mktemp("feedthrough")
    with building_for_windows():
        return {v: values_tools.feedthrough_fmu(folder / f"F{v}.fmu", v) for v in VERSIONS}


@pytest.fixture(scope="module")
def state_space(wine, tmp_path_factory):
    with building_for_windows():
        return values_tools.state_space_fmu(tmp_path_factory.mktemp("S") / "S.fmu", fixed=True)


@pytest.fixture(scope="module")
def sized(wine, tmp_path_factory):
    with building_for_windows():
        return values_tools.state_space_fmu(tmp_path_factory.mktemp("Sized") / "S.fmu")


class TestInWine:
    @in_turn(
        {
            "test": [
                types.test_numbers_of_every_type_come_out_as_they_went_in,
                types.test_enumerations_are_discrete,
                arrays.test_some_elements_are_inputs,
            ],
            "version": VERSIONS,
        }
    )
    def test_values(self, feedthrough, version, test):
        test(feedthrough, version, {})

    @pytest.mark.parametrize("version", VERSIONS)
    def test_an_fmu_reads_a_file_of_its_resources(self, wine, tmp_path, version, make_envs):
        with building_for_windows():
            types.test_an_fmu_reads_a_file_of_its_resources(tmp_path, version, {}, make_envs)

    @in_turn({"interface": ["co_simulation", "model_exchange"], "probe": [None, 60.0]})
    def test_arrays(self, state_space, sized, interface, probe, make_envs):
        options = {"interface": interface, "tolerance": 1e-9}
        arrays.test_arrays_follow_the_closed_form(state_space, options)
        sizes.test_structural_parameters_give_arrays_their_sizes(sized, options, probe, make_envs)

    @pytest.mark.parametrize(
        "test",
        [
            arrays.test_one_element,
            arrays.test_vector_environments_do_as_single_ones,
            arrays.test_snapshots,
        ],
    )
    def test_elements(self, state_space, test):
        test(state_space, {})

    @pytest.mark.parametrize(
        "test",
        [
            arrays.test_hooks_on_arrays_of_environments,
            arrays.test_parameters_of_one_episode,
        ],
    )
    def test_faces(self, state_space, test):
        test(state_space)

    @pytest.mark.parametrize(
        "test", [arrays.test_each_environment_has_its_own_array, arrays.test_rollouts]
    )
    def test_vector_environments(self, state_space, test, make_envs):
        test(state_space, make_envs)
