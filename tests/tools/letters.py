"""Names whose letters only look the same, and models that have such names."""

import re
import string
import zipfile

import fmugym

MICRO, GREEK = "\u00b5_r", "\u03bc_r"

_TO_WIDE = {ord(letter): ord(letter) + 0xFEE0 for letter in string.ascii_letters}


def wide(name):
    """A name in letters of the width of Chinese ones, which are other characters."""
    return name.translate(_TO_WIDE)


def with_wide_names(text):
    """A CSV file with such names in its heading; units stay."""
    heading, rows = text.split("\n", 1)
    return "\n".join([re.sub(r"(?<![^,])[^,\[\n]+", lambda one: wide(one[0]), heading), rows])


def with_names(folder, **names):
    """The pendulum with other names of its variables."""
    source = fmugym.bundled_fmu("Pendulum", fmi_version="2.0")
    path = folder / "model.fmu"
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(path, "w") as new:
        for entry in old.infolist():
            content = old.read(entry)
            if entry.filename == "modelDescription.xml":
                text = content.decode()
                for name, other in names.items():
                    assert f'name="{name}"' in text
                    text = text.replace(f'name="{name}"', f'name="{other}"')
                content = text.encode()
            new.writestr(entry, content)
    return path
