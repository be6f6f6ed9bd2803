"""What Aoki and Nakamura leave for later: their slip estimator on a computer, with noise, and where the road changes.

python experiments/slip_estimator/run.py sampled            a controller at 1 kHz, with computing delay
python experiments/slip_estimator/run.py noise              an accelerometer with noise and bias
python experiments/slip_estimator/run.py changing-road      an edge to another surface
"""

from experiments._shared.entry import run_part
from experiments._shared.numbers import store_parts
from experiments.slip_estimator import changing_road, noise, sampled

if __name__ == "__main__":
    parts = {"sampled": sampled.main, "noise": noise.main, "changing-road": changing_road.main}
    run_part(store_parts(__file__, parts))
