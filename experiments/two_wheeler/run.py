"""A two-wheeler held upright by an arm: tuned weights, output feedback, and a machine designed with its gain.

python experiments/two_wheeler/run.py weights       LQ weights tuned for the region of attraction
python experiments/two_wheeler/run.py lqg           output feedback from two noisy angles
python experiments/two_wheeler/run.py codesign      arm, mount, motor, gear and weights together
"""

from experiments._shared.entry import run_part
from experiments._shared.numbers import store_parts
from experiments.two_wheeler import codesign, lqg, weights

if __name__ == "__main__":
    parts = {"weights": weights.main, "lqg": lqg.main, "codesign": codesign.main}
    run_part(store_parts(__file__, parts))
