"""Reports: results as one self-contained HTML file, for colleagues and for printing. Needs the extra `report`.

- `documents`: documents of commands, found in a folder or a file
- `page`: contents of a section, as plain data
- `studies`, `findings`, `proofs`, `experiments`, `assessments`: a document as a section
- `writing`: sections as HTML, by the template beside it
"""

from diffabs.output.report.documents import Document as Document
from diffabs.output.report.documents import ReportError as ReportError
from diffabs.output.report.documents import find_documents as find_documents
from diffabs.output.report.writing import build_report as build_report
from diffabs.output.report.writing import is_report as is_report
from diffabs.output.report.writing import write_report as write_report
