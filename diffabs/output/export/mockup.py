"""A plant as an FMU (FMI 2.0 for co-simulation): compiled C that needs neither Python nor this package at run time.

Libraries that make FMUs of Python code run Python, and here JAX, in every step of the importing tool. `plant_c` writes
the plant as C, so the FMU consists of its library, its source and a description.
"""

import hashlib
import importlib.resources
import io
import math
import platform
import subprocess
import sys
import uuid
import zipfile
from typing import Any
from xml.etree import ElementTree as xml

from diffabs.compiler.emit.c99_words import Words, is_name
from diffabs.compiler.runtime.toolchain import NoCompiler, find_compiler
from diffabs.host import files
from diffabs.host.values import make_printable
from diffabs.loop.closed_loop import Loop
from diffabs.output.export.device import NotExported
from diffabs.output.export.plant_c import FmuVariable, PlantSource, plant_source

FMU_COMPILER_FLAGS = ("-x", "c", "-std=c99", "-O2", "-ffp-contract=off", "-fvisibility=hidden", "-shared", "-fPIC")
MOCKUP_COMPILE_TIMEOUT_S = 600
LONG_AGO = (1980, 1, 1, 0, 0, 0)  # date of every file in the archive, so that equal plants give equal bytes
SYSTEMS = {"linux": ("linux", "so"), "darwin": ("darwin", "dylib"), "win32": ("win", "dll")}
CAUSES = {
    "output": {"causality": "output", "variability": "continuous", "initial": "calculated"},
    "input": {"causality": "input", "variability": "continuous"},
    "parameter": {"causality": "parameter", "variability": "fixed", "initial": "exact"},
}


def build_fmu(loop: Loop, name: str, *, step: float, duration: float = 1.0, about: str = "") -> bytes:
    """Return an FMU of a loop's plant as the bytes of its zip archive; it runs on this kind of machine.

    The controls are the inputs, and the signals of the plant's output are the outputs. Every number of the plant and of
    its initial condition is a parameter that the importing tool may set.

    Args:
        loop: Closed loop; controller, sensor and actuator are not part of the FMU.
        name: Name of the model, an identifier of C.
        step: Largest step of the plant's Runge-Kutta method [s].
        duration: Default duration of an experiment [s].
        about: Description, one line.

    Raises:
        ValueError: Step or duration is not positive and finite.
        NotExported: The name is no identifier, a parameter of plant or start is no number or has a wrong value or
            shape, an operation has no translation, a state is not a real number, or no C compiler works.
    """
    if not is_name(name):
        raise NotExported(f"{name!r} is no name that C has for a function: letters, digits and _")
    # As Python's numbers: the text of NumPy's has the name of the type.
    step, duration = float(step), float(duration)
    if not all(0 < x < math.inf for x in (step, duration)):
        raise ValueError(f"step = {step!r} s, duration = {duration!r} s: positive and finite numbers are needed")
    about = make_printable(about)
    plant = plant_source(loop)
    # A digest instead of a random identifier: the same plant has the same GUID, and any change gives another one.
    guid = str(uuid.UUID(hashlib.sha256(f"{plant} {name} {step} {about}".encode()).hexdigest()[:32]))
    source = _source(plant, guid, step)
    system, ending = SYSTEMS.get(sys.platform, SYSTEMS["linux"])
    folder = f"{system}{'64' if platform.architecture()[0] == '64bit' else '32'}"
    content = {
        "modelDescription.xml": _description(plant, name, guid, step, duration, about),
        f"sources/{name}.c": source.encode(),
        f"binaries/{folder}/{name}.{ending}": _compile_library(source),
    }
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as file:
        for path, data in content.items():
            file.writestr(zipfile.ZipInfo(path, LONG_AGO), data, zipfile.ZIP_DEFLATED)
    return archive.getvalue()


def _source(plant: PlantSource, guid: str, step: float) -> str:
    """Return all C of the FMU as one file."""
    outputs, inputs = (sum(variable.role == role for variable in plant.variables) for role in ("output", "input"))
    number = Words("double", lambda op, place: place).literal  # a literal has no place
    begun = ", ".join(number(variable.value) for variable in plant.variables)
    struct = "double v[VARIABLES], x[STATES], time, stop;\n  int phase, ready;\n  char guid[sizeof GUID];"
    limits = {
        name: ", ".join(number(getattr(variable, name)) for variable in plant.variables) for name in ("low", "high")
    }
    head = (
        "#include <math.h>\n#include <stdbool.h>\n#include <stddef.h>\n#include <stdint.h>\n\n"
        # Constants, not macros: a macro would replace variables of the same name in the plant's code.
        f'static const char GUID[] = "{guid}";\nstatic const double STEP = {step!r};\n'
        f"enum {{ VARIABLES = {len(plant.variables)}, OUTPUTS = {outputs}, INPUTS = {inputs} }};\n"
        f"enum {{ STATES = {plant.states} }};\n\n"
        f"typedef struct {{\n  {struct}\n}} model;\n\n"
        f"static const double begun[VARIABLES] = {{{begun}}};\n"
        f"static const double low[VARIABLES] = {{{limits['low']}}};\n"
        f"static const double high[VARIABLES] = {{{limits['high']}}};\n"
    )
    glue = (importlib.resources.files("diffabs.output.export") / "fmi2.c").read_text(encoding="utf-8")
    return f"{head}\n{plant.text}\n{glue}"


def _compile_library(source: str) -> bytes:
    """Return a library for this machine; raise NotExported if there is no compiler or compilation fails."""
    with files.temporary_folder("diffabs-") as folder:
        text, result = folder / "fmu.c", folder / "fmu.lib"
        text.write_text(source, encoding="utf-8")
        try:
            command = [*find_compiler().command, *FMU_COMPILER_FLAGS, str(text), "-o", str(result), "-lm"]
            compilation = subprocess.run(command, capture_output=True, text=True, timeout=MOCKUP_COMPILE_TIMEOUT_S)
        except (NoCompiler, OSError, subprocess.TimeoutExpired) as error:
            raise NotExported(f"an FMU needs a C compiler: {' '.join(str(error).split())}") from None
        if compilation.returncode or not result.is_file():
            raise NotExported(f"{command[0]} does not compile it: {' '.join(compilation.stderr.split())[:300]}")
        return result.read_bytes()


def _description(plant: PlantSource, name: str, guid: str, step: float, duration: float, about: str) -> bytes:
    """Return modelDescription.xml."""
    root = xml.Element("fmiModelDescription", {
        **{"fmiVersion": "2.0", "modelName": name, "guid": guid, "generationTool": "diffabs", "description": about},
    })  # fmt: skip
    simulation = xml.SubElement(root, "CoSimulation", {
        **{"modelIdentifier": name, "canHandleVariableCommunicationStepSize": "true"},
        **{"canGetAndSetFMUstate": "true", "canSerializeFMUstate": "true"},
    })  # fmt: skip
    xml.SubElement(xml.SubElement(simulation, "SourceFiles"), "File", {"name": f"{name}.c"})
    units = dict.fromkeys(variable.unit for variable in plant.variables if variable.unit not in ("", "1"))
    if units:
        definitions = xml.SubElement(root, "UnitDefinitions")
        for unit in units:
            xml.SubElement(definitions, "Unit", {"name": make_printable(unit)})
    xml.SubElement(root, "DefaultExperiment", {"startTime": "0.0", "stopTime": repr(duration), "stepSize": repr(step)})
    variables = xml.SubElement(root, "ModelVariables")
    for reference, variable in enumerate(plant.variables):
        _variable(variables, variable, reference)
    structure = xml.SubElement(root, "ModelStructure")
    # Every output depends on the state, and in initialization on the parameters.
    outputs = [k for k, variable in enumerate(plant.variables, 1) if variable.role == "output"]
    for tag in ("Outputs", "InitialUnknowns"):
        parent = xml.SubElement(structure, tag)
        for index in outputs:
            xml.SubElement(parent, "Unknown", {"index": str(index)})
    xml.indent(root)
    return xml.tostring(root, encoding="UTF-8", xml_declaration=True)


def _variable(parent: Any, variable: FmuVariable, reference: int) -> None:
    """Add a ScalarVariable to the description."""
    scalar = xml.SubElement(parent, "ScalarVariable", {
        "name": variable.name, "valueReference": str(reference), **CAUSES[variable.role],
    })  # fmt: skip
    start = {} if variable.role == "output" else {"start": repr(variable.value).replace("inf", "INF")}
    limits = {"min": variable.low, "max": variable.high} if variable.role == "parameter" else {}
    # A limit of the largest double means no limit, and FMI's readers need no such attribute.
    shown = {name: repr(limit) for name, limit in limits.items() if abs(limit) < sys.float_info.max}
    xml.SubElement(
        scalar,
        "Real",
        {**shown, **start, **({} if variable.unit in ("", "1") else {"unit": make_printable(variable.unit)})},
    )
