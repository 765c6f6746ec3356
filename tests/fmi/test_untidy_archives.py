"""Archives as tools make them: what is not as the standard has it is tidied up, told, and runs."""

import gc
import stat
import zipfile
from pathlib import Path

import fmpy
import pytest
from combinations import in_turn
from fmu_tools import (
    PlainEnv,
    library_name,
    platform_folder,
    probe_config,
    probe_fmu,
    read_fmu,
    require_refused,
)

from fmugym import FMU

XML = "modelDescription.xml"
SUFFIX = fmpy.sharedLibraryExtension
each_version = pytest.mark.parametrize("version", [1, 2, 3])
pytestmark = pytest.mark.filterwarnings("ignore:Duplicate name")


@pytest.fixture(autouse=True)
def leaves_nothing(same_working_directory, temp_root):
    yield
    if any(temp_root.iterdir()):  # a collection takes longer than most tests
        gc.collect()
    assert list(temp_root.iterdir()) == []


def pack(folder, entries):
    """Write an archive of pairs of names and contents; names may come twice, or end in a slash."""
    path = folder / "Untidy.fmu"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in entries:
            info = zipfile.ZipInfo("placeholder")
            info.filename = name  # the constructor would turn backslashes into slashes on Windows
            info.compress_type = zipfile.ZIP_DEFLATED
            archive.writestr(info, content)
    return path


@pytest.fixture
def make(probe, tmp_path):
    """Pack the probe with its names changed, and with more entries before and after."""

    def pack_probe(version=2, rename=lambda name: name, before=(), after=()):
        files = [(rename(name), content) for name, content in read_fmu(probe(version)).items()]
        return pack(tmp_path, [*before, *files, *after])

    return pack_probe


def runs(path, expected=0.3, **config):
    """Play an episode."""
    with PlainEnv(path, probe_config(**config)) as env:
        env.reset(seed=0)
        for _ in range(3):
            observation, *_ = env.step([1.0])
    assert observation[0] == pytest.approx(expected)


def findings(path):
    return " / ".join(FMU(path).findings)


class TestNames:
    @in_turn(
        {
            "identifier": ["Pro-be", "Pro.be", "Pro be", "1st", "Pröbe", "~", "-"],
            "version": [2, 3],
        }
    )
    def test_model_identifiers_that_are_not_c_identifiers(self, tmp_path, identifier, version):
        """FMI 2.0 and 3.0 make a file name of it, and nothing else."""
        old, new = library_name(version), library_name(version, identifier)
        edits = {'modelIdentifier="Probe"': f'modelIdentifier="{identifier}"'}
        path = probe_fmu(tmp_path, version, edits)
        files = read_fmu(path)
        runs(pack(tmp_path, [(new if name == old else name, c) for name, c in files.items()]))

    @each_version
    def test_backslashes(self, make, version):
        path = make(version, lambda name: name.replace("/", "\\"), after=[("resources\\a\\b", "x")])
        runs(path)
        assert "backslashes" in findings(path)
        fmu = FMU(path)
        assert (fmu.extract() / "resources" / "a" / "b").read_text() == "x"
        fmu.close()

    @pytest.mark.parametrize(
        "rename",
        [lambda n: f"./{n}", lambda n: n.replace("/", "//"), lambda n: n.replace("/", "/./")],
    )
    def test_odd_ways_to_write_a_path(self, make, rename):
        runs(make(2, rename))

    @pytest.mark.parametrize("change", [str.upper, str.lower, str.title])
    def test_case(self, make, change):
        """Windows does not mind, so that some tools do not either."""
        path = make(2, lambda n: n if n.endswith(SUFFIX) else change(n))
        runs(path)
        assert "taken for 'modelDescription.xml'" in findings(path)

    @pytest.mark.parametrize("folder", ["Binaries", "BINARIES"])
    def test_case_of_folders(self, make, folder):
        platform = platform_folder(2)
        name = f"{folder}/{platform.upper()}/Probe{SUFFIX}"
        path = make(2, lambda n: name if n.endswith(SUFFIX) else n)
        runs(path)
        assert f"{folder!r} in the archive is taken for 'binaries'" in findings(path)

    @pytest.mark.parametrize("change", [str, str.upper, str.title])
    @each_version
    def test_folders_of_another_fmi_version(self, make, version, change):
        """FMI 3.0 has other names for platforms; the folder of the version counts more."""
        own, other = platform_folder(version), change(platform_folder(2 if version == 3 else 3))
        path = make(version, lambda n: n.replace(f"/{own}/", f"/{other}/"))
        runs(path)
        assert f"the library is 'binaries/{other}/Probe{SUFFIX}', expected" in findings(path)
        path = make(version, after=[(f"binaries/{other}/Probe{SUFFIX}", "no library")])
        runs(path)
        assert "the library is" not in findings(path)

    def test_a_folder_of_another_fmi_version_with_several_libraries(self, make):
        other = platform_folder(2)
        path = make(
            3,
            lambda n: f"binaries/{other}/One{SUFFIX}" if n.endswith(SUFFIX) else n,
            after=[(f"binaries/{other}/Two{SUFFIX}", "")],
        )
        require_refused(path, f"2 libraries for this platform in binaries/{other}")

    def test_colons(self, make):
        """They are fine on Unix; zipfile replaces them on Windows."""
        runs(make(after=[("resources/12:30.csv", "x")]))

    def test_a_folder_around_everything_is_named(self, make):
        path = make(2, lambda n: f"Model/{n}")
        require_refused(
            path, r"no modelDescription.xml, but 'Model/modelDescription.xml'; pack the files"
        )


class TestEntries:
    @pytest.mark.parametrize("name", ["./", ".", "", ".\\", "././"])
    def test_an_entry_for_the_archive_itself(self, make, name):
        runs(make(before=[(name, "")], after=[(name, "")]))

    @pytest.mark.parametrize("name", ["./", ".\\", "resources/"])
    def test_folders_with_content(self, make, name):
        """They hung the check of folders once."""
        runs(make(after=[(name, "content")]))

    def test_folders_with_two_entries(self, make):
        folders = [("resources/", ""), ("binaries/", ""), ("resources/", ""), ("binaries", "")]
        runs(make(before=folders, after=folders))

    def test_folders_without_a_slash_or_an_entry(self, make):
        folders = [("resources", ""), ("resources/deep", ""), ("resources/deep/file", "x")]
        path = make(before=folders)
        runs(path)
        fmu = FMU(path)
        assert (fmu.extract() / "resources/deep/file").read_text() == "x"
        fmu.close()

    def test_empty_folders_are_made(self, make):
        """An FMU may want to write there."""
        fmu = FMU(make(after=[("resources/out/", ""), ("resources/log\\", "")]))
        folder = fmu.extract() / "resources"
        assert sorted(path.name for path in folder.iterdir()) == ["log", "out"]
        fmu.close()

    def test_two_equal_files(self, make, probe):
        xml = read_fmu(probe(2))[XML]
        path = make(after=[(XML, xml)])
        runs(path)
        assert findings(path) == ""

    def test_of_two_files_the_last_one_counts(self, make, probe):
        """As for zipfile and FMPy, and for tools that replace a file by adding it again."""
        path = make(before=[(XML, "<old/>"), (library_name(2), "old")])
        runs(path)
        assert f"several files {XML!r}; the last one is used" in findings(path)

    @pytest.mark.parametrize("other", [f"./{XML}", XML.upper()])
    def test_the_exact_name_counts_before_others(self, make, other):
        for place in ("before", "after"):
            path = make(**{place: [(other, "<other/>")]})
            runs(path)
            assert f"several files {XML!r}" in findings(path)


class TestLibraries:
    @pytest.fixture
    def named(self, make):
        """Pack the probe with a library of another name."""

        def pack_named(name="Other", version=2, **more):
            other = library_name(version, name)
            return make(version, lambda n: other if n.endswith(SUFFIX) else n, **more)

        return pack_named

    @in_turn({"name": ["Other", "probe", "lib Probe-1.0"], "version": [2, 3]})
    def test_of_another_name(self, named, caplog, version, name, ran):
        path, other = named(name, version), library_name(version, name)
        with caplog.at_level("INFO", "fmugym"):
            runs(path)
        assert other in caplog.text
        assert f"the library is {other!r}, expected {library_name(version)!r}" in findings(path)
        out = ran("info", path)
        assert other in out
        assert ": runs here" in out

    @pytest.mark.usefixtures("engine")
    def test_of_another_name_in_a_process(self, named):
        runs(named(), isolation="process")

    def test_two_of_other_names_are_named(self, named, probe):
        library = read_fmu(probe(2))[library_name(2)]
        path = named("One", after=[(library_name(2, "Two"), library)])
        require_refused(
            path, rf"2 libraries .*\(One{SUFFIX}, Two{SUFFIX}\), but none is named Probe{SUFFIX}"
        )


class TestLinks:
    """Symbolic links, which zip stores as files that hold the path of their target."""

    @staticmethod
    def add(path, links):
        with zipfile.ZipFile(path, "a") as archive:
            for name, target in links.items():
                info = zipfile.ZipInfo(name)
                info.create_system = 3
                info.external_attr = (stat.S_IFLNK | 0o777) << 16
                archive.writestr(info, target)
        return path

    def test_inside_of_the_archive_stand_for_their_targets(self, make):
        library = library_name(2)
        real = library.replace("Probe", "libreal")
        path = make(2, lambda n: real if n.endswith(SUFFIX) else n, after=[("resources/a/b", "x")])
        links = {
            library.replace("Probe", "middle"): f"libreal{SUFFIX}",
            library: f"./middle{SUFFIX}",
            "resources/link": "a/b",
            "resources/a/up": "../link",
        }
        runs(self.add(path, links))
        fmu = FMU(path)
        folder = fmu.extract() / "resources"
        assert (folder / "link").read_text() == (folder / "a" / "up").read_text() == "x"
        assert not any(Path(p).is_symlink() for p in folder.rglob("*"))
        fmu.close()

    @pytest.mark.parametrize(
        "target", ["/etc/passwd", "../../x", "absent", "link", "loop", "x\0y", "", "a" * 10_000]
    )
    def test_to_elsewhere_are_refused(self, make, target):
        path = self.add(make(), {"resources/link": target, "resources/loop": "link"})
        require_refused(
            path, "'resources/l(ink|oop)' is a symbolic link to .*, not a file of the archive"
        )
