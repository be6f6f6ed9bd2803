"""Selection of the engine of a sweep's runs: "auto" becomes "kernel" or "xla" once, before the first chunk.

The manifest records the result, because the last bits of a chunk depend on it. A resumed sweep keeps what its manifest
records.
"""

import dataclasses
import pathlib

from diffabs.engine.drive.batches import describe_placement
from diffabs.engine.drive.engine import resolve_request
from diffabs.uncertainty.sweep.manifest import read_manifest
from diffabs.uncertainty.sweep.runner import find_study_objection
from diffabs.uncertainty.sweep.seal import SweepError
from diffabs.uncertainty.sweep.store import MANIFEST_NAME
from diffabs.uncertainty.sweep.study import Study

REMOTE_REASON = "the workers of a scheduler may have other compilers and processors; a kernel is made on request only"


def choose_study_engine(
    study: Study, folder: str | pathlib.Path, *, resume: bool = False, remote: bool = False
) -> tuple[Study, str]:
    """Return the study with engine "xla" or "kernel", and the reason why "auto" became "xla", or "".

    A study that names its engine is returned as it is. "auto" becomes the engine that the manifest in the folder
    records, if the sweep is resumed. Otherwise it becomes a kernel, if one can make the runs.

    Raises:
        SweepError: The engine is "kernel", and no kernel can make the runs.
    """
    study, why = _resolve_auto(study, folder, resume, remote)
    if study.engine == "kernel" and (objection := find_study_objection(study)):
        raise SweepError(objection)
    return study, why


def _resolve_auto(study: Study, folder: str | pathlib.Path, resume: bool, remote: bool) -> tuple[Study, str]:
    if study.engine != "auto":
        return study, ""
    if resume and (pathlib.Path(folder) / MANIFEST_NAME).exists():
        recorded = read_manifest(pathlib.Path(folder))["study"].get("engine", {"name": "xla"})["name"]
        return dataclasses.replace(study, engine=recorded), ""
    if (meant := resolve_request("auto")) != "auto":
        return dataclasses.replace(study, engine=meant), ""
    by_kernel = dataclasses.replace(study, engine="kernel")
    why = REMOTE_REASON if remote else describe_placement(()) or find_study_objection(by_kernel) or ""
    return (dataclasses.replace(study, engine="xla"), why) if why else (by_kernel, "")
