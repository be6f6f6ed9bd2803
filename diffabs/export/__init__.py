"""What was tuned, for where it shall run: the computer's part of a loop as C, or as difference equations."""

from diffabs.export.c99 import c_source as c_source
from diffabs.export.device import Device as Device
from diffabs.export.device import NotExported as NotExported
from diffabs.export.device import device as device
from diffabs.export.difference_equations import equations as equations
