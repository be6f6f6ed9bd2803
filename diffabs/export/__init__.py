"""What was tuned, for where it shall run: the computer's part of a loop as C, Structured Text or difference equations;
and the plant as an FMU."""

from diffabs.export.c99 import c_source as c_source
from diffabs.export.device import Device as Device
from diffabs.export.device import NotExported as NotExported
from diffabs.export.device import device as device
from diffabs.export.difference_equations import equations as equations
from diffabs.export.mockup import fmu as fmu
from diffabs.export.structured_text import structured_text as structured_text
