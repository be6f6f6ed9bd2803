"""Selection of the engine of a sweep's runs: "auto" becomes "kernel" or "xla" once, before the first chunk.

The manifest records the result, because the last bits of a chunk depend on it. A resumed sweep keeps what its manifest
records.
"""

import dataclasses
import hashlib
import json
import pathlib
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils

from diffabs.compiler import pipeline
from diffabs.simulate.drive.engine import resolve_request
from diffabs.simulate.drive.sharding import describe_placement
from diffabs.sweep.manifest import read_manifest
from diffabs.sweep.runner import find_study_objection
from diffabs.sweep.store import MANIFEST_NAME
from diffabs.sweep.study import Study

REMOTE_REASON = "the workers of a scheduler may have other compilers and processors; a kernel is made on request only"
UNLIKE_REASON = "the processes of the sweep have no kernel of one compiler and processor"


def choose_study_engine(
    study: Study, folder: str | pathlib.Path, *, resume: bool = False, remote: bool = False
) -> tuple[Study, str]:
    """Return the study with engine "xla" or "kernel", and the reason why "auto" became "xla", or "".

    A study that names its engine is returned as it is. "auto" becomes the engine that the manifest in the folder
    records, if the sweep is resumed. Otherwise it becomes a kernel, if one can make the runs. Several processes
    (`jax.distributed`) call this together and choose the same engine.

    Args:
        study: Study to run.
        folder: Folder of the sweep.
        resume: Whether the sweep continues in the folder.
        remote: Whether other machines compute the chunks.

    Raises:
        ValueError: The name of the engine is unknown.
        SweepError: The manifest cannot be read.
    """
    if study.engine != "auto":
        return study, ""
    if resume and (pathlib.Path(folder) / MANIFEST_NAME).exists():
        recorded = read_manifest(pathlib.Path(folder))["study"].get("engine", {"name": "xla"})["name"]
        return dataclasses.replace(study, engine=recorded), ""
    if (meant := resolve_request("auto")) != "auto":
        return dataclasses.replace(study, engine=meant), ""
    by_kernel = dataclasses.replace(study, engine="kernel")
    why = REMOTE_REASON if remote else describe_placement(()) or find_study_objection(by_kernel) or ""
    if jax.process_count() > 1 and not _is_common_kernel(possible=not why):
        why = why or UNLIKE_REASON
    return (dataclasses.replace(study, engine="xla"), why) if why else (by_kernel, "")


def _is_common_kernel(possible: bool) -> bool:
    """Return whether every process of the sweep can make a kernel, all by one compiler for one processor."""
    vote = 0  # of a process without a kernel
    if possible:
        build = json.dumps(pipeline.describe_kernel_build(), sort_keys=True)
        vote = 1 + int(hashlib.sha256(build.encode()).hexdigest()[:7], 16)
    votes: Any = np.asarray(multihost_utils.process_allgather(np.int32(vote)))
    return bool(vote and (votes == vote).all())
