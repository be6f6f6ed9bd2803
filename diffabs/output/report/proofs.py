"""Designs, certificates with their claims, and proofs over a box as sections of a report."""

import shlex

from diffabs.core.types import Table
from diffabs.output.report.documents import Document, ReportError
from diffabs.output.report.page import (
    VERDICT_NAMES,
    ReportTable,
    ReportVerdict,
    Section,
    describe_missing,
    describe_origin,
    embed_named,
    format_known,
    join_words,
    model_tables,
    table_unit,
)
from diffabs.robust.design.verify import verify_file

PROOF_UNITS = {
    "decay_rate": "1/s",
    "damping": "1",
    "trace_cost": "1",
    "guaranteed_cost": "1",
    "lower_bound": "1",
    "gap": "1",
}


def design_section(document: Document) -> Section:
    """Return the section of a design, or of the certificate of a given gain."""
    content = document.content
    units = content.get("units") or {}
    ranges = join_words(
        f"{path} {low:.6g} to {high:.6g}{_unit(units.get(path))}" for path, (low, high) in content["over"].items()
    )
    designed = content["lower_bound"] is not None
    question = "What is proved of the state feedback u = K x"
    if designed:
        question = "Which state feedback u = K x costs least by one P for all specifications, and what is proved of it"
    return Section(
        title=f"{'Design for' if designed else 'Certificate of a gain of'} {content['scenario']}",
        question=f"{question}, over {ranges}?",
        answer=[content["reason"]] if content["reason"] else [],
        model=model_tables(content["model"]),
        tables=[ReportTable("Gain", ("state", "gain"), [*zip(content["states"], content["gain"] or (), strict=False)])],
        certificate=proof_verdicts(content),
        certificate_tables=proof_tables(content, content),
        notes=_notes(content),
        provenance=describe_origin(content),
        command=content["made"]["command"],
        again=list(map(_verify_command, content["files"].values())),
    )  # fmt: skip


def proof_verdicts(proof: Table) -> list[ReportVerdict]:
    """Return a certificate's verdicts (proved, disproved or undecided), or one with the reason why there is none."""
    if proof.get("gain") is None:
        return [ReportVerdict("no certificate", proof.get("reason") or "none is required")]
    exactly = ", verified in exact arithmetic" if proof["verified_exactly"] else ""
    stable = proof["quadratically_stable"]
    about = (
        f"one Lyapunov matrix for all {proof['vertices']} vertices, for parameters that vary arbitrarily fast{exactly}"
    )
    verdicts = [ReportVerdict(VERDICT_NAMES[stable], about)]
    for claim in proof["claims"] or []:
        kind = claim["kind"]
        verdicts.append(ReportVerdict("proved" if claim["proved"] else "not proved", f"{kind}{_value(kind, proof)}"))
    if proof.get("reason"):
        verdicts.append(ReportVerdict("note", proof["reason"]))
    return verdicts


def _verify_command(path: object) -> str:
    """Return the command that verifies a file; a document may give the file a name that looks like an option."""
    path = f"./{path}" if str(path).startswith("-") else str(path)
    return shlex.join(["diffabs", "verify", path])


def _value(kind: str, proof: Table) -> str:
    key = {"decay": "decay_rate", "cost": "guaranteed_cost"}.get(kind, kind)
    value = proof.get(key)
    return "" if value is None else f": {value:.8g}{_unit(PROOF_UNITS.get(key))}"


def _unit(text: str | None) -> str:
    return "" if text in (None, "", "1") else f" {text}"


def proof_tables(proof: Table, content: Table) -> list[ReportTable]:
    """Return tables of the numbers of a certificate, and of its vertices with their poles."""
    if proof.get("gain") is None:
        return []
    units = proof.get("units") or content.get("units") or {}
    numbers = [
        [name.replace("_", " "), proof[name], of] for name, of in PROOF_UNITS.items() if proof.get(name) is not None
    ]
    poles = proof["poles"] or []
    corners = proof["corners"] or [{} for _ in poles]
    names = list(corners[0]) if corners else []
    pole = "slowest pole, real part [1/s]" if proof["period"] is None else "largest |pole| [1]"
    rows = [
        [i, *(corner.get(name) for name in names), pole_value]
        for i, (corner, pole_value) in enumerate(zip(corners, poles, strict=False))
    ]
    heads = [f"{name} [{table_unit(units[name])}]" if name in units else name for name in names]
    return [ReportTable("Numbers of the certificate", ("quantity", "value", "unit"), numbers),
            ReportTable(f"{proof['vertices']} vertices", ("vertex", *heads, pole), rows)]  # fmt: skip


def _notes(content: Table) -> list[str]:
    notes = [f"Neglected: {line}" for line in content["neglected"]]
    if not content["exact"]:
        notes.append("The linear model differs from the loop's linearisation; the proof is about the model.")
    return notes


def certificate_section(document: Document) -> Section:
    """Return the section of a saved certificate, read again, whose claims are proved again."""
    content = document.content
    try:
        proved = verify_file(document.path)
    except ValueError as error:
        raise ReportError(str(error)) from None
    system = content["system"]
    corners = system.get("corners") or []
    names = list(corners[0]) if corners else []
    states = system.get("states") or []
    return Section(
        title=f"Certificate {document.path.name}",
        question="Does the saved certificate prove what it claims? It is proved again, in fractions, by code that"
        " is independent of the code that made it.",
        answer=[f"{sum(not claim.reason for claim in proved)} of {len(proved)} claims are proved."],
        model=[
            ReportTable("Vertices", ("vertex", *names), [[i, *row.values()] for i, row in enumerate(corners)], "in SI")
        ],
        tables=[ReportTable("Gain", tuple(states), content["gain"])],
        certificate=[ReportVerdict("not proved" if claim.reason else "proved",
                             f"{claim.kind}: {claim.says}{claim.reason and f' ({claim.reason})'}") for claim in proved],
        provenance=describe_origin(content),
        again=[_verify_command(document.path)],
    )  # fmt: skip


def box_section(document: Document) -> Section:
    """Return the section of a proof over a box of parameters."""
    content = document.content
    verdict, claims = content["verdict"], [_describe_claim(claim) for claim in content["claims"]]
    units = {path: row["unit"] for path, row in content["model"]["parameters"].items()}
    ranges = join_words(
        f"{path} from {low:.6g} to {high:.6g}{_unit(units.get(path))}" for path, (low, high) in content["over"].items()
    )
    question = f"Does every run satisfy {join_words(claims)}" if claims else "Which bounds hold for every run"
    files = content.get("files") or {}
    sides = [[path, *ends, table_unit(units.get(path))] for path, ends in content["over"].items()]
    keys = ("low", "high", "worst_run", "looseness", "unit")
    bounds = [[name, *(row.get(key) for key in keys)] for name, row in content["bounds"].items()]
    cells = [["proved", content["cells"]], ["left", content["left"]], ["tried", content["tried"]],
             ["share of the box that is left [1]", content["share_left"]],
             ["computing time [s]", content["seconds"]]]  # fmt: skip
    figures = list(filter(None, [embed_named(document.folder, files.get("plot"), "The cells of the proof")]))
    return Section(
        title=f"Proof over a box of {content['scenario']}",
        question=f"{question}, for every {ranges}?",
        answer=[f"{verdict}: {content['reason']}." if content["reason"] else f"{verdict}."],
        verdicts=[ReportVerdict(verdict, claim) for claim in claims] or [ReportVerdict(verdict, "the bounds below")],
        model=model_tables(content["model"]),
        model_note="The values of the box's parameters stand for nothing: the proof is about all of the box.",
        figures=figures,
        figures_note=describe_missing(figures, files.get("plot")),
        tables=[
            ReportTable("Box", ("parameter", "low", "high", "unit"), sides, "in SI; the ends belong to the box"),
            ReportTable(
                "Bounds of every run",
                ("quantity", "proved from", "to", "worst run found", "looseness", "unit"),
                bounds,
                "an empty cell: nothing is proved",
            ),
            ReportTable("Cells", ("cells", "number"), cells),
        ],
        notes=["The runs are those of the model in real numbers, without the rounding of the simulation."],
        provenance=describe_origin(content),
        command=content["made"]["command"],
        again=[_verify_command(files["certificate"])] if verdict == "proved" and "certificate" in files else [],
    )


def _describe_claim(claim: Table) -> str:
    relation = ">=" if claim["quantity"].startswith("least") else "<="
    return f"{claim['quantity'].replace('_', ' ')} {relation} {format_known(claim['bound'])}"
