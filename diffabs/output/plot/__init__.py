"""Figures of runs, sweeps and tunings. Only this package imports matplotlib (the extra `plot`)."""

from diffabs.output.plot.measured import MeasuredPanel as MeasuredPanel
from diffabs.output.plot.measured import draw_measured as draw_measured
from diffabs.output.plot.runs import draw_angle_lines as draw_angle_lines
from diffabs.output.plot.runs import draw_balance as draw_balance
from diffabs.output.plot.runs import draw_braking as draw_braking
from diffabs.output.plot.runs import draw_convergence as draw_convergence
from diffabs.output.plot.runs import draw_friction as draw_friction
from diffabs.output.plot.runs import draw_positions as draw_positions
from diffabs.output.plot.runs import draw_run as draw_run
from diffabs.output.plot.runs import draw_signals as draw_signals
from diffabs.output.plot.runs import draw_slip_lines as draw_slip_lines
from diffabs.output.plot.runs import draw_slips as draw_slips
from diffabs.output.plot.runs import draw_speeds as draw_speeds
from diffabs.output.plot.runs import shade_region as shade_region
from diffabs.output.plot.style import COLOURS as COLOURS
from diffabs.output.plot.style import DASHES as DASHES
from diffabs.output.plot.style import GREY as GREY
from diffabs.output.plot.style import KMH as KMH
from diffabs.output.plot.style import control_label as control_label
from diffabs.output.plot.style import label_axes as label_axes
from diffabs.output.plot.style import make_logarithmic as make_logarithmic
from diffabs.output.plot.style import save_figure as save_figure
from diffabs.output.plot.style import sheet as sheet
from diffabs.output.plot.style import signal_label as signal_label
