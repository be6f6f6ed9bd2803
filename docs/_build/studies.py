"""A hook of MkDocs: the site has the page of each study, `experiments/STUDY/README.md`, with its figures and documents.

The links of a page are those of the repository. Where one leads from `docs/` to a study or back, the hook writes the
link of the site, in which `docs/` is the top."""

import pathlib
import posixpath
import re
from typing import Any

ROOT = pathlib.Path(__file__).parent.parent.parent
SHOWN = (".md", ".png", ".json")
LINK = re.compile(r"(?<=\]\()[\w./-]+(?=[)#])")


def study_files() -> list[str]:
    """Return what the site shows of the studies, by paths from the root of the repository."""
    return sorted(path.relative_to(ROOT).as_posix() for path in ROOT.glob("experiments/**/*") if path.suffix in SHOWN)


def site_links(markdown: str, uri: str) -> str:
    """Return the page at `uri` of the site with the links of the site."""
    folder = posixpath.dirname(uri if uri.startswith("experiments/") else f"docs/{uri}")

    def site_link(link: re.Match[str]) -> str:
        target = posixpath.normpath(posixpath.join(folder, link[0])).removeprefix("docs/")
        return posixpath.relpath(target, posixpath.dirname(uri) or ".")

    return LINK.sub(site_link, markdown)


def on_files(files: Any, config: Any) -> Any:
    """Return the files of the site with those of the studies."""
    from mkdocs.structure.files import File

    for uri in study_files():
        files.append(File.generated(config, uri, abs_src_path=str(ROOT / uri)))
    return files


def on_page_markdown(markdown: str, page: Any, **rest: Any) -> str:
    """Return the page with the links of the site."""
    del rest
    return site_links(markdown, page.file.src_uri)
