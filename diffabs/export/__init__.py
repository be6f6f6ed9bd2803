"""Export of a tuned loop: the controller as C99, Structured Text or difference equations, and the plant as an FMU."""

from diffabs.export.c99 import c_source as c_source
from diffabs.export.device import ComputerProgram as ComputerProgram
from diffabs.export.device import NotExported as NotExported
from diffabs.export.device import computer_program as computer_program
from diffabs.export.difference_equations import difference_equations as difference_equations
from diffabs.export.mockup import build_fmu as build_fmu
from diffabs.export.sampling import sample_controller as sample_controller
from diffabs.export.structured_text import structured_text as structured_text
