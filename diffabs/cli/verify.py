"""The command `verify`: a saved certificate, proved again by code that did not make it."""

import math
import pathlib
from typing import Annotated

import typer

from diffabs.cli import console, show, show_proofs
from diffabs.host import documents, provenance
from diffabs.host.process import core_count


def verify_certificate(
    file: Annotated[
        pathlib.Path, typer.Argument(metavar="FILE.json", help="Certificate written by design, certify or prove.")
    ],
    seconds: Annotated[
        float,
        typer.Option(help="Of a file of design or certify: limit of the computing time [s]; then not proved."),
    ] = 6.0,
    share: Annotated[
        float | None,
        typer.Option(
            help="Of a file of prove or certify --sensitivity: share of its cells to check, drawn at random.  "
            "[default: 0.01 of prove, else 1]"
        ),
    ] = None,
    as_json: console.Json = False,
) -> None:
    """Prove a saved certificate again: of design and certify in exact fractions, of prove and
    certify --sensitivity in Arb's balls.

    The code is independent of the code that made the certificate.
    Exit status: 0 proved, or not refuted where --share leaves cells unchecked; 1 not proved, 2 no certificate."""
    from diffabs.scenario.proofs import verify

    with console.end_on_errors():
        if not 0 < seconds < math.inf:
            console.fail(f"--seconds = {seconds:g} is outside (0, inf) s")
        if share is not None and not 0 < share <= 1:
            console.fail(f"--share = {share:g} is outside (0, 1]")
        try:
            verification = console.run_with_lines(
                lambda tell: verify(file, share=share, seconds=seconds, progress=tell, processes=core_count()),
                f"verifying {file}",
            )
        except ModuleNotFoundError:
            console.need_extra("proof")
            raise
        except ValueError as error:
            console.fail(f"{file}: {' '.join(str(error).split())}")
        versions = provenance.versions(*(["numpy"] if verification.scenario else []))
        result = {"file": str(file), **verification.record(), "versions": versions}
        show.show_verification(documents.stamp("verification", result), as_json)
        if verification.reason:
            console.conclude(f"{file}: not proved: {verification.reason}")
        if verification.scenario and not as_json:
            box_words = show_proofs.describe_box(verification.over, verification.scenario, digits=9)
            where = "" if verification.complete else "in the cells proved again only: "
            console.say(f"{where}for every {box_words} of the scenario in the file, whatever its title says")
