"""A result as one HTML file that needs nothing else: for colleagues, and for paper. Needs the extra `report`.

documents   what commands wrote, found in a folder or a file
page        what a section of a report consists of
studies, findings, proofs, experiments    a document as a section
writing     sections as HTML, by the template beside it
"""

from diffabs.report.documents import Document as Document
from diffabs.report.documents import ReportError as ReportError
from diffabs.report.documents import find_documents as find_documents
from diffabs.report.writing import build_report as build_report
from diffabs.report.writing import is_report as is_report
