"""FMU archives: what is refused before anything runs, extraction, and cleaning up."""

import gc
import os
import re
import shutil
import zipfile
from functools import partial

import pytest
from fmu_tools import (
    MAJOR_VERSIONS,
    edited_fmu,
    library_name,
    probe_fmu,
    require_refused,
    write_fmu,
)

from fmugym import FMU, ConfigError, FMULoadError, bundled_fmu
from fmugym.fmi import ArchiveLimits, safe_zip, temporary


@pytest.fixture
def fmu_path(probe):
    return probe(2)


@pytest.fixture(autouse=True)
def leaves_nothing(same_working_directory, temp_root):
    """Whatever happens: the working directory is as before, and no temporary file is left."""
    yield
    if any(temp_root.iterdir()):  # a collection takes longer than most tests
        gc.collect()
    assert list(temp_root.iterdir()) == []


class TestInterruptedRemoval:
    """A signal may arrive at any moment; the fixture above finds what is left."""

    def interrupt(self, monkeypatch, name):
        """Let a function of the module raise in its first call."""
        usual, calls = getattr(temporary, name), []

        def raising(*arguments):
            calls.append(1)
            if len(calls) == 1:
                raise KeyboardInterrupt
            return usual(*arguments)

        monkeypatch.setattr(temporary, name, raising)

    def test_before_the_first_file_has_gone(self, fmu_path, monkeypatch):
        fmu = FMU(fmu_path)
        fmu.extract()
        self.interrupt(monkeypatch, "_leave")
        with pytest.raises(KeyboardInterrupt):
            fmu.close()

    def test_before_it_has_begun(self, fmu_path, monkeypatch, temp_root):
        fmu = FMU(fmu_path)
        with monkeypatch.context() as patched:
            self.interrupt(patched, "_is_own")
            fmu.extract()
            with pytest.raises(KeyboardInterrupt):
                fmu.close()
        assert len(list(temp_root.iterdir())) == 1
        fmu.close()

    def test_at_the_end_of_the_interpreter(self, fmu_path, monkeypatch, temp_root):
        fmu = FMU(fmu_path)
        folder = fmu.extract()
        monkeypatch.setattr(temporary, "_is_own", lambda owner: False)
        del fmu
        gc.collect()
        assert folder.exists()
        temporary.remove_rest()


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
        assert "Probe.fmu: 1 findings" in caplog.text
        assert "mix" in caplog.text

    def test_repr_names_the_file(self, fmu_path):
        assert str(fmu_path) in repr(FMU(fmu_path))


def zeros_after(name, distance, content):
    """50 bytes are lost behind a name."""
    place = content.index(name) + distance
    return content[:place] + bytes(50) + content[place + 50 :]


def encrypted(content):
    """The flag in the central directory is set."""
    place = content.rindex(b"PK\x01\x02") + 8
    return content[:place] + bytes([content[place] | 1]) + content[place + 1 :]


DAMAGES = {
    "the library": (partial(zeros_after, b"binaries/", 2000), "is damaged: "),
    "the model description": (partial(zeros_after, b"modelDescription.xml", 40), "is damaged: "),
    "cut out": (lambda c: c[:500] + c[1500:], "is damaged|is not all there|is not an FMU"),
    "cut off": (lambda c: c[:-30], "is not an FMU"),
    "a header": (lambda c: c.replace(b"PK\x03\x04", b"PK\0\0"), "is damaged: Bad magic number"),
    "a size": (
        lambda c: c.replace((2**20).to_bytes(4, "little"), b"\x10\0\0\0"),
        "is damaged: Bad CRC-32",
    ),
    "encrypted": (encrypted, "encrypted"),
}


class TestBadArchives:
    @pytest.mark.parametrize("damage", DAMAGES)
    def test_damaged(self, fmu_path, tmp_path, damage):
        """By disks, and by downloads that lose a piece or the end."""
        change, match = DAMAGES[damage]
        path = edited_fmu(fmu_path, tmp_path, add={"resources/zeros": bytes(2**20)})
        path.write_bytes(change(path.read_bytes()))
        require_refused(path, match, max_ratio=2000)

    def test_missing_file(self, tmp_path):
        require_refused(tmp_path / "absent.fmu", "there is no FMU at")

    def test_a_folder(self, tmp_path):
        require_refused(tmp_path, "there is no FMU at.*folder.*zip")

    @pytest.mark.skipif(os.name != "posix", reason="Windows has no such pipes")
    def test_a_pipe(self, tmp_path):
        os.mkfifo(tmp_path / "pipe.fmu")
        require_refused(
            tmp_path / "pipe.fmu", "there is no FMU at.*pipe.fmu, which is no regular file$"
        )

    def test_a_misspelt_name(self, tmp_path):
        (tmp_path / "Boiler.fmu").touch()
        require_refused(tmp_path / "boilr.FMU", "boilr.*'Boiler.fmu'")

    def test_a_name_that_no_file_can_have(self, tmp_path):
        require_refused(tmp_path / ("long" * 100), "there is no FMU at|is not an FMU.*too long")

    @pytest.mark.parametrize("content", [b"", b"PK", b"not a zip archive" * 100])
    def test_not_a_zip(self, tmp_path, content):
        path = tmp_path / "some.fmu"
        path.write_bytes(content)
        require_refused(path, "is not an FMU")

    def test_no_model_description(self, tmp_path):
        require_refused(
            write_fmu(tmp_path / "some.fmu", {"readme.txt": ""}), "no modelDescription.xml"
        )

    @pytest.mark.parametrize(
        "name",
        [
            "../evil.so",
            "/evil.so",
            "a/../../evil",
            "..",
            "c:evil.dll",
            "C:\\evil.dll",
            "a\\..\\..\\evil",
            "\\\\server\\share\\evil",
            "//server/share/evil",
        ],
    )
    def test_files_outside_of_the_folder(self, fmu_path, tmp_path, name):
        require_refused(
            edited_fmu(fmu_path, tmp_path, add={name: "x"}), "outside of the FMU's own folder"
        )

    def test_devices_of_windows(self, fmu_path, tmp_path, monkeypatch):
        path = edited_fmu(fmu_path, tmp_path, add={"resources/nul.txt": "x"})
        assert FMU(path).runs_here
        monkeypatch.setattr(safe_zip, "_has_devices", True)
        require_refused(path, "'resources/nul.txt' has the name of a device of Windows")

    @pytest.mark.parametrize("folds", [True, False])
    def test_names_that_differ_in_case(self, fmu_path, tmp_path, monkeypatch, folds):
        """On Windows and macOS they are one file."""
        monkeypatch.setattr(safe_zip, "_folds_case", folds)
        path = edited_fmu(fmu_path, tmp_path, add={"resources/a": "", "resources/A": ""})
        if folds:
            require_refused(path, "'resources/A' and 'resources/a' differ only in case")
        else:
            assert FMU(path).runs_here

    @pytest.mark.parametrize(
        "limit", ["max_entries", "max_extracted_bytes", "max_xml_bytes", "max_variables"]
    )
    def test_limits(self, fmu_path, limit):
        """Each is named where it is exceeded, and can be moved there and no further."""
        with pytest.raises(FMULoadError, match=rf"the limit is 1;.*raise {limit} of") as caught:
            FMU(fmu_path, limits=ArchiveLimits(**{limit: 1}))
        size = int(re.search(r"(\d+) (files|bytes|variables)", str(caught.value)).group(1))
        require_refused(fmu_path, f"the limit is {size - 1}", **{limit: size - 1})
        FMU(fmu_path, limits=ArchiveLimits(**{limit: size}))

    def test_limit_of_the_ratio(self, fmu_path, tmp_path):
        path = edited_fmu(fmu_path, tmp_path, add={"resources/zeros": bytes(2**25)})
        require_refused(path, "times its size, the limit is 200; .*max_ratio")
        FMU(path, limits=ArchiveLimits(max_ratio=1100))

    def test_limits_are_positive_integers(self):
        with pytest.raises(ConfigError, match="max_entries must be a positive integer, got 0"):
            ArchiveLimits(max_entries=0)
        with pytest.raises(ConfigError, match=r"max_ratio must be .*, got 1\.5"):
            ArchiveLimits(max_ratio=1.5)

    def test_limits_in_a_config(self, make_env):
        with pytest.raises(FMULoadError, match="the limit is 1; if you trust it, raise max_entr"):
            make_env(archive_limits=ArchiveLimits(max_entries=1))
        with pytest.raises(FMULoadError, match="the limit is 1; if you trust it, raise max_entr"):
            make_env(archive_limits={"max_entries": 1})
        with pytest.raises(ConfigError, match="archive_limits must be a table"):
            make_env(archive_limits=[1])

    def test_preload_is_a_list(self, fmu_path):
        with pytest.raises(ConfigError, match="preload must be a list of paths, got 'libm"):
            FMU(fmu_path, preload="libm.so.6")

    def test_a_directory_that_would_take_minutes_to_read(self, tmp_path):
        path = tmp_path / "many.fmu"
        with zipfile.ZipFile(path, "w") as file:
            for index in range(3000):
                file.writestr(f"resources/{index:0100}", "")
        require_refused(
            path, r"its directory has \d+ bytes, the limit is .*max_entries", max_entries=1
        )

    def test_many_small_files_are_fine(self, fmu_path, tmp_path):
        more = {f"resources/{index:0100}": "" for index in range(3000)}
        assert FMU(edited_fmu(fmu_path, tmp_path, add=more)).runs_here

    def test_zip_bomb(self, tmp_path):
        """Files that overlap in the archive: 100 kB unpack to 3 GB on paper."""
        path = tmp_path / "bomb.fmu"
        write_fmu(path, {"modelDescription.xml": bytes(100_000_000)}, level=9)
        with zipfile.ZipFile(path) as file:
            entry = file.infolist()[0]
        with zipfile.ZipFile(path, "a") as file:
            for index in range(30):
                copy = zipfile.ZipInfo(f"resources/{index}")
                for name in ("header_offset", "file_size", "compress_size", "CRC"):
                    setattr(copy, name, getattr(entry, name))
                copy.compress_type = entry.compress_type
                file.filelist.append(copy)
            file.writestr("resources/last", "")  # so that the directory is written
        assert path.stat().st_size < 200_000
        require_refused(path, r"unpacks to \d+ times its size")

    def test_other_ways_of_compression(self, fmu_path, tmp_path):
        path = edited_fmu(fmu_path, tmp_path)
        with zipfile.ZipFile(path, "a", zipfile.ZIP_LZMA) as file:
            file.writestr("resources/table.csv", "1,2")
        require_refused(path, "'resources/table.csv' is compressed by method 14; FMI allows")

    def test_a_file_that_is_also_a_folder(self, fmu_path, tmp_path):
        more = {"resources/a": "x", "resources/a/b": ""}
        match = "'resources/a' is a file, but other files lie inside of it"
        require_refused(edited_fmu(fmu_path, tmp_path, add=more), match)

    def test_a_file_without_a_name(self, fmu_path, tmp_path):
        require_refused(
            edited_fmu(fmu_path, tmp_path, add={".": "x"}), "'.' has content but no name"
        )


class TestLibraries:
    def test_no_library_for_this_platform(self, fmu_path, tmp_path):
        path = edited_fmu(fmu_path, tmp_path, drop=["binaries"], add={"binaries/amiga/P.so": ""})
        fmu = FMU(path)
        assert not fmu.runs_here
        place = f"binaries/{fmu.description.platform}/"
        require_refused(path, rf"no library for this platform \({place}.*built for: amiga")

    def test_no_library_at_all(self, fmu_path, tmp_path):
        require_refused(edited_fmu(fmu_path, tmp_path, drop=["binaries"]), "no platform at all")

    def test_what_is_no_library_is_not_extracted(self, fmu_path, tmp_path, monkeypatch):
        path = edited_fmu(fmu_path, tmp_path, add={library_name(2): b"text"})
        monkeypatch.setattr(zipfile.ZipFile, "extractall", lambda *_: pytest.fail("extracted"))
        require_refused(path, "Probe.fmu: binaries/.* is not a shared library, expected one of")


def test_a_file_that_is_replaced_after_it_was_opened(tmp_path):
    """The model description would be that of one FMU, and the library that of another."""
    path = tmp_path / "Replaced.fmu"
    shutil.copy(bundled_fmu("Pendulum", "2.0"), path)
    fmu = FMU(path)
    shutil.copy(bundled_fmu("Pendulum", "3.0"), path)
    with pytest.raises(FMULoadError, match=r"Replaced.fmu was changed after it was opened"):
        fmu.extract()
    assert FMU(path).extract().is_dir()


def test_errors_quote_a_little_of_a_damaged_file(probe, tmp_path):
    """zipfile quotes what it finds in the place of a name."""
    path = tmp_path / "Probe.fmu"
    content = bytearray(probe(2).read_bytes())
    content[26:28] = (5000).to_bytes(2, "little")  # the length of the first name
    path.write_bytes(content)
    with pytest.raises(
        FMULoadError, match=r"Probe.fmu is damaged: File name in directory"
    ) as caught:
        FMU(path)
    assert len(str(caught.value)) < 1000
