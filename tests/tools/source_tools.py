"""FMUs that bring their source code, and no library."""

import building
import exchange_tools
import fmu_tools

FILES = ("core.c", "usual.c", "dahlquist.c")
BOTH = ("CoSimulation", "ModelExchange")


def sources(version):
    """The source code of a model, by its place in the FMU."""
    folder = building.HERE / "exchange"
    names = (*FILES, f"fmi{version}.c", "exchange.h")
    found = {f"sources/code/{name}": (folder / name).read_bytes() for name in names}
    stubs = fmu_tools.stubs(version, f"fmi{version}", folder / f"fmi{version}.c")
    return found | {"sources/headers/stubs.h": stubs.encode()}


def build_description():
    names = [f"code/{name}" for name in (*FILES, "fmi3.c")]
    return f"""<fmiBuildDescription fmiVersion="3.0">
      <BuildConfiguration modelIdentifier="Other"/>
      <BuildConfiguration modelIdentifier="Model">
        <SourceFileSet language="C99">
          {"".join(f'<SourceFile name="{name}"/>' for name in names)}
          <PreprocessorDefinition name="STUBS" value="&quot;stubs.h&quot;"/>
          <PreprocessorDefinition name="FMI_VERSION" value="3"/>
          <PreprocessorDefinition name="BROKEN" optional="true" value="x"/>
          <IncludeDirectory name="headers"/>
        </SourceFileSet>
      </BuildConfiguration>
    </fmiBuildDescription>"""


def write_source_fmu(path, version=3, add=None):
    """Write an FMU without a library.

    Args:
        path: The new file.
        version: Of FMI: the model description of 2 lists the sources, a build description of 3.
        add: More files, by their places.
    """
    files = sources(version)
    xml = exchange_tools.describe("dahlquist", version, BOTH)
    if version == 3:
        files["sources/buildDescription.xml"] = build_description().encode()
    else:
        names = (*(f"code/{name}" for name in FILES), "code/shim.c")
        text = '#define FMI_VERSION 2\n#define STUBS "../headers/stubs.h"\n#include "fmi2.c"\n'
        files["sources/code/shim.c"] = text.encode()
        listing = "".join(f'<File name="{name}"/>' for name in names)
        xml = xml.replace("/><", f"><SourceFiles>{listing}</SourceFiles></CoSimulation><", 1)
    files["modelDescription.xml"] = xml
    return fmu_tools.write_fmu(path, files | (add or {}))
