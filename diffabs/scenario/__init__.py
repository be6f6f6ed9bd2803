"""Scenarios: TOML files to loops and tasks, and back.

Exports `load`, `loads`, `dump`, `names`, `Scenario`, `ScenarioError`; a run by `simulate`, and a sample of a sweep by
`load_sample`; proofs from the loop to the file and back: `prove_box`, `prove_frequency`, `verify`,
`Proof`, `FrequencyProof` and `Verification`.
"""

from typing import TYPE_CHECKING

from diffabs.host.exports import lazy_getattr

if TYPE_CHECKING:
    from diffabs.scenario.frequency_proofs import FrequencyProof as FrequencyProof
    from diffabs.scenario.frequency_proofs import prove_frequency as prove_frequency
    from diffabs.scenario.proofs import Proof as Proof
    from diffabs.scenario.proofs import Verification as Verification
    from diffabs.scenario.proofs import prove_box as prove_box
    from diffabs.scenario.proofs import verify as verify
    from diffabs.scenario.samples import load_sample as load_sample
    from diffabs.scenario.scenario import Scenario as Scenario
    from diffabs.scenario.scenario import ScenarioError as ScenarioError
    from diffabs.scenario.scenario import dump as dump
    from diffabs.scenario.scenario import load as load
    from diffabs.scenario.scenario import loads as loads
    from diffabs.scenario.scenario import names as names
    from diffabs.scenario.simulation import Simulation as Simulation
    from diffabs.scenario.simulation import simulate as simulate

__getattr__ = lazy_getattr(__name__)
