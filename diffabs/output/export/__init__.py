"""Export of a tuned loop: the controller as C99, Structured Text or difference equations, and the plant as an FMU."""

from diffabs.output.export.c99 import c_source as c_source
from diffabs.output.export.c99 import make_identifier as make_identifier
from diffabs.output.export.device import ComputerProgram as ComputerProgram
from diffabs.output.export.device import NotExported as NotExported
from diffabs.output.export.device import computer_program as computer_program
from diffabs.output.export.difference_equations import difference_equations as difference_equations
from diffabs.output.export.mockup import build_fmu as build_fmu
from diffabs.output.export.sampling import sample_controller as sample_controller
from diffabs.output.export.structured_text import structured_text as structured_text
