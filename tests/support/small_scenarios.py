"""Scenarios that a command can run in a second, as texts of files."""

from sweeping import SCENARIO, rig, tune_section

IDENTIFY = f"""{rig(50.0, 48.0)}
[solver]
step = 1e-3
duration = 0.5
"""
MEASUREMENTS = "t [s],wheel_speed [m/s],slip [1],command [N m]\n0,13.8,0.0,1\n0.1,12.9,0.05,1\n0.3,11.0,0.1,2\n"
SWEEP = f"""title = "small"{rig(30.0, 25.0)}
[sensor]
type = "noise"
slip = 0.005
period = 4e-3
[solver]
step = 2e-3
duration = 0.25
[sweep]
samples = 150
chunk = 64
seed = 3
[sweep.over]
"plant.mass" = {{ low = 5.3, high = 6.2 }}
"initial.speed_kmh" = {{ low = 28.0, high = 34.0 }}
"controller.gain.0" = {{ type = "triangular", low = -5e3, mode = -4e3, high = -3e3 }}
"controller.gain.1" = {{ type = "categorical", choices = [-40.0, 1e308], weights = [0.9, 0.1] }}
[sweep.failures]
overshoot = 0.3
"""
TUNE = f"""title = "small"{rig(50.0, 48.0)}
[solver]
step = 1e-3
duration = 0.15
seed = 3
{tune_section(2, 0.5)}"""
RARE = SCENARIO.replace(
    "{ low = 28.0, high = 34.0 }", "{ type = 'normal', mean = 30.0, deviation = 1.0, low = 26.0, high = 40.0 }"
)
