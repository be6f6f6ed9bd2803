"""Tunings and identifications as sections."""

import pathlib
from collections.abc import Iterator, Mapping
from typing import Any

from diffabs.report import proofs
from diffabs.report.charts import lines
from diffabs.report.documents import Document
from diffabs.report.page import (
    UNKNOWN,
    Figure,
    Section,
    Table,
    Verdict,
    command,
    image,
    listed,
    model_tables,
    origin,
    said,
    unit,
)

NORMAL = 1.959964  # standard deviations on either side of a 95 % interval


def tune(document: Document) -> Section:
    """Return the section of a tuning."""
    content = document.content
    before, after = (content["objective"][when] for when in ("before", "after"))
    limits = [row["name"] for row in content["constraints"]]
    under = f", so that {listed(limits)} keep{'s' if len(limits) == 1 else ''} the bound" if limits else ""
    lanes = f"{content['lanes']} run{'s' if content['lanes'] != 1 else ''}"
    return Section(
        title=f"Tuning of {content['scenario']}",
        question=f"Which values of {listed(content['free'])} make the objective least over {lanes}{under}?",
        answer=[f"The objective went from {before:.6g} to {after:.6g}; it ended because {content['reason']}."],
        verdicts=[_kept(row) for row in content["constraints"]],
        model=model_tables(content.get("model")),
        model_note="Before the tuning." if content.get("model") else UNKNOWN,
        figures=list(_figures(document)),
        tables=list(_tuned(content)),
        certificate=proofs.verdicts(content["certificate"]),
        certificate_tables=proofs.tables(content["certificate"], content),
        notes=["Interrupted: the best so far, not a minimum."] if content.get("interrupted") else [],
        provenance=origin(content, gradients=content["evaluations"], mode=content["mode"], seed=_seed(content),
                          engine=said(content["engine"])),
        again=command(content),
    )  # fmt: skip


def _seed(content: Mapping[str, Any]) -> Any:
    return ((content.get("model") or {}).get("solver") or {}).get("seed")


def _kept(row: Mapping[str, Any]) -> Verdict:
    after = "not known" if row["after"] is None else f"{row['after']:.6g}"
    return Verdict("met" if row["met"] else "not met", f"{row['name']}: {after}, bound {row['bound']:.6g}")


def _figures(document: Document) -> Iterator[Figure]:
    """How the objective fell, and the picture that the command has drawn, where it still is."""
    history = document.content["history"]
    points = [(row["evaluations"], row["objective"]) for row in history]
    if len(points) > 1:
        yield Figure("The objective after so many gradients", drawn=lines(points, "gradients computed", "objective"))
    if plot := document.content["files"].get("plot"):
        for path in (document.folder / pathlib.PurePath(plot).name, pathlib.Path(plot)):
            if found := image(path, "How the tuning went, and its worst run before and after"):
                yield found
                return


def _tuned(content: Mapping[str, Any]) -> Iterator[Table]:
    units = (content.get("model") or {}).get("metrics") or {}
    keys = ("before", "after", "low", "high")
    rows = [[path, *(row[key] for key in keys), unit(row["unit"])] for path, row in content["free"].items()]
    yield Table("Free parameters", ("parameter", *keys, "unit"), rows)
    metrics = [
        [name, *(content["metrics"][when][of][name] for of in ("mean", "worst") for when in ("before", "after")),
         unit(units.get(name))]
        for name in content["metrics"]["before"]["mean"]
    ]  # fmt: skip
    headings = ("metric", "mean before", "mean after", "worst before", "worst after", "unit")
    yield Table(f"Over {content['lanes']} runs", headings, metrics)
    if content["constraints"]:
        keys = ("name", "bound", "before", "after", "met")
        rows = [[row[key] for key in keys] for row in content["constraints"]]
        yield Table("Constraints, worst run or vertex", ("constraint", *keys[1:]), rows)
    starts = [[i, row["objective"], row["violation"], row["reason"]] for i, row in enumerate(content["starts"], 1)]
    yield Table("Starts", ("start", "objective", "violation", "ended because"), starts)


def identify(document: Document) -> Section:
    """Return the section of an identification."""
    content = document.content
    data = content["data"]
    return Section(
        title=f"Identification of {content['scenario']}",
        question=f"Which values of {listed(content['values'])} explain {data['samples']:,} measured instants of"
        f" {listed(data['columns'])} until {data['until']:g} s, and how well do these determine them?",
        answer=[f"chi2 = {content['chi2']:.6g} with {content['degrees']} degrees of freedom; it ended because"
                f" {content['reason']}."],
        verdicts=_determined(content),
        model=model_tables(content.get("model")),
        model_note="Before the identification." if content.get("model") else UNKNOWN,
        tables=list(_identified(content)),
        notes=["Interrupted: the values so far, not the best ones."] if content.get("interrupted") else [],
        provenance=origin(content, evaluations=content["evaluations"]),
        again=command(content),
    )  # fmt: skip


def _determined(content: Mapping[str, Any]) -> list[Verdict]:
    loose = [Verdict("not determined", row["direction"]) for row in content["undetermined"]]
    return loose or [Verdict("determined", "every parameter that was free")]


def _identified(content: Mapping[str, Any]) -> Iterator[Table]:
    rows = []
    for name, row in content["values"].items():
        value, deviation = row["value"], row["deviation"]
        ends = (None, None) if deviation is None else (value - NORMAL * deviation, value + NORMAL * deviation)
        rows.append([name, row["before"], value, deviation, *ends, row["low"], row["high"], unit(row["unit"])])
    headings = ("parameter", "before", "identified", "standard deviation", "low (95 %)", "high (95 %)", "least allowed",
                "greatest allowed", "unit")  # fmt: skip
    yield Table("Parameters", headings, rows, "intervals: of a normal distribution with this standard deviation")
    keys = ("sigma", "rms", "mean", "largest")
    rows = [[name, *(row[key] for key in keys), unit(row["unit"])] for name, row in content["residuals"].items()]
    yield Table("Simulated minus measured", ("column", *keys, "unit"), rows)
    if content["correlations"]:
        rows = [[listed(row["between"]), row["correlation"]] for row in content["correlations"]]
        yield Table("Strong correlations", ("between", "correlation"), rows)
