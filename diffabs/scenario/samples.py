"""One sample of a sweep, from its folder, as a scenario."""

import dataclasses
import pathlib

import jax
import jax.numpy as jnp

from diffabs.scenario import section_sweep
from diffabs.scenario.scenario import Scenario, loads


def load_sample(folder: pathlib.Path, number: int, where: str = "sample") -> tuple[Scenario, jax.Array]:
    """Return one sample of a sweep as a scenario with the sample's values, and the random key of its noise.

    Args:
        folder: Folder of a sweep of a scenario.
        number: Number of the sample, from 0.
        where: Name of the number, for messages.

    Raises:
        SweepError: The folder is no sweep of a scenario or was changed, or the sample is not in it.
        ScenarioError: The sample was refused.

    See also:
        `simulate`: The run of the sample.
        `sweep.Study.lane`: A sample of a study that comes from no scenario.

    Examples:
        >>> from diffabs.scenario import load_sample, simulate  # doctest: +SKIP
        >>> simulation = simulate(*load_sample(pathlib.Path("out/sweep-slip-lmi"), 4711))  # doctest: +SKIP
    """
    from diffabs.uncertainty.sweep.store import SweepError, check_owner, describe_differences, read_manifest

    folder = pathlib.Path(folder)
    manifest = read_manifest(folder)
    source = manifest["source"]
    if "scenario" not in source:
        raise SweepError(f"{folder} was not swept from a scenario; Study.lane({number}) is this sample")
    scenario = loads(source["scenario"].encode(), source.get("name", ""), f"{folder}", integrated=False)
    study = section_sweep.build_study(scenario)
    swept = {name: value for name, value in manifest["study"].items() if name != "engine"}  # XLA runs single samples
    for line in describe_differences(swept, study.table(), "study"):
        raise SweepError(f"{folder}: the scenario in its manifest is not what was swept: {line}")
    if not 0 <= number < study.samples:
        raise SweepError(f"{where} {number} is outside [0, {study.samples - 1}]")
    check_owner(folder, manifest, number)
    loop, key = study.accepted_lane(number)
    loop = jax.tree.map(lambda x: jnp.asarray(x, study.dtype), loop)
    return dataclasses.replace(scenario, name=f"{scenario.name}, sample {number}", title="", loop=loop), key
