"""Figures of runs, sweeps and tunings. The only importer of matplotlib (the extra `plot`)."""

from diffabs.plot.runs import angle_lines as angle_lines
from diffabs.plot.runs import balance as balance
from diffabs.plot.runs import braking as braking
from diffabs.plot.runs import convergence as convergence
from diffabs.plot.runs import friction as friction
from diffabs.plot.runs import of as of
from diffabs.plot.runs import positions as positions
from diffabs.plot.runs import region as region
from diffabs.plot.runs import signals as signals
from diffabs.plot.runs import slip_lines as slip_lines
from diffabs.plot.runs import slips as slips
from diffabs.plot.runs import speeds as speeds
from diffabs.plot.style import COLOURS as COLOURS
from diffabs.plot.style import DASHES as DASHES
from diffabs.plot.style import DPI as DPI
from diffabs.plot.style import GREY as GREY
from diffabs.plot.style import KMH as KMH
from diffabs.plot.style import TITLE as TITLE
from diffabs.plot.style import controlled as controlled
from diffabs.plot.style import label as label
from diffabs.plot.style import logarithmic as logarithmic
from diffabs.plot.style import named as named
from diffabs.plot.style import save as save
from diffabs.plot.style import sheet as sheet
