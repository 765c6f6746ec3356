"""FMU archives: what is refused before anything runs, extraction, and cleaning up."""

import gc
import pathlib
import stat
import sys
import zipfile

import fmpy
import pytest
from fmu_tools import MAJOR_VERSIONS, edited_fmu, library_name, probe_fmu, read_fmu, write_fmu

from fmugym import FMU, FMULoadError, archive, bundled_fmu

ELF = sys.platform == "linux"
only_elf = pytest.mark.skipif(not ELF, reason="looks at ELF libraries")


@pytest.fixture
def fmu_path(probe):
    return probe(2)


def refused(path, match):
    with pytest.raises(FMULoadError, match=match) as caught:
        FMU(path).extract()
    assert pathlib.Path(path).name in str(caught.value)


class TestGoodArchives:
    @pytest.mark.parametrize("version", MAJOR_VERSIONS)
    def test_only_what_this_machine_needs_is_extracted(self, version, tmp_path, temp_root):
        more = {
            "sources/model.c": "",
            "documentation/index.html": "",
            "binaries/amiga/Probe.so": "",
            "resources/data/table.csv": "1",
            "extra/terms.txt": "2",
        }
        fmu = FMU(probe_fmu(tmp_path, version, add=more))
        folder = fmu.extract()
        found = {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()}
        assert found == {
            "modelDescription.xml",
            library_name(version),
            "resources/data/table.csv",
            "extra/terms.txt",
        }
        assert set(fmu.platforms) >= {"amiga", fmu.platform}
        fmu.close()
        assert list(temp_root.iterdir()) == []

    def test_extracts_once_and_again_after_close(self, fmu_path, temp_root):
        fmu = FMU(fmu_path)
        assert list(temp_root.iterdir()) == []  # nothing is written before it is needed
        first = fmu.extract()
        assert fmu.extract() == first
        fmu.close()
        fmu.close()
        assert not first.exists()
        second = fmu.extract()
        assert (second / library_name(2)).is_file()
        fmu.close()

    def test_the_folder_goes_with_the_object(self, fmu_path, temp_root):
        fmu = FMU(fmu_path)
        fmu.extract()
        del fmu
        gc.collect()
        assert list(temp_root.iterdir()) == []

    def test_a_resources_folder_is_always_there(self, fmu_path):
        fmu = FMU(fmu_path)
        assert (fmu.extract() / "resources").is_dir()
        fmu.close()

    def test_relative_paths_stay_valid_when_the_working_directory_changes(
        self, fmu_path, tmp_path, monkeypatch
    ):
        monkeypatch.chdir(fmu_path.parent)
        fmu = FMU(fmu_path.name)
        monkeypatch.chdir(tmp_path)
        assert fmu.path == fmu_path
        assert fmu.extract().is_dir()
        fmu.close()

    def test_findings_are_logged_and_do_not_stop(self, tmp_path, caplog):
        path = probe_fmu(tmp_path, 2, {'name="sum"': 'name="mix"'})
        with caplog.at_level("INFO", "fmugym"):
            assert FMU(path).runs_here
        assert "Probe.fmu: 1 findings in the model description" in caplog.text
        assert "mix" in caplog.text

    def test_repr_names_the_file(self, fmu_path):
        assert str(fmu_path) in repr(FMU(fmu_path))


class TestBadArchives:
    def test_missing_file(self, tmp_path):
        refused(tmp_path / "absent.fmu", "there is no FMU at")

    def test_a_folder(self, tmp_path):
        refused(tmp_path, "there is no FMU at")

    @pytest.mark.parametrize("content", [b"", b"PK", b"not a zip archive" * 100])
    def test_not_a_zip(self, tmp_path, content):
        path = tmp_path / "some.fmu"
        path.write_bytes(content)
        refused(path, "is not an FMU")

    def test_cut_off_zip(self, fmu_path, tmp_path):
        path = tmp_path / "cut.fmu"
        path.write_bytes(fmu_path.read_bytes()[:-30])
        refused(path, "is not an FMU")

    def test_no_model_description(self, tmp_path):
        refused(write_fmu(tmp_path / "some.fmu", {"readme.txt": ""}), "no modelDescription.xml")

    @pytest.mark.parametrize(
        "name", ["../evil.so", "/evil.so", "a/../../evil", "c:evil.dll", "a\\..\\..\\evil"]
    )
    def test_files_outside_of_the_folder(self, fmu_path, tmp_path, temp_root, name):
        refused(edited_fmu(fmu_path, tmp_path, add={name: "x"}), "outside of its own folder")
        assert list(temp_root.iterdir()) == []

    def test_symbolic_links(self, fmu_path, tmp_path):
        path = edited_fmu(fmu_path, tmp_path)
        link = zipfile.ZipInfo("resources/link")
        link.create_system = 3
        link.external_attr = (stat.S_IFLNK | 0o777) << 16
        with zipfile.ZipFile(path, "a") as file:
            file.writestr(link, "/etc/passwd")
        refused(path, "symbolic link")

    def test_encryption(self, fmu_path, tmp_path):
        content = bytearray(edited_fmu(fmu_path, tmp_path).read_bytes())
        content[content.rindex(b"PK\x01\x02") + 8] |= 1  # the flag in the central directory
        path = tmp_path / "Probe.fmu"
        path.write_bytes(content)
        refused(path, "encrypted")

    @pytest.mark.filterwarnings("ignore:Duplicate name")
    def test_two_files_of_one_name(self, fmu_path, tmp_path):
        path = edited_fmu(fmu_path, tmp_path)
        with zipfile.ZipFile(path, "a") as file:
            file.writestr("modelDescription.xml", "<other/>")
        refused(path, "two files of one name")

    def test_too_many_files(self, fmu_path, tmp_path, monkeypatch):
        monkeypatch.setattr(archive, "MAX_ENTRIES", 4)
        more = {f"resources/{i}": "" for i in range(5)}
        refused(edited_fmu(fmu_path, tmp_path, add=more), "7 files, the limit is 4")

    def test_too_large(self, fmu_path, tmp_path, monkeypatch):
        monkeypatch.setattr(archive, "MAX_EXTRACTED_BYTES", 100_000)
        path = edited_fmu(fmu_path, tmp_path, add={"resources/big": bytes(200_000)})
        refused(path, "the limit is 100000")

    def test_zip_bomb(self, tmp_path, temp_root):
        """Files that overlap in the archive: 100 kB unpack to 10 GB on paper."""
        path = write_fmu(tmp_path / "bomb.fmu", {"modelDescription.xml": bytes(100_000_000)})
        with zipfile.ZipFile(path) as file:
            entry = file.infolist()[0]
        with zipfile.ZipFile(path, "a") as file:
            for index in range(30):
                copy = zipfile.ZipInfo(f"resources/{index}")
                for name in ("header_offset", "file_size", "compress_size", "CRC"):
                    setattr(copy, name, getattr(entry, name))
                copy.compress_type = entry.compress_type
                file.filelist.append(copy)
            file._didModify = True
        assert path.stat().st_size < 200_000
        refused(path, "1000 times its size")
        assert list(temp_root.iterdir()) == []

    def test_damaged_contents(self, fmu_path, tmp_path, temp_root):
        content = bytearray(edited_fmu(fmu_path, tmp_path).read_bytes())
        middle = content.index(b"binaries/") + 2000  # inside of the compressed library
        content[middle : middle + 50] = bytes(50)
        path = tmp_path / "Probe.fmu"
        path.write_bytes(content)
        refused(path, "cannot be extracted")
        assert list(temp_root.iterdir()) == []

    def test_damaged_model_description(self, fmu_path, tmp_path):
        content = bytearray(edited_fmu(fmu_path, tmp_path).read_bytes())
        start = content.index(b"modelDescription.xml") + 40
        content[start : start + 50] = bytes(50)
        path = tmp_path / "Probe.fmu"
        path.write_bytes(content)
        refused(path, "cannot be read")

    def test_a_file_that_is_also_a_folder(self, fmu_path, tmp_path, temp_root):
        more = {"resources/a": "", "resources/a/b": ""}
        refused(edited_fmu(fmu_path, tmp_path, add=more), "cannot be extracted")
        assert list(temp_root.iterdir()) == []

    def test_a_file_without_a_name(self, fmu_path, tmp_path):
        refused(edited_fmu(fmu_path, tmp_path, add={".": "x"}), "without a name")


class TestLibraries:
    def test_no_library_for_this_platform(self, fmu_path, tmp_path, temp_root):
        path = edited_fmu(fmu_path, tmp_path, drop=["binaries"], add={"binaries/amiga/P.so": ""})
        assert not FMU(path).runs_here
        refused(path, "no library for this platform .*built for: amiga")
        assert list(temp_root.iterdir()) == []

    def test_no_library_at_all(self, fmu_path, tmp_path):
        refused(edited_fmu(fmu_path, tmp_path, drop=["binaries"]), "no platform at all")

    @only_elf
    @pytest.mark.parametrize(
        ("content", "match"),
        [(b"", "not a shared library"), (b"MZ\0\0", "not a shared library"), (b"\x7fELF", "cut")],
    )
    def test_not_a_library(self, fmu_path, tmp_path, temp_root, content, match):
        path = edited_fmu(fmu_path, tmp_path, add={library_name(2): content})
        with pytest.raises(FMULoadError, match=match):
            FMU(path).extract()
        assert list(temp_root.iterdir()) == []

    @only_elf
    @pytest.mark.parametrize("part", [0.2, 0.9])
    def test_a_library_that_is_cut_short(self, fmu_path, tmp_path, part):
        """The dynamic linker would end the process with SIGBUS."""
        library = read_fmu(fmu_path)[library_name(2)]
        cut = {library_name(2): library[: int(part * len(library))]}
        with pytest.raises(FMULoadError, match="cut short"):
            FMU(edited_fmu(fmu_path, tmp_path, add=cut)).extract()

    @only_elf
    def test_a_library_of_another_processor(self, tmp_path):
        files = read_fmu(bundled_fmu("Pendulum", "3.0"))
        other = "aarch64" if fmpy.architecture == "x86_64" else "x86_64"
        library = files[f"binaries/{other}-linux/Pendulum.so"]
        path = edited_fmu(
            bundled_fmu("Pendulum"), tmp_path, add={library_name(2, "Pendulum"): library}
        )
        with pytest.raises(FMULoadError, match=f"built for {other}, this process runs on"):
            FMU(path).extract()
