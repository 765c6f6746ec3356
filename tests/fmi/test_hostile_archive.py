"""Archives that try to exhaust memory or time, or to take over a terminal, are harmless."""

import json
import logging
import os
import re
import stat
import subprocess
import sys
import time
import zipfile

import pytest
from combinations import in_turn
from fmu_tools import (
    PlainEnv,
    edited_fmu,
    probe_config,
    probe_fmu,
    probe_xml,
    require_refused,
    write_fmu,
)

from fmugym import FMU, FMULoadError, SimulationError
from fmugym.errors import printable

XML = "modelDescription.xml"
CONTROL = re.compile(r"[\x00-\x09\x0b-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069]")
"""What a terminal may obey; the line break is looked at where it matters."""

EVIL = "\x9b2J\x85fake line\u202e"
"""What XML can carry: a control sequence, a line break, a reversal of the writing direction."""

MEASURE = """
import re, sys
from fmugym import FMU, FMUGymError

def peak():  # getrusage counts the parent's memory too
    return int(re.search(r"VmHWM:\\s+(\\d+)", open("/proc/self/status").read())[1])

before = peak()
try:
    FMU(sys.argv[1])
    print("read")
except FMUGymError as error:
    print(error)
print((peak() - before) // 1024)
"""


def opened(path):
    """Open an FMU in a process of its own; returns what came of it and the megabytes it took."""
    command = [sys.executable, "-c", MEASURE, str(path)]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120)
    text, megabytes = done.stdout.splitlines()
    return text, int(megabytes)


def with_xml(folder, xml, **files):
    return write_fmu(folder / "some.fmu", {XML: xml, **files})


@pytest.mark.skipif(sys.platform != "linux", reason="measures memory with /proc")
class TestMemory:
    def test_a_false_size_of_the_xml(self, tmp_path):
        """It takes 2.1 GB to unpack the file to its end."""
        path = tmp_path / "some.fmu"
        with (
            zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive,
            archive.open(XML, "w") as f,
        ):
            for _ in range(1024):
                f.write(b" " * 2**20)
        content = bytearray(path.read_bytes())
        entry = content.rindex(b"PK\x01\x02")
        content[entry + 24 : entry + 28] = (1000).to_bytes(4, "little")
        path.write_bytes(content)
        text, megabytes = opened(path)
        assert megabytes < 50
        assert "is damaged: Bad CRC-32" in text

    def test_markup_in_an_encoding_that_hides_it(self, tmp_path):
        """UTF-7 spells < and > as letters."""
        xml = '<?xml version="1.0" encoding="UTF-7"?>+ADw-r+AD4-' + "+ADw-a/+AD4-" * 1_300_000
        text, megabytes = opened(with_xml(tmp_path, xml + "+ADw-/r+AD4-"))
        assert megabytes < 100
        assert "its encoding is 'UTF-7', expected 'UTF-8'" in text

    def test_two_declarations_of_encodings(self, tmp_path):
        """Parsers that take the second one would find elements that were not counted."""
        hidden = "+ADw-a/+AD4-" * 1_000_000
        head = '<?xml version="1.0"?><?xml version="1.0" encoding="UTF-7"?>'
        xml = probe_xml(2).replace("<ModelVariables>", f"{hidden}<ModelVariables>")
        text, megabytes = opened(with_xml(tmp_path, head + xml))
        assert megabytes < 100
        assert "is not valid XML" in text

    def test_markup_in_two_bytes_a_character(self, tmp_path):
        elements = "<a/>" * 1_600_000
        xml = f'<?xml version="1.0" encoding="UTF-16"?><r>{elements}</r>'
        text, _ = opened(with_xml(tmp_path, xml.encode("utf-16")))
        assert "elements and attributes" not in text  # they are fewer than the limit
        assert "found <r fmiVersion" in text
        edited = xml.replace("<a/>" * 1_600_000, "<a/>" * 3_000_000).encode("utf-16")
        text, megabytes = opened(with_xml(tmp_path, edited, noise=os.urandom(2**18)))
        assert re.search(r"some 300000\d elements and attributes, the limit is 2501000", text)
        assert megabytes < 150

    def test_dependencies_of_unknowns(self, tmp_path):
        """FMPy makes a list of millions of objects of them."""
        xml = probe_xml(2)
        unknown = f'<Unknown index="1" dependencies="{"1 " * 1_500_000}"/>'
        structure = f"<ModelStructure><Outputs>{unknown * 18}</Outputs></ModelStructure>"
        assert "<ModelStructure/>" in xml
        xml = xml.replace("<ModelStructure/>", structure)
        text, megabytes = opened(with_xml(tmp_path, xml, noise=os.urandom(2**19)))
        assert text == "read"
        assert megabytes < 250


class TestTime:
    def test_names_of_many_parts(self, tmp_path):
        """Each folder above a file was compared with each file: quadratic in the parts."""
        path = probe_fmu(tmp_path, add={"a/" * 32_000 + "x": ""})
        begin = time.process_time()
        require_refused(path, r"'a/a/a.*\.\.\.' lies in more than 64 folders")
        assert time.process_time() - begin < 1.0

    def test_many_files_in_deep_folders(self, tmp_path):
        deep = "/".join("abcdefgh" * 7)
        path = probe_fmu(tmp_path, add={f"resources/{deep}/{n}": "" for n in range(5_000)})
        begin = time.process_time()
        FMU(path)
        assert time.process_time() - begin < 5.0

    def test_many_links(self, tmp_path):
        """Each of them must not read the directory of the archive again."""
        path = probe_fmu(tmp_path)
        with zipfile.ZipFile(path, "a") as archive:
            for number in range(3_000):
                link = zipfile.ZipInfo(f"resources/{number}")
                link.create_system, link.external_attr = 3, (stat.S_IFLNK | 0o777) << 16
                archive.writestr(link, f"../{XML}")
        begin = time.process_time()
        FMU(path)
        assert time.process_time() - begin < 3.0


class TestNumbers:
    @in_turn({"reference": [-1, 2**32, 2**63, 10**30], "version": [1, 2, 3]})
    def test_references_beyond_32_bits(self, tmp_path, reference, version):
        edits = {'valueReference="0"': f'valueReference="{reference}"'}
        path = probe_fmu(tmp_path, version, edits)
        require_refused(
            path, f"variable 'a' has the value reference {reference}, expected 0 to 4294967295"
        )

    def test_items_beyond_64_bits(self, tmp_path):
        edits = {'name="slow" value="1"': f'name="slow" value="{"9" * 400}"'}
        require_refused(
            probe_fmu(tmp_path, 2, edits), "item 'slow' of the enumeration 'Mode' is 9+, exp"
        )


def test_lines_of_findings_are_those_of_the_file(tmp_path):
    """Nothing that is left out moves the lines."""
    xml = probe_xml(2).replace('name="mix"', 'name="sum"')
    xml = f'<?xml version="1.0"\n encoding="UTF-8"?>\n<!-- one\ntwo -->\n{xml}'
    line = next(n for n, text in enumerate(xml.splitlines(), 1) if 'name="sum"' in text)
    second = next(n for n, t in enumerate(xml.splitlines(), 1) if 'name="sum"' in t and n > line)
    (finding,) = FMU(probe_fmu(tmp_path, 2, add={XML: xml})).findings
    assert f"line {second - 1}" in finding  # FMPy does not see the line break in the declaration


class TestControlCharacters:
    def test_printable(self):
        assert printable("Träger 温度 25 °C") == "Träger 温度 25 °C"
        assert printable("a\x1b[2J\r\n\x00") == r"a\x1b[2J\r\n\x00"
        assert not CONTROL.search(printable("".join(map(chr, range(0x3000)))))

    def test_errors(self, tmp_path):
        """The name of the model is quoted when it refuses to run."""
        path = probe_fmu(tmp_path, 2, {'modelName="Probe"': f'modelName="{EVIL}"', "{probe-": "{x"})
        with pytest.raises(FMULoadError, match="refused to be instantiated") as caught:
            PlainEnv(path, probe_config())
        assert not CONTROL.search(str(caught.value))
        with pytest.raises(SimulationError) as caught:
            raise SimulationError(f"step of {EVIL}\n failed")
        assert "\n" not in str(caught.value)

    @pytest.mark.parametrize("version", [1, 2, 3])
    def test_messages_in_log_error_and_info(self, probe, caplog, version):
        label = "\x1b[31m\x07red\x9b\nforged line"
        parameters = {"label": label, "log_status": 1, "fault": 3, "fault_step": 2}
        config = probe_config(model_parameters=parameters)
        with caplog.at_level(logging.INFO):
            env = PlainEnv(probe(version), config, logging.INFO)
        env.reset()
        infos = [env.step(0.0)[4] for _ in range(2)]
        env.close()
        texts = [r.getMessage() for r in caplog.records] + [str(infos[-1].get("fault", ""))]
        said = [text for text in texts if "red" in text]
        assert len(said) >= 2
        assert all(r"\x1b[31m\x07red" in text for text in said)
        assert not any("\n" in text or CONTROL.search(text) for text in texts)

    def test_findings_in_the_log(self, tmp_path, caplog):
        edits = {'name="sum"': f'name="{EVIL}"', 'name="mix"': f'name="{EVIL}"'}
        with caplog.at_level("INFO", "fmugym"):
            FMU(probe_fmu(tmp_path, 2, edits))
        assert "is not unique" in caplog.text
        assert not any(CONTROL.search(message) for message in caplog.messages)

    @pytest.mark.parametrize("options", [[], ["--all"], ["--json"]])
    def test_command_line(self, tmp_path, options, ran):
        edits = {'modelName="Probe"': f'modelName="{EVIL}"', 'name="sum"': f'name="{EVIL}"'}
        path = probe_fmu(tmp_path, 2, edits, add={f"resources/{EVIL}": ""})
        out = ran("info", path, *options)
        assert not CONTROL.search(out)
        if options == ["--json"]:
            assert json.loads(out)["model_name"] == EVIL

    def test_command_line_errors(self, tmp_path, refused):
        path = edited_fmu(probe_fmu(tmp_path), tmp_path, add={f"../{EVIL}\x1b": ""})
        assert not CONTROL.search(refused("info", path))
