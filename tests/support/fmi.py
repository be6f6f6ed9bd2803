"""An importer of FMUs: FMI 2.0 by ctypes, written from the standard and not from what makes them."""

import ctypes
import pathlib
import subprocess
import zipfile
from collections.abc import Sequence
from xml.etree import ElementTree

REFERENCE = ctypes.c_uint
COSIMULATION = 1


class Fmu:
    """An instance of the FMU in a file, unpacked into a folder. Functions return the status: 0 ok, 3 error. With
    `flags` the library is compiled anew, from the source that is in it."""

    def __init__(self, path: pathlib.Path, folder: pathlib.Path, guid: str | None = None, flags: Sequence[str] = ()):
        with zipfile.ZipFile(path) as archive:
            archive.extractall(folder)
        self.description = ElementTree.parse(folder / "modelDescription.xml").getroot()
        name = self.description.find("CoSimulation").get("modelIdentifier")
        (binary,) = (folder / "binaries").glob(f"*/{name}.*")
        if flags:
            source, binary = folder / "sources" / f"{name}.c", folder / "again.so"
            command = ["cc", "-std=c99", "-shared", "-fPIC", *flags, str(source), "-o", str(binary), "-lm"]
            subprocess.run(command, check=True)
        self.library = ctypes.CDLL(str(binary))
        self.library.fmi2Instantiate.restype = ctypes.c_void_p
        self.references = {
            one.get("name"): int(one.get("valueReference")) for one in self.description.iter("ScalarVariable")
        }
        given = (b"one", COSIMULATION, (guid or self.description.get("guid")).encode(), b"", None, 0, 0)
        self.instance = ctypes.c_void_p(self.library.fmi2Instantiate(*given))

    def call(self, name: str, *args) -> int:
        """A function of the standard by its name without `fmi2`, of this instance."""
        return getattr(self.library, f"fmi2{name}")(self.instance, *args)

    def begin(self, **parameters):
        """Set parameters ("__" for dots), and initialise."""
        call = self.library
        zero = ctypes.c_double(0.0)
        assert call.fmi2SetupExperiment(self.instance, 0, zero, zero, 0, zero) == 0
        assert call.fmi2EnterInitializationMode(self.instance) == 0
        for name, value in parameters.items():
            assert self.set(name.replace("__", "."), value) == 0
        assert call.fmi2ExitInitializationMode(self.instance) == 0
        return self

    def set(self, name: str, value: float) -> int:
        reference = REFERENCE(self.references[name])
        return self.library.fmi2SetReal(
            self.instance, ctypes.byref(reference), ctypes.c_size_t(1), ctypes.byref(ctypes.c_double(value))
        )

    def get(self, *names: str) -> list[float]:
        at = (REFERENCE * len(names))(*(self.references[name] for name in names))
        values = (ctypes.c_double * len(names))()
        assert self.library.fmi2GetReal(self.instance, at, ctypes.c_size_t(len(names)), values) == 0
        return list(values)

    def step(self, t: float, length: float) -> int:
        return self.library.fmi2DoStep(self.instance, ctypes.c_double(t), ctypes.c_double(length), 1)

    def state(self) -> ctypes.c_void_p:
        kept = ctypes.c_void_p(None)
        assert self.library.fmi2GetFMUstate(self.instance, ctypes.byref(kept)) == 0
        return kept

    def restore(self, kept: ctypes.c_void_p) -> None:
        assert self.library.fmi2SetFMUstate(self.instance, kept) == 0
        assert self.library.fmi2FreeFMUstate(self.instance, ctypes.byref(kept)) == 0
        assert kept.value is None
